"""How the line answers the command: gain and lag by regression over what was logged in the last seconds.

The command is held from tick to tick, so what drove the line at t - lag is the last command at or before that. Both
are taken without their means, and the lag is where they correlate best; the gain is the regression's slope there. A
command that hardly moved tells nothing: there is no estimate then. A line that does not answer has a gain near 0 and
no lag.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from pmutools.timebase import NS

WINDOW_S = 20.0
MOVED_MW = 2.0
"""Standard deviation of the command, below which it has not moved enough."""
LAGS_MS = np.arange(0, 505, 5)
"""Tried; a peak between two of them is found by a parabola."""
CORRELATED = 0.5
"""Least correlation at which a lag is told."""
STALE_NS = 2 * NS
"""The line has not reported for so long: nothing is known of it."""
IMPLAUSIBLE_MW = 1e5
FEWEST = 40
"""Reports of the line in the window."""
MOST = 4096
"""Values kept of each: 68 s of ticks."""


class Response(NamedTuple):
    gain: float
    """MW of the line per MW of the command."""
    lag_ms: float | None
    """None where the line's power does not follow the command."""


class LineResponse:
    """A sliding window over the command and the line's power."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * NS)
        self._command: deque[tuple[int, float]] = deque(maxlen=MOST)
        self._line: deque[tuple[int, float]] = deque(maxlen=MOST)

    def command(self, tick_ns: int, mw: float) -> None:
        """What was driven from ``tick_ns`` on."""
        if self._command and tick_ns <= self._command[-1][0]:
            self._command.clear()  # the clock was set back: nothing before can be compared
            self._line.clear()
        self._command.append((tick_ns, mw if abs(mw) < IMPLAUSIBLE_MW else 0.0))

    def line(self, time_ns: int, modulation_mw: float) -> None:
        """The line's power beside its schedule, as it was at ``time_ns``; one that is not newer is left out."""
        if not abs(modulation_mw) < IMPLAUSIBLE_MW or (self._line and time_ns <= self._line[-1][0]):
            return
        self._line.append((time_ns, modulation_mw))

    def estimate(self) -> Response | None:
        """Over the window before the newest report; None where too little moved, or too little was told."""
        if len(self._line) < FEWEST or len(self._command) < FEWEST:
            return None
        if self._command[-1][0] - self._line[-1][0] > STALE_NS:
            return None
        ticks, driven = (np.array(column) for column in zip(*self._command, strict=True))
        times, power = (np.array(column) for column in zip(*self._line, strict=True))
        lags_ns = LAGS_MS.astype(np.int64) * (NS // 1000)
        first = max(int(times[-1]) - self._window_ns, int(ticks[0]) + int(lags_ns[-1]))
        inside = (times >= first) & (times <= ticks[-1])
        times, power = times[inside], power[inside]
        if len(times) < FEWEST:
            return None
        places = np.searchsorted(ticks, times[None, :] - lags_ns[:, None], side="right") - 1
        commands = driven[places]
        commands = commands - commands.mean(axis=1, keepdims=True)
        power = power - power.mean()
        moved = commands.std(axis=1)
        if moved[0] < MOVED_MW:
            return None
        products = commands @ power / len(power)
        own = power.std()
        if own < 1e-9:
            return Response(0.0, None)
        correlation = products / (np.maximum(moved, 1e-9) * own)
        best = int(np.argmax(correlation))
        gain = float(products[best] / max(moved[best] ** 2, 1e-9))
        if correlation[best] < CORRELATED:
            return Response(gain, None)
        return Response(gain, float(LAGS_MS[best] + _vertex(correlation, best) * (LAGS_MS[1] - LAGS_MS[0])))


def _vertex(values: np.ndarray, at: int) -> float:
    """Of a parabola through three neighbours, as a share of their distance; 0 at an end."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2 * here + after
    return 0.0 if bend >= 0 else float(0.5 * (before - after) / bend)
