"""Which reporting instants a stream filled: gaps, repeated, overtaken and backward stamps, in order of arrival.

A slot is the number of a reporting instant since 1970 (:func:`pmutools.timebase.slot`). Memory is bounded: slots that
are missing are remembered, in case they come later, up to :data:`HOLES` and from gaps of up to :data:`NEAR` slots.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

NEAR = 1000
"""A stamp that goes back by more slots than this is another clock's."""
HOLES = 10_000


@dataclass
class SlotCounts:
    """Counts of what was added so far; ``missing`` slots lie in ``gaps`` runs between the first and the last one."""

    gaps: int = 0
    missing: int = 0
    duplicates: int = 0
    reordered: int = 0
    """Came after a later one, for the first time."""
    backwards: int = 0
    """Went back by more than :data:`NEAR` slots; counting goes on from there."""
    _low: int | None = None
    _high: int = 0
    _holes: dict[int, None] = field(default_factory=dict)
    """Missing slots that may still come, oldest first."""

    def add(self, slots: npt.NDArray[np.int64]) -> None:
        """Count the slots (N,) of frames that follow all before them."""
        if not len(slots):
            return
        if self._low is None:
            self._low, self._high = int(slots[0]), int(slots[0]) - 1
        steps = np.diff(slots, prepend=self._high)
        if (steps < 0).any():
            for slot in slots.tolist():
                self._add_one(slot)
            return
        self.duplicates += int(np.count_nonzero(steps == 0))
        for at in np.flatnonzero(steps > 1).tolist():
            self._skip(int(slots[at] - steps[at]) + 1, int(slots[at]))
        self._high = int(slots[-1])

    def restart(self) -> None:
        """What comes next has another grid."""
        self._low = None
        self._holes.clear()

    def _add_one(self, slot: int) -> None:
        assert self._low is not None
        if slot > self._high:
            if slot > self._high + 1:
                self._skip(self._high + 1, slot)
            self._high = slot
        elif slot in self._holes:
            del self._holes[slot]
            self.missing -= 1
            self.gaps += (slot - 1 in self._holes) + (slot + 1 in self._holes) - 1  # the gap is split, shorter or gone
            self.reordered += 1
        elif slot < self._low - NEAR or slot < self._high - NEAR:
            self.backwards += 1
            self._low = self._high = slot
        elif slot < self._low:
            if slot < self._low - 1:
                self._skip(slot + 1, self._low)
            self._low = slot
            self.reordered += 1
        else:
            self.duplicates += 1

    def _skip(self, first: int, end: int) -> None:
        """Nothing came for slots ``first`` to below ``end``."""
        self.gaps += 1
        self.missing += end - first
        if end - first > NEAR:
            return
        self._holes.update(dict.fromkeys(range(first, end)))
        while len(self._holes) > HOLES:
            del self._holes[next(iter(self._holes))]
