"""The control process's end of the wire to the server: never waits, whatever the server does."""

from __future__ import annotations

import socket
from pathlib import Path

from dcon.link.shipper import Shipper

RETRY_NS = 500_000_000
"""Between two tries to connect."""
MESSAGES_A_CALL = 8
"""Read of the server's messages at a time."""
LARGEST_WORD = 4096
"""Bytes of a message of the server."""


class Shipping:
    """Connects when there is a server, and moves what a :class:`Shipper` has. Every call returns at once."""

    def __init__(self, path: Path, shipper: Shipper) -> None:
        """``path`` of the server's socket."""
        self.path = str(path)
        self.shipper = shipper
        self._sock: socket.socket | None = None
        self._tried_ns: int | None = None

    @property
    def is_connected(self) -> bool:
        return self._sock is not None

    def service(self, now_ns: int) -> int:
        """Connect, listen, send: to be called once a tick, with the time of a clock without steps. Bundles sent."""
        if self._sock is None and not self._connect(now_ns):
            return 0
        if not self._listen():
            return 0
        return self.shipper.service(self._send)

    def close(self) -> None:
        if self._sock is not None:
            self._sock.close()
        self._sock = None
        self.shipper.lost()

    def _connect(self, now_ns: int) -> bool:
        if self._tried_ns is not None and now_ns - self._tried_ns < RETRY_NS:
            return False
        self._tried_ns = now_ns
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.setblocking(False)
        try:
            sock.connect(self.path)
        except OSError:
            sock.close()
            return False
        self._sock = sock
        return True

    def _listen(self) -> bool:
        """Whether the server is still there."""
        assert self._sock is not None
        for _ in range(MESSAGES_A_CALL):
            try:
                message = self._sock.recv(LARGEST_WORD)
            except BlockingIOError:
                break
            except OSError:
                message = b""
            if not message:
                self.close()
                return False
            self.shipper.told(message)
        return True

    def _send(self, data: bytes) -> bool:
        if self._sock is None:
            return False
        try:
            self._sock.send(data)
        except BlockingIOError:
            return False
        except OSError:
            self.close()
            return False
        return True
