"""Chunks of flows -> a .pcap or .pcapng file with the packets that would have carried them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Protocol

from pmutools.errors import EncodeError, SourceError
from pmutools.flow import Chunk, Flow
from pmutools.formats.capture import link, pcapng
from pmutools.formats.capture.build import Endpoint, Route, parse_endpoint
from pmutools.formats.capture.tcp import ACK, SYN
from pmutools.formats.output import OutputFile
from pmutools.timebase import NS

SEGMENT_BYTES = 1400
"""TCP payload of one packet at most."""
SUFFIXES = (".pcap", ".pcapng")
COMPRESSIONS = ("", ".gz", ".zst")

_PSH = 0x08
_SYN_OPTIONS = b"\x02\x04\x05\x78" + b"\x01\x03\x03\x0e"  # segments of 1400 bytes, windows in units of 16 KiB
_SNAPLEN = 262_144
_C37118_PORT = 4713


class CaptureWriter:
    """Writes chunks as Ethernet packets, stamped with their arrival in nanoseconds. Use as a context manager.

    The name decides: ``.pcap`` or ``.pcapng``, with ``.gz`` or ``.zst`` after it or not. The same chunks give the same
    bytes. The file is valid up to the last :meth:`flush`. Not for several threads.

    - UDP: one datagram a chunk, in IP fragments above the MTU.
    - TCP: a handshake when a connection is first seen, then segments of up to 1400 bytes with running sequence
      numbers; ``lost_before`` leaves a gap in them, which the receiver acknowledges. A chunk whose
      ``Flow.connection`` differs from the one before, between the same endpoints, opens a new connection.
    - A ``file`` flow becomes UDP between ports 4713 of a loopback address of its own, 127.0.0.1 on.

    Raises :class:`SourceError` where the file cannot be written or its name has no known suffix, and
    :class:`EncodeError` for a chunk that packets cannot carry: endpoints without a numeric address, more than 65507
    bytes (IPv6: 65527) in a datagram, an arrival that the stamp cannot hold.
    """

    def __init__(self, path: str | Path, suffix: str | None = None) -> None:
        """``suffix`` says the kind where the name does not, as that of standard output (``-``)."""
        self.path = Path(path)
        self._container = _container(self.path if suffix is None else Path(suffix))
        self._packetizer = _Packetizer()
        self._file = OutputFile(self.path)
        self._file.write(self._container.header)

    def __enter__(self) -> CaptureWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, chunk: Chunk) -> None:
        """Append the packets of ``chunk``. One without an arrival: in pcapng without a stamp, in pcap stamped as the
        packet before it (the first: 1970)."""
        packets = self._packetizer.packets(chunk)
        self._file.write(b"".join([self._container.record(chunk.arrival_ns, packet) for packet in packets]))

    def flush(self) -> None:
        """Put all that was written into the file, readable to its end."""
        self._file.flush()

    def close(self) -> None:
        """Finish the file; may be called again."""
        self._file.close()


class _Container(Protocol):
    header: bytes

    def record(self, arrival_ns: int | None, packet: bytes) -> bytes: ...


def _container(path: Path) -> _Container:
    name = path.name.lower()
    for compression in COMPRESSIONS:
        stem = name.removesuffix(compression)
        if stem.endswith(".pcapng"):
            return _Pcapng()
        if stem.endswith(".pcap"):
            return _Pcap()
    raise SourceError(f"cannot tell the kind of capture from the name {path}; end it in .pcap or .pcapng (.gz, .zst)")


class _Pcap:
    """pcap with nanosecond stamps, little-endian."""

    header = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, _SNAPLEN, link.ETHERNET)

    def __init__(self) -> None:
        self._last_ns = 0

    def record(self, arrival_ns: int | None, packet: bytes) -> bytes:
        if arrival_ns is None:
            arrival_ns = self._last_ns
        if not 0 <= arrival_ns < NS << 32:
            raise EncodeError(f"arrival {arrival_ns} ns is outside 1970..2106, which a .pcap can hold")
        self._last_ns = arrival_ns
        return struct.pack("<IIII", *divmod(arrival_ns, NS), len(packet), len(packet)) + packet


class _Pcapng:
    """One section, one interface with nanosecond stamps, little-endian."""

    header = struct.pack("<IIIHHqI", pcapng.SECTION_HEADER, 28, 0x1A2B3C4D, 1, 0, -1, 28) + struct.pack(
        "<IIHHIHHBxxxHHI", pcapng.INTERFACE, 32, link.ETHERNET, 0, 0, 9, 1, 9, 0, 0, 32
    )

    def record(self, arrival_ns: int | None, packet: bytes) -> bytes:
        size = len(packet)
        padding = bytes(-size & 3)
        if arrival_ns is None:
            length = 16 + size + len(padding)
            head = struct.pack("<III", pcapng.SIMPLE_PACKET, length, size)
        else:
            if arrival_ns < 0:
                raise EncodeError(f"arrival {arrival_ns} ns is before 1970, which a capture cannot hold")
            length = 32 + size + len(padding)
            stamp = arrival_ns >> 32, arrival_ns & 0xFFFFFFFF
            head = struct.pack("<IIIIIII", pcapng.ENHANCED_PACKET, length, 0, *stamp, size, size)
        return b"".join((head, packet, padding, struct.pack("<I", length)))


class _Connection:
    """A TCP connection as written so far: the next sequence number of either source endpoint."""

    __slots__ = ("number", "sequences")

    def __init__(self, number: int, sequences: dict[str, int]) -> None:
        self.number = number
        self.sequences = sequences


class _Packetizer:
    """Chunks -> Ethernet frames; keeps what the flows need to go on."""

    def __init__(self) -> None:
        self._routes: dict[tuple[str, str, str], Route] = {}
        self._connections: dict[tuple[str, ...], _Connection] = {}
        self._files = 0
        self._ident = 0

    def packets(self, chunk: Chunk) -> Iterator[bytes]:
        """The frames of one chunk."""
        flow = chunk.flow
        route = self._routes.get(flow[:3]) or self._open(flow)
        if flow.transport == "tcp":
            return self._tcp(route, chunk)
        return route.udp(chunk.data, self._next_ident())

    def _open(self, flow: Flow) -> Route:
        if flow.transport == "file":
            self._files += 1
            host = Endpoint((0x7F000000 + self._files).to_bytes(4, "big"), _C37118_PORT)
            route = Route(host, host)
        else:
            source = parse_endpoint(flow.source)
            route = Route(source, parse_endpoint(flow.destination) if flow.destination else source)
        if len(route.source.address) != len(route.destination.address):
            raise EncodeError(f"flow {flow.source} -> {flow.destination} mixes IPv4 and IPv6")
        self._routes[flow[:3]] = route
        return route

    def _next_ident(self) -> int:
        self._ident += 1
        return self._ident

    def _tcp(self, route: Route, chunk: Chunk) -> Iterator[bytes]:
        flow = chunk.flow
        pair = tuple(sorted((flow.source, flow.destination)))
        connection = self._connections.get(pair)
        if connection is None or connection.number != flow.connection:
            connection = self._connections[pair] = _Connection(flow.connection, _initial_sequences(flow))
            yield from self._handshake(route, flow, connection)
        sequences = connection.sequences
        sequence = sequences[flow.source] + chunk.lost_before
        for start in range(0, len(chunk.data), SEGMENT_BYTES):
            part = chunk.data[start : start + SEGMENT_BYTES]
            yield from route.tcp(sequence, sequences[flow.destination], _PSH | ACK, part, self._next_ident())
            sequence += len(part)
        sequences[flow.source] = sequence
        if chunk.lost_before:
            back = Route(route.destination, route.source)
            yield from back.tcp(sequences[flow.destination], sequence, ACK, b"", self._next_ident())

    def _handshake(self, route: Route, flow: Flow, connection: _Connection) -> Iterator[bytes]:
        """SYN, SYN-ACK, ACK; the client is the side with the higher port."""
        forth, back = route, Route(route.destination, route.source)
        client, server = flow.source, flow.destination
        if route.source.port < route.destination.port:
            forth, back, client, server = back, forth, server, client
        sequences = connection.sequences
        mine, others = sequences[client], sequences[server]
        yield from forth.tcp(mine, 0, SYN, b"", self._next_ident(), _SYN_OPTIONS)
        yield from back.tcp(others, mine + 1, SYN | ACK, b"", self._next_ident(), _SYN_OPTIONS)
        yield from forth.tcp(mine + 1, others + 1, ACK, b"", self._next_ident())
        sequences[client] = mine + 1
        sequences[server] = others + 1


def _initial_sequences(flow: Flow) -> dict[str, int]:
    """Repeatable initial sequence numbers, which differ from one connection to the next."""
    return {
        endpoint: (zlib.crc32(endpoint.encode()) + flow.connection * 0x1000_0001) & 0xFFFFFFFF
        for endpoint in (flow.source, flow.destination)
    }
