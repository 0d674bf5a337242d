"""Commands straight to a plant model or a gateway, as :mod:`dcon.link.command` lays them out."""

from __future__ import annotations

import socket
from contextlib import suppress

from dcon.drivers.driver import Readback
from dcon.limiter import MW_PER_V
from dcon.link.command import CommandOut, encode
from dcon.places import Destination
from pmutools.errors import SettingsError
from pmutools.net.endpoint import Endpoint
from pmutools.net.sockets import explain, resolve


class UdpCommandDriver:
    """Sends commands to one endpoint; what the system refuses, or nobody listens to, is counted and never raised.

    A :class:`~dcon.drivers.driver.Driver` that reads nothing back.
    """

    reads_back = False
    settle_ns = 0

    def __init__(self, endpoint: Destination) -> None:
        """Raises SourceError for a host that is unknown or unreachable, SettingsError for what is no UDP endpoint."""
        if not isinstance(endpoint, Endpoint):
            raise SettingsError(f"[output] {endpoint}: driven by a process of its own, dcon output; see dcon run")
        where = resolve(endpoint.host, endpoint.port, datagram=True)
        try:
            self._sock = socket.socket(where.family, socket.SOCK_DGRAM)
            self._sock.setblocking(False)
            self._sock.connect(where.sockaddr)
        except OSError as error:
            raise explain(error, endpoint) from None
        self._sequence = 0
        self._last: tuple[int, float] = 0, 0.0
        self.driven = self.failed = 0

    @property
    def trouble(self) -> str:
        """Nobody knows: a datagram that arrives nowhere looks like one that does."""
        return ""

    def send(self, time_ns: int, output_v: float, flags: int = 0) -> None:
        """Drive ``output_v`` volts from now on."""
        datagram = encode(CommandOut(self._sequence, time_ns, output_v * MW_PER_V, output_v, flags))
        self._sequence += 1
        self.driven += 1
        self._last = time_ns, output_v
        try:
            self._sock.send(datagram)
        except ConnectionRefusedError:  # tells of the one before, and this one has not left
            self.failed += 1
            with suppress(OSError):
                self._sock.send(datagram)
        except OSError:
            self.failed += 1

    drive = send

    def readback(self) -> Readback | None:
        return None

    def close(self) -> None:
        """Leave 0 V, where that was not the last word."""
        time_ns, output_v = self._last
        if output_v:
            self.send(time_ns, 0.0)
        self._sock.close()
