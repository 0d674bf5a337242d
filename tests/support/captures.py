"""Capture files for tests: where the real recordings are, and a plain pcap writer that shares nothing with pmutools."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

CAPTURE_DIR = Path(__file__).resolve().parents[3] / "shared" / "captures"


class Contents(NamedTuple):
    """What a real capture holds: frames by type, and the stream's IDCODE."""

    config: int
    data: int
    command: int
    idcode: int


REAL_CAPTURES = {
    "C37.118_1PMU_TCP.pcap": Contents(1, 252, 3, 241),
    "C37.118_1PMU_UDP.pcap": Contents(1, 356, 4, 60),
    "C37.118_4in1PMU_TCP.pcap": Contents(3, 1342, 8, 60),
    "c37_1100_fullclean.pcap": Contents(1, 422, 3, 1),
}


def capture_path(name: str) -> Path:
    """A real recording beside the checkout; skips the test, saying so, where it is absent."""
    path = CAPTURE_DIR / name
    if not path.exists():
        pytest.skip(f"real capture {name} is not in ../shared/captures beside the checkout")
    return path


class Endpoint(NamedTuple):
    host: str
    port: int


PMU = Endpoint("192.0.2.1", 4713)
PDC = Endpoint("192.0.2.2", 54712)


def udp_packet(payload: bytes, source: Endpoint = PMU, destination: Endpoint = PDC) -> bytes:
    """One Ethernet/IPv4/UDP packet."""
    header = struct.pack(">HHHH", source.port, destination.port, 8 + len(payload), 0)
    return _ethernet(17, source, destination, header + payload)


def tcp_packets(
    segments: Iterable[bytes], source: Endpoint = PMU, destination: Endpoint = PDC, *, handshake: bool = True
) -> list[bytes]:
    """Ethernet/IPv4/TCP packets that carry ``segments`` in order, after a handshake."""
    packets, seq, ack = [], 1000, 2000
    if handshake:
        packets.append(_tcp(source, destination, seq - 1, 0, 0x02))
        packets.append(_tcp(destination, source, ack - 1, seq, 0x12))
        packets.append(_tcp(source, destination, seq, ack, 0x10))
    for segment in segments:
        packets.append(_tcp(source, destination, seq, ack, 0x18, segment))
        seq += len(segment)
    return packets


def write_pcap(
    path: Path, packets: Sequence[bytes], *, first_ns: int = 1_700_000_000 * 10**9, step_ns: int = 10**6
) -> Path:
    """Write Ethernet ``packets``, ``step_ns`` apart, as a nanosecond pcap; returns ``path``."""
    parts = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 1)]
    for index, packet in enumerate(packets):
        seconds, rest_ns = divmod(first_ns + index * step_ns, 10**9)
        parts.append(struct.pack("<IIII", seconds, rest_ns, len(packet), len(packet)) + packet)
    path.write_bytes(b"".join(parts))
    return path


def _tcp(source: Endpoint, destination: Endpoint, seq: int, ack: int, flags: int, payload: bytes = b"") -> bytes:
    ports = (source.port, destination.port)
    header = struct.pack(">HHIIBBHHH", *ports, seq, ack, 0x50, flags, 0xFFFF, 0, 0)
    return _ethernet(6, source, destination, header + payload)


def _ethernet(protocol: int, source: Endpoint, destination: Endpoint, payload: bytes) -> bytes:
    hosts = b"".join(bytes(map(int, end.host.split("."))) for end in (source, destination))
    head = struct.pack(">BBHHHBB", 0x45, 0, 20 + len(payload), 0, 0, 64, protocol)
    total = sum(struct.unpack(">9H", head + hosts))
    checksum = ~(total % 0xFFFF) & 0xFFFF
    return bytes(6) + b"\x02\0\0\0\0\1" + b"\x08\0" + head + struct.pack(">H", checksum) + hosts + payload
