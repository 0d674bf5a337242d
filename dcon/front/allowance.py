"""How many data frames may come in the name of one PMU: a flood of them takes the control process no time to unpack."""

from __future__ import annotations

from pmutools.timebase import NS

FRAMES_A_SECOND = 960
"""Sixteen a tick of 60 Hz, which is what a tick reads of one PMU at most. A PMU sends 120 or fewer."""
BURST = 128
"""At once, after a pause: a second of 120 frames/s."""


class Allowance:
    """Of each PMU, how many frames pass. Time is that of their arrival: a pause of this process costs nobody any."""

    def __init__(self) -> None:
        self._left: dict[int, tuple[float, int]] = {}
        """By PMU: frames that would pass at once, and when the last one came."""

    def takes(self, pmu: int, arrival_ns: int) -> bool:
        """Whether one more passes. A stamp before the one of the last gives no new ones: UTC may have been stepped."""
        left, last_ns = self._left.get(pmu, (float(BURST), arrival_ns))
        left = min(BURST, left + max(arrival_ns - last_ns, 0) * FRAMES_A_SECOND / NS)
        passes = left >= 1
        self._left[pmu] = left - passes, arrival_ns
        return passes
