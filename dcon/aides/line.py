"""The ``pdci`` loop: the status of the DC line."""

from __future__ import annotations

import select
import socket
import time
from contextlib import suppress
from pathlib import Path

from dcon.aides.aide import ROUND_S, Aide
from dcon.core.values import Pdci
from dcon.drivers.line_status import LineOnModbus, StatusInbox
from dcon.link.beats import LoopName
from dcon.places import LineSource, ModbusLine
from pmutools.net.endpoint import Endpoint
from pmutools.net.sockets import explain, resolve

SPARE_S = 0.02
"""Least time between two rounds of the ``pdci`` loop: a flood of datagrams is taken in gulps, and told once each."""
AT_ONCE = 2048
"""Datagrams taken in one round."""


class PdciAide(Aide):
    """The status of the DC line."""

    def __init__(self, source: LineSource | None, run_dir: Path) -> None:
        """Raises SourceError where the address cannot be bound."""
        super().__init__(LoopName.PDCI, run_dir)
        self._sock = _bound(source) if isinstance(source, Endpoint) else None
        self._from = source.source if isinstance(source, Endpoint) else None
        self._device = LineOnModbus(source) if isinstance(source, ModbusLine) else None
        self.inbox = StatusInbox()
        self.foreign = 0
        """Datagrams from another address than the one configured."""
        self._told: Pdci | None = None

    def round(self) -> None:
        if self._sock is None:
            self._stopped.wait(ROUND_S)
        elif select.select([self._sock], [], [], ROUND_S)[0]:
            status = self.inbox.take(self._datagrams(self._sock), time.monotonic_ns(), time.time_ns())
            if status is not None:
                self._tell(status)
            self._stopped.wait(SPARE_S)
        if self._device is not None and (newest := self._device.newest) is not None and newest is not self._told:
            self._tell(newest)

    def _tell(self, line: Pdci) -> None:
        self._told = line
        self.tell(line)

    def counts(self) -> dict[str, int]:
        return super().counts() | {
            "line_foreign": self.foreign,
            "line_refused": sum(self.inbox.refused.values()),
            "line_failed": 0 if self._device is None else self._device.failed,
        }

    def _datagrams(self, sock: socket.socket) -> list[bytes]:
        found: list[bytes] = []
        with suppress(OSError):
            for _ in range(AT_ONCE):
                data, sender = sock.recvfrom(128)
                if self._from is None or sender[0] == self._from:
                    found.append(data)
                else:
                    self.foreign += 1
        return found

    def release(self) -> None:
        super().release()
        if self._sock is not None:
            self._sock.close()
        if self._device is not None:
            self._device.close()


def _bound(where: Endpoint) -> socket.socket:
    address = resolve(where.host, where.port, datagram=True)
    sock = socket.socket(address.family, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.bind(address.sockaddr)
    except OSError as error:
        sock.close()
        raise explain(error, f"[pdci] {where}") from None
    return sock
