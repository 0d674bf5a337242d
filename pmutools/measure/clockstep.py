"""A sender's clock that is set by less than the horizon: stamps jump while frames keep coming at their pace.

Neither loss nor copies look like this. After an outage arrivals have jumped as far as stamps; what a link had stored
comes in a lump; a frame that is late comes alone; of two senders the frames alternate. So a jump is a clock's where
:data:`ROWS` frames before it have one delay, as many from it on have another, these come at the stream's own pace, and
no more time passed between the two than between any.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pmutools.c37118.batch import NO_TIME
from pmutools.measure.columns import Flags, Frames, Ints, joined
from pmutools.timebase import NS

ROWS = 8
"""So many frames on both sides decide."""
LEAST_NS = 9 * NS // 10
"""A jump by less, or by fewer than :data:`LEAST_PERIODS`, is none; a leap second is one."""
LEAST_PERIODS = 10
STEPS = 32
"""So many are remembered."""
_LIKE_NS = NS // 10
"""Delays, and arrivals, that differ by less, or by less than two periods, are alike."""


class ClockStep(NamedTuple):
    """The sender's clock was set by ``change_ns`` at ``at_ns`` (time of arrival)."""

    change_ns: int
    at_ns: int


class StepWatch:
    """Splits frames of one stream, in order of arrival, where the sender's clock was set."""

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self._like_ns = max(_LIKE_NS, 2 * period_ns)
        self._least_ns = max(LEAST_NS, LEAST_PERIODS * period_ns)
        self._before: list[Frames] = []
        """The last frames that were handed on, up to :data:`ROWS`."""
        self._held: list[Frames] = []

    def feed(self, frames: Frames) -> Iterator[tuple[int, Frames]]:
        """``(change_ns, part)``: 0, or by how much the clock was set with the first of this part, which has at least
        :data:`ROWS` frames. Fewer than these are kept where they may be such.
        """
        if self._held:
            frames, self._held = joined([*self._held, frames]), []
        known = joined([*self._before, frames]) if self._before else frames
        offset = len(known) - len(frames)
        first = step_ns = 0
        for row in (np.flatnonzero(self._jumps(known)) + 1).tolist():
            at = row - offset
            if at < first:
                continue
            if len(frames) - at < ROWS:
                if at > first:
                    yield step_ns, self._handed(frames[first:at])
                self._held = [frames[at:]]
                return
            if not (change_ns := self._change_ns(known[max(0, row - ROWS) : row + ROWS], min(row, ROWS))):
                continue
            if at > first:
                yield step_ns, self._handed(frames[first:at])
            first, step_ns = at, change_ns
        yield step_ns, self._handed(frames[first:])

    def flush(self) -> Iterator[tuple[int, Frames]]:
        """What was kept, at the end."""
        held, self._held = self._held, []
        yield from ((0, self._handed(part)) for part in held)

    def _handed(self, part: Frames) -> Frames:
        tail = joined([*self._before, part]) if len(part) < ROWS and self._before else part
        self._before = [tail[-ROWS:]]
        return part

    def _jumps(self, frames: Frames) -> Flags:
        """(N - 1,) where a jump may be: stamps go far, arrivals do not."""
        gaps = np.diff(frames.arrival_ns)
        far: Flags = np.abs(np.diff(frames.slot)) * self._period_ns >= self._least_ns - self._period_ns
        return far & (np.abs(gaps) <= self._like_ns)

    def _change_ns(self, around: Frames, row: int) -> int:
        """By how much the clock was set between ``row`` and the one before it; 0 if it was not."""
        if row < ROWS // 2 or bool((around.arrival_ns == NO_TIME).any()):
            return 0
        arrivals = around.arrival_ns - around.arrival_ns[0]
        delays = arrivals - np.rint((around.slot - around.slot[0]) * self._period_ns).astype(np.int64)
        before, after = delays[:row], delays[row:]
        pace_ns = (ROWS - 1) * self._period_ns / 2
        alike = max(_spread(before), _spread(after)) <= self._like_ns
        paced = pace_ns <= int(arrivals[-1] - arrivals[row]) and _spread(around.slot[row:]) <= 3 * ROWS
        if not alike or not paced or len(np.unique(around.slot[row:])) < ROWS // 2:
            return 0
        change_ns = int(np.median(before) - np.median(after))
        return change_ns if abs(change_ns) >= self._least_ns else 0


def _spread(values: Ints) -> int:
    return int(values.max() - values.min())
