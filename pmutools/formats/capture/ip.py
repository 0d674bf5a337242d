"""IPv4 and IPv6: headers, extension headers, reassembly of fragments (RFC 791, RFC 8200)."""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple

TCP = 6
UDP = 17

MAX_PARTIALS = 1024
"""Datagrams being reassembled at one time; beyond it the oldest is given up."""
MAX_PARTIAL_BYTES = 1 << 24
"""Bytes held for them."""
MAX_PARTIAL_AGE_NS = 30_000_000_000

_HOP_BY_HOP, _ROUTING, _FRAGMENT, _AUTHENTICATION, _DESTINATION = 0, 43, 44, 51, 60
_EXTENSIONS = (_HOP_BY_HOP, _ROUTING, _FRAGMENT, _AUTHENTICATION, _DESTINATION, 135, 139, 140)  # mobility, HIP, shim6

_ipv4 = struct.Struct(">BxHHHxBxx4s4s").unpack_from
_ipv6 = struct.Struct(">IHBx16s16s").unpack_from
_fragment_header = struct.Struct(">BxHI").unpack_from


class Malformed(ValueError):
    """A header that contradicts itself or the packet it is in."""


class Fragment(NamedTuple):
    """Which part of which datagram a payload is (``offset`` in bytes)."""

    ident: int
    offset: int
    more: bool


class Datagram(NamedTuple):
    """What IP carries: addresses packed, the payload as far as it was captured, the bytes of it that were not."""

    protocol: int
    source: bytes
    destination: bytes
    payload: bytes
    missing: int = 0
    fragment: Fragment | None = None


def decode_ipv4(packet: bytes, at: int) -> Datagram:
    """The IPv4 packet at ``at``. The header checksum is not looked at: captures on the sending host lack it."""
    version, total, ident, flags, protocol, source, destination = _ipv4(packet, at)
    header = (version & 0x0F) * 4
    if total == 0:  # left to the network card by segmentation offload
        total = len(packet) - at
    if version >> 4 != 4 or header < 20 or total < header:
        raise Malformed("IPv4 header")
    stop = at + total
    fragment = Fragment(ident, (flags & 0x1FFF) * 8, bool(flags & 0x2000)) if flags & 0x3FFF else None
    payload = packet[at + header : stop]
    return Datagram(protocol, source, destination, payload, total - header - len(payload), fragment)


def decode_ipv6(packet: bytes, at: int) -> Datagram:
    """The IPv6 packet at ``at``, extension headers passed over up to a fragment's."""
    version, length, protocol, source, destination = _ipv6(packet, at)
    if version >> 28 != 6:
        raise Malformed("IPv6 header")
    length = length or len(packet) - at - 40  # jumbo, or left to the network card
    payload = packet[at + 40 : at + 40 + length]
    datagram = Datagram(protocol, source, destination, payload, length - len(payload))
    return skip_extensions(datagram)


def skip_extensions(datagram: Datagram) -> Datagram:
    """Pass over IPv6 extension headers at the start of the payload; a fragment header is noted and ends it."""
    protocol, source, destination, payload, missing, _ = datagram
    at = 0
    fragment = None
    while fragment is None and protocol in _EXTENSIONS:
        if protocol == _FRAGMENT:
            protocol, place, ident = _fragment_header(payload, at)
            at += 8
            if place & 0xFFF9:  # else an atomic fragment, which is whole (RFC 6946)
                fragment = Fragment(ident, place & 0xFFF8, bool(place & 1))
        else:
            size = (payload[at + 1] + 2) * 4 if protocol == _AUTHENTICATION else (payload[at + 1] + 1) * 8
            protocol = payload[at]
            at += size
    if at > len(payload) + missing:
        raise Malformed("IPv6 extension header")
    missing -= max(0, at - len(payload))
    return Datagram(protocol, source, destination, payload[at:], missing, fragment)


