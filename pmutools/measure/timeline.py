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
        came = np.where(seen.arrival_ns == NO_TIME, seen.time_ns, seen.arrival_ns)
        if len(came):
            at = self._place(came)
            self._count("frames", at)
            for name, bits in (("unsynchronised", int(Stat.NOT_SYNCHRONISED)), ("unusable", STAT_DATA_ERROR_MASK)):
                hit = seen.stat & np.uint16(bits) != 0
                if hit.any():
                    self._count(name, at[hit])
        known = (seen.arrival_ns != NO_TIME) & (seen.state <= STATES.index(State.LATE))
        if known.any():
            delay = seen.delay_ns[known]
            at = self._place(seen.arrival_ns[known])
            self._lag_ns = int(delay[-1])
            self._count("delayed", at)
            self._sums["total_ns"] += np.bincount(at, delay, self._buckets).astype(np.int64)
            np.minimum.at(self._least, at, delay)
            np.maximum.at(self._most, at, delay)
        for name, states in (("late", (State.LATE,)), ("duplicated", (State.DUPLICATE, State.CONFLICTING))):
            hit = np.isin(seen.state, [STATES.index(state) for state in states])
            if hit.any():
                self._count(name, self._place(came[hit]))
        if len(seen.lost) and seen.rate:
            due = timebase.slot_times_array(seen.lost, seen.rate) + self._lag_ns
            self._count("lost", self._place(due))

    def course(self) -> Course | None:
        """All so far; None where nothing was."""
        if self._start_ns is None:
            return None
        used = np.flatnonzero(self._sums["frames"] + self._sums["lost"] + self._sums["delayed"])
        end = int(used[-1]) + 1 if used.size else 0
        sums = {name: column[:end].copy() for name, column in self._sums.items()}
        return Course(self._start_ns, self._width_ns, least_ns=self._least[:end], most_ns=self._most[:end], **sums)

    def _count(self, name: str, at: npt.NDArray[np.intp]) -> None:
        self._sums[name] += np.bincount(at, minlength=self._buckets)

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
