"""How the processes of ``dcon run`` tell it that they work: ``sd_notify``, each to a socket of its own."""

from __future__ import annotations

import select
from pathlib import Path

from dcon.link import paths
from dcon.link.notify import READY

DATAGRAM_BYTES = 4096


def ear_of(member: str) -> str:
    """Name of the socket in the run folder at which ``dcon run`` hears a member."""
    return f"run.{member}"


class Ear:
    """Hears one member, life after life. Raises SourceError where its socket cannot be had."""

    def __init__(self, folder: Path, member: str) -> None:
        self._sock = paths.bind_datagram(folder, ear_of(member))
        self.path = str(folder / ear_of(member))
        """For the member's ``NOTIFY_SOCKET``."""
        self.is_ready = False
        """In this life."""
        self.silent_s = 0.0
        """For how long it has said nothing, as far as anybody listened."""

    def begin(self) -> None:
        """A new life: what is left of the last one says nothing of it."""
        self.listen(0.0)
        self.is_ready, self.silent_s = False, 0.0

    def listen(self, passed_s: float) -> None:
        """Take what has come; ``passed_s`` since the last time, of which a pause of this process is no part."""
        self.silent_s += passed_s
        while True:
            try:
                said = self._sock.recv(DATAGRAM_BYTES)
            except OSError:
                return
            self.silent_s = 0.0
            self.is_ready = self.is_ready or READY.encode() in said.splitlines()

    def register(self, poll: select.poll) -> None:
        poll.register(self._sock, select.POLLIN)

    def close(self) -> None:
        paths.release(self._sock)
