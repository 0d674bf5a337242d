"""pmutools: play, read, convert and characterize IEEE C37.118 PMU streams.

The package is layered; an import goes to a lower layer only (``tests/test_layers.py`` holds it):
ground floor -> ``c37118`` -> ``formats``, ``impair``, ``net``, ``grid``, ``modal`` -> ``tools`` -> ``stream``, ``cli``.

What most programs need is here, imported when it is asked for: :func:`open_stream` for live streams and recordings,
:func:`open_source` and :func:`open_sink` for files, :func:`load_sites` for an initialisation file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pmutools.errors import PmuError as PmuError
    from pmutools.errors import SettingsError as SettingsError
    from pmutools.errors import SourceError as SourceError
    from pmutools.errors import StreamTimeout as StreamTimeout
    from pmutools.formats import open_sink as open_sink
    from pmutools.formats import open_source as open_source
    from pmutools.sites import Site as Site
    from pmutools.sites import load_sites as load_sites
    from pmutools.stream import StationValues as StationValues
    from pmutools.stream import Stream as Stream
    from pmutools.stream import StreamBatch as StreamBatch
    from pmutools.stream import StreamFrame as StreamFrame
    from pmutools.stream import open_stream as open_stream

__version__ = "0.1.0"

_HOMES = {
    "PmuError": "pmutools.errors",
    "SettingsError": "pmutools.errors",
    "Site": "pmutools.sites",
    "SourceError": "pmutools.errors",
    "StationValues": "pmutools.stream",
    "Stream": "pmutools.stream",
    "StreamBatch": "pmutools.stream",
    "StreamFrame": "pmutools.stream",
    "StreamTimeout": "pmutools.errors",
    "load_sites": "pmutools.sites",
    "open_sink": "pmutools.formats",
    "open_source": "pmutools.formats",
    "open_stream": "pmutools.stream",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> object:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'pmutools' has no attribute {name!r}")
    value: object = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
