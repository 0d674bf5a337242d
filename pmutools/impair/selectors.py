"""Which frames a stage acts on: ``when=every 7 offset 3``, ``when=type config or 5..8 and 10%``, ``drop = 10,50-59``.

::

    SELECTOR  TERM or TERM ...           TERM  FACTOR and FACTOR ...      FACTOR  [not] ATOM | [not] (SELECTOR)
    ATOM      ITEM, ITEM ...             any of the items
    ITEM      10 | 50-59 | 50- | every 100 [offset 3]      frame indices
              5..8 | 5.. | ..8                             seconds of stream time, first included, last not
              wall 5..8                                    seconds of scheduled time from the start of play
              stamp 2016-09-08T17:05:11Z..                 recorded stamps, UTC, last not included
              second 0,30-59                               UTC second of the minute of the recorded stamp
              slot 0,1-3                                   number of the frame within its UTC second
              first after config                           first data frame of the run, and after a configuration
              value N1.freq_hz < 59.95                     a decoded value; <= > >= == != and & for a mask
              P%                                           each frame with probability P, keyed draws
              type data|config|header|command|any          frame type

A selector that says nothing of types means data frames. ``wall``, ``stamp``, ``second`` and ``slot`` reach as far as
the list goes on with plain ranges. Names with ``and``, ``or``, commas or brackets are written in double quotes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.draws import Draws
from pmutools.impair.blocks import chance
from pmutools.impair.moment import Moment, Test
from pmutools.impair.values import Comparison, comparison
from pmutools.parsers import Indices, Parser, index_set, probability, seconds_ns
from pmutools.timebase import NS, parse_utc, slot

_TYPES = {
    "data": frozenset((FrameType.DATA,)),
    "config": frozenset(kind for kind in FrameType if kind.is_config),
    "header": frozenset((FrameType.HEADER,)),
    "command": frozenset((FrameType.COMMAND,)),
    "any": frozenset(FrameType),
}
Ranges = tuple[tuple[float, float], ...]
"""(first, end) in ns, the end not included; an open end is infinity."""
NO_INDICES = Indices()
_SECONDS_A_MINUTE = 60


@dataclass(frozen=True, slots=True)
class Atom:
    """Any of what is given, or if ``negated`` none of it. ``times``, ``walls`` and ``stamps`` are ranges in ns."""

    indices: Indices = NO_INDICES
    times: Ranges = ()
    chance: float | None = None
    types: frozenset[FrameType] = frozenset()
    negated: bool = False
    walls: Ranges = ()
    stamps: Ranges = ()
    seconds: Indices = NO_INDICES
    slots: Indices = NO_INDICES
    fresh: bool = False
    values: tuple[Comparison, ...] = ()

    @property
    def is_time(self) -> bool:
        """Whether this is nothing but ranges of time."""
        return self == Atom(times=self.times, walls=self.walls, stamps=self.stamps)

    def atoms(self) -> Iterator[Atom]:
        yield self

    def check(self, config: StreamConfig | None) -> None:
        """Raise ValueError for what cannot be told of a stream of this configuration."""
        stamped = self.stamps or self.seconds != NO_INDICES or self.slots != NO_INDICES
        if config is None and (stamped or self.values):
            what = "stamps" if stamped else "values"
            raise ValueError(f"{what} can only be read in a stream whose configuration is known")
        if config is not None and self.slots != NO_INDICES and not config.rate:
            raise ValueError("slot: the stream's DATA_RATE is 0, so a second has no slots")
        for value in self.values:
            value.reader(config)  # type: ignore[arg-type]  # None was refused above

    def test(self, draws: Draws, variates: Iterator[int]) -> Test:
        """Whether a frame fits; the chance, if any, is the next draw of ``variates``."""
        tests, negated = tuple(self._tests(draws, next(variates))), self.negated
        if len(tests) == 1 and not negated:
            return tests[0]
        return lambda at: any(test(at) for test in tests) is not negated

    def _tests(self, draws: Draws, variate: int) -> Iterator[Test]:
        types, indices = self.types, self.indices
        if types:
            yield lambda at: at.type in types
        if indices != NO_INDICES:
            yield lambda at: at.index in indices
        yield from (_within(low, high, _stream_time) for low, high in self.times)
        yield from (_within(low, high, _wall_time) for low, high in self.walls)
        yield from (_within(low, high, _stamp) for low, high in self.stamps)
        if self.seconds != NO_INDICES:
            yield _second_in(self.seconds)
        if self.slots != NO_INDICES:
            yield _slot_in(self.slots)
        if self.fresh:
            yield lambda at: at.fresh
        yield from (value.test() for value in self.values)
        if self.chance is not None:
            happens = chance(draws, self.chance, variate)
            yield lambda at: happens(at) == 1


def _stream_time(at: Moment) -> int | None:
    return at.time_ns


def _wall_time(at: Moment) -> int | None:
    return at.offset_ns


def _stamp(at: Moment) -> int | None:
    return at.stamp_ns


def _within(low: float, high: float, time_of: Callable[[Moment], int | None]) -> Test:
    def fits(at: Moment) -> bool:
        time_ns = time_of(at)
        return time_ns is not None and low <= time_ns < high

    return fits


def _second_in(seconds: Indices) -> Test:
    def fits(at: Moment) -> bool:
        stamp_ns = at.stamp_ns
        return stamp_ns is not None and stamp_ns // NS % _SECONDS_A_MINUTE in seconds

    return fits


def _slot_in(slots: Indices) -> Test:
    """Stamps are snapped to the grid; below one frame a second, every frame is in slot 0."""

    def fits(at: Moment) -> bool:
        stamp_ns, config = at.stamp_ns, at.original.config
        if stamp_ns is None or config is None or not config.rate:
            return False
        return (slot(stamp_ns, config.rate) % config.data_rate if config.data_rate > 0 else 0) in slots

    return fits


@dataclass(frozen=True, slots=True)
class Group:
    """A selector in parentheses."""

    terms: tuple[tuple[Atom | Group, ...], ...]
    negated: bool = False

    def atoms(self) -> Iterator[Atom]:
        return (atom for term in self.terms for factor in term for atom in factor.atoms())

    def test(self, draws: Draws, variates: Iterator[int]) -> Test:
        terms = tuple(tuple(factor.test(draws, variates) for factor in term) for term in self.terms)
        negated = self.negated
        if len(terms) == 1 and len(terms[0]) == 1 and not negated:
            return terms[0][0]
        return lambda at: any(all(test(at) for test in term) for term in terms) is not negated


@dataclass(frozen=True, slots=True)
class Selector:
    """A disjunction of conjunctions of atoms and groups."""

    terms: tuple[tuple[Atom | Group, ...], ...]

    def test(self, draws: Draws) -> Test:
        """Whether a stage acts on a frame; ``draws`` are for this selector alone."""
        if self == DATA:
            return is_data
        if self == ANY:
            return _is_any
        return Group(self.terms).test(draws, count())

    def check(self, config: StreamConfig | None) -> None:
        """Raise ValueError for what cannot be told of a stream of this configuration, such as an unknown value."""
        for atom in Group(self.terms).atoms():
            atom.check(config)

    def before(self, lead_ns: int) -> Selector:
        """The ``lead_ns`` before each range of a selector that is nothing but ranges of time; raises ValueError."""
        data = Atom(types=_TYPES["data"])
        ranges = [factor for term in self.terms for factor in term if factor != data]
        earlier = [_before(factor, lead_ns) for factor in ranges if isinstance(factor, Atom) and factor.is_time]
        if not len(self.terms) == len(ranges) == len(earlier):
            raise ValueError("only ranges of time have a time before them; write when=5..8")
        return Selector(tuple((atom, data) for atom in earlier))


def _before(atom: Atom, lead_ns: int) -> Atom:
    return Atom(
        times=tuple((low - lead_ns, low) for low, _ in atom.times),
        walls=tuple((low - lead_ns, low) for low, _ in atom.walls),
        stamps=tuple((low - lead_ns, low) for low, _ in atom.stamps),
    )


DATA = Selector(((Atom(types=_TYPES["data"]),),))
ANY = Selector(((Atom(types=_TYPES["any"]),),))


def is_data(at: Moment) -> bool:
    return at.type is FrameType.DATA


def _is_any(at: Moment) -> bool:
    return True


def selector(text: str) -> Selector:
    """Parse SELECTOR; raises ValueError."""
    return _selector(text, _TYPES["data"])


def selector_of_any(text: str) -> Selector:
    """The same, but frames of any type are meant where no type is named."""
    return _selector(text, _TYPES["any"])


_MOST_GROUPS = 100


def _selector(text: str, types: frozenset[FrameType]) -> Selector:
    if text.count("(") > _MOST_GROUPS:
        raise ValueError(f"more than {_MOST_GROUPS} brackets; write it shorter")
    terms = _terms(text)
    if not any(atom.types for atom in Group(terms).atoms()):
        terms = tuple((*term, Atom(types=types)) for term in terms)
    return Selector(terms)


def _terms(text: str) -> tuple[tuple[Atom | Group, ...], ...]:
    return tuple(tuple(_factor(part) for part in _split(term, "and")) for term in _split(text, "or"))


def _split(text: str, word: str) -> list[str]:
    parts = _split_outside(text, rf"\b{word}\b")
    if not all(parts):
        raise ValueError(f"{text!r} has nothing on one side of {word!r}" if len(parts) > 1 else "nothing is selected")
    return parts


def _split_outside(text: str, separator: str) -> list[str]:
    """Split at ``separator`` (a pattern) outside parentheses and double quotes; parts trimmed."""
    depth, start, parts = 0, 0, list[str]()
    for match in re.finditer(rf'"[^"]*"|[()]|{separator}', text):
        token = match[0]
        if token in "()":
            depth += 1 if token == "(" else -1
            if depth < 0:
                raise ValueError(f"{text!r} has a ')' without '('")
        elif not depth and token[0] != '"':
            parts.append(text[start : match.start()].strip())
            start = match.end()
    if depth:
        raise ValueError(f"{text!r} has a '(' without ')'")
    return [*parts, text[start:].strip()]


_NOT = re.compile(r"not\b\s*", re.IGNORECASE)
_RANGE = re.compile(r"(.*?)\.\.(.*)")
_KEYWORD = re.compile(r"(wall|stamp|second|slot|value|type)\s+(.*)", re.IGNORECASE | re.DOTALL)
_FIRST = re.compile(r"first\s+after\s+config", re.IGNORECASE)


def _factor(text: str) -> Atom | Group:
    negation = _NOT.match(text)
    positive = text[negation.end() :] if negation else text
    if not positive:
        raise ValueError("'not' stands alone; say what is not to be selected")
    if positive.startswith("("):
        if not positive.endswith(")"):
            raise ValueError(f"{text!r}: write 'and' or 'or' after ')'")
        return Group(_terms(positive[1:-1]), negation is not None)
    return _atom(positive, negated=negation is not None)


def _atom(text: str, *, negated: bool) -> Atom:
    items = _split_outside(text, ",")
    if not all(items):
        raise ValueError(f"{text!r} has an empty item; remove the extra ','")
    lists: dict[str, list[str]] = {"": [], "second": [], "slot": []}
    ranges: dict[str, list[tuple[float, float]]] = {"": [], "wall": [], "stamp": []}
    share, types, fresh, values, about = None, frozenset[FrameType](), False, list[Comparison](), ""
    for item in items:
        keyword = _KEYWORD.fullmatch(item)
        word, rest = (keyword[1].lower(), keyword[2].strip()) if keyword else (about, item)
        about = word if word in _LASTING else ""
        if word == "value":
            values.append(comparison(rest))
        elif word == "type":
            types |= _frame_types(rest.lower())
        elif _FIRST.fullmatch(rest):
            fresh = True
        elif rest.endswith("%"):
            if share is not None:
                raise ValueError(f"{text!r} has two probabilities; give one")
            share = probability(rest)
        elif word in ranges and (word or _RANGE.fullmatch(rest)):
            ranges[word].append(_range(word, rest))
        else:
            lists[word].append(rest)
    seconds = index_set(lists["second"])
    if any(first >= _SECONDS_A_MINUTE for first in seconds.starts):
        raise ValueError("second: a minute has the seconds 0 to 59")
    return Atom(
        index_set(lists[""]),
        tuple(ranges[""]),
        share,
        types,
        negated,
        tuple(ranges["wall"]),
        tuple(ranges["stamp"]),
        seconds,
        index_set(lists["slot"]),
        fresh,
        tuple(values),
    )


_LASTING = ("wall", "stamp", "second", "slot")
"""Words that reach over the plain items after them."""


def _frame_types(word: str) -> frozenset[FrameType]:
    if word not in _TYPES:
        raise ValueError(f"{word!r} is no frame type; known: {', '.join(_TYPES)}")
    return _TYPES[word]


_READ: dict[str, tuple[Parser[int], float, str]] = {
    "": (seconds_ns, 0, "in seconds"),
    "wall": (seconds_ns, 0, "in seconds"),
    "stamp": (parse_utc, -math.inf, "in UTC"),
}
"""How the ends of a range are read, where an open one begins, and how they are written."""


def _range(word: str, text: str) -> tuple[float, float]:
    """(first, end) in ns of ``first..last``; an open end is infinity."""
    read, least, written = _READ[word]
    match = _RANGE.fullmatch(text)
    if match is None:
        raise ValueError(f"{word} {text}: write START..END {written}")
    first, last = match[1].strip(), match[2].strip()
    low, high = read(first) if first else least, read(last) if last else math.inf
    if high <= low:
        raise ValueError(f"{first}..{last} runs backwards; write START..END {written}")
    return low, high
