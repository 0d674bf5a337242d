"""The gate: a stream that falls silent and comes back, by stream time, frame index or order.

``disable = 5..8,20..``; with ``release=burst``, what was due in the silence is sent when the stream comes back, as a
device with a store-and-forward buffer does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from pmutools.draws import Draws
from pmutools.impair.grammar import named_parts
from pmutools.impair.moment import Moment
from pmutools.impair.selectors import Selector, selector_of_any
from pmutools.parsers import choice, parsed_by

HOLD_LIMIT = 65_536
"""Frames kept for a burst, a stream (18 minutes at 60/s); the oldest beyond are given up."""


@dataclass(frozen=True, slots=True)
class Disable:
    when: Selector = field(metadata=parsed_by(selector_of_any))
    release: str = field(default="skip", metadata=parsed_by(choice("skip", "burst")))


class Verdict(Enum):
    OPEN = 0
    CLOSED = 1
    HOLD = 2
    """Closed, and the frame is kept for a burst."""


class Gate:
    """The schedule of one stream's silences; ``draws`` gives the draws of a stage by its name."""

    def __init__(self, parts: tuple[Disable, ...], draws: Callable[[str], Draws]) -> None:
        self._closures = [
            (part.when.test(draws(f"{name}.when")), Verdict.HOLD if part.release == "burst" else Verdict.CLOSED)
            for name, part in named_parts("disable", parts)
        ]

    def verdict(self, at: Moment) -> Verdict:
        for closes, verdict in self._closures:
            if closes(at):
                return verdict
        return Verdict.OPEN
