"""Signs of life of a process's loops, for the watchdog."""

from __future__ import annotations

from dcon.link.beats import RUNNING, beat
from dcon.link.paths import Sender
from pmutools.clock import Clock

BEAT_NS = 10_000_000
"""A loop that goes round more often beats so often: to be heard, not counted."""


class Beater:
    """Counts the rounds of each loop, and tells of them."""

    def __init__(self, sender: Sender, clock: Clock) -> None:
        self._sender, self._clock = sender, clock
        self._counters: dict[str, int] = {}
        self._told_ns: dict[str, int] = {}

    def beat(self, loop: str, state: int = RUNNING) -> None:
        """The loop has gone round once more."""
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._told_ns.get(loop, -BEAT_NS) < BEAT_NS:
            return
        self._told_ns[loop] = now_ns
        counter = self._counters[loop] = (self._counters.get(loop, -1) + 1) & 0xFFFFFFFF
        self._sender.send(beat(loop, counter, now_ns, state))
