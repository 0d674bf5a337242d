"""Classic .pcap: a 24-byte file header, then records of a 16-byte header and the packet (libpcap's pcap-savefile(5)).

Both byte orders, microsecond and nanosecond stamps, and the 24-byte record header of Kuznetzov's patched libpcap.

A record is accepted when a plausible one starts where its length says; where that fails, the next place is searched
for, byte by byte, from which plausible records chain.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.formats.capture.records import LOOK, MAX_PACKET, RUN, Ints, Records, Verdict, gather, read_records
from pmutools.formats.capture.tally import Tally
from pmutools.formats.capture.window import Window
from pmutools.timebase import NS

FILE_HEADER = 24

# magic -> byte order, nanoseconds per unit of the fraction, record header size
MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000, 16),
    b"\xa1\xb2\xc3\xd4": (">", 1000, 16),
    b"\x4d\x3c\xb2\xa1": ("<", 1, 16),
    b"\xa1\xb2\x3c\x4d": (">", 1, 16),
    b"\x34\xcd\xb2\xa1": ("<", 1000, 24),
    b"\xa1\xb2\xcd\x34": (">", 1000, 24),
}

_DAY_S = 86_400
_SETTLED_S = 500_000_000  # 1985: a search believes an earlier stamp only near the last good one
_CHAIN = 3  # plausible headers in a row that end a search; must fit into LOOK
_STEP = 1 << 16  # bytes searched at a time


def read_pcap(window: Window, tally: Tally) -> Iterator[Records]:
    """The packets of a file that starts with one of :data:`MAGICS`.

    A stamp more than a day from both its neighbours, which agree with each other, is damage; any other step of the
    clock is taken as it is.
    """
    window.advance(0, FILE_HEADER)
    if len(window.data) < FILE_HEADER:
        tally.cut_bytes += len(window.data)
        return
    tally.overhead_bytes += FILE_HEADER
    grammar = _Pcap(window.data)
    window.advance(FILE_HEADER, 0)
    yield from read_records(window, tally, grammar)


class _Head(NamedTuple):
    seconds: int
    stop: int  # where the next record starts


class _Pcap:
    def __init__(self, header: bytes) -> None:
        self.order, self.unit_ns, self.size = MAGICS[header[:4]]
        # The upper half of the field holds flags and the length of a frame check sequence.
        self.linktype: int = struct.unpack_from(self.order + "I", header, 20)[0] & 0xFFFF
        word = self.order + "u4"
        self._layout = np.dtype([("seconds", word), ("fraction", word), ("length", word), ("wire_length", word)])
        self._unpack = struct.Struct(self.order + "IIII").unpack_from
        self._length = struct.Struct(self.order + "I").unpack_from
        self._units = NS // self.unit_ns
        self._last_s: int | None = None

    def run(self, data: bytes, pos: int) -> tuple[Records, int]:
        """The chain of lengths is followed first, blindly, and then cut at the first implausible header."""
        size, length = self.size, self._length
        chain: list[int] = []
        last = len(data) - size
        while pos <= last and len(chain) <= RUN:
            chain.append(pos)
            pos += size + length(data, pos + 8)[0]
        heads = gather(data, np.array(chain, np.int64), self._layout)
        seconds = heads["seconds"].astype(np.int64)
        sound = (heads["length"] > 0) & (heads["length"] <= heads["wire_length"])
        sound &= (heads["wire_length"] <= MAX_PACKET) & (heads["fraction"] < self._units)
        followed = sound[:-1] & sound[1:] & (np.abs(np.diff(seconds)) <= _DAY_S)
        count = int(np.argmin(followed)) if not followed.all() else len(followed)
        if count:
            self._last_s = int(seconds[count - 1])
        records = self._records(data, np.array(chain[:count], np.int64), heads[:count])
        return records, chain[count] if chain else pos

    def _records(self, data: bytes, positions: Ints, heads: npt.NDArray[Any]) -> Records:
        start = positions + self.size
        arrival_ns = heads["seconds"].astype(np.int64) * NS + heads["fraction"].astype(np.int64) * self.unit_ns
        wire_length = heads["wire_length"].astype(np.int64)
        return Records(
            data, start, start + heads["length"], wire_length, arrival_ns, np.full(len(start), self.linktype)
        )

    def judge(self, data: bytes, pos: int, ended: bool) -> Verdict:
        if len(data) - pos < self.size:
            return Verdict(pos, len(data), cut=True)
        head = self._head(data, pos)
        if head is None or head.stop > len(data):
            limit = len(data) if ended else len(data) - LOOK
            found = self._search(data, pos + 1, limit)
            return Verdict(pos, limit if found is None else found, cut=found is None and head is not None)
        resume = head.stop
        if len(data) - head.stop >= self.size:
            follower = self._head(data, head.stop)
            if follower is None:
                # A good record inside this one shows that its length is wrong; else it is the follower that is damaged.
                found = self._search(data, pos + 1, head.stop)
                if found is not None:
                    return Verdict(pos, found)
            elif not _near(follower.seconds, head.seconds):
                after = self._head(data, follower.stop)
                if after is not None and _near(after.seconds, head.seconds):
                    resume = follower.stop
        self._last_s = head.seconds
        place = np.array([pos])
        return Verdict(head.stop, resume, record=self._records(data, place, gather(data, place, self._layout)))

    def _head(self, data: bytes, pos: int) -> _Head | None:
        """The header at ``pos``, if there is a plausible one."""
        if len(data) - pos < self.size:
            return None
        seconds, fraction, length, wire_length = self._unpack(data, pos)
        if not 0 < length <= wire_length <= MAX_PACKET or fraction >= self._units:
            return None
        return _Head(seconds, pos + self.size + length)

    def _search(self, data: bytes, begin: int, end: int) -> int | None:
        """First place in [begin, end) from which plausible records chain."""
        last = min(end, len(data) - self.size + 1)
        word = np.dtype(self.order + "u4")
        for start in range(begin, last, _STEP):
            count = min(_STEP, last - start)
            seconds, fraction, length, wire_length = (
                np.ndarray((count,), word, data, start + offset, (1,)) for offset in (0, 4, 8, 12)
            )
            likely = (length > 0) & (length <= wire_length) & (wire_length <= MAX_PACKET) & (fraction < self._units)
            settled = seconds >= _SETTLED_S
            if self._last_s is not None:
                settled |= np.abs(seconds.astype(np.int64) - self._last_s) <= _DAY_S
            for candidate in np.flatnonzero(likely & settled):
                if self._chains(data, start + int(candidate)):
                    return start + int(candidate)
        return None

    def _chains(self, data: bytes, pos: int) -> bool:
        """Whether plausible records follow each other from ``pos`` on, long enough or up to the end of ``data``."""
        seconds: int | None = None
        for _ in range(_CHAIN):
            if seconds is not None and len(data) - pos < self.size:
                return True
            head = self._head(data, pos)
            if head is None or (seconds is not None and not _near(head.seconds, seconds)):
                return False
            if head.stop > len(data):
                return seconds is not None
            seconds, pos = head.seconds, head.stop
        return True


def _near(seconds: int, other: int) -> bool:
    return abs(seconds - other) <= _DAY_S
