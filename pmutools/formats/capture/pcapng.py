"""pcapng: blocks of type, length, body and the length again (IETF draft-ietf-opsawg-pcapng).

Sections in either byte order, any number of interfaces with their own link type, ``if_tsresol`` and ``if_tsoffset``;
Enhanced, Simple and (obsolete) Packet Blocks. Blocks of other types are passed over. A block is accepted when both its
lengths agree; where they do not, the next place is searched for where blocks of known types chain.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.formats.capture.records import (
    LOOK,
    MAX_PACKET,
    NO_STAMP,
    RUN,
    Ints,
    Records,
    Verdict,
    gather,
    read_records,
)
from pmutools.formats.capture.tally import Tally
from pmutools.formats.capture.window import Window
from pmutools.timebase import NS

SECTION_HEADER = 0x0A0D0D0A
INTERFACE = 1
PACKET = 2
SIMPLE_PACKET = 3
ENHANCED_PACKET = 6
_WITH_PACKET = (ENHANCED_PACKET, SIMPLE_PACKET, PACKET)
# Without packets: names, statistics, journal, secrets, custom.
_KNOWN = (SECTION_HEADER, INTERFACE, *_WITH_PACKET, 4, 5, 9, 10, 0xBAD, 0x40000BAD)

MAGIC = b"\x0a\x0d\x0d\x0a"
ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
"""Byte-order magic (bytes 8-12 of a section header) -> byte order."""

MAX_BLOCK = 1 << 24
"""A longer block is taken for damage (libpcap's limit)."""
MAX_INTERFACES = 1 << 16
"""Further descriptions in one section are not kept."""
NO_INTERFACE = -1
"""LINKTYPE of a packet whose interface its section does not describe (unsupported, therefore)."""

_OPTION_END = 0
_OPTION_TSRESOL = 9
_OPTION_TSOFFSET = 14
_CHAIN = 2  # blocks in a row that end a search; must fit into LOOK
_SEARCHED_BLOCK = MAX_PACKET + 64
_STEP = 1 << 16  # bytes searched at a time
_INT64 = 1 << 63


class Interface(NamedTuple):
    """What an Interface Description Block says of its packets. ``snaplen`` (bytes) 0 is no limit."""

    linktype: int
    snaplen: int = 0
    ticks_hz: int = 1_000_000
    offset_ns: int = 0


_UNKNOWN = Interface(NO_INTERFACE)


def is_pcapng(head: bytes) -> bool:
    """Whether the first 12 bytes of a file begin a section."""
    return head[:4] == MAGIC and head[8:12] in ORDERS


def read_pcapng(window: Window, tally: Tally) -> Iterator[Records]:
    """The packets of a file for which :func:`is_pcapng` holds.

    A packet block whose lengths contradict each other, or whose stamp is outside int64 nanoseconds, is skipped as a
    gap of its own.
    """
    return read_records(window, tally, _Pcapng(tally))


class _Pcapng:
    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self.interfaces: list[Interface] = []
        self._begin_section("<")

    def _begin_section(self, order: str) -> None:
        self.order = order
        self.interfaces.clear()
        self._head = struct.Struct(order + "II").unpack_from
        self._seam = struct.Struct(order + "III").unpack_from
        # As far as the captured length; a Simple Packet Block has its wire length in place of ``interface``.
        fields = ("kind", "length", "interface", "high", "low", "captured", "wire_length")
        self._layout = np.dtype([(name, order + "u4") for name in fields])

    def run(self, data: bytes, pos: int) -> tuple[Records, int]:
        """A section's and an interface's description end the run, lest packets before them be read by it."""
        positions: list[int] = []
        size = len(data)
        seam = self._seam
        kind, length = self._head(data, pos) if size - pos >= 12 else (0, 0)
        while size - pos >= 12 and len(positions) < RUN:
            if kind == SECTION_HEADER:
                if positions:
                    break
                length = self._enter_section(data, pos)
                seam = self._seam
            stop = pos + length
            if length & 3 or not 12 <= length <= MAX_BLOCK or stop > size:
                break
            # The closing length and the next block's head in one go.
            closing, next_kind, next_length = (
                seam(data, stop - 4) if stop + 8 <= size else seam(data[stop - 4 : stop] + bytes(8))
            )
            if closing != length:
                break
            if kind in _WITH_PACKET:
                positions.append(pos)
            elif kind == INTERFACE:
                if positions:
                    break
                self._add_interface(data[pos + 8 : stop - 4])
            elif kind not in _KNOWN:
                self._tally.unknown_blocks += 1
            pos, kind, length = stop, next_kind, next_length
        return self._records(data, np.array(positions, np.int64)), pos

    def _records(self, data: bytes, positions: Ints) -> Records:
        """The packets of the packet blocks at ``positions``."""
        short = len(data) - int(positions[-1]) < self._layout.itemsize if len(positions) else False
        heads = gather(data + bytes(self._layout.itemsize) if short else data, positions, self._layout)
        kind, number = heads["kind"], heads["interface"].astype(np.int64)
        simple, obsolete = kind == SIMPLE_PACKET, kind == PACKET
        # The obsolete block has a 16-bit interface number and a drop count in the same place.
        number = np.where(simple, 0, np.where(obsolete, number & 0xFFFF if self.order == "<" else number >> 16, number))
        interfaces = self.interfaces or [_UNKNOWN]
        unknown = number >= len(self.interfaces)
        number[unknown] = 0
        linktype = np.full(len(positions), NO_INTERFACE)
        ticks = heads["high"].astype(np.uint64) << np.uint64(32) | heads["low"]
        arrival_ns = np.full(len(positions), NO_STAMP, np.int64)
        for present in np.unique(number).tolist():
            rows = number == present
            linktype[rows & ~unknown] = interfaces[present].linktype
            stamped = rows & ~simple
            arrival_ns[stamped] = _arrival_ns(ticks[stamped], interfaces[present])
        room = heads["length"].astype(np.int64) - np.where(simple, 16, 32)
        wire_length = heads["wire_length"].astype(np.int64)
        captured = heads["captured"].astype(np.int64)
        if simple.any():
            wire_length[simple] = heads["interface"][simple]
            captured[simple] = np.minimum(wire_length[simple], interfaces[0].snaplen or _INT64 - 1)
            captured[simple] = np.minimum(captured[simple], room[simple])
        start = positions + np.where(simple, 12, 28)
        sound = (captured >= 0) & (captured <= room) & (simple | (arrival_ns != NO_STAMP))
        damaged = heads["length"][~sound].astype(np.int64)
        self._tally.overhead_bytes -= int(damaged.sum())  # where the caller will have put these bytes
        self._tally.skipped_bytes += int(damaged.sum())
        self._tally.gaps += len(damaged)
        columns = start, start + captured, wire_length, arrival_ns, linktype
        return Records(data, *(column if sound.all() else column[sound] for column in columns))

    def _add_interface(self, body: bytes) -> None:
        if len(body) >= 8 and len(self.interfaces) < MAX_INTERFACES:
            self.interfaces.append(_interface(self.order, body))

    def _enter_section(self, data: bytes, pos: int) -> int:
        """Begin the section whose header is at ``pos`` and return the header's length, or 0 if it is not whole."""
        length = self._claimed(data, pos)
        if not length or data[pos + 4 : pos + 8] != data[pos + length - 4 : pos + length]:
            return 0
        self._begin_section(ORDERS[data[pos + 8 : pos + 12]])
        return length

    def judge(self, data: bytes, pos: int, ended: bool) -> Verdict:
        length = self._claimed(data, pos)
        if length and pos + length > len(data) and not ended:
            return Verdict(pos, pos, need=length + LOOK)
        limit = len(data) if ended else len(data) - LOOK
        found = self._search(data, pos + 1, limit)
        cut = found is None and (len(data) - pos < 12 or pos + length > len(data))
        return Verdict(pos, limit if found is None else found, cut=cut)

    def _claimed(self, data: bytes, pos: int) -> int:
        """Length that the block at ``pos`` claims, 0 where it cannot be one."""
        if len(data) - pos < 12:
            return 0
        order, shortest = self.order, 12
        if data[pos : pos + 4] == MAGIC:
            order, shortest = ORDERS.get(data[pos + 8 : pos + 12], ""), 28
            if not order:
                return 0
        (length,) = struct.unpack_from(order + "I", data, pos + 4)
        return int(length) if shortest <= length <= MAX_BLOCK and not length & 3 else 0

    def _search(self, data: bytes, begin: int, end: int) -> int | None:
        """First place in [begin, end) from which blocks of known types chain."""
        last = min(end, len(data) - 11)
        word = np.dtype(self.order + "u4")
        for start in range(begin, last, _STEP):
            count = min(_STEP, last - start)
            kind = np.ndarray((count,), word, data, start, (1,))
            length = np.ndarray((count,), word, data, start + 4, (1,))
            sound = (length >= 12) & (length <= _SEARCHED_BLOCK) & (length & 3 == 0)
            for candidate in np.flatnonzero(np.isin(kind, _KNOWN) & (sound | (kind == SECTION_HEADER))):
                if self._chains(data, start + int(candidate)):
                    return start + int(candidate)
        return None

    def _chains(self, data: bytes, pos: int) -> bool:
        """Whether blocks follow each other from ``pos`` on, long enough or up to the end of ``data``."""
        for link in range(_CHAIN):
            if link and len(data) - pos < 12:
                return True
            length = self._claimed(data, pos)
            stop = pos + length
            if not length or stop > len(data):
                return bool(link and length)
            if data[stop - 4 : stop] != data[pos + 4 : pos + 8]:
                return False
            pos = stop
        return True


def _arrival_ns(ticks: npt.NDArray[np.uint64], interface: Interface) -> Ints:
    """Nanoseconds since 1970 of an interface's ticks, :data:`NO_STAMP` where int64 cannot hold them."""
    ticks_hz, offset_ns = interface.ticks_hz, interface.offset_ns
    if NS % ticks_hz or abs(offset_ns) >= _INT64 >> 1:
        exact = (tick * NS // ticks_hz + offset_ns for tick in ticks.tolist())
        return np.array([each if -_INT64 <= each < _INT64 else NO_STAMP for each in exact], np.int64)
    tick_ns = NS // ticks_hz
    fits = ticks <= (_INT64 - 1 - max(offset_ns, 0)) // tick_ns
    return np.where(fits, ticks.astype(np.int64) * tick_ns + offset_ns, NO_STAMP)


def _interface(order: str, body: bytes) -> Interface:
    linktype, _, snaplen = struct.unpack_from(order + "HHI", body)
    ticks_hz, offset_s = 1_000_000, 0
    pos = 8
    while len(body) - pos >= 4:
        code, length = struct.unpack_from(order + "HH", body, pos)
        value = body[pos + 4 : pos + 4 + length]
        if code == _OPTION_TSRESOL and value:
            ticks_hz = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == _OPTION_TSOFFSET and len(value) == 8:
            (offset_s,) = struct.unpack(order + "q", value)
        elif code == _OPTION_END:
            break
        pos += 4 + length + (-length & 3)
    return Interface(linktype, snaplen, ticks_hz, offset_s * NS)
