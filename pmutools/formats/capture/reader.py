"""Capture file -> chunks of its flows: file grammar, link layer, IP, UDP or TCP, one after the other."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import numpy as np

from pmutools.errors import SourceError
from pmutools.flow import Chunk, Flow, StampSource, Train
from pmutools.formats.capture import ip, link
from pmutools.formats.capture.pcap import MAGICS, read_pcap
from pmutools.formats.capture.pcapng import is_pcapng, read_pcapng
from pmutools.formats.capture.plain import Mask, Plain, alike, plain
from pmutools.formats.capture.records import NO_STAMP, Records, gather
from pmutools.formats.capture.tally import Fate, Tally
from pmutools.formats.capture.tcp import Reassembly, Segment
from pmutools.formats.capture.window import Window

MAX_FLOWS = 1 << 16
"""UDP flows remembered at one time; a forgotten one is made anew, equal to the old."""

_NOTHING: Sequence[Chunk] = ()
_tcp = struct.Struct(">4xIIBB").unpack_from
_udp = struct.Struct(">4xH").unpack_from

_data = itemgetter(0)
T = TypeVar("T")


class CaptureReader:
    """The UDP datagrams and TCP bytes of a .pcap or .pcapng file, gzip or zstd over it or not.

    The file's kind is seen from its content. Iterating yields :class:`~pmutools.flow.Chunk` in the order in which the
    file makes them deliverable, and each iteration reads the file anew, with a new ``tally``. Only one iteration at a
    time; not for several threads. Memory: the packets of one
    block of the file (window.py), and the stated bounds of the reassembly of IP fragments
    (``ip.py``) and TCP (``tcp.py``).

    ``arrival_ns`` is the packet's stamp; of a datagram in fragments, the last fragment's; of TCP bytes that waited for
    others, that of the segment which released them. It is None where the file has no stamp (Simple Packet Block).
    Damage in the file is counted in ``tally``, never raised. IP, UDP and TCP checksums are not looked at: captures on
    the sending host lack them.

    Raises :class:`SourceError` for a file that cannot be opened, is empty or is no capture.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.tally = Tally()
        self._window: Window | None = None
        with Window(self.path) as window:
            self.kind = _require_capture(window)
            """``pcap`` or ``pcapng``."""

    @property
    def progress(self) -> float:
        """Share of the file read by the present iteration, 0..1."""
        if self._window is None or not self._window.size:
            return 0.0
        return min(1.0, self._window.position / self._window.size)

    def __iter__(self) -> Iterator[Chunk]:
        return self._read(_Dissector.chunks)

    def trains(self) -> Iterator[Chunk | Train]:
        """The same, but datagrams of one flow and size together where there are many: much faster to work on.

        The order of what one flow carries is kept, not that among flows.
        """
        return self._read(_Dissector.trains)

    def _read(self, pieces: Callable[[_Dissector, Records], Iterable[T]]) -> Iterator[T | Chunk]:
        tally = self.tally = Tally()
        with Window(self.path) as window:
            self._window = window
            read = read_pcapng if _require_capture(window) == "pcapng" else read_pcap
            dissector = _Dissector(tally)
            for batch in read(window, tally):
                found = pieces(dissector, batch)
                tally.file_bytes = window.total
                yield from found
            yield from dissector.close()
            tally.file_bytes, tally.decompression_failed = window.total, window.failed


def is_capture(head: bytes) -> bool:
    """Whether a file that begins with ``head`` (12 bytes or more, decompressed) is a .pcap or a .pcapng."""
    return head[:4] in MAGICS or is_pcapng(head)


def _require_capture(window: Window) -> str:
    window.advance(0, 12)
    if is_capture(window.data):
        return "pcapng" if is_pcapng(window.data) else "pcap"
    if not window.data:
        why = "holds nothing that can be decompressed" if window.size else "is empty"
        raise SourceError(f"{window.path} {why}; record it again or name another file")
    raise SourceError(
        f"{window.path} is no capture (begins with {window.data[:4].hex(' ')}); name a .pcap or .pcapng file"
    )


