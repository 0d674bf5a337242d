"""Which frames a stage acts on: ``when=every 7 offset 3``, ``when=type config or 5..8 and 10%``, ``drop = 10,50-59``.

::

    SELECTOR  TERM or TERM ...           TERM  FACTOR and FACTOR ...           FACTOR  [not] ATOM
    ATOM      ITEM, ITEM ...             any of the items
    ITEM      10 | 50-59 | 50- | every 100 [offset 3]      frame indices
              5..8 | 5.. | ..8                             seconds of stream time, first included, last not
              P%                                           each frame with probability P, keyed draws
              type data|config|header|command|any          frame type

A selector that says nothing of types means data frames.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from pmutools.c37118.constants import FrameType
from pmutools.draws import Draws
from pmutools.impair.blocks import chance
from pmutools.impair.moment import Moment
from pmutools.parsers import Indices, index_set, probability, seconds_ns, split_top

Test = Callable[[Moment], bool]

_TYPES = {
    "data": frozenset((FrameType.DATA,)),
    "config": frozenset(kind for kind in FrameType if kind.is_config),
    "header": frozenset((FrameType.HEADER,)),
    "command": frozenset((FrameType.COMMAND,)),
    "any": frozenset(FrameType),
}
_RANGE = re.compile(r"(.*)\.\.(.*)")


NO_INDICES = Indices()


@dataclass(frozen=True, slots=True)
class Atom:
    """Any of: an index, a stream time range in ns, a chance, a frame type. ``types`` empty: not asked."""

    indices: Indices = NO_INDICES
    times: tuple[tuple[float, float], ...] = ()
    chance: float | None = None
    types: frozenset[FrameType] = frozenset()
    negated: bool = False

    def test(self, draws: Draws, variate: int) -> Test:
        """Whether a frame fits; the chance, if any, is draw ``variate``."""
        indices, times, types, negated = self.indices, self.times, self.types, self.negated
        happens = None if self.chance is None else chance(draws, self.chance, variate)

        def fits(at: Moment) -> bool:
            found = (
                at.type in types
                or at.index in indices
                or any(low <= at.time_ns < high for low, high in times)
                or (happens is not None and happens(at) == 1)
            )
            return found is not negated

        return fits


@dataclass(frozen=True, slots=True)
class Selector:
    """A disjunction of conjunctions of atoms."""

    terms: tuple[tuple[Atom, ...], ...]

    def test(self, draws: Draws) -> Test:
        """Whether a stage acts on a frame; ``draws`` are for this selector alone."""
        if self == DATA:
            return is_data
        if self == ANY:
            return _is_any
        terms, variate = list[tuple[Test, ...]](), 0
        for term in self.terms:
            terms.append(tuple(atom.test(draws, variate + place) for place, atom in enumerate(term)))
            variate += len(term)
        return lambda at: any(all(test(at) for test in term) for term in terms)


DATA = Selector(((Atom(types=_TYPES["data"]),),))
ANY = Selector(((Atom(types=_TYPES["any"]),),))


def is_data(at: Moment) -> bool:
    return at.type is FrameType.DATA


def _is_any(at: Moment) -> bool:
    return True


def selector(text: str) -> Selector:
    """Parse SELECTOR; raises ValueError."""
    return _parse(text, _TYPES["data"])


def selector_of_any(text: str) -> Selector:
    """The same, but frames of any type are meant where no type is named."""
    return _parse(text, _TYPES["any"])


def _parse(text: str, types: frozenset[FrameType]) -> Selector:
    terms = [tuple(_factor(part) for part in _split(term, "and")) for term in _split(text, "or")]
    if not any(atom.types for term in terms for atom in term):
        terms = [(*term, Atom(types=types)) for term in terms]
    return Selector(tuple(terms))


def _split(text: str, word: str) -> list[str]:
    parts = [part.strip() for part in re.split(rf"\b{word}\b", text)]
    if not all(parts):
        raise ValueError(f"{text!r} has nothing on one side of {word!r}" if len(parts) > 1 else "nothing is selected")
    return parts


def _factor(text: str) -> Atom:
    words = text.split(maxsplit=1)
    negated = words[0].lower() == "not"
    if negated and len(words) == 1:
        raise ValueError("'not' stands alone; say what is not to be selected")
    plain, times, share, types = list[str](), list[tuple[float, float]](), None, frozenset[FrameType]()
    for item in split_top(words[1] if negated else text):
        if item.endswith("%"):
            if share is not None:
                raise ValueError(f"{text!r} has two probabilities; give one")
            share = probability(item)
        elif match := _RANGE.fullmatch(item):
            times.append(time_range(match[1], match[2]))
        elif item.lower().startswith("type "):
            types |= _frame_types(item[5:].strip().lower())
        else:
            plain.append(item)
    return Atom(index_set(plain), tuple(times), share, types, negated)


def _frame_types(word: str) -> frozenset[FrameType]:
    if word not in _TYPES:
        raise ValueError(f"{word!r} is no frame type; known: {', '.join(_TYPES)}")
    return _TYPES[word]


def time_range(first: str, last: str) -> tuple[float, float]:
    """(start, end) in ns of ``first..last`` in seconds; an open end is infinity."""
    low = seconds_ns(first) if first.strip() else 0
    high = seconds_ns(last) if last.strip() else math.inf
    if high <= low:
        raise ValueError(f"{first.strip()}..{last.strip()} runs backwards; write START..END in seconds")
    return low, high
