"""Which reporting instants the streams filled, all of them at once: expected, received, duplicated, stale.

The same counts as :mod:`pmutools.measure.slots`, with less memory of the past: what comes more than :data:`REACH` slots
behind is stale. A stamp that jumps further is believed where the arrivals say that so much time has passed (an
outage: its slots are lost), else it is a stray, until :data:`CONFIRM` frames in a row agree with it: then the sender's
clock was set, and counting goes on from there without a loss.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pmutools.tools.watch.table import Column, Flags, Ints, Segments, Table

WINDOW = 1024
"""Slots remembered, a byte each."""
REACH = 500
"""How far a frame may be from the newest: 8 s at 60 frames/s. Twice this and one fit the window."""
CONFIRM = 4
_MASK = WINDOW - 1
_APART = 1 << 40
"""Further than any two slots of neighbouring segments can be."""


class SlotTable(Table):
    """Counts (R,), and the last slots of each stream."""

    COLUMNS: ClassVar = {
        "head": Column(np.int64),
        "low": Column(np.int64),
        "head_arrival_ns": Column(np.int64),
        "stray": Column(np.int64),
        "strays": Column(np.int64),
        "period_ns": Column(np.float64),
        "expected": Column(np.int64),
        "received": Column(np.int64),
        "duplicated": Column(np.int64),
        "stale": Column(np.int64),
        "epochs": Column(np.int64),
        "filled": Column(np.uint8, 0, WINDOW),
    }
    head: Ints
    """The newest slot."""
    low: Ints
    """The first slot of the epoch."""
    head_arrival_ns: Ints
    stray: Ints
    """The slot of the last stray, and how many came in a row."""
    strays: Ints
    period_ns: np.ndarray[tuple[int], np.dtype[np.float64]]
    expected: Ints
    received: Ints
    """Unique frames."""
    duplicated: Ints
    stale: Ints
    epochs: Ints
    """Times that counting began anew; 0: nothing has come yet."""
    filled: np.ndarray[tuple[int, int], np.dtype[np.uint8]]

    def restart(self, row: int, period_ns: float) -> None:
        """What comes next counts at another rate, or is the first."""
        self.period_ns[row], self.epochs[row] = period_ns, 0
        self.filled[row] = 0

    def add(self, segments: Segments, slot: Ints, arrival_ns: Ints) -> Flags:
        """Count frames (N,), at most a segment a stream; gives which are the first of their slots."""
        rows = segments.rows
        if (fresh := self.epochs[rows] == 0).any():
            self._begin(rows[fresh], slot[segments.starts[fresh]])
        ahead = slot - self.head[segments.row]
        far = np.logical_or.reduceat(np.abs(ahead) > REACH, segments.starts)
        if not far.any():
            first = self._near(segments, slot, ahead)
        else:
            first = np.zeros(len(slot), np.bool_)
            for segment in np.flatnonzero(far).tolist():
                start, length = int(segments.starts[segment]), int(segments.lengths[segment])
                frames = slice(start, start + length)
                first[frames] = self._one_by_one(int(rows[segment]), slot[frames], arrival_ns[frames])
            if not far.all():
                near, frames_of_near = segments.only(~far)
                first[frames_of_near] = self._near(near, slot[frames_of_near], ahead[frames_of_near])
        self.head_arrival_ns[rows] = arrival_ns[segments.ends]
        return first

    def _begin(self, rows: np.ndarray[tuple[int], np.dtype[np.intp]], slot: Ints) -> None:
        self.head[rows], self.low[rows], self.epochs[rows], self.strays[rows] = slot - 1, slot, 1, 0

    def _near(self, segments: Segments, slot: Ints, ahead: Ints) -> Flags:
        """Frames within reach of what came before."""
        rows, row = segments.rows, segments.row
        apart = np.repeat(np.arange(len(rows)) * _APART, segments.lengths)
        newest = np.maximum.accumulate(ahead + apart) - apart
        before = np.empty_like(newest)
        before[1:] = newest[:-1]
        before[segments.starts] = 0
        np.maximum(before, 0, out=before)
        first = ahead > before
        self._advance(segments, np.maximum(newest[segments.ends], 0))
        filled, cell = self.filled.reshape(-1), row * WINDOW + (slot & _MASK)
        filled[cell[first]] = 1
        if not first.all():
            late = np.flatnonzero(~first)
            timely = slot[late] >= self.low[row[late]]
            np.add.at(self.stale, row[late[~timely]], np.int64(1))
            late = late[timely]
            found, where = np.unique(cell[late], return_index=True)
            filling = late[where[filled[found] == 0]]
            filled[cell[filling]], first[filling] = 1, True
            np.add.at(self.duplicated, row[late], np.int64(1))
            np.add.at(self.duplicated, row[filling], np.int64(-1))
        self.received[rows] += segments.sums(first)
        return first

    def _advance(self, segments: Segments, by: Ints) -> None:
        """Make the slots up to the new heads empty, and expected."""
        rows = segments.rows
        place = np.arange(int(by.sum())) - np.repeat(np.cumsum(by) - by, by) + 1
        slots = np.repeat(self.head[rows], by) + place
        self.filled.reshape(-1)[np.repeat(rows, by) * WINDOW + (slots & _MASK)] = 0
        self.head[rows] += by
        self.expected[rows] += by

    def _one_by_one(self, row: int, slot: Ints, arrival_ns: Ints) -> Flags:
        """A stream whose stamps jump."""
        first = np.zeros(len(slot), np.bool_)
        for place, (at, came_ns) in enumerate(zip(slot.tolist(), arrival_ns.tolist(), strict=True)):
            ahead = at - int(self.head[row])
            if abs(ahead) <= REACH:
                alone = Segments(np.array([row]), np.zeros(1, np.intp), np.ones(1, np.intp))
                first[place] = self._near(alone, slot[place : place + 1], np.array([ahead]))[0]
            elif ahead > 0 and self._is_outage(row, ahead, came_ns):
                self._jump(row, at, ahead)
                first[place] = True
            else:
                near = self.strays[row] > 0 and abs(at - int(self.stray[row])) <= REACH
                self.stray[row], self.strays[row] = at, self.strays[row] + 1 if near else 1
                self.stale[row] += 1
                if self.strays[row] < CONFIRM:
                    continue
                self.stale[row] -= CONFIRM
                self.received[row] += CONFIRM - 1
                self.epochs[row] += 1
                self.low[row] = at
                self._jump(row, at, CONFIRM)
                first[place] = True
            self.strays[row] = 0
            self.head_arrival_ns[row] = came_ns
        return first

    def _jump(self, row: int, slot: int, expected: int) -> None:
        """Go on from a slot that a frame came for."""
        self.filled[row] = 0
        self.filled[row, slot & _MASK] = 1
        self.head[row] = slot
        self.expected[row] += expected
        self.received[row] += 1

    def _is_outage(self, row: int, ahead: int, arrival_ns: int) -> bool:
        passed_ns = arrival_ns - int(self.head_arrival_ns[row])
        return bool(abs(ahead * self.period_ns[row] - passed_ns) <= REACH * self.period_ns[row])
