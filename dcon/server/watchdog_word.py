"""What the server knows of the watchdog: its own word, by ``status.in``; what the control log says only without one."""

from __future__ import annotations

import socket
from typing import Any

from dcon.link.beats import WatchdogState, WatchdogStatus, decode_status
from dcon.server.status import watchdog_of

STATUSES_A_ROUND = 64
"""Taken at once."""
DATAGRAM_BYTES = 256


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
