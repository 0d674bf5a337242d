"""What the control process keeps for the server, and what it sends next: pure, without a socket.

On connecting, the server says of which session it has what: ``{"session": number or null, "have": sequence}``; later,
what it has flushed: ``{"ack": sequence}``. It is sent the head, the newest configurations that it would not get
otherwise, and everything after ``have`` that is kept still.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from dcon.link.bundle import Bundle, Entry, Kind, encode, shares, unnumbered

BUNDLES_A_CALL = 8
"""Sent at most at a time: the server catches up at eight times the pace, and no tick is held up."""


class Kept(NamedTuple):
    """A bundle in the ring, and when it came (monotonic)."""

    sequence: int
    at_ns: int
    data: bytes
    is_tick: bool
    """It ends a tick."""


class Ring:
    """The newest bundles, bounded by age (``span_ns``) and size (``most_bytes``); they are numbered by it, from 0."""

    def __init__(self, span_ns: int, most_bytes: int) -> None:
        self.span_ns = span_ns
        self.most_bytes = most_bytes
        self.size = 0
        self.next = 0
        """Sequence of the next."""
        self.unsafe_ticks = 0
        """That nobody has acknowledged: kept still, or fallen out."""
        self._kept: deque[Kept] = deque()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def first(self) -> int:
        """Sequence of the oldest; that of the next where nothing is kept."""
        return self._kept[0].sequence if self._kept else self.next

    def push(self, data: bytes, now_ns: int, *, is_tick: bool = False) -> None:
        """Keep the next; ``now_ns`` on a clock without steps."""
        self._kept.append(Kept(self.next, now_ns, data, is_tick))
        self.unsafe_ticks += is_tick
        self.next += 1
        self.size += len(data)
        while self._kept and (self.size > self.most_bytes or now_ns - self._kept[0].at_ns > self.span_ns):
            self._drop()

    def acknowledge(self, sequence: int) -> None:
        """All up to ``sequence`` are safe elsewhere."""
        while self._kept and self._kept[0].sequence <= sequence:
            self.unsafe_ticks -= self._kept[0].is_tick
            self._drop()

    def at(self, sequence: int) -> bytes | None:
        """An encoded bundle; None where it is not kept (any more, or yet)."""
        place = sequence - self.first
        return self._kept[place].data if 0 <= place < len(self._kept) else None

    def _drop(self) -> None:
        self.size -= len(self._kept.popleft().data)


class Shipper:
    """One session's bundles, and how far a server is. Memory: the ring's bound, the head, a configuration a PMU."""

    def __init__(self, session: int, head: Iterable[bytes], ring: Ring) -> None:
        """``head`` are the encoded pieces that say what the session is."""
        self.session = session
        self.ring = ring
        self.sent = 0
        self._ticks = 0
        self._head = tuple(head)
        self._configs: dict[str, tuple[int, bytes]] = {}
        """By PMU, the newest and its sequence."""
        self._first: deque[bytes] = deque()
        """To be sent before what is numbered."""
        self._next: int | None = None
        """To be sent then; None until the server has said what it has."""

    @property
    def behind(self) -> int:
        """Bundles that wait."""
        return self.ring.next - (self.ring.first if self._next is None else max(self._next, self.ring.first))

    def tick(self, tick_ns: int, entries: Iterable[Entry], now_ns: int) -> None:
        """Ship the entries of a tick: one bundle, or several where it is very large."""
        *parts, last = shares(entries)
        for number, part in enumerate(parts):
            self._push(Kind.MORE, tick_ns, part, now_ns, goes_on=number > 0)
        self._push(Kind.TICK, tick_ns, last, now_ns, goes_on=bool(parts))
        self._ticks += 1

    def config(self, name: str, frame: bytes, time_ns: int, now_ns: int) -> None:
        """Ship a configuration frame of a PMU that came at ``time_ns``."""
        data = self._push(Kind.CONFIG, 0, (Entry("config", name, frame, time_ns, time_ns),), now_ns)
        self._configs[name] = self.ring.next - 1, unnumbered(data)

    def end(self, now_ns: int) -> None:
        """Nothing comes after this."""
        self._push(Kind.END, 0, (), now_ns)

    def lost(self) -> None:
        """No server is connected."""
        self._next = None
        self._first.clear()

    def told(self, message: bytes) -> None:
        """Take in what the server says; what makes no sense changes nothing."""
        try:
            said = json.loads(message)
            have = said.get("ack", said.get("have"))
        except (ValueError, AttributeError, RecursionError):
            return
        if not isinstance(have, int):
            return
        if "ack" in said:
            if self._next is not None and have < self._next:
                self.ring.acknowledge(have)
            return
        if said.get("session") != self.session or have >= self.ring.next:
            have = -1
        self._next = 0
        self._first = deque(self._head)
        self._skip(have + 1)

    def service(self, send: Callable[[bytes], bool], most: int = BUNDLES_A_CALL) -> int:
        """Give at most ``most`` bundles to ``send`` (false: not now, and no more this time); how many it took."""
        if self._next is None:
            return 0
        self._skip(self.ring.first)
        taken = 0
        while taken < most:
            if self._first:
                data: bytes | None = self._first[0]
            else:
                data = self.ring.at(self._next)
            if data is None or not send(data):
                break
            taken += 1
            if self._first:
                self._first.popleft()
            else:
                self._next += 1
        self.sent += taken
        return taken

    def _skip(self, to: int) -> None:
        """Go on at ``to`` or what is kept after it; configurations that are passed over are repeated."""
        assert self._next is not None
        before, self._next = self._next, max(self._next, to, self.ring.first)
        self._first += [frame for at, frame in self._configs.values() if before <= at < self._next]

    def _push(
        self, kind: Kind, tick_ns: int, entries: tuple[Entry, ...], now_ns: int, *, goes_on: bool = False
    ) -> bytes:
        data = encode(Bundle(kind, self.ring.next, self.session, tick_ns, entries, self._ticks, goes_on))
        self.ring.push(data, now_ns, is_tick=kind is Kind.TICK)
        return data
