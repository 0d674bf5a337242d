"""Bytes of one flow -> frames and counted skips, nothing between.

A C37.118 stream has no delimiters: a frame is found by SYNC, FRAMESIZE and CHK. Whatever is not part of a good frame
becomes a :class:`Skipped`, so frame bytes plus skipped bytes always equal the bytes fed in. After a bad frame the
search goes on one byte past its SYNC, never at the size it claimed.

The memory of a framer is bounded by one frame (64 KiB). A false SYNC that claims a long frame could hide the good
frames behind it until that many bytes have come; so while an unproven candidate is incomplete, a complete good frame
behind it whose first six bytes (SYNC, FRAMESIZE, IDCODE) this flow has shown before ends the wait.

A datagram holds whole frames, and its bytes are right or it does not come: where :data:`TRIES` places in it look like
the beginning of a frame and are none, what is left of it is skipped. So no datagram costs more than so many CHKs of it.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import NamedTuple

from pmutools.c37118.checksum import chk
from pmutools.c37118.constants import MIN_FRAME_SIZE, FrameType
from pmutools.flow import StampSource


class SkipReason(StrEnum):
    """Why bytes are not part of a frame."""

    NO_SYNC = "no-sync"
    BAD_TYPE = "bad-type"
    BAD_SIZE = "bad-size"
    BAD_CHK = "bad-chk"
    TRUNCATED = "truncated"
    UNSUPPORTED = "unsupported-version"
    """A whole frame of the 2024 message set (version 3), skipped by its FRAMESIZE."""
    NO_CONFIG = "no-config"
    """A good data frame for which no fitting configuration came."""


class Frame(NamedTuple):
    """One verified frame. ``offset`` counts the flow's bytes before it."""

    data: bytes
    arrival_ns: int | None
    stamp_source: StampSource
    offset: int

    @property
    def type(self) -> FrameType:
        return _TYPES[self.data[1] >> 4]

    @property
    def idcode(self) -> int:
        return self.data[4] << 8 | self.data[5]


class Skipped(NamedTuple):
    """A run of bytes that is no frame, with the first cause met in it.

    ``idcode`` is what its bytes claim, where they begin as a frame does that is damaged or cannot be read.
    """

    reason: SkipReason
    offset: int
    nbytes: int
    idcode: int | None = None


_TYPES = tuple(FrameType)
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time
_AA = 0xAA
_SYNC = re.compile(rb"\xaa(?:[\x00-\x5f\x83\x93\xa3\xb3\xc3\xd3\xe3\xf3]|\Z)", re.DOTALL)
TRIES = 8
"""Bad frames of a datagram that are looked behind."""
_COMMAND_SIZE = 18
_OF_A_READ = (StampSource.KERNEL, StampSource.HARDWARE)
"""Stamps that are those of a read's last bytes."""
_KNOWN_HEADS = 64
"""How many distinct (SYNC, FRAMESIZE, IDCODE) a flow remembers as proven."""


def _next_sync(buffer: bytes, at: int, end: int) -> int:
    """Where the next SYNC of a known type may begin; ``end`` if nowhere."""
    found = _SYNC.search(buffer, at, end)
    return found.start() if found else end


def _claimed(buffer: bytes, at: int) -> int | None:
    """The IDCODE of what begins like a frame at ``at``."""
    return buffer[at + 4] << 8 | buffer[at + 5] if buffer[at] == _AA and at + 6 <= len(buffer) else None


