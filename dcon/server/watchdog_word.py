"""What the server knows of the watchdog: its own word, by ``status.in``; what the control log says only without one.

The watchdog answers no order. What became of one that it was told is read from a status that it sends after that.
"""

from __future__ import annotations

import socket
from typing import Any, Final, NamedTuple

from dcon.link.beats import Verb, WatchdogState, WatchdogStatus, decode_status
from dcon.server.status import watchdog_of
from pmutools.timebase import NS

STATUSES_A_ROUND = 64
"""Taken at once."""
DATAGRAM_BYTES = 256
TAKEN_NS: Final = NS // 50
"""A status of the watchdog that is so much younger than an order knows of it: it takes what comes within 10 ms."""
LONGEST_NS: Final = NS
"""For such a status, however patient the settings are."""
TOLD, UNREACHED = "was told", "could not be reached"
"""What is said of the watchdog in the answer to an order that is its own too; more than TOLD is no good news."""


class Told(NamedTuple):
    """The watchdog was told an order."""

    verb: Verb
    at_ns: int
    """Monotonic."""
    reached: bool
    """Its socket took it."""


def outcome(verb: Verb, status: WatchdogStatus) -> str:
    """What the watchdog has made of an order, by a status from after that."""
    causes = " ".join(status.causes)
    match verb:
        case Verb.ESTOP if status.closed:
            return f"{TOLD}, and its relays are closed still"
        case Verb.RESET if status.state is WatchdogState.TRIPPED:
            tripped = f"{TOLD}, and is still tripped"
            return f"{tripped}: {causes}; when that is over, order it again" if causes else f"{tripped}: order it again"
        case Verb.RESET:
            return f"{TOLD}, and is not tripped" + ("" if status.healthy else f", but not healthy: {causes}")
    return TOLD


class WatchdogWord:
    """The newest status that the watchdog has sent itself."""

    def __init__(self, sock: socket.socket, patience_ns: int) -> None:
        """``sock`` is bound, and does not block. Who has said nothing for longer than ``patience_ns`` is silent."""
        self.sock = sock
        self.patience_ns = patience_ns
        self.malformed = 0
        """Datagrams that are no status."""
        self._status: WatchdogStatus | None = None
        self._at_ns = 0
        """When that was so, monotonic."""

    def hear(self, now_ns: int) -> None:
        """Take what has come by ``now_ns`` (monotonic, which is the sender's clock too)."""
        for _ in range(STATUSES_A_ROUND):
            try:
                status = decode_status(self.sock.recv(DATAGRAM_BYTES))
            except OSError:
                return
            if status is None:
                self.malformed += 1
            else:
                self._status, self._at_ns = status, min(status.monotonic_ns, now_ns)

    def told(self, now_ns: int, utc_ns: int) -> dict[str, Any] | None:
        """For operators; None where it never said anything."""
        status = self._status
        if status is None:
            return None
        age_ns = max(now_ns - self._at_ns, 0)
        return watchdog_of(
            age_ns > self.patience_ns,
            source="watchdog",
            age_ms=age_ns / 1e6,
            time_ns=utc_ns - age_ns,
            relays_closed=status.closed,
            estop=not status.estop_released,
            latched=status.state is WatchdogState.TRIPPED,
            causes=status.causes,
            beats_ms=dict(status.beats_ms),
        )

    def after(self, told: Told, now_ns: int) -> str | None:
        """What an answer is to say of the watchdog; None while its word is awaited still.

        Of one that never says anything (``[watchdog] status`` may not name this socket) only that it was told.
        """
        if not told.reached:
            return UNREACHED
        if self._status is None:
            return TOLD
        if self._at_ns - told.at_ns >= TAKEN_NS:
            return outcome(told.verb, self._status)
        if now_ns - told.at_ns < min(self.patience_ns, LONGEST_NS) + TAKEN_NS:
            return None
        return f"{TOLD}, and has said nothing since"
