"""Telling systemd how a service is: the datagrams of ``sd_notify(3)``, to the socket that ``NOTIFY_SOCKET`` names."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

READY, ALIVE, STOPPING = "READY=1", "WATCHDOG=1", "STOPPING=1"


class Notifier:
    """Sends assignments, one a line; without the variable nothing is sent. Never waits, never raises."""

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        name = environ.get("NOTIFY_SOCKET", "")
        self._path = "\0" + name[1:] if name.startswith("@") else name
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if name else None
        if self._sock is not None:
            self._sock.setblocking(False)

    def tell(self, *assignments: str, status: str = "") -> bool:
        """Whether it was taken. ``status`` is one line for people."""
        if self._sock is None:
            return False
        lines = (*assignments, *([f"STATUS={' '.join(status.split())}"] if status else []))
        try:
            self._sock.sendto("\n".join(lines).encode(), self._path)
        except OSError:
            return False
        return True