class _Partial:
    """The fragments of one datagram so far."""

    __slots__ = ("began_ns", "held", "nbytes", "packets", "parts", "protocol", "total")

    def __init__(self, began_ns: int | None) -> None:
        self.began_ns = began_ns
        self.parts: dict[int, bytes] = {}
        self.held = 0
        self.total: int | None = None
        self.protocol = 0
        self.packets = 0
        self.nbytes = 0  # captured bytes of the packets

    def joined(self) -> bytes | None:
        """The whole payload, or None while a part is missing. Where fragments overlap, the lower offset counts."""
        if self.total is None or self.held < self.total:
            return None
        payload = bytearray()
        for offset, part in sorted(self.parts.items()):
            if offset > len(payload):
                return None
            payload += part[len(payload) - offset :]
        return bytes(payload[: self.total]) if len(payload) >= self.total else None


class Whole(NamedTuple):
    """A reassembled datagram, and what it cost: packets and their captured bytes."""

    datagram: Datagram
    packets: int
    nbytes: int


class Fragments:
    """Datagrams in reassembly, bounded in number, bytes and age; ``lost`` lists (packets, captured bytes) given up."""

    def __init__(self) -> None:
        self._partials: dict[tuple[bytes, bytes, int, int], _Partial] = {}
        self._held = 0
        self.lost: list[tuple[int, int]] = []

    def add(self, datagram: Datagram, arrival_ns: int | None, nbytes: int) -> Whole | None:
        """Take in a fragment from a packet of ``nbytes`` captured bytes; return the datagram that it completes.

        Raises Malformed for a fragment that cannot be part of any datagram.
        """
        protocol, source, destination, payload, _, fragment = datagram
        assert fragment is not None
        ident, offset, more = fragment
        if not payload or offset + len(payload) > 0xFFFF or (more and len(payload) & 7):
            raise Malformed("fragment")
        self._expire(arrival_ns)
        # In IPv4 the protocol tells datagrams apart; in IPv6 only the first fragment's counts.
        key = (source, destination, ident, protocol if len(source) == 4 else 0)
        partial = self._partials.get(key)
        if partial is None:
            partial = self._partials[key] = _Partial(arrival_ns)
        partial.packets += 1
        partial.nbytes += nbytes
        if offset == 0:
            partial.protocol = protocol
        if not more and partial.total is None:
            partial.total = offset + len(payload)
        before = partial.parts.get(offset, b"")
        if len(payload) > len(before):
            partial.parts[offset] = payload
            partial.held += len(payload) - len(before)
            self._held += len(payload) - len(before)
        whole = partial.joined()
        if whole is None:
            while self._held > MAX_PARTIAL_BYTES or len(self._partials) > MAX_PARTIALS:
                self._give_up_oldest()
            return None
        del self._partials[key]
        self._held -= partial.held
        return Whole(Datagram(partial.protocol, source, destination, whole), partial.packets, partial.nbytes)

    def close(self) -> None:
        """Give up what is still incomplete."""
        while self._partials:
            self._give_up_oldest()

    def _expire(self, now_ns: int | None) -> None:
        while now_ns is not None and self._partials:
            began_ns = next(iter(self._partials.values())).began_ns
            if began_ns is None or now_ns - began_ns <= MAX_PARTIAL_AGE_NS:
                return
            self._give_up_oldest()

    def _give_up_oldest(self) -> None:
        partial = self._partials.pop(next(iter(self._partials)))
        self._held -= partial.held
        self.lost.append((partial.packets, partial.nbytes))


def endpoints(key: bytes) -> tuple[str, str]:
    """``host:port`` of source and destination from packed source, destination, source port, destination port."""
    size = (len(key) - 4) // 2
    source_port, destination_port = struct.unpack(">HH", key[-4:])
    return _endpoint(key[:size], source_port), _endpoint(key[size : 2 * size], destination_port)


def _endpoint(address: bytes, port: int) -> str:
    if len(address) == 4:
        return f"{socket.inet_ntop(socket.AF_INET, address)}:{port}"
    return f"[{socket.inet_ntop(socket.AF_INET6, address)}]:{port}"
