"""Ethernet frames around a payload: IPv4/IPv6, UDP in fragments where it must be, TCP; all checksums filled in."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from typing import NamedTuple

from pmutools.errors import EncodeError
from pmutools.formats.capture import ip, link

MTU = 1500
MAX_UDP_IPV4 = 65507
MAX_UDP_IPV6 = 65527

_HOP_LIMIT = 64
_FRAGMENT_HEADER = 44


class Endpoint(NamedTuple):
    """A packed address (4 or 16 bytes) and a port."""

    address: bytes
    port: int

    @property
    def mac(self) -> bytes:
        """A locally administered address made from the IP address, or the group's (RFC 1112, RFC 2464)."""
        address = self.address
        if len(address) == 4 and 224 <= address[0] < 240:
            return b"\x01\x00\x5e" + bytes((address[1] & 0x7F,)) + address[2:]
        if address == b"\xff\xff\xff\xff":
            return b"\xff" * 6
        if len(address) == 16 and address[0] == 0xFF:
            return b"\x33\x33" + address[-4:]
        return b"\x02\x00" + address[-4:]


def parse_endpoint(text: str) -> Endpoint:
    """``host:port`` or ``[host]:port`` with a numeric host. Raises :class:`EncodeError` for anything else."""
    host, _, port = text.rpartition(":")
    number = int(port) if port.isdecimal() else -1
    host = host.removeprefix("[").removesuffix("]").partition("%")[0]
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        address = socket.inet_pton(family, host)
    except OSError:
        number = -1
    if not 0 <= number <= 0xFFFF:
        raise EncodeError(f"flow endpoint {text!r} is not a numeric ADDRESS:PORT, which a capture file needs")
    return Endpoint(address, number)


class Route(NamedTuple):
    """One direction between two endpoints of one address family."""

    source: Endpoint
    destination: Endpoint

    def udp(self, data: bytes, ident: int) -> Iterator[bytes]:
        """The frames of one datagram; ``ident`` names it where it is sent in fragments."""
        limit = MAX_UDP_IPV4 if len(self.source.address) == 4 else MAX_UDP_IPV6
        if len(data) > limit:
            raise EncodeError(f"{len(data)} bytes do not fit a UDP datagram ({limit} at most); use a TCP flow")
        header = struct.pack(">HHHH", self.source.port, self.destination.port, len(data) + 8, 0)
        check = self._checksum(ip.UDP, header + data) or 0xFFFF
        return self._packets(ip.UDP, header[:6] + check.to_bytes(2, "big") + data, ident)

    def tcp(
        self, sequence: int, acknowledged: int, flags: int, data: bytes, ident: int, options: bytes = b""
    ) -> Iterator[bytes]:
        """The frame of one segment; ``data`` and ``options`` (padded to 4) must fit the MTU."""
        ports = self.source.port, self.destination.port
        offset = (20 + len(options)) << 2
        header = struct.pack(
            ">HHIIBBHHH", *ports, sequence & 0xFFFFFFFF, acknowledged & 0xFFFFFFFF, offset, flags, 0xFFFF, 0, 0
        )
        segment = header + options + data
        check = self._checksum(ip.TCP, segment)
        return self._packets(ip.TCP, segment[:16] + check.to_bytes(2, "big") + segment[18:], ident)

    def _checksum(self, protocol: int, segment: bytes) -> int:
        pseudo = self.source.address + self.destination.address + struct.pack(">IxxxB", len(segment), protocol)
        return checksum(pseudo + segment)

    def _packets(self, protocol: int, payload: bytes, ident: int) -> Iterator[bytes]:
        if len(self.source.address) == 4:
            return self._ipv4(protocol, payload, ident)
        return self._ipv6(protocol, payload, ident)

    def _ipv4(self, protocol: int, payload: bytes, ident: int) -> Iterator[bytes]:
        ethernet = self.destination.mac + self.source.mac + struct.pack(">H", link.IPV4)
        addresses = self.source.address + self.destination.address
        room = MTU - 20
        for offset in range(0, len(payload), room):
            part = payload[offset : offset + room]
            more = offset + len(part) < len(payload)
            place = offset >> 3 | more << 13
            header = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), ident & 0xFFFF, place, _HOP_LIMIT, protocol, 0)
            check = checksum(header + addresses)
            yield ethernet + header[:10] + check.to_bytes(2, "big") + addresses + part

    def _ipv6(self, protocol: int, payload: bytes, ident: int) -> Iterator[bytes]:
        ethernet = self.destination.mac + self.source.mac + struct.pack(">H", link.IPV6)
        addresses = self.source.address + self.destination.address
        version = 6 << 28
        if len(payload) <= MTU - 40:
            yield ethernet + struct.pack(">IHBB", version, len(payload), protocol, _HOP_LIMIT) + addresses + payload
            return
        room = (MTU - 48) & ~7
        for offset in range(0, len(payload), room):
            part = payload[offset : offset + room]
            more = offset + len(part) < len(payload)
            header = struct.pack(">IHBB", version, 8 + len(part), _FRAGMENT_HEADER, _HOP_LIMIT)
            fragment = struct.pack(">BxHI", protocol, offset | more, ident & 0xFFFFFFFF)
            yield ethernet + header + addresses + fragment + part


def checksum(data: bytes) -> int:
    """The Internet checksum (RFC 1071). The ones' complement sum of 16-bit words is the number modulo 65535."""
    if len(data) & 1:
        data += b"\x00"
    return (0xFFFF - int.from_bytes(data, "big") % 0xFFFF) % 0xFFFF
