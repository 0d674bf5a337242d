"""What the meters look at: a few columns of each data frame of one stream, in order of arrival."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.constants import Stat

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """N data frames of one stream, in order of arrival. A slot is the number of a reporting instant since 1970."""

    slot: Ints
    off_grid_ns: Ints
    """(N,) distance of the stamp from its slot's instant."""
    time_ns: Ints
    arrival_ns: Ints
    """(N,) :data:`~pmutools.c37118.batch.NO_TIME` where nobody saw it."""
    delay_ns: Ints
    """(N,) arrival less stamp; NO_TIME where there is no arrival."""
    synchronised: Flags
    """(N,) MSG_TQ says locked, and no station's STAT says not synchronised, or unlocked for 10 s or longer."""
    stamp_source: npt.NDArray[np.uint8]
    """(N,) index into :data:`~pmutools.c37118.batch.STAMP_SOURCES`."""
    mark: npt.NDArray[np.uint32]
    """(N,) equal for equal frames: what tells a duplicate from a second frame of the same stamp."""

    def __len__(self) -> int:
        return len(self.slot)

    def __getitem__(self, rows: slice | Flags) -> Frames:
        return Frames(*(getattr(self, item.name)[rows] for item in fields(self)))


def joined(parts: Sequence[Frames]) -> Frames:
    """One after the other."""
    if len(parts) == 1:
        return parts[0]
    return Frames(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(Frames)))


_UNLOCKED = 0x0030


def frames_of(batch: Batch, stat: npt.NDArray[np.uint16], rate: Fraction, counted: int = 0) -> Frames:
    """The columns of a batch, ``stat`` as of :func:`any_station`.

    Without a rate every frame has a slot of its own, from ``counted`` up: none is missed.
    """
    if rate:
        slot = timebase.slots_array(batch.time_ns, rate)
        off_grid = timebase.grid_offset_array(batch.time_ns, rate)
    else:
        slot = np.arange(counted, counted + len(batch))
        off_grid = np.zeros(len(batch), np.int64)
    delay = batch.arrival_ns - batch.time_ns
    if (unknown := batch.arrival_ns == NO_TIME).any():
        delay[unknown] = NO_TIME
    synchronised = (batch.time_quality & 0xF == 0) & (stat & np.uint16(Stat.NOT_SYNCHRONISED | _UNLOCKED) == 0)
    return Frames(
        slot, off_grid, batch.time_ns, batch.arrival_ns, delay, synchronised, batch.stamp_source, _marks(batch)
    )


def any_station(stat: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """(N,) the bits that any of the stations (N, S) sets."""
    found = np.zeros(len(stat), np.uint16)
    for number in range(stat.shape[1]):  # ten times faster than to reduce along the short axis
        found |= stat[:, number]
    return found


def _marks(batch: Batch) -> npt.NDArray[np.uint32]:
    """CHK of the frames where there are any (frames that differ share it once in 65,536), else one of the values."""
    if batch.wire is not None:
        chk: npt.NDArray[np.uint32] = batch.wire["chk"].astype(np.uint32)
        return chk
    mixed = np.bitwise_or.reduce(batch.stat, axis=1).astype(np.uint64)
    for column in (batch.frequency, batch.rocof, batch.phasors.view(np.float64), batch.analogs):
        if column.size:
            for number in range(column.shape[1]):
                mixed = mixed * np.uint64(0x9E3779B97F4A7C15) ^ np.ascontiguousarray(column[:, number]).view(np.uint64)
    folded: npt.NDArray[np.uint32] = (mixed >> np.uint64(32)).astype(np.uint32) ^ mixed.astype(np.uint32)
    return folded
