"""Order and loss patterns of a stream: what came in which order, and how the losses lie.

===================== ======== ==================================================================================
reordered             RFC 4737 a frame whose slot is below one that came before it; duplicates are left out
reordering extent     RFC 4737 for a reordered frame at place i of arrival: i - min{j < i: slot[j] > slot[i]}
late time offset      RFC 4737 arrival of i less arrival of that j: how much longer a concentrator had to wait
n-reordering          RFC 4737 the largest n such that the n frames just before it all have larger slots
loss period, distance RFC 3357 a run of losses; the difference of the slots of two losses that follow each other
burst, gap            RFC 3611 a burst is the longest span from loss to loss with less than Gmin received in between
===================== ======== ==================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pmutools.c37118.batch import NO_TIME
from pmutools.measure.columns import Flags, Ints
from pmutools.measure.counts import LARGEST, Counts, Tally
from pmutools.measure.histogram import Histogram, ms

GMIN = 16
"""RFC 3611's customary Gmin: so many frames received in a row end a burst."""
NOTICEABLE = 99
"""RFC 3357's δ: a loss is noticeable where the loss before it is at most so many slots away."""
DEEPEST = 256
"""n-reordering is counted up to here."""


@dataclass
class OrderCounts(Counts):
    """Reordering among unique frames (RFC 4737)."""

    received: int = 0
    reordered: int = 0
    extent: Tally = field(default_factory=Tally)
    late_offset: Histogram = field(default_factory=Histogram)
    n_reordering: Tally = field(default_factory=Tally)
    free_runs: Tally = field(default_factory=Tally)
    """Lengths of the runs of frames in order between two reordered ones."""

    def to_json(self) -> dict[str, Any]:
        """``ratio`` is reordered / received; order consistency, as NASPI names it, is 1 less that."""
        return {
            "count": self.reordered,
            "ratio": self.reordered / self.received if self.received else None,
            "extent": self.extent.to_json(),
            "late_offset_ms": self.late_offset.summary_ms(),
            "n_reordering": self.n_reordering.to_json(),
            "free_runs": self.free_runs.to_json(),
        }


class OrderMeter:
    """Reordering, from unique frames in order of arrival. It remembers ``reach`` slots of frames that came in order."""

    def __init__(self, reach: int) -> None:
        self._reach = reach
        self.counts = OrderCounts()
        self.restart()

    def restart(self) -> None:
        """What comes next belongs to another epoch."""
        self._place = self._run = 0
        self._highs = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
        """Frames that came in order: slot, place, arrival. Their slots rise, so that a search finds RFC 4737's j."""
        self._recent = np.zeros(0, np.int64)

    def add(self, slot: Ints, before: Ints, arrival_ns: Ints) -> None:
        """Unique frames (N,), and the highest slot before each."""
        if not len(slot):
            return
        place = np.arange(self._place, self._place + len(slot))
        self._place += len(slot)
        self.counts.received += len(slot)
        in_order = slot > before
        ordered = bool(in_order.all())
        recent = min(self._reach, len(slot))
        if ordered and len(slot) >= self._reach:  # the usual case
            self._highs = (slot[-recent:].copy(), place[-recent:], arrival_ns[-recent:].copy())
        else:
            kept = [
                np.concatenate((old, new[in_order]))
                for old, new in zip(self._highs, (slot, place, arrival_ns), strict=True)
            ]
            if not ordered:
                self._reordered(slot, place, arrival_ns, ~in_order, kept)
            fresh = np.searchsorted(kept[0], kept[0][-1] - self._reach, side="right") if len(kept[0]) else 0
            self._highs = (kept[0][fresh:], kept[1][fresh:], kept[2][fresh:])
        self._runs(in_order, ordered)
        self._recent = (slot if len(slot) >= DEEPEST else np.concatenate((self._recent, slot)))[-DEEPEST:].copy()

    def _reordered(self, slot: Ints, place: Ints, arrival_ns: Ints, late: Flags, highs: list[Ints]) -> None:
        rows = np.flatnonzero(late)
        self.counts.reordered += len(rows)
        overtaking = np.searchsorted(highs[0], slot[rows], side="right")
        self.counts.extent.add(place[rows] - highs[1][overtaking])
        since, then = highs[2][overtaking], arrival_ns[rows]
        known = (since != NO_TIME) & (then != NO_TIME)
        self.counts.late_offset.add(then[known] - since[known])
        line = np.concatenate((self._recent, slot))
        at = rows + len(self._recent)
        depth = np.zeros(len(rows), np.int64)
        active = np.arange(len(rows))
        for step in range(1, DEEPEST + 1):
            active = active[at[active] >= step]
            active = active[line[at[active] - step] > line[at[active]]]
            if not active.size:
                break
            depth[active] = step
        self.counts.n_reordering.add(depth)

    def _runs(self, in_order: Flags, ordered: bool) -> None:
        if ordered:
            self._run += len(in_order)
            return
        ends = np.flatnonzero(~in_order)
        lengths = np.diff(ends, prepend=-1) - 1
        lengths[0] += self._run
        self.counts.free_runs.add(lengths[lengths > 0])
        self._run = len(in_order) - 1 - int(ends[-1])


