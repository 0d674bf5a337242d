"""A stream's course over the run: what came, how late, what was lost, bucket by bucket, in constant memory.

When the run outgrows the buckets, neighbours are merged and each is twice as wide; so an hour has as many as a minute.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.constants import STAT_DATA_ERROR_MASK, Stat
from pmutools.measure.columns import Ints
from pmutools.measure.stream import STATES, Seen, State

BUCKETS = 1024
FIRST_WIDTH_NS = timebase.NS // 10
_LATE, _DUPLICATE, _CONFLICTING = map(STATES.index, (State.LATE, State.DUPLICATE, State.CONFLICTING))
_NEVER = np.iinfo(np.int64).max
_SUMS = ("frames", "total_ns", "delayed", "late", "lost", "duplicated", "unsynchronised", "unusable")


@dataclass(frozen=True)
class Course:
    """Buckets (N,) of equal width from ``start_ns`` (UTC of arrival) on; those without frames are among them."""

    start_ns: int
    width_ns: int
    frames: Ints
    """Arrivals, copies among them."""
    least_ns: Ints
    """Delay; where ``delayed`` is 0 it means nothing, as do the next two."""
    total_ns: Ints
    most_ns: Ints
    delayed: Ints
    """Unique frames with a delay."""
    late: Ints
    lost: Ints
    """Slots whose frame was due in this bucket and never came."""
    duplicated: Ints
    unsynchronised: Ints
    unusable: Ints
    """Frames that STAT calls invalid."""

    @property
    def time_ns(self) -> Ints:
        """(N,) the middle of each bucket."""
        middle: Ints = self.start_ns + self.width_ns // 2 + np.arange(len(self.frames)) * self.width_ns
        return middle


class Timeline:
    """Takes what a :class:`~pmutools.measure.stream.StreamMeter` has seen."""

    def __init__(self, buckets: int = BUCKETS, first_width_ns: int = FIRST_WIDTH_NS) -> None:
        """``buckets`` is even."""
        self._buckets, self._width_ns = buckets, first_width_ns
        self._start_ns: int | None = None
        self._sums = {name: np.zeros(buckets, np.int64) for name in _SUMS}
        self._least, self._most = np.full(buckets, _NEVER), np.full(buckets, NO_TIME)
        self._lag_ns = 0
        """Arrival less stamp of the last frame: when a lost one would have come."""

    def add(self, seen: Seen) -> None:
        """What became of frames, in order of arrival, and of the lost."""
        if len(seen.slot):
            self._add_frames(seen)
        if len(seen.lost) and seen.rate:
            due = timebase.slot_times_array(seen.lost, seen.rate) + self._lag_ns
            self._count("lost", self._place(due))

    def _add_frames(self, seen: Seen) -> None:
        unknown = seen.arrival_ns == NO_TIME
        at = self._place(np.where(unknown, seen.time_ns, seen.arrival_ns))
        state = seen.state
        self._count("frames", at)
        for name, hit in (
            ("unsynchronised", seen.stat & np.uint16(Stat.NOT_SYNCHRONISED) != 0),
            ("unusable", seen.stat & np.uint16(STAT_DATA_ERROR_MASK) != 0),
            ("late", state == _LATE),
            ("duplicated", (state == _DUPLICATE) | (state == _CONFLICTING)),
        ):
            if hit.any():
                self._count(name, at[hit])
        first = (state <= _LATE) & ~unknown
        delay = seen.delay_ns
        if not first.all():
            at, delay = at[first], delay[first]
        if len(delay):
            self._lag_ns = int(delay[-1])
            self._count("delayed", at)
            np.add.at(self._sums["total_ns"], at, delay)
            np.minimum.at(self._least, at, delay)
            np.maximum.at(self._most, at, delay)

    def course(self) -> Course | None:
        """All so far; None where nothing was."""
        if self._start_ns is None:
            return None
        used = np.flatnonzero(self._sums["frames"] + self._sums["lost"] + self._sums["delayed"])
        end = int(used[-1]) + 1 if used.size else 0
        sums = {name: column[:end].copy() for name, column in self._sums.items()}
        return Course(self._start_ns, self._width_ns, least_ns=self._least[:end], most_ns=self._most[:end], **sums)

    def _count(self, name: str, at: npt.NDArray[np.intp]) -> None:
        low = int(at.min())
        counts = np.bincount(at - low)
        self._sums[name][low : low + len(counts)] += counts

    def _place(self, times: Ints) -> npt.NDArray[np.intp]:
        """Buckets of UTC times; what lies before the first goes to the first (a clock that was set back)."""
        if self._start_ns is None:
            self._start_ns = int(times[0]) // self._width_ns * self._width_ns
        newest = int(times.max())
        while newest - self._start_ns >= self._buckets * self._width_ns:
            self._widen()
        return np.clip((times - self._start_ns) // self._width_ns, 0, self._buckets - 1).astype(np.intp)

    def _widen(self) -> None:
        half = self._buckets // 2
        for column in self._sums.values():
            column[:half], column[half:] = column.reshape(half, 2).sum(1), 0
        self._least[:half], self._least[half:] = self._least.reshape(half, 2).min(1), _NEVER
        self._most[:half], self._most[half:] = self._most.reshape(half, 2).max(1), NO_TIME
        self._width_ns *= 2
