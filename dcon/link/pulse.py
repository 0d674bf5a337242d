"""The heartbeat of a loop, to the watchdog."""

from __future__ import annotations

from dcon.link.beats import LoopName, LoopState, encode_beat
from dcon.link.paths import Sender
from pmutools.timebase import NS


class Pulse:
    """Sends the beats of one loop, from the loop itself: when it hangs, they stop."""

    def __init__(self, loop: LoopName, sender: Sender, period_ns: int = NS // 10) -> None:
        self._loop, self._sender, self._period_ns = loop, sender, period_ns
        self._counter = 0
        self.due_ns = 0
        """When the next is due."""

    def beat(self, now_ns: int, state: LoopState = LoopState.RUNNING) -> None:
        """Send a beat where it is due, or says that the loop does not go on."""
        if now_ns >= self.due_ns or state is not LoopState.RUNNING:
            self._sender.send(encode_beat(self._loop, self._counter, now_ns, state))
            self._counter += 1
            self.due_ns = now_ns + self._period_ns
