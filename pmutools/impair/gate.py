"""The gate: a stream that falls silent and comes back, by stream time, frame index or order.

``disable = 5..8,20..``; with ``release=burst``, what was due in the silence is sent when the stream comes back, as a
device with a store-and-forward buffer does; ``tcp=`` says what TCP clients see of the silence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from pmutools.draws import Draws
from pmutools.flow import Hangup
from pmutools.impair.grammar import named_parts
from pmutools.impair.moment import Moment
from pmutools.impair.selectors import Selector, selector_of_any
from pmutools.parsers import choice, parsed_by

HOLD_LIMIT = 65_536
"""Frames kept for a burst, a stream (18 minutes at 60/s); the oldest beyond are given up."""


def _hangup(text: str) -> Hangup:
    return Hangup(choice(*Hangup)(text))


@dataclass(frozen=True, slots=True)
class Switch:
    """How a stream is silent, by order or by schedule."""

    release: str = field(default="skip", metadata=parsed_by(choice("skip", "burst")))
    tcp: Hangup = field(default=Hangup.SILENCE, metadata=parsed_by(_hangup))

    @property
    def holds(self) -> bool:
        """Whether frames are kept for a burst."""
        return self.release == "burst"


@dataclass(frozen=True)
class _Scheduled:
    when: Selector = field(metadata=parsed_by(selector_of_any))


@dataclass(frozen=True)
class Disable(Switch, _Scheduled):  # the fields of the last base come first
    """A switch with its schedule."""


class Gate:
    """The schedule of one stream's silences; ``draws`` gives the draws of a stage by its name."""

    def __init__(self, parts: Sequence[Disable], draws: Callable[[str], Draws]) -> None:
        self._closures = [(part.when.test(draws(f"{name}.when")), part) for name, part in named_parts("disable", parts)]

    def closure(self, at: Moment) -> Switch | None:
        """How the stream is silent; None where it is not."""
        for closes, part in self._closures:
            if closes(at):
                return part
        return None
