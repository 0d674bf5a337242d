"""The delay stage: a sum of terms, each a distribution, a trace over frame indices or a course over stream time.

``delay = normal(44, 1.3, min=40, max=48) + constant(15) + lognormal(1, 1.5, max=25) corr=30% order=keep``

Terms are independent of each other. ``corr`` is the correlation of consecutive frames through a Gaussian copula:
z(n) = ρ z(n-1) + sqrt(1-ρ²) Φ⁻¹(u), and Φ(z) takes the place of u, so the distribution itself stays exact (netem's
mixing of uniforms narrows it). A sum below zero is sent at once. ``order=keep`` is a FIFO link: no frame leaves
before one that came earlier; by default, frames overtake.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.draws import Draws
from pmutools.impair.blocks import Lanes, by_index
from pmutools.impair.distributions import (
    DISTRIBUTIONS,
    Constant,
    Distribution,
    Quantile,
    distribution,
    distribution_of,
    is_bare,
)
from pmutools.impair.moment import Moment
from pmutools.impair.quantiles import LEAST, MOST, Array, normal_cdf, normal_quantile
from pmutools.impair.selectors import DATA, Selector, selector
from pmutools.parsers import bind, call, choice, number, parsed_by, probability, split_top, suggestion
from pmutools.timebase import NS

_MS = 1e6
_LONGEST_MS = 1e12
"""About 31 years, so that sums of heavy tails stay within 64 bits of ns."""
_NUMBER = parsed_by(number())
_POSITIVE = parsed_by(number(1e-6))
DAY_NS = 86_400 * NS


@dataclass(frozen=True, slots=True)
class Trace:
    """The given delays (ms), frame by frame, over and over."""

    values: tuple[float, ...] = field(metadata=parsed_by(number(), rest=True))


@dataclass(frozen=True, slots=True)
class Step:
    """``before`` until ``time`` (s), ``after`` from then on."""

    utc: ClassVar[bool] = False
    time: float = field(metadata=_NUMBER)
    before: float = field(metadata=_NUMBER)
    after: float = field(metadata=_NUMBER)

    def at(self, time_s: float) -> float:
        """The delay in ms at a stream time."""
        return self.before if time_s < self.time else self.after


@dataclass(frozen=True, slots=True)
class Ramp:
    """From ``before`` at ``start`` (s) in a straight line to ``after`` at ``end`` (s); level outside."""

    utc: ClassVar[bool] = False
    start: float = field(metadata=_NUMBER)
    end: float = field(metadata=_NUMBER)
    before: float = field(metadata=_NUMBER)
    after: float = field(metadata=_NUMBER)

    def __post_init__(self) -> None:
        if not self.end > self.start:
            raise ValueError("ramp: end must be after start")

    def at(self, time_s: float) -> float:
        share = min(1.0, max(0.0, (time_s - self.start) / (self.end - self.start)))
        return self.before + share * (self.after - self.before)


@dataclass(frozen=True, slots=True)
class Sinusoid:
    """``mean`` + ``amplitude`` * sin(2π t/``period`` + ``phase``): period in s, phase in degrees (a day: 86400)."""

    utc: ClassVar[bool] = False
    mean: float = field(metadata=_NUMBER)
    amplitude: float = field(metadata=_NUMBER)
    period: float = field(metadata=_POSITIVE)
    phase: float = field(default=0.0, metadata=_NUMBER)

    def at(self, time_s: float) -> float:
        return self.mean + self.amplitude * math.sin(math.tau * time_s / self.period + math.radians(self.phase))


@dataclass(frozen=True, slots=True)
class Diurnal:
    """``mean`` + ``amplitude`` * cos(2π (h - ``peak``)/24), h the UTC hour of the recorded stamp: busiest at ``peak``.

    By stream time, from midnight, where the stream's configuration is not known.
    """

    utc: ClassVar[bool] = True
    mean: float = field(metadata=_NUMBER)
    amplitude: float = field(metadata=_NUMBER)
    peak: float = field(default=18.0, metadata=parsed_by(number(0, 24)))

    def at(self, time_s: float) -> float:
        """The delay in ms at a time of day in s (whole days do not count)."""
        return self.mean + self.amplitude * math.cos(math.tau * (time_s / 3600 - self.peak) / 24)


Course = Step | Ramp | Sinusoid | Diurnal
Term = Distribution | Trace | Course
COURSES: Mapping[str, type[Course]] = {"step": Step, "ramp": Ramp, "sinusoid": Sinusoid, "diurnal": Diurnal}


def delay_terms(text: str) -> tuple[Term, ...]:
    """``DIST + DIST ...``, where a bare number is a constant; raises ValueError."""
    return tuple(_term(part) for part in split_top(text, "+"))


def _term(text: str) -> Term:
    if is_bare(text):
        return distribution(text)
    parts = call(text)
    if parts.name == "trace":
        return bind(Trace, parts)
    if parts.name in COURSES:
        return bind(COURSES[parts.name], parts)
    if parts.name not in DISTRIBUTIONS:
        known = (*DISTRIBUTIONS, "trace", *COURSES)
        raise ValueError(f"{parts.name!r} is no delay; {suggestion(parts.name, known)}")
    return distribution_of(parts)


@dataclass(frozen=True, slots=True)
class Delay:
    terms: tuple[Term, ...] = field(metadata=parsed_by(delay_terms))
    corr: float = field(default=0.0, metadata=parsed_by(probability))
    order: str = field(default="free", metadata=parsed_by(choice("free", "keep")))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))

    def __post_init__(self) -> None:
        if self.corr == 1:
            raise ValueError("corr: 100% would freeze the delay; stay below")

    def source(self, draws: Draws) -> DelaySource:
        """This part at work on one stream."""
        return DelaySource(self, draws)


class ByIndex(NamedTuple):
    """Delays in ns of data frames by their index alone: of one, and of an array (N,)."""

    one: Callable[[int], int]
    many: Callable[[npt.NDArray[np.int64]], npt.NDArray[np.int64]]


def fixed(delay_ns: int) -> ByIndex:
    """The same for every frame."""
    return ByIndex(lambda index: delay_ns, lambda index: np.full(index.size, delay_ns, np.int64))


class DelaySource:
    """The delay of a frame in ns, before the sum of all parts is held at 0.

    ``indexed`` does the same by the index of a data frame alone; None where the time has a say.
    """

    def __init__(self, part: Delay, draws: Draws) -> None:
        fixed_ns = sum(round(term.value * _MS) for term in part.terms if isinstance(term, Constant))
        self._courses = [term for term in part.terms if isinstance(term, Course)]
        drawn = {variate: term for variate, term in enumerate(part.terms) if not isinstance(term, Constant | Course)}
        self._terms = Lanes(lambda lane: DrawnTerms(drawn, draws, lane, fixed_ns, part.corr), draws)
        self._fixed_ns = None if drawn else fixed_ns
        self.indexed: ByIndex | None = None
        if not self._courses:
            blocks = self._terms.data
            self.indexed = ByIndex(blocks.__getitem__, partial(by_index, blocks)) if drawn else fixed(fixed_ns)

    def __call__(self, at: Moment) -> int:
        delay_ns = self._terms(at) if self._fixed_ns is None else self._fixed_ns
        if self._courses:
            delay_ns += round(sum(course.at(_clock(course, at) / NS) for course in self._courses) * _MS)
        return delay_ns


def _clock(course: Course, at: Moment) -> int:
    """The time that a course goes by, in ns."""
    stamp_ns = at.stamp_ns if course.utc else None
    return at.time_ns if stamp_ns is None else stamp_ns % DAY_NS


class DrawnTerms:
    """The chain of the terms that go by index, each keyed by its place in the sum, plus ``fixed_ns``; in ns."""

    def __init__(
        self,
        terms: Mapping[int, Distribution | Trace],
        draws: Draws,
        lane: int = 0,
        fixed_ns: int = 0,
        corr: float = 0.0,
    ) -> None:
        self.memory = corr > 0
        self._draws, self._lane = draws, lane
        self._fixed_ns = fixed_ns
        self._rho, self._innovation = corr, math.sqrt(1 - corr * corr)
        self._traces = [np.array(term.values) for term in terms.values() if isinstance(term, Trace)]
        self._random: dict[int, Quantile] = {
            variate: term.quantile() for variate, term in terms.items() if not isinstance(term, Trace)
        }
        self._z: dict[int, float | None] = {}

    def begin(self, index: int) -> None:
        self._z = dict.fromkeys(self._random)

    def run(self, first: int, count: int) -> array[int]:
        total = np.full(count, self._fixed_ns)
        for values in self._traces:
            total += _whole_ns(values[np.arange(first, first + count) % values.size])
        for variate, quantile in self._random.items():
            u = self._draws.uniforms(first, count, variate, self._lane)
            total += _whole_ns(quantile(self._correlated(variate, u) if self.memory else u))
        return array("q", total.tobytes())

    def _correlated(self, variate: int, u: Array) -> Array:
        rho, innovation, z = self._rho, self._innovation, self._z[variate]
        mixed = list[float]()
        for fresh in normal_quantile(u).tolist():
            z = fresh if z is None else rho * z + innovation * fresh
            mixed.append(normal_cdf(z))
        self._z[variate] = z
        bounded: Array = np.clip(np.array(mixed), LEAST, MOST)
        return bounded


def _whole_ns(ms: Array) -> npt.NDArray[np.int64]:
    bounded: Array = np.clip(ms, -_LONGEST_MS, _LONGEST_MS)
    return np.rint(bounded * _MS).astype(np.int64)