def _stamps(records: Records) -> list[int | None]:
    stamps: list[int | None] = records.arrival_ns.tolist()
    for row in np.flatnonzero(records.arrival_ns == NO_STAMP).tolist():
        stamps[row] = None
    return stamps


class _Flows(dict[bytes, Flow]):
    """UDP flows by packed source, destination and ports."""

    def __missing__(self, key: bytes) -> Flow:
        if len(self) >= MAX_FLOWS:
            self.clear()
        flow = self[key] = Flow("udp", *ip.endpoints(key))
        return flow


class _Dissector:
    """Packets -> chunks, and what becomes of each packet -> tally."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._flows = _Flows()
        self._fragments = ip.Fragments()
        self._tcp = Reassembly(tally)

    def chunks(self, records: Records) -> list[Chunk]:
        """The chunks that these packets make deliverable."""
        short, stamps = plain(records), _stamps(records)
        return self._in_order(records, short, stamps, short.udp, self._others(records, short, stamps))

    def trains(self, records: Records) -> list[Chunk | Train]:
        """The same; of flows that do nothing but send equal datagrams, these together."""
        short, stamps = plain(records), _stamps(records)
        others = self._others(records, short, stamps)
        busy = {chunk.flow for _, chunks in others for chunk in chunks}
        apart = short.udp.copy()
        found: list[Chunk | Train] = []
        for rows in alike(short):
            flow = self._flows[short.key[rows[0]].tobytes()]
            if flow in busy:
                continue
            apart[rows] = False
            size = int(short.end[rows[0]] - short.begin[rows[0]])
            datagrams = gather(records.data, short.begin[rows], np.dtype(("V", size))).tobytes()
            found.append(Train(datagrams, size, [stamps[row] for row in rows.tolist()], flow))
            self._tally.chunks += len(rows)
            self._tally.payload_bytes += len(datagrams)
        found += self._in_order(records, short, stamps, apart, others)
        return found

    def _others(self, records: Records, short: Plain, stamps: list[int | None]) -> list[tuple[int, Sequence[Chunk]]]:
        """What the packets that are not plain UDP make deliverable, by row."""
        data, start, stop, wire_length, _, linktype = records
        others: list[tuple[int, Sequence[Chunk]]] = []
        columns = (short.key, short.sequence, short.acknowledged, short.flags, short.begin, short.end, stop - start)
        segments = zip(*(column[short.tcp].tolist() for column in columns), strict=True)
        for row in np.flatnonzero(~short.udp).tolist():
            chunks: Sequence[Chunk]
            if short.tcp[row]:
                key, sequence, acknowledged, flags, begin, end, size = next(segments)
                segment = Segment(key, sequence, acknowledged, flags, data[begin:end], 0, stamps[row])
                fate, chunks = self._tcp.feed(segment)
                self._tally.count(fate, size)
            else:
                packet = data[int(start[row]) : int(stop[row])]
                chunks = self._dissect(stamps[row], int(linktype[row]), int(wire_length[row]), packet)
            if chunks:
                others.append((row, chunks))
        self._tally.count(Fate.UDP, int((stop - start)[short.udp].sum()), int(short.udp.sum()))
        return others

    def _in_order(
        self,
        records: Records,
        short: Plain,
        stamps: list[int | None],
        wanted: Mask,
        others: list[tuple[int, Sequence[Chunk]]],
    ) -> list[Chunk]:
        """The datagrams of the ``wanted`` plain UDP rows and ``others``, by row."""
        out: list[Chunk] = []
        append, data, flows, new, capture = out.append, records.data, self._flows, tuple.__new__, StampSource.CAPTURE
        rows = np.flatnonzero(wanted)
        keys, begins, ends = short.key[rows].tolist(), short.begin[rows].tolist(), short.end[rows].tolist()
        arrivals = stamps if len(rows) == len(stamps) else [stamps[row] for row in rows.tolist()]
        done = 0
        places = np.searchsorted(rows, [row for row, _ in others]).tolist()
        for place, chunks in [*zip(places, (chunks for _, chunks in others), strict=True), (len(rows), _NOTHING)]:
            part = slice(done, place)
            for begin, end, stamp, key in zip(begins[part], ends[part], arrivals[part], keys[part], strict=True):
                append(new(Chunk, (data[begin:end], stamp, flows[key], capture, 0)))
            done = place
            out += chunks
        self._count_chunks(out)
        return out

    def close(self) -> list[Chunk]:
        """What the end of the file makes deliverable."""
        self._fragments.close()
        self._count_lost_fragments()
        out = self._tcp.close()
        self._count_chunks(out)
        return out

    def _count_chunks(self, chunks: list[Chunk]) -> None:
        self._tally.chunks += len(chunks)
        self._tally.payload_bytes += sum(map(len, map(_data, chunks)))

    def _dissect(self, arrival_ns: int | None, linktype: int, wire_length: int, packet: bytes) -> Sequence[Chunk]:
        """The general way, for any packet."""
        fate, chunks, packets, nbytes = Fate.DAMAGED, _NOTHING, 1, len(packet)
        try:
            network = link.network_layer(linktype, packet)
            if network is None:
                seen = self._tally.unsupported_links
                seen[linktype] = seen.get(linktype, 0) + 1
                fate = Fate.UNSUPPORTED_LINK
            elif network[0] == link.NOT_IP:
                fate = Fate.NOT_IP
            else:
                kind, offset = network
                datagram = ip.decode_ipv4(packet, offset) if kind == link.IPV4 else ip.decode_ipv6(packet, offset)
                if datagram.missing and len(packet) >= wire_length:
                    raise ip.Malformed("IP length")
                if datagram.fragment is not None:
                    self._tally.fragments += 1
                    if datagram.missing:
                        self._tally.count(Fate.TRUNCATED, nbytes)
                        return _NOTHING
                    whole = self._fragments.add(datagram, arrival_ns, nbytes)
                    self._count_lost_fragments()
                    if whole is None:
                        return _NOTHING
                    datagram, packets, nbytes = whole
                    if kind == link.IPV6:
                        datagram = ip.skip_extensions(datagram)
                fate, chunks = self._transport(datagram, arrival_ns)
        except ip.Malformed:
            fate = Fate.DAMAGED
        except (struct.error, IndexError):  # a header reaches beyond the packet
            fate = Fate.TRUNCATED if len(packet) < wire_length else Fate.DAMAGED
        self._tally.count(fate, nbytes, packets)
        return chunks

    def _transport(self, datagram: ip.Datagram, arrival_ns: int | None) -> tuple[Fate, Sequence[Chunk]]:
        protocol, source, destination, payload, missing, fragment = datagram
        if fragment is not None or protocol not in (ip.UDP, ip.TCP):
            return (Fate.OTHER_IP if fragment is None else Fate.DAMAGED), _NOTHING
        key = source + destination + payload[:4]
        if protocol == ip.UDP:
            length = _udp(payload)[0] or len(payload) + missing
            if not 8 <= length <= len(payload) + missing:
                return Fate.DAMAGED, _NOTHING
            if length > len(payload):
                return Fate.TRUNCATED, _NOTHING
            return Fate.UDP, (Chunk(payload[8:length], arrival_ns, self._flows[key]),)
        sequence, acknowledged, offset, flags = _tcp(payload)
        header = (offset >> 4) * 4
        if not 20 <= header <= len(payload) + missing:
            return Fate.DAMAGED, _NOTHING
        data = b"" if missing else payload[header:]
        unseen = len(payload) + missing - header if missing else 0
        fate, chunks = self._tcp.feed(Segment(key, sequence, acknowledged, flags, data, unseen, arrival_ns))
        return (Fate.TRUNCATED if missing else fate), chunks

    def _count_lost_fragments(self) -> None:
        for packets, nbytes in self._fragments.lost:
            self._tally.count(Fate.FRAGMENT_LOST, nbytes, packets)
        self._fragments.lost.clear()