@dataclass
class LossCounts(Counts):
    """How losses lie (RFC 3357), and RFC 3611's bursts and gaps."""

    slots: int = 0
    lost: int = 0
    periods: Tally = field(default_factory=Tally)
    """Lengths of loss periods, in slots: NASPI's gap sizes."""
    distances: Tally = field(default_factory=Tally)
    bursts: int = 0
    burst_slots: int = 0
    burst_lost: int = 0
    longest: int = field(default=0, metadata=LARGEST)
    """The longest loss period."""

    def to_json(self, period_ns: float) -> dict[str, Any]:
        gap_slots, gap_lost = self.slots - self.burst_slots, self.lost - self.burst_lost
        return {
            "count": self.periods.count,
            "mean": self.periods.mean,
            "max": self.longest,
            "max_ms": ms(self.longest * period_ns),
            "lengths": [list(item) for item in self.periods.items()],
            "distance": self.distances.to_json(),
            "noticeable": self.distances.at_most(NOTICEABLE) / self.lost if self.lost else None,
            "mean_between_ms": ms(self.slots * period_ns / self.periods.count) if self.periods.count else None,
            "bursts": {
                "gmin": GMIN,
                "count": self.bursts,
                "density": self.burst_lost / self.burst_slots if self.burst_slots else 0.0,
                "mean_ms": ms(self.burst_slots * period_ns / self.bursts) if self.bursts else None,
                "gap_density": gap_lost / gap_slots if gap_slots else 0.0,
                "gap_mean_ms": ms(gap_slots * period_ns / (self.bursts + 1)),
            },
        }


class LossMeter:
    """Loss patterns, from slots in order, each received or lost for good."""

    def __init__(self) -> None:
        self.counts = LossCounts()
        self.restart()

    def restart(self) -> None:
        """Another epoch: what ended the last one, ended."""
        self._close_period()
        self._close_burst()
        self._since = -1
        """Slots since the last loss, itself included; -1 before the first."""

    _period = 0
    _burst_slots = _burst_lost = 0
    _since = -1

    def add(self, received: Flags) -> None:
        """Slots (K,) that follow those before."""
        self.counts.slots += len(received)
        if received.all():
            if len(received):
                self._close_period()
                self._since += len(received) if self._since >= 0 else 0
            return
        edges = np.flatnonzero(np.diff(received)) + 1
        starts = np.concatenate(([0], edges))
        lengths = np.diff(np.concatenate((starts, [len(received)])))
        for came, length in zip(received[starts].tolist(), lengths.tolist(), strict=True):
            if came:
                self._close_period()
                self._since += length if self._since >= 0 else 0
            else:
                self._lose(length)

    def add_lost(self, count: int) -> None:
        """So many lost slots in a row."""
        if count:
            self.counts.slots += count
            self._lose(count)

    def _lose(self, count: int) -> None:
        self.counts.lost += count
        self._period += count
        self.counts.longest = max(self.counts.longest, self._period)
        if self._since >= 0:
            self.counts.distances.add_one(self._since)
        self.counts.distances.add_one(1, count - 1)
        if self._since < 0 or self._since > GMIN:
            self._close_burst()
            self._burst_slots = 0
        else:
            self._burst_slots += self._since - 1
        self._burst_slots += count
        self._burst_lost += count
        self._since = 1

    def _close_period(self) -> None:
        self.counts.periods.add_one(self._period, int(self._period > 0))
        self._period = 0

    def _close_burst(self) -> None:
        if self._burst_lost > 1:
            self.counts.bursts += 1
            self.counts.burst_slots += self._burst_slots
            self.counts.burst_lost += self._burst_lost
        self._burst_slots = self._burst_lost = 0

    def close(self) -> None:
        """Count the loss period and the burst that are still open."""
        self._close_period()
        self._close_burst()
