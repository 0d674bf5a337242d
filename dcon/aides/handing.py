"""Orders between the gate and the control process, whose socket may be full for a moment. Pure, without a socket.

What is not taken is tried again for :data:`PATIENCE_NS`; then the operator hears that it was not taken. An emergency
stop goes first, and what waited before it is given up: nothing that was ordered before a stop may come after it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from dcon.aides.order_gate import Passed
from dcon.core.system import Trigger
from dcon.link.news import encode
from pmutools.timebase import NS

PATIENCE_NS: Final = NS
"""Shorter than :data:`dcon.link.orders.ANSWER_NS`, after which the operator is told that nobody knows."""
WAITING: Final = 64
"""Orders that may wait; more are given up at once."""
NOT_TAKEN: Final = "the controller did not take it"
STOPPED: Final = "an emergency stop came first"


class Reply(NamedTuple):
    """What an order's sender is to hear, ``{"digest", "refused"}``, and at which socket."""

    path: str
    said: dict[str, Any]


class _Waiting(NamedTuple):
    until_ns: int
    datagram: bytes
    passed: Passed


class Handing:
    """The orders that wait, the first to go first."""

    def __init__(self) -> None:
        self._waiting: deque[_Waiting] = deque()
        self._replies: list[Reply] = []
        self.lost = 0
        """Orders and refusals that were given up."""

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, passed: Passed, now_ns: int) -> None:
        """Take what has passed the gate at ``now_ns``, of a clock without steps."""
        if passed.news is None:
            return
        made = _Waiting(now_ns + PATIENCE_NS, encode(passed.news), passed)
        if passed.news.name == Trigger.ESTOP:
            orders = [each for each in self._waiting if each.passed.order]
            self._waiting = deque([made, *(each for each in self._waiting if not each.passed.order)])
            for each in orders:
                self._give_up(each, STOPPED)
        elif len(self._waiting) < WAITING:
            self._waiting.append(made)
        else:
            self._give_up(made, NOT_TAKEN)

    def send(self, take: Callable[[bytes], bool], now_ns: int) -> list[Reply]:
        """Offer to ``take``, in order, until it does not; returns what is to be said of those that were given up."""
        while self._waiting and take(self._waiting[0].datagram):
            self._waiting.popleft()
        while self._waiting and now_ns >= self._waiting[0].until_ns:
            self._give_up(self._waiting.popleft(), NOT_TAKEN)
        replies, self._replies = self._replies, []
        return replies

    def _give_up(self, each: _Waiting, why: str) -> None:
        self.lost += 1
        if each.passed.order:
            self._replies.append(Reply(each.passed.reply_to, {"digest": each.passed.order, "refused": why}))
