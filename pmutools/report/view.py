"""A run, as its report looks at it: streams with names that are unique, which of them in detail, and the time shown."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pmutools.measure.fits import Fit, fits, typical
from pmutools.measure.histogram import NS_PER_MS, Histogram
from pmutools.measure.require import Verdict
from pmutools.measure.run import Run
from pmutools.measure.stream import StreamResult
from pmutools.measure.timeline import Course
from pmutools.report.text import labels
from pmutools.timebase import NS

DETAILED = 12
"""So many streams have plots of their own."""
RULE = (
    f"{DETAILED} streams have plots of their own: those with most failed limits first, then those with the largest "
    "share of expected frames that cannot be used (1 − completeness), then those with the largest p99 of PDV"
)
_SHORTEST_GAP_NS = 2 * NS


@dataclass(frozen=True)
class Stream:
    """One stream: its place, its name on axes, and what was measured of it."""

    number: int
    label: str
    told: Mapping[str, Any]
    result: StreamResult
    course: Course | None
    verdicts: Sequence[Verdict] = ()

    @property
    def anchor(self) -> str:
        """Of its section."""
        return f"stream-{self.number + 1}"

    @property
    def stem(self) -> str:
        """What the names of its files begin with; letters that any file system takes."""
        slug = re.sub(r"[^a-z0-9]+", "-", self.label.lower()).strip("-")
        return f"{self.number + 1:03d}-{slug}" if slug else f"{self.number + 1:03d}"

    @property
    def measured(self) -> bool:
        """Some frame came."""
        return bool(self.told["received"])

    @property
    def failed(self) -> int:
        """Limits that do not hold for it."""
        return sum(not verdict.holds for verdict in self.verdicts)

    @cached_property
    def typical(self) -> tuple[Histogram, str]:
        """The delays to draw, and their name: ``pdv`` where the delays themselves are a clock's error."""
        return typical(self.result.counts.delays)

    @cached_property
    def fits(self) -> list[Fit]:
        """Of each family of distributions, the nearest to them."""
        return fits(self.typical[0])

    @property
    def clock_error(self) -> bool:
        """The delays are a clock's error, by hours or below zero: only their variation is worth drawing."""
        return self.typical[1] == "pdv"

    @property
    def bound_ms(self) -> float | None:
        """Uncertainty of a delay."""
        bound: float | None = self.told["uncertainty_ms"]
        return bound

    @cached_property
    def gaps_ms(self) -> list[tuple[float, float]]:
        """Stretches between its first and last frame in which nothing came (UTC)."""
        if self.course is None or not len(self.course.frames):
            return []
        width = self.course.width_ns
        empty = np.concatenate(([False], self.course.frames == 0, [False])).astype(np.int8)
        edges = np.flatnonzero(np.diff(empty)).reshape(-1, 2)
        least = max(_SHORTEST_GAP_NS, 2 * width, 3 * self.result.period_ns)
        edges = edges[(edges[:, 1] - edges[:, 0]) * width >= least]
        return [tuple(pair) for pair in ((self.course.start_ns + edges * width) / NS_PER_MS).tolist()]

    @property
    def badness(self) -> tuple[float, ...]:
        """By :data:`RULE`, the worst the largest."""
        complete = self.told["quality"]["completeness"]
        return (self.failed, 1 - (complete if complete is not None else 1.0), self.told["pdv_ms"]["p99"] or 0.0)


class View:
    """What the parts of a report are made from."""

    def __init__(self, run: Run) -> None:
        self.run = run
        told = run.summary["streams"]
        names = labels(each["name"] for each in told)
        verdicts: dict[str, list[Verdict]] = {}
        for verdict in run.verdicts:
            verdicts.setdefault(verdict.stream, []).append(verdict)
        courses = run.courses or [None] * len(told)
        self.streams = [
            Stream(number, name, each, result, course, verdicts.get(each["name"], ()))
            for number, (name, each, result, course) in enumerate(zip(names, told, run.results, courses, strict=True))
        ]
        self.measured = [stream for stream in self.streams if stream.measured]
        worst = sorted(self.measured, key=lambda stream: stream.badness, reverse=True)
        self.detailed = self.measured if len(self.measured) <= DETAILED else worst[:DETAILED]
        self.begin_ns, self.end_ns = self._span()

    @property
    def all(self) -> Mapping[str, Any]:
        """What was counted of all streams together."""
        told: Mapping[str, Any] = self.run.summary["all"]
        return told

    def _span(self) -> tuple[int | None, int | None]:
        """The time of the run: as given, else from the first arrival to the last (or stamp, where nobody saw any)."""
        if self.run.begin_ns or self.run.end_ns:
            return self.run.begin_ns, self.run.end_ns
        results = self.run.results
        for first, last in (("first_arrival_ns", "last_arrival_ns"), ("first_ns", "last_ns")):
            begins = [at for result in results if (at := getattr(result, first)) is not None]
            ends = [at for result in results if (at := getattr(result, last)) is not None]
            if begins and ends:
                return min(begins), max(ends)
        return None, None

    @cached_property
    def shown_ms(self) -> tuple[float, float] | None:
        """What axes of time show: the run, or where its arrivals lie elsewhere (a recording's), those."""
        ends = [bound for course in self._courses() for bound in (course.start_ns, _end_ns(course))]
        if not ends:
            return None
        first, last = min(ends), max(ends)
        begin, end = self.begin_ns, self.end_ns
        if begin is not None and end is not None and begin - 60 * NS <= first and last <= end + 60 * NS:
            first, last = min(first, begin), max(last, end)
        return first / NS_PER_MS, last / NS_PER_MS

    def _courses(self) -> Iterator[Course]:
        return (stream.course for stream in self.streams if stream.course is not None and len(stream.course.frames))


def _end_ns(course: Course) -> int:
    return course.start_ns + len(course.frames) * course.width_ns
