"""Packets and capture files byte by byte, of any kind that a reader may meet; shares nothing with pmutools.

A record is (arrival in ns, packet), or (arrival, packet, length on the wire) where the capture cut the packet.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

T0 = 1_700_000_000 * 10**9

A4 = bytes((192, 0, 2, 1))
B4 = bytes((192, 0, 2, 2))
A6 = bytes.fromhex("20010db8000000000000000000000001")
B6 = bytes.fromhex("20010db8000000000000000000000002")
PORT_A, PORT_B = 4713, 50_000

FIN, SYN, RST, PSH, ACK = 1, 2, 4, 8, 16

Record = tuple[int, bytes] | tuple[int, bytes, int]


# Files


def pcap(
    records: Sequence[Record], *, order: str = "<", nanoseconds: bool = True, modified: bool = False, linktype: int = 1
) -> bytes:
    magic = 0xA1B2CD34 if modified else 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    out = [struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 262144, linktype)]
    for arrival_ns, packet, *wire in records:
        seconds, rest = divmod(arrival_ns, 10**9)
        fraction = rest if nanoseconds and not modified else rest // 1000
        out.append(struct.pack(order + "IIII", seconds, fraction, len(packet), *(wire or [len(packet)])))
        if modified:
            out.append(struct.pack(order + "IHBB", 2, 0x0800, 0, 0))
        out.append(packet)
    return b"".join(out)


def block(order: str, kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) & 3)
    length = struct.pack(order + "I", len(body) + 12)
    return struct.pack(order + "I", kind) + length + body + length


def section(order: str = "<", options: bytes = b"") -> bytes:
    return block(order, 0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1) + options)


def option(order: str, code: int, value: bytes) -> bytes:
    return struct.pack(order + "HH", code, len(value)) + value + bytes(-len(value) & 3)


def interface(
    order: str = "<", linktype: int = 1, snaplen: int = 0, tsresol: int | None = None, offset_s: int | None = None
) -> bytes:
    options = option(order, 2, b"eth0")
    if tsresol is not None:
        options += option(order, 9, bytes((tsresol,)))
    if offset_s is not None:
        options += option(order, 14, struct.pack(order + "q", offset_s))
    return block(order, 1, struct.pack(order + "HHI", linktype, 0, snaplen) + options + option(order, 0, b""))


def enhanced(packet: bytes, ticks: int, number: int = 0, order: str = "<", wire: int | None = None) -> bytes:
    head = struct.pack(order + "5I", number, ticks >> 32, ticks & 0xFFFFFFFF, len(packet), wire or len(packet))
    return block(order, 6, head + packet + bytes(-len(packet) & 3) + option(order, 1, b"comment"))


def simple(packet: bytes, order: str = "<", wire: int | None = None) -> bytes:
    return block(order, 3, struct.pack(order + "I", wire or len(packet)) + packet)


def obsolete(packet: bytes, ticks: int, number: int = 0, order: str = "<") -> bytes:
    head = struct.pack(order + "HH4I", number, 7, ticks >> 32, ticks & 0xFFFFFFFF, len(packet), len(packet))
    return block(order, 2, head + packet)


def pcapng(records: Sequence[Record], order: str = "<") -> bytes:
    """One section, one interface with nanosecond stamps."""
    blocks = [enhanced(packet, ticks, 0, order, *wire) for ticks, packet, *wire in records]
    return section(order) + interface(order, tsresol=9) + b"".join(blocks)


# Link layers


def ethernet(network: bytes, ethertype: int | None = None, vlans: Sequence[int] = ()) -> bytes:
    """``vlans`` are tag protocol identifiers, outermost first."""
    kind = ethertype or (0x0800 if network[0] >> 4 == 4 else 0x86DD)
    tags = b"".join(struct.pack(">HH", tpid, 7) for tpid in vlans)
    return b"\x02\0\0\0\0\2" + b"\x02\0\0\0\0\1" + tags + struct.pack(">H", kind) + network


def cooked(network: bytes, version: int) -> bytes:
    kind = 0x0800 if network[0] >> 4 == 4 else 0x86DD
    if version == 1:
        return struct.pack(">HHH8sH", 0, 1, 6, bytes(8), kind) + network
    return struct.pack(">HHIHBB8s", kind, 0, 3, 1, 0, 6, bytes(8)) + network


# IP


def ipv4(
    payload: bytes,
    protocol: int = 17,
    source: bytes = A4,
    destination: bytes = B4,
    *,
    options: bytes = b"",
    ident: int = 0,
    offset: int = 0,
    more: bool = False,
    total: int | None = None,
) -> bytes:
    size = 20 + len(options)
    length = size + len(payload) if total is None else total
    place = offset >> 3 | (0x2000 if more else 0)
    head = struct.pack(">BBHHHBBH", 0x40 | size // 4, 0, length, ident, place, 64, protocol, 0)
    return head + source + destination + options + payload


def ipv6(payload: bytes, protocol: int = 17, source: bytes = A6, destination: bytes = B6) -> bytes:
    return struct.pack(">IHBB", 6 << 28, len(payload), protocol, 64) + source + destination + payload


def ipv6_fragment(payload: bytes, protocol: int, offset: int, more: bool, ident: int = 9) -> bytes:
    return ipv6(struct.pack(">BBHI", protocol, 0, offset | more, ident) + payload, 44)


def udp(data: bytes, source: int = PORT_A, destination: int = PORT_B, length: int | None = None) -> bytes:
    return struct.pack(">HHHH", source, destination, 8 + len(data) if length is None else length, 0) + data


def tcp(
    data: bytes, sequence: int, flags: int = ACK | PSH, acknowledged: int = 0, source: int = PORT_A, to: int = PORT_B
) -> bytes:
    numbers = sequence & 0xFFFFFFFF, acknowledged & 0xFFFFFFFF
    return struct.pack(">HHIIBBHHH", source, to, *numbers, 0x50, flags, 0xFFFF, 0, 0) + data


def udp_frame(data: bytes) -> bytes:
    """A plain Ethernet/IPv4/UDP packet."""
    return ethernet(ipv4(udp(data)))


def tcp_frame(
    data: bytes, sequence: int, flags: int = ACK | PSH, acknowledged: int = 0, *, back: bool = False
) -> bytes:
    """A plain Ethernet/IPv4/TCP packet, from A to B or back."""
    if back:
        return ethernet(ipv4(tcp(data, sequence, flags, acknowledged, PORT_B, PORT_A), 6, B4, A4))
    return ethernet(ipv4(tcp(data, sequence, flags, acknowledged), 6))
