"""StreamReader, ``pmu read``: live streams into recordings.

::

    LiveSource.rounds() -> read: counts, observers -> Recorder
                                                      Log      one recording
                                                      Rolling  numbered recordings, one after the other
                                                      Ring     a history; a recording around each trigger

A round is what came within some part of a second, a block a stream; a recorder is given one round after the other.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pmutools.tools.reader.reading import Reading as Reading
    from pmutools.tools.reader.run import read as read

_HOMES = {"Reading": "reading", "read": "run"}
__all__ = ["Reading", "read"]


def __getattr__(name: str) -> object:
    """Imported when asked for: they bring numpy, and options are read and sockets bound before that."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
