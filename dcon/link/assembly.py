"""Whole ticks from bundles, in order: what was there before is left out, what is missing is told. Pure.

Memory: the pieces of one head (:data:`MOST_PIECES`) and the bundles of one tick (:data:`MOST_PARTS`). A tick that needs
more is lost, and told as a gap.
"""

from __future__ import annotations

from typing import NamedTuple

from dcon.link.bundle import Bundle, Entry, Kind
from pmutools.schema.messages import MESSAGES

AWAY = "the server was away for longer than is kept, or they came too fast"
UNREADABLE = "what came from the controller could not be read"
TOO_LARGE = "they were larger than is taken"
MOST_PIECES = 512
"""Of a head, 64 MB: more than any initialisation file and probing signal have."""
MOST_PARTS = 64
"""Bundles of a tick, 8 MB."""


class Place(NamedTuple):
    """How far the bundles of a session have come."""

    session: int | None = None
    have: int = -1
    """Sequence of the last."""
    ticks: int = 0
    """Number of the next tick: all before it were whole, or are told as missing."""


class Pieces(NamedTuple):
    """All pieces of a head; whether they make sense is for :func:`~dcon.session.head.head_of` to say."""

    session: int
    bundles: tuple[Bundle, ...]


class Gap(NamedTuple):
    """What is missing before what comes next."""

    bundles: int
    """That never came."""
    ticks: int
    """That are not whole; 0 where only configurations are missing, which are repeated."""
    reason: str


Item = Pieces | Bundle | Gap
"""A bundle is a whole tick, with the entries of all its bundles; a configuration; or the end."""


class Assembly:
    """Takes the bundles of one session, then of another; raises nothing."""

    def __init__(self, place: Place | None = None) -> None:
        self.place = place or Place()
        self.malformed = 0
        """Bundles that made no sense."""
        self._pieces: list[Bundle] = []
        self._parts: list[Bundle] = []
        """Of the tick under way."""

    @property
    def is_amid(self) -> bool:
        """A tick has begun and is not whole yet."""
        return bool(self._parts)

    def begin(self, place: Place) -> None:
        """Take the bundles of this session from now on, those after ``place.have``."""
        self.place = place
        self._parts = []

    def wants(self, bundle: Bundle) -> bool:
        """Whether it is news."""
        if bundle.kind is Kind.HEAD:
            return True
        return bundle.session == self.place.session and (not bundle.is_numbered or bundle.sequence > self.place.have)

    def take(self, bundle: Bundle) -> list[Item]:
        """What has become whole with it, after what is missing before that."""
        if not self.wants(bundle):
            return []
        if bundle.kind is Kind.HEAD:
            return self._head(bundle)
        if not bundle.is_numbered:
            self.malformed += bundle.kind is not Kind.CONFIG
            return [bundle] if bundle.kind is Kind.CONFIG else []
        missing = bundle.sequence - self.place.have - 1
        if missing or bundle.tick > self.place.ticks:
            self._parts = []
        if bundle.kind in (Kind.TICK, Kind.MORE):
            return self._part(bundle, missing)
        return [*self._moved(bundle, bundle.tick, missing), bundle]

    def _head(self, piece: Bundle) -> list[Item]:
        numbers = [(entry.log_time_ns, entry.publish_time_ns) for entry in piece.entries]
        at, count = numbers[0] if len(numbers) == 1 else (-1, 0)
        if at == 0 or (self._pieces and self._pieces[0].session != piece.session):
            self._pieces = []
        if at != len(self._pieces) or not at < count <= MOST_PIECES:
            self.malformed += 1
            return []
        self._pieces.append(piece)
        if len(self._pieces) < count:
            return []
        pieces, self._pieces = tuple(self._pieces), []
        return [Pieces(piece.session, pieces)]

    def _part(self, bundle: Bundle, missing: int) -> list[Item]:
        if bundle.tick < self.place.ticks:  # the rest of a tick that was given up
            self.malformed += not bundle.goes_on
            return self._moved(bundle, bundle.tick, missing)
        if bundle.goes_on and missing:
            return self._moved(bundle, bundle.tick + 1, missing)
        gaps = self._moved(bundle, bundle.tick, missing)
        if reason := self._flaw(bundle):
            self.malformed += reason is UNREADABLE
            self._parts = []
            return [*gaps, *self._moved(bundle, bundle.tick + 1, 0, reason)]
        self._parts.append(bundle)
        if bundle.kind is Kind.MORE:
            return gaps
        entries = tuple(entry for part in self._parts for entry in part.entries)
        self._parts = []
        self.place = self.place._replace(ticks=bundle.tick + 1)
        return [*gaps, bundle._replace(entries=entries, goes_on=False)]

    def _flaw(self, bundle: Bundle) -> str:
        """Why its tick cannot be whole; "" where it can."""
        if bundle.goes_on != self.is_amid or bundle.tick_ns <= 0 or not all(map(_is_known, bundle.entries)):
            return UNREADABLE
        return TOO_LARGE if len(self._parts) == MOST_PARTS else ""

    def _moved(self, bundle: Bundle, ticks: int, missing: int, reason: str = UNREADABLE) -> list[Item]:
        """Go on after ``bundle``, with the tick of number ``ticks``; the gap that this is, if any."""
        lost = max(ticks - self.place.ticks, 0)
        self.place = Place(self.place.session, bundle.sequence, self.place.ticks + lost)
        return [Gap(missing, lost, AWAY if missing else reason)] if missing or lost else []


def _is_known(entry: Entry) -> bool:
    if entry.message == "PmuFrame":
        return bool(entry.name)
    return entry.message in MESSAGES and not entry.name
