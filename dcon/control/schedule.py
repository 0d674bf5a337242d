"""When ticks fall: every 1/60 s of UTC plus a phase, as absolute deadlines that never drift."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

from pmutools import timebase


class TickGrid(NamedTuple):
    """Tick k is at k/``rate_hz`` s of UTC plus ``phase_ns``."""

    rate_hz: int
    phase_ns: int

    def after(self, time_ns: int) -> int:
        """Index of the first tick later than ``time_ns``."""
        index = timebase.slot(time_ns - self.phase_ns, Fraction(self.rate_hz))
        while self.time_ns(index) <= time_ns:
            index += 1
        return index

    def time_ns(self, index: int) -> int:
        """UTC of tick ``index``."""
        return timebase.slot_time_ns(index, Fraction(self.rate_hz)) + self.phase_ns
