"""TCP reassembly: segments as captured -> each direction's bytes in order (RFC 9293).

Sequence numbers are unwrapped into positions that only grow. A segment past a hole waits until the hole is filled or
given up; a hole is given up

- when the receiver has acknowledged past it, or the connection was reset, and nothing came for 50 ms: the missing
  bytes were on the wire, but are not in the file;
- when nothing came for 10 s;
- when more than 1 MiB or 1024 segments wait behind it, or 64 MiB behind all holes together;
- at the end of the file, or where the ports are used again.

Arrival stamps: bytes that had to wait for others carry the time of the segment that released them. After a hole that
was given up they keep their own: the receiver never waited for them, or we cannot know how long.
"""

from __future__ import annotations

from bisect import bisect_right
from operator import attrgetter
from typing import NamedTuple

from pmutools.flow import Chunk, Flow, StampSource
from pmutools.formats.capture.ip import endpoints
from pmutools.formats.capture.tally import Fate, Tally

SYN, RST, ACK = 0x02, 0x04, 0x10

MAX_WAITING_BYTES = 1 << 20
MAX_WAITING_SEGMENTS = 1024
MAX_WAITING_BYTES_ALL = 1 << 26
HOLE_NS = 10_000_000_000
ACKNOWLEDGED_HOLE_NS = 50_000_000
"""Not 0: several capture queues can put an acknowledgement before the data that it is for."""
WINDOW = 1 << 24
"""A sequence number further from the expected one is none of the connection's (largest window in practice: 16 MiB)."""
MAX_DIRECTIONS = 1 << 17
"""Beyond it the half that has been idle longest is forgotten."""

_MASK = 0xFFFFFFFF
_HALF = 1 << 31


class Segment(NamedTuple):
    """One TCP segment with its flow's key (packed source, destination, ports); ``missing`` payload bytes were cut off
    by the capture, and then ``data`` is empty."""

    key: bytes
    sequence: int
    acknowledged: int
    flags: int
    data: bytes
    missing: int
    arrival_ns: int | None


class _Waiting(NamedTuple):
    begin: int
    end: int
    arrival_ns: int | None
    data: bytes | None  # None: the bytes are not in the file


class _Stray(NamedTuple):
    sequence: int
    arrival_ns: int | None
    data: bytes


_begin = attrgetter("begin")


class _Direction:
    """One direction of one connection. Positions are sequence numbers, unwrapped."""

    __slots__ = (
        "acknowledged",
        "begun",
        "expected",
        "flow",
        "initial",
        "is_reset",
        "key",
        "lost",
        "peer",
        "progress_ns",
        "stray",
        "used",
        "waiting",
        "waiting_bytes",
    )

    def __init__(self, key: bytes, connection: int) -> None:
        self.key = key
        self.peer: _Direction = self
        self.used = 0
        self.reset(connection)

    def reset(self, connection: int) -> None:
        self.flow = Flow("tcp", *endpoints(self.key), connection)
        self.expected: int | None = None  # position of the next byte to deliver
        self.begun = 0  # position of the first
        self.initial: int | None = None  # sequence number after that of the SYN
        self.acknowledged = 0
        self.is_reset = False
        self.waiting: list[_Waiting] = []  # by position
        self.waiting_bytes = 0
        self.progress_ns: int | None = None
        self.lost = 0  # bytes given up since the last delivered chunk
        self.stray: _Stray | None = None


