"""Duplicates, and frames that leave in another order than they came."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from pmutools.draws import Draws
from pmutools.impair.blocks import chance
from pmutools.impair.moment import Moment, Test
from pmutools.impair.outgoing import Outgoing
from pmutools.impair.selectors import DATA, Selector, selector
from pmutools.parsers import choice, integer, parsed_by, probability

MAX_COPIES = 64


@dataclass(frozen=True, slots=True)
class Duplicate:
    """``count`` more copies with probability ``p``, each with its own delay."""

    p: float = field(metadata=parsed_by(probability))
    count: int = field(default=1, metadata=parsed_by(integer(1, MAX_COPIES)))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))


@dataclass(frozen=True, slots=True)
class Reorder:
    """A frame that others overtake, with probability ``p``, and at least ``gap`` frames since the last one.

    ``mode=late`` (the default) holds it until the next ``depth`` frames of the stream are out: reordering extent
    ``depth`` (RFC 4737) whatever the delays. ``mode=early`` is netem's: it leaves without its delay.
    """

    p: float = field(metadata=parsed_by(probability))
    depth: int = field(default=1, metadata=parsed_by(integer(1, 1000)))
    gap: int = field(default=0, metadata=parsed_by(integer(0)))
    mode: str = field(default="late", metadata=parsed_by(choice("late", "early")))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))


class Leaving(NamedTuple):
    """A copy of a frame on its way out."""

    outgoing: Outgoing
    at: Moment


class Reordering:
    """Reorder at work on one stream. One frame at most is held; none is picked meanwhile."""

    def __init__(self, part: Reorder, draws: Draws, selected: Test) -> None:
        self._part = part
        self._happens = chance(draws, part.p)
        self._selected = selected
        self._since = part.gap
        self._held: Leaving | None = None
        self._left = 0
        self._latest_ns = 0

    @property
    def holding(self) -> bool:
        return self._held is not None

    def apply(self, leaving: Leaving) -> tuple[Leaving, ...]:
        """What may leave now, in order; the held frame comes with the last of those that overtook it."""
        outgoing, at = leaving
        self._since += 1
        if self._held is None and self._since > self._part.gap and self._happens(at) and self._selected(at):
            self._since = 0
            if self._part.mode == "early":
                due_ns, marks = outgoing.offset_ns - outgoing.delay_ns, (*outgoing.marks, "reorder:early")
                return (Leaving(outgoing._replace(offset_ns=due_ns, delay_ns=0, marks=marks), at),)
            self._held, self._left, self._latest_ns = leaving, self._part.depth, outgoing.offset_ns
            return ()
        if self._held is None:
            return (leaving,)
        self._left -= 1
        self._latest_ns = max(self._latest_ns, outgoing.offset_ns)
        return (leaving,) if self._left else (leaving, *self.close())

    def close(self) -> tuple[Leaving, ...]:
        """The held frame, at the latest time of those that overtook it."""
        if (held := self._held) is None:
            return ()
        self._held = None
        marks = (*held.outgoing.marks, f"reorder:{self._part.depth - self._left}")
        return (Leaving(held.outgoing._replace(offset_ns=self._latest_ns, marks=marks), held.at),)
