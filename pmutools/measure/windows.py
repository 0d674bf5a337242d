"""How many frames come in each control window: 0, 1, or 2 and more (the paper's Fig. 11).

A controller that runs at Fs takes what has come since its last step. Windows of 1/Fs are aligned to UTC: window w goes
from w/Fs to (w + 1)/Fs after a whole second. With perfect arrival each has one frame; a window without one holds the
last command, and two frames in the next make up for it. The wait from an arrival to the end of its window is what a
controller that steps there adds to the delay.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from pmutools import timebase
from pmutools.measure.columns import Ints
from pmutools.measure.counts import LARGEST, Counts, Tally
from pmutools.measure.histogram import Histogram

_SILENCE = 86_400
"""The receiver's clock was set where more windows than a day's (at 1/s) pass without a frame."""


@dataclass
class WindowCounts(Counts):
    """Windows from that of the first arrival to that of the last."""

    empty: int = 0
    one: int = 0
    more: int = 0
    most: int = field(default=0, metadata=LARGEST)
    empty_runs: Tally = field(default_factory=Tally)
    """Lengths of the runs of empty windows."""
    to_tick: Histogram = field(default_factory=Histogram)
    """From a frame's arrival to the end of its window."""

    @property
    def windows(self) -> int:
        return self.empty + self.one + self.more

    def to_json(self) -> dict[str, int]:
        return {"0": self.empty, "1": self.one, "2+": self.more}


class WindowMeter:
    """Counts of frames per window, from arrivals in order."""

    def __init__(self, rate: Fraction, phase_ns: int = 0) -> None:
        self.counts = WindowCounts()
        self._phase_ns = phase_ns
        self.restart(rate)

    def restart(self, rate: Fraction) -> None:
        """What comes next is sent at another rate, or after the clock was set."""
        self.close()
        self._rate = rate
        self._window: int | None = None
        self._frames = 0

    _window: int | None = None
    _frames = 0

    def add(self, arrival_ns: Ints) -> None:
        """Arrivals (N,) that are known."""
        if not len(arrival_ns) or not self._rate:
            return
        window, left_ns = _windows(arrival_ns - self._phase_ns, self._rate)
        self.counts.to_tick.add(left_ns)
        if self._window is not None:
            window = np.concatenate(([self._window], window))
        if (np.diff(window) < 0).any():  # stamps out of order count in the window that has begun
            window = np.maximum.accumulate(window)
        starts = np.flatnonzero(np.diff(window, prepend=window[0] - 1))
        held = np.diff(starts, append=len(window))
        held[0] += self._frames - (self._window is not None)
        self._window, self._frames = int(window[-1]), int(held[-1])
        self._count(held[:-1])
        skipped = np.diff(window[starts]) - 1
        skipped = skipped[(skipped > 0) & (skipped < _SILENCE * max(1, int(self._rate)))]
        self.counts.empty += int(skipped.sum())
        self.counts.empty_runs.add(skipped)

    def _count(self, held: Ints) -> None:
        """Windows that are over, each with this many frames."""
        if not held.size:
            return
        one = int(np.count_nonzero(held == 1))
        self.counts.one += one
        self.counts.more += held.size - one
        self.counts.most = max(self.counts.most, int(held.max()))

    def close(self) -> None:
        """Count the window that has begun."""
        if self._window is not None:
            self._count(np.array([self._frames]))
        self._window, self._frames = None, 0


def _windows(moved_ns: Ints, rate: Fraction) -> tuple[Ints, Ints]:
    """The window (N,) that each time is in, and how long it is until that ends."""
    if rate.denominator != 1:
        period_ns = rate.denominator * timebase.NS
        windows, into_ns = np.divmod(moved_ns, period_ns)
        return windows, period_ns - into_ns
    base_s = int(moved_ns[0]) // timebase.NS
    since_ns = moved_ns - base_s * timebase.NS
    if max(int(since_ns.max()), -int(since_ns.min())) < (1 << 52) // rate.numerator:
        ticks = since_ns * rate.numerator
        windows = np.floor(ticks / timebase.NS).astype(np.int64)  # floats divide faster; what they miss is put right
        rest = ticks - windows * timebase.NS
        windows += (rest >= timebase.NS).astype(np.int64) - (rest < 0)
        rest = ticks - windows * timebase.NS
    else:
        seconds, inside_ns = np.divmod(since_ns, timebase.NS)
        windows, rest = np.divmod(inside_ns * rate.numerator, timebase.NS)
        windows += seconds * rate.numerator
    windows += base_s * rate.numerator
    return windows, ((timebase.NS - rest) / rate.numerator).astype(np.int64)
