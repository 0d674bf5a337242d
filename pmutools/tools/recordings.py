"""One or several recordings as one source, and what of them could not be read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pmutools.formats import open_source
from pmutools.formats.source import Source


def open_recordings(
    paths: Sequence[str | Path], *, data_rate: int | None = None, fnom_hz: float | None = None
) -> Source:
    """The recordings merged on time; arguments, SourceError and SettingsError as of :func:`open_source`."""
    sources = [open_source(path, data_rate=data_rate, fnom_hz=fnom_hz) for path in paths]
    if len(sources) == 1:
        return sources[0]
    from pmutools.formats.folder import MergedSource

    return MergedSource(Path(f"{len(sources)} recordings"), "several", sources)


def losses(source: Source) -> dict[str, int]:
    """What a source that has been read to its end held beside frames, by name: bytes skipped, container defects."""
    return {f"bytes skipped, {reason}": nbytes for reason, nbytes in source.tally.skipped.items()} | source.defects()
