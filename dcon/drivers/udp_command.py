"""The command as a UDP datagram, to a plant model or a gateway. 40 bytes, big-endian::

    4s magic "DCN1" | I sequence | q time_ns (UTC of the tick) | d command MW | d output V | I flags | I CRC-32

The MW are those really driven: 0 in open loop. A receiver must ignore what is not 40 bytes, has another magic, a
CRC that does not hold, or a sequence it has passed; and must go to 0 MW when datagrams stop coming.
"""

from __future__ import annotations

import socket
import struct
import zlib
from contextlib import suppress
from typing import NamedTuple

from dcon.drivers.driver import Readback
from dcon.limiter import MW_PER_V
from dcon.places import Destination
from pmutools.errors import SettingsError
from pmutools.net.endpoint import Endpoint
from pmutools.net.sockets import explain, resolve

MAGIC = b"DCN1"
_BODY = struct.Struct(">4sIqddI")
_CRC = struct.Struct(">I")
SIZE = _BODY.size + _CRC.size


class CommandOut(NamedTuple):
    """What one datagram says."""

    sequence: int
    time_ns: int
    command_mw: float
    output_v: float
    flags: int = 0


def encode(command: CommandOut) -> bytes:
    """The datagram of a command; the sequence wraps at 2**32."""
    body = _BODY.pack(
        MAGIC,
        command.sequence & 0xFFFFFFFF,
        command.time_ns,
        command.command_mw,
        command.output_v,
        command.flags & 0xFFFFFFFF,
    )
    return body + _CRC.pack(zlib.crc32(body))


def decode(datagram: bytes) -> CommandOut | None:
    """The command in a datagram; None for anything else."""
    if len(datagram) != SIZE or datagram[:4] != MAGIC:
        return None
    if zlib.crc32(datagram[:-4]) != _CRC.unpack(datagram[-4:])[0]:
        return None
    _, sequence, time_ns, command_mw, output_v, flags = _BODY.unpack(datagram[:-4])
    return CommandOut(sequence, time_ns, command_mw, output_v, flags)


def follows(sequence: int, last: int) -> bool:
    """Whether a sequence, which wraps at 2**32, is newer than ``last``."""
    return 0 < (sequence - last) % (1 << 32) < 1 << 31


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
