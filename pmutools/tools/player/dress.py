"""From rows of a reel to the bytes that are sent: new stamps, IDCODEs and CHK, a column at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.checksum import seal_array
from pmutools.tools.player.cast import Cast
from pmutools.tools.player.reel import I64
from pmutools.tools.player.stamps import SOC, gathered, write_idcodes, write_stamps


class Dressed(NamedTuple):
    """N frames in ``wire``, of ``nbytes`` each, from ``at`` on."""

    wire: npt.NDArray[np.uint8]
    at: I64
    nbytes: I64


def dress(
    cast: Cast, rows: I64, parts: npt.NDArray[np.int32], stamps_ns: I64 | None, *, whole_seconds: bool
) -> Dressed:
    """Frames of ``rows`` as ``parts`` send them at ``stamps_ns`` (POSIX UTC; None: as recorded).

    ``whole_seconds``: stamps differ from those recorded by whole seconds, so FRACSEC stays as it is, bit for bit.
    """
    reel = cast.reel
    edition = reel.rows.edition[rows]
    nbytes, at = reel.sizes[edition], reel.rows.at[rows]
    starts = np.cumsum(nbytes) - nbytes
    sizes = np.unique(nbytes) if nbytes.min() != nbytes.max() else nbytes[:1]
    wire = np.empty(int(nbytes.sum()) if len(sizes) > 1 else 0, np.uint8)
    for size in sizes:
        chosen = np.flatnonzero(nbytes == size) if len(sizes) > 1 else slice(None)
        frames = gathered(reel.wire, at[chosen], int(size))
        if stamps_ns is not None:
            stamps = stamps_ns[chosen]
            if whole_seconds:
                moved = (stamps - reel.rows.source_ns[rows[chosen]]) // timebase.NS
                soc = frames[:, SOC].copy().view(">u4")[:, 0].astype(np.int64) + moved
                write_stamps(frames, soc, None)
            else:
                write_stamps(frames, *timebase.from_ns_array(stamps, reel.time_bases[edition[chosen]]))
        if cast.emulated:
            _alter(cast, frames, rows[chosen], parts[chosen], None if stamps_ns is None else stamps_ns[chosen])
            write_idcodes(frames, cast.idcodes[parts[chosen]])
        if cast.emulated or stamps_ns is not None:
            seal_array(frames)
        if len(sizes) == 1:
            return Dressed(frames.reshape(-1), starts, nbytes)
        places = starts[chosen, None] + np.arange(size)
        wire[places] = frames
    return Dressed(wire, starts, nbytes)


def _alter(
    cast: Cast, frames: npt.NDArray[np.uint8], rows: I64, parts: npt.NDArray[np.int32], stamps_ns: I64 | None
) -> None:
    """Put the values of parts that differ from their track's into ``frames``."""
    altered = np.flatnonzero(cast.altered[parts])
    if not len(altered):
        return
    editions = cast.reel.rows.edition[rows]
    for edition in np.unique(editions[altered]):
        chosen = altered[editions[altered] == edition]
        config = cast.reel.editions[edition]
        stamps = cast.reel.rows.stamp_ns[rows[chosen]] if stamps_ns is None else stamps_ns[chosen]
        fresh = cast.alter(frames[chosen].tobytes(), config, parts[chosen], stamps)
        frames[chosen] = np.frombuffer(fresh, np.uint8).reshape(len(chosen), -1)