class Reassembly:
    """All TCP connections of a capture. ``feed`` and ``close`` return the chunks that became deliverable."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._directions: dict[bytes, _Direction] = {}
        self._fed = 0
        self._waiting_bytes = 0

    def feed(self, segment: Segment) -> tuple[Fate, list[Chunk]]:
        key, sequence, acknowledged, flags, data, missing, arrival_ns = segment
        out: list[Chunk] = []
        direction = self._directions.get(key) or self._open(key, out)
        self._fed += 1
        direction.used = self._fed
        if flags & SYN:
            sequence = (sequence + 1) & _MASK
            self._synchronise(direction, sequence, out)
        peer = direction.peer
        if flags & RST:
            direction.is_reset = peer.is_reset = True
        if flags & ACK and peer.waiting:
            self._acknowledge(peer, acknowledged)
            self._give_up_hopeless(peer, arrival_ns, out)
        fate = Fate.TCP_EMPTY
        if data or missing:
            fate = self._accept(direction, sequence, data, missing, arrival_ns, out)
        if direction.waiting:
            self._give_up_hopeless(direction, arrival_ns, out)
        return fate, out

    def close(self) -> list[Chunk]:
        """Deliver all that still waits, each hole given up."""
        out: list[Chunk] = []
        for direction in self._directions.values():
            self._flush(direction, out)
        return out

    def _open(self, key: bytes, out: list[Chunk]) -> _Direction:
        if len(self._directions) >= MAX_DIRECTIONS:
            self._forget(out)
        size = (len(key) - 4) // 2
        reverse = key[size:-4] + key[:size] + key[-2:] + key[-4:-2]
        direction = self._directions[key] = _Direction(key, 0)
        if reverse != key:
            direction.peer = self._directions[reverse] = _Direction(reverse, 0)
            direction.peer.peer = direction
        return direction

    def _forget(self, out: list[Chunk]) -> None:
        """Drop the connections that have been idle longest, both directions of each."""
        by_use = sorted(self._directions.values(), key=lambda direction: max(direction.used, direction.peer.used))
        for direction in by_use[: len(by_use) // 2]:
            for half in (direction, direction.peer):
                self._flush(half, out)
                self._directions.pop(half.key, None)

    def _synchronise(self, direction: _Direction, first: int, out: list[Chunk]) -> None:
        """Take in a SYN whose connection's bytes begin at sequence number ``first``."""
        peer = direction.peer
        if direction.initial == first:  # the SYN again
            return
        late = direction.expected is not None and direction.initial is None and direction.begun & _MASK == first
        if not late:
            peer_is_older = peer.expected is not None and peer.initial is None
            if direction.expected is not None or peer_is_older:
                self._restart(direction, out)
            direction.expected = direction.begun = first
        direction.initial = first

    def _restart(self, direction: _Direction, out: list[Chunk]) -> None:
        """The ports are used again: end the connection in both directions and number the next."""
        connection = direction.flow.connection + 1
        for half in (direction, direction.peer):
            self._flush(half, out)
            half.reset(connection)

    def _accept(
        self,
        direction: _Direction,
        sequence: int,
        data: bytes,
        missing: int,
        arrival_ns: int | None,
        out: list[Chunk],
    ) -> Fate:
        """Take in a segment with payload; deliver what it makes deliverable."""
        expected = direction.expected
        if expected is None:
            expected = direction.expected = direction.begun = sequence
        begin = _unwrap(sequence, expected)
        end = begin + len(data) + missing
        if not -WINDOW <= begin - expected <= WINDOW:
            return self._adopt(direction, _Stray(sequence, arrival_ns, data), missing, out)
        direction.stray = None
        if end <= expected:
            self._tally.repeated_bytes += len(data)
            return Fate.TCP_REPEATED
        waiting = direction.waiting
        if begin <= expected:
            self._deliver(direction, begin, end, None if missing else data, arrival_ns, out)
            if waiting:
                self._drain(direction, arrival_ns, out)
            return Fate.TCP
        place = bisect_right(waiting, begin, key=_begin)
        if place and waiting[place - 1].end >= end:
            self._tally.repeated_bytes += len(data)
            return Fate.TCP_REPEATED
        waiting.insert(place, _Waiting(begin, end, arrival_ns, None if missing else data))
        direction.waiting_bytes += len(data)
        self._waiting_bytes += len(data)
        return Fate.TCP

    def _adopt(self, direction: _Direction, stray: _Stray, missing: int, out: list[Chunk]) -> Fate:
        """Of two strays that fit each other, but not the connection, make another one, whose SYN is not in the file."""
        before, direction.stray = direction.stray, None if missing else stray
        if missing or before is None or (before.sequence + len(before.data)) & _MASK != stray.sequence:
            return Fate.TCP_STRAY
        self._restart(direction, out)
        for sequence, arrival_ns, data in (before, stray):
            self._accept(direction, sequence, data, 0, arrival_ns, out)
        return Fate.TCP

    def _deliver(
        self,
        direction: _Direction,
        begin: int,
        end: int,
        data: bytes | None,
        arrival_ns: int | None,
        out: list[Chunk],
    ) -> None:
        """Hand on what [begin, end) has beyond the expected position, which is in it."""
        assert direction.expected is not None
        overlap = direction.expected - begin
        direction.expected = end
        direction.progress_ns = arrival_ns
        if data is None:
            self._lose(direction, end - begin - overlap)
            return
        if overlap:
            self._tally.repeated_bytes += overlap
            data = data[overlap:]
        out.append(Chunk(data, arrival_ns, direction.flow, StampSource.CAPTURE, direction.lost))
        direction.lost = 0

    def _drain(self, direction: _Direction, arrival_ns: int | None, out: list[Chunk]) -> None:
        """Deliver the waiting segments up to the next hole, none earlier than ``arrival_ns``."""
        done = 0
        for begin, end, own_ns, data in direction.waiting:
            assert direction.expected is not None
            if begin > direction.expected:
                break
            done += 1
            nbytes = len(data or b"")
            direction.waiting_bytes -= nbytes
            self._waiting_bytes -= nbytes
            if end <= direction.expected:
                self._tally.repeated_bytes += nbytes
                continue
            if own_ns is not None and (arrival_ns is None or own_ns > arrival_ns):
                arrival_ns = own_ns
            self._deliver(direction, begin, end, data, arrival_ns, out)
        del direction.waiting[:done]

    def _acknowledge(self, direction: _Direction, acknowledged: int) -> None:
        assert direction.expected is not None
        position = _unwrap(acknowledged, direction.expected)
        if position - direction.expected <= 2 * WINDOW:
            direction.acknowledged = max(direction.acknowledged, position)

    def _give_up_hopeless(self, direction: _Direction, now_ns: int | None, out: list[Chunk]) -> None:
        while direction.waiting and self._is_hopeless(direction, now_ns):
            self._give_up(direction, out)

    def _is_hopeless(self, direction: _Direction, now_ns: int | None) -> bool:
        """Whether the hole before the waiting segments will not be filled."""
        first = direction.waiting[0]
        if (
            direction.waiting_bytes > MAX_WAITING_BYTES
            or len(direction.waiting) > MAX_WAITING_SEGMENTS
            or self._waiting_bytes > MAX_WAITING_BYTES_ALL
        ):
            return True
        if now_ns is None or first.arrival_ns is None:
            return False
        since_ns = max(first.arrival_ns, direction.progress_ns or first.arrival_ns)
        passed = direction.is_reset or direction.acknowledged >= first.begin
        return now_ns - since_ns > (ACKNOWLEDGED_HOLE_NS if passed else HOLE_NS)

    def _give_up(self, direction: _Direction, out: list[Chunk]) -> None:
        """Go on behind the hole."""
        assert direction.expected is not None
        first = direction.waiting[0]
        self._lose(direction, first.begin - direction.expected)
        direction.expected = first.begin
        self._drain(direction, first.arrival_ns, out)

    def _lose(self, direction: _Direction, nbytes: int) -> None:
        direction.lost += nbytes
        self._tally.lost_bytes += nbytes

    def _flush(self, direction: _Direction, out: list[Chunk]) -> None:
        while direction.waiting:
            self._give_up(direction, out)


def _unwrap(sequence: int, near: int) -> int:
    """The position with this sequence number that is nearest to ``near``."""
    return near + ((sequence - near + _HALF) & _MASK) - _HALF
