"""Stamps that stand still: frames go on coming, and all say the same time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pmutools.c37118.batch import NO_TIME
from pmutools.measure.columns import Frames


class Standstill(NamedTuple):
    """So many frames in a row with one stamp, over so long; ``ended`` tells that others came after them."""

    frames: int = 0
    length_ns: int = 0
    """From the first of them to the last, by arrivals; 0 where nobody saw them come."""
    stamp_ns: int = 0
    ended: bool = False


NO_STANDSTILL = Standstill()


class StandstillMeter:
    """The longest run of equal stamps, from frames in order of arrival."""

    def __init__(self) -> None:
        self._longest = Standstill()
        self._stamp_ns: int | None = None
        self._frames = 0
        self._since_ns = self._last_ns = NO_TIME

    def add(self, frames: Frames) -> None:
        """Frames (N,), N > 0."""
        times, arrivals = frames.time_ns, frames.arrival_ns
        starts = np.flatnonzero(np.diff(times)) + 1
        if not len(starts) and int(times[0]) == self._stamp_ns:
            self._go_on(len(times), int(arrivals[-1]))
            return
        first = int(starts[0]) if len(starts) else len(times)
        if int(times[0]) == self._stamp_ns:
            self._go_on(first, int(arrivals[first - 1]))
        else:
            starts = np.concatenate(([0], starts))
        self._keep()
        counts = np.diff(starts, append=len(times))
        most = int(np.argmax(counts))
        for at in dict.fromkeys((most, len(starts) - 1)):  # the longest of these, and the one that may go on
            begin, count = int(starts[at]), int(counts[at])
            self._stamp_ns, self._frames = int(times[begin]), count
            self._since_ns, self._last_ns = int(arrivals[begin]), int(arrivals[begin + count - 1])
            if at < len(starts) - 1:
                self._keep()

    def _go_on(self, count: int, arrival_ns: int) -> None:
        self._frames += count
        self._last_ns = arrival_ns

    @property
    def _now(self) -> Standstill:
        known = NO_TIME not in (self._since_ns, self._last_ns)
        return Standstill(self._frames, self._last_ns - self._since_ns if known else 0, self._stamp_ns or 0)

    def _keep(self) -> None:
        if self._frames > self._longest.frames:
            self._longest = self._now._replace(ended=True)

    @property
    def longest(self) -> Standstill:
        """So far."""
        return self._now if self._frames > self._longest.frames else self._longest