class Framer:
    """Finds frames in the bytes of one flow.

    ``streaming`` is true where a frame may continue in the next feed (TCP, files); datagrams carry nothing over.
    Not thread-safe: one flow, one framer, one caller.
    """

    def __init__(self, *, streaming: bool) -> None:
        self.streaming = streaming
        self._buffer = b""
        self._offset = 0
        self._heads: dict[bytes, int] = {}
        """FRAMESIZE of the kinds of frame shown, by their first six bytes."""
        self._searched: dict[bytes, int] = {}
        """Offset up to which the flow has been searched for each of them."""
        self._open: Skipped | None = None

    @property
    def pending(self) -> int:
        """Bytes in no item yet: the beginning of a frame, or a run of skipped bytes that may go on."""
        return len(self._buffer) + (self._open.nbytes if self._open else 0)

    def feed(
        self,
        data: bytes,
        arrival_ns: int | None = None,
        stamp_source: StampSource = StampSource.CAPTURE,
        lost_before: int = 0,
    ) -> list[Frame | Skipped]:
        """Take in bytes; give back, in order, what is now known. A frame carries the arrival of its last byte.

        ``lost_before`` says that so many bytes of the flow are missing before ``data``: what was held back is given
        up, and offsets go on counting the bytes seen.
        """
        size = self._heads.get(data[:6])
        if size == len(data) and not (self._buffer or lost_before or self._open) and not chk(data):
            frame = _new(Frame, (data, arrival_ns, stamp_source, self._offset))
            self._offset += size
            return [frame]  # the usual case: one whole frame of a kind seen before
        out: list[Frame | Skipped] = []
        if lost_before:
            self._scan(out, None, stamp_source, final=True)
        self._buffer = self._buffer + data if self._buffer else bytes(data)
        self._scan(out, arrival_ns, stamp_source, final=not self.streaming)
        return out

    @property
    def offset(self) -> int:
        """Bytes of the flow that are in frames or skipped."""
        return self._offset

    def pass_over(self, nbytes: int) -> None:
        """Bytes of the flow that were found to be whole frames without this framer, while nothing was pending."""
        self._offset += nbytes

    def close(self) -> list[Frame | Skipped]:
        """End of the flow: what was held back is framed or skipped."""
        out: list[Frame | Skipped] = []
        self._scan(out, None, StampSource.CAPTURE, final=True)
        return out

    def _scan(
        self, out: list[Frame | Skipped], arrival_ns: int | None, stamp_source: StampSource, *, final: bool
    ) -> None:
        buffer, at, end = self._buffer, 0, len(self._buffer)
        tries = TRIES
        while at < end:
            reason, size = self._judge(buffer, at, end, final)
            if not size:
                break
            if reason is None:
                self._close_run(out)
                frame = buffer[at : at + size] if size < end else buffer
                batched = self.streaming and at + size < end and stamp_source in _OF_A_READ
                source = StampSource.KERNEL_BATCHED if batched else stamp_source  # the stamp is the read's last byte's
                out.append(Frame(frame, arrival_ns, source, self._offset + at))
            elif reason is SkipReason.UNSUPPORTED:  # whole frames: each a record of its own
                self._close_run(out)
                out.append(Skipped(reason, self._offset + at, size, _claimed(buffer, at)))
            else:
                if not self.streaming and reason is not SkipReason.NO_SYNC:
                    tries -= 1
                    size = size if tries else end - at
                self._skip(reason, buffer, at, size)
            at += size
        self._buffer = buffer[at:]
        self._offset += at
        if final or not self._buffer:
            self._close_run(out)

    def _judge(self, buffer: bytes, at: int, end: int, final: bool) -> tuple[SkipReason | None, int]:
        """What begins at ``at``: (None, size) a frame, (reason, n) n bytes to skip, (None, 0) more bytes needed."""
        if buffer[at] != _AA:
            return SkipReason.NO_SYNC, _next_sync(buffer, at + 1, end) - at
        if end - at < 4:
            return (SkipReason.TRUNCATED, 1) if final else (None, 0)
        second = buffer[at + 1]
        size = buffer[at + 2] << 8 | buffer[at + 3]
        newer = second & 0x80 and second & 0xF == 3
        if not newer and (second & 0x80 or second >> 4 >= len(_TYPES)):
            return SkipReason.BAD_TYPE, _next_sync(buffer, at + 1, end) - at
        if size < (_COMMAND_SIZE if second >> 4 == FrameType.COMMAND else MIN_FRAME_SIZE):
            return SkipReason.BAD_SIZE, 1
        if at + size > end:
            if final:
                return SkipReason.TRUNCATED, 1
            hidden = self._proven_behind(buffer, at, end)
            return (SkipReason.BAD_SIZE, hidden - at) if hidden else (None, 0)
        if chk(buffer[at : at + size]):
            return SkipReason.BAD_CHK, 1
        if newer:
            return SkipReason.UNSUPPORTED, size
        head = buffer[at : at + 6]
        if head not in self._heads:
            while len(self._heads) >= _KNOWN_HEADS:
                oldest = next(iter(self._heads))
                del self._heads[oldest]
                self._searched.pop(oldest, None)
            self._heads[head] = size
        return None, size

    def _proven_behind(self, buffer: bytes, at: int, end: int) -> int:
        """Where a complete good frame of a proven kind begins behind an unproven candidate; 0 if there is none.

        What was searched once is not searched again, however small the pieces in which the input comes.
        """
        if buffer[at : at + 6] in self._heads:
            return 0
        first = 0
        for head, size in self._heads.items():
            found = buffer.find(head, max(at + 1, self._searched.get(head, 0) - self._offset), end)
            while 0 <= found <= end - size and chk(buffer[found : found + size]):
                found = buffer.find(head, found + 1, end)
            if 0 <= found <= end - size:
                first = min(first, found) if first else found
            self._searched[head] = self._offset + (found if found >= 0 else end - len(head) + 1)
        return first

    def _skip(self, reason: SkipReason, buffer: bytes, at: int, nbytes: int) -> None:
        run = self._open
        if run is None:
            self._open = Skipped(reason, self._offset + at, nbytes, _claimed(buffer, at))
        else:
            self._open = run._replace(nbytes=run.nbytes + nbytes)

    def _close_run(self, out: list[Frame | Skipped]) -> None:
        if self._open is not None:
            out.append(self._open)
            self._open = None
