"""What the meters look at: a few columns of each data frame of one stream, in order of arrival."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.constants import Stat

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class Gist(NamedTuple):
    """What of N data frames is measured, before anything is computed: some 30 bytes a frame."""

    time_ns: Ints
    arrival_ns: Ints
    stamp_source: npt.NDArray[np.uint8]
    time_quality: npt.NDArray[np.uint8]
    stat: npt.NDArray[np.uint16]
    """(N, S)."""
    valid: Flags
    """(N,) at all stations."""
    absent: Flags | None
    """(N,) some frequency or phasor is NaN; None: none is."""
    mark: npt.NDArray[np.uint32]
    """(N,) equal for equal frames: what tells a duplicate from a second frame of the same stamp."""

    @property
    def frames(self) -> int:
        return len(self.time_ns)


def gist_of(batch: Batch) -> Gist:
    """The columns of a batch, most of them shared with it; its values and its wire are let go."""
    absent: Flags | None = None
    valid: Flags = batch.valid[:, 0] if batch.valid.shape[1] == 1 else np.logical_and.reduce(batch.valid, axis=1)
    if _holds_nan(batch.frequency) or _holds_nan(batch.phasors):
        absent = np.logical_or(np.isnan(batch.frequency).any(1), np.isnan(batch.phasors).any(1))
    return Gist(
        batch.time_ns,
        batch.arrival_ns,
        batch.stamp_source,
        batch.time_quality,
        batch.stat,
        valid,
        absent,
        _marks(batch),
    )


def _holds_nan(values: npt.NDArray[np.inexact[Any]]) -> bool:
    """Whether there is a NaN, most likely: infinities of both signs look like one."""
    total = np.add.reduce(values, axis=None)
    return bool(total != total)


def gathered(parts: Sequence[Gist]) -> Gist:
    """One after the other; of the same number of stations."""
    if len(parts) == 1:
        return parts[0]
    absent = None
    if any(part.absent is not None for part in parts):
        absent = np.concatenate(
            [np.zeros(part.frames, np.bool_) if part.absent is None else part.absent for part in parts]
        )
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in Gist._fields if name != "absent"
    }
    return Gist(absent=absent, **columns)


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
    stat: npt.NDArray[np.uint16]
    """(N,) the bits that any of the stations sets."""
    mark: npt.NDArray[np.uint32]
    """(N,) as of :class:`Gist`."""

    def __len__(self) -> int:
        return len(self.slot)

    def __getitem__(self, rows: slice | Flags) -> Frames:
        return Frames(*(getattr(self, name)[rows] for name in _FRAMES))


def joined(parts: Sequence[Frames]) -> Frames:
    """One after the other."""
    if len(parts) == 1:
        return parts[0]
    return Frames(*(np.concatenate([getattr(part, name) for part in parts]) for name in _FRAMES))


_FRAMES = tuple(item.name for item in fields(Frames))
_UNLOCKED = 0x0030


def are_synchronised(time_quality: npt.NDArray[np.uint8], stat: npt.NDArray[np.uint16]) -> Flags:
    """(N,) MSG_TQ says locked, and STAT (N,) neither not synchronised nor unlocked for 10 s or longer."""
    found: Flags = (time_quality & 0xF == 0) & (stat & np.uint16(Stat.NOT_SYNCHRONISED | _UNLOCKED) == 0)
    return found


def frames_of(gist: Gist, rate: Fraction, counted: int = 0) -> Frames:
    """What the meters look at of a gist.

    Without a rate every frame has a slot of its own, from ``counted`` up: none is missed.
    """
    if rate:
        slot = timebase.slots_array(gist.time_ns, rate)
        off_grid = timebase.grid_offset_array(gist.time_ns, rate)
    else:
        slot = np.arange(counted, counted + gist.frames)
        off_grid = np.zeros(gist.frames, np.int64)
    delay = gist.arrival_ns - gist.time_ns
    if (unknown := gist.arrival_ns == NO_TIME).any():
        delay[unknown] = NO_TIME
    stat = any_station(gist.stat)
    synchronised = are_synchronised(gist.time_quality, stat)
    return Frames(
        slot, off_grid, gist.time_ns, gist.arrival_ns, delay, synchronised, gist.stamp_source, stat, gist.mark
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
