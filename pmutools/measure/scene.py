"""What a diagnosis looks at, and what one row of the table of diagnoses is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median_low
from typing import Literal, NamedTuple

from pmutools.measure.clockquality import ClockLog
from pmutools.measure.delay import SECOND_WITHIN_NS
from pmutools.measure.histogram import NS_PER_MS
from pmutools.measure.stream import StreamResult
from pmutools.timebase import NS

ENOUGH = 50
"""Fewer frames with an arrival tell nothing of delays."""


class Peer(NamedTuple):
    """What is asked of other streams: their rate, frames/s, and their median delay."""

    rate: float
    middle_ns: float


def peers_of(results: Sequence[StreamResult]) -> tuple[Peer, ...]:
    """Streams as each of them sees all: one a rate, whose delay is the median of their medians."""
    found: dict[float, list[float]] = {}
    for result in results:
        middle = _middle(result)
        if result.rate and middle is not None:
            found.setdefault(float(result.rate), []).append(middle)
    return tuple(Peer(rate, median_low(middles)) for rate, middles in sorted(found.items()))


@dataclass(frozen=True)
class Scene:
    """What a diagnosis may look at."""

    result: StreamResult
    clock: ClockLog = field(default_factory=ClockLog)
    others: Sequence[Peer] = ()
    """All streams of the run, this one among them, by rate."""

    @property
    def middle_ns(self) -> float | None:
        """Median delay, of enough frames."""
        return _middle(self.result)

    @property
    def leaps(self) -> int:
        """How often the delay changed by a whole second from a frame to the next."""
        steps = (abs(abs(step.change_ns) - NS) < SECOND_WITHIN_NS for step in self.result.clock_steps)
        return self.result.counts.delays.second_steps + sum(steps)

    @property
    def locked_share(self) -> float:
        delays = self.result.counts.delays
        return delays.locked.count / delays.delay.count if delays.delay.count else 0.0


Level = Literal["finding", "note"]
"""A note is of what many devices do and no figure suffers from."""
Test = Callable[[Scene], str | None]


class Diagnosis(NamedTuple):
    """A finding: the row's id, its sentence and its level."""

    id: str
    text: str
    level: Level = "finding"


class Row(NamedTuple):
    """A symptom: what it is called, what it looks at, and the test that says it in words or returns None."""

    id: str
    sign: str
    test: Test
    level: Level = "finding"


def _middle(result: StreamResult) -> float | None:
    delays = result.counts.delays.delay
    return delays.quantile_ns(0.5) if delays.count >= ENOUGH else None


def ms_text(value_ns: float, sign: str = "") -> str:
    """A duration in ms."""
    return f"{value_ns / NS_PER_MS:{sign}.4g} ms"


def span_text(value_ns: float) -> str:
    """A long duration in the largest unit that there are two of."""
    seconds = value_ns / NS
    for unit, size in (("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"
