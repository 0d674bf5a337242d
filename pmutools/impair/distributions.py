"""Distributions of a delay, DIST of the grammar: each is the function that turns uniform draws into milliseconds.

One draw a frame whatever the distribution (a mixture spends its draw on the choice and what is left of it on the
value), so a change of distribution keeps every other draw. Parameters are in milliseconds unless said otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import NamedTuple, Protocol

import numpy as np

from pmutools.impair.quantiles import LEAST, MOST, Array, each, gamma_quantile, normal_cdf, normal_quantile
from pmutools.parsers import Call, bind, call, number, parsed_by, probability, suggestion

Quantile = Callable[[Array], Array]
_ANY = parsed_by(number())
_NOT_NEGATIVE = parsed_by(number(0))
_POSITIVE = parsed_by(number(1e-9))


class Distribution(Protocol):
    def quantile(self) -> Quantile:
        """The function from draws in (0, 1) to values in ms."""


@dataclass(frozen=True, slots=True)
class Constant:
    """Always ``value``."""

    value: float = field(metadata=_ANY)

    def quantile(self) -> Quantile:
        return lambda u: np.full_like(u, self.value)


@dataclass(frozen=True, slots=True)
class Uniform:
    """Equally likely from ``low`` to ``high``."""

    low: float = field(metadata=_ANY)
    high: float = field(metadata=_ANY)

    def __post_init__(self) -> None:
        _ordered("uniform", self.low, self.high)

    def quantile(self) -> Quantile:
        return lambda u: self.low + (self.high - self.low) * u


@dataclass(frozen=True, slots=True)
class Normal:
    """Mean and standard deviation."""

    mean: float = field(metadata=_ANY)
    sd: float = field(metadata=_NOT_NEGATIVE)

    def quantile(self) -> Quantile:
        return lambda u: self.mean + self.sd * normal_quantile(u)


@dataclass(frozen=True, slots=True)
class TruncatedNormal:
    """The normal distribution of ``mean`` and ``sd`` given that it falls between ``low`` and ``high``."""

    mean: float = field(metadata=_ANY)
    sd: float = field(metadata=_POSITIVE)
    low: float = field(metadata=_ANY)
    high: float = field(metadata=_ANY)

    def __post_init__(self) -> None:
        _ordered("truncnormal", self.low, self.high)
        if not self._share()[1] > 0:
            raise ValueError("truncnormal: nothing of the normal lies between low and high; move them nearer to mean")

    def _share(self) -> tuple[float, float, bool]:
        """(probability below, probability within, counted from above), from the side where they are exact."""
        a, b = (self.low - self.mean) / self.sd, (self.high - self.mean) / self.sd
        above = a > 0
        if above:
            a, b = -b, -a
        below = normal_cdf(a)
        return below, normal_cdf(b) - below, above

    def quantile(self) -> Quantile:
        below, within, above = self._share()

        def values(u: Array) -> Array:
            z = normal_quantile(np.clip(below + within * (1.0 - u if above else u), 1e-300, MOST))
            return np.clip(self.mean + self.sd * (-z if above else z), self.low, self.high)

        return values


@dataclass(frozen=True, slots=True)
class Lognormal:
    """Mean and standard deviation of the delay itself, not of its logarithm."""

    mean: float = field(metadata=_POSITIVE)
    sd: float = field(metadata=_NOT_NEGATIVE)

    def quantile(self) -> Quantile:
        variance = math.log1p((self.sd / self.mean) ** 2)
        mu, sigma = math.log(self.mean) - variance / 2, math.sqrt(variance)
        return lambda u: each(math.exp, mu + sigma * normal_quantile(u))


@dataclass(frozen=True, slots=True)
class Gamma:
    """Mean and standard deviation; shape = (mean/sd)², scale = sd²/mean."""

    mean: float = field(metadata=_POSITIVE)
    sd: float = field(metadata=_POSITIVE)

    def __post_init__(self) -> None:
        if not 0.05 <= (self.mean / self.sd) ** 2 <= 1e4:
            raise ValueError("gamma: mean/sd must be 0.23 to 100; beyond 100 use normal")

    def quantile(self) -> Quantile:
        standard, scale = gamma_quantile((self.mean / self.sd) ** 2), self.sd**2 / self.mean
        return lambda u: scale * standard(u)


@dataclass(frozen=True, slots=True)
class Exponential:
    """Exponential of the given mean; shifted by ``shift=`` or by adding a constant."""

    mean: float = field(metadata=_NOT_NEGATIVE)

    def quantile(self) -> Quantile:
        return lambda u: -self.mean * each(math.log1p, -u)


@dataclass(frozen=True, slots=True)
class Weibull:
    """``shape`` (no unit; below 1 a heavy tail) and ``scale``."""

    shape: float = field(metadata=parsed_by(number(0.05)))
    scale: float = field(metadata=_NOT_NEGATIVE)

    def quantile(self) -> Quantile:
        return lambda u: self.scale * each(math.exp, each(math.log, -each(math.log1p, -u)) / self.shape)


@dataclass(frozen=True, slots=True)
class Pareto:
    """P(delay > x) = (scale/x)**shape from ``scale`` up; no mean at shape <= 1: give it a ``max``."""

    shape: float = field(metadata=parsed_by(number(0.05)))
    scale: float = field(metadata=_POSITIVE)

    def quantile(self) -> Quantile:
        return lambda u: self.scale * each(math.exp, np.minimum(700.0, each(math.log1p, -u) / -self.shape))


@dataclass(frozen=True, slots=True)
class ParetoNormal:
    """netem's table of that name, as a formula: mean + jitter * (N/4 + 3P/4), both parts of one draw, within ±4.

    N is the standard normal, P = (4/3) * ((1 - u)**(-1/3) - 1.5).
    """

    mean: float = field(metadata=_ANY)
    jitter: float = field(metadata=_NOT_NEGATIVE)

    def quantile(self) -> Quantile:
        def values(u: Array) -> Array:
            pareto = (each(math.exp, each(math.log1p, -u) / -3.0) - 1.5) * (4.0 / 3.0)
            normal = np.clip(normal_quantile(u), -4.0, 4.0)
            return self.mean + self.jitter * (0.25 * normal + 0.75 * np.minimum(pareto, 4.0))

        return values


@dataclass(frozen=True, slots=True)
class Empirical:
    """One of the given values, each equally likely."""

    sample: tuple[float, ...] = field(metadata=parsed_by(number(), rest=True))

    def quantile(self) -> Quantile:
        ranked: Array = np.array(sorted(self.sample))
        return lambda u: ranked[(u * ranked.size).astype(np.int64)]


@dataclass(frozen=True, slots=True)
class Histogram:
    """Bins of three numbers each, low edge, high edge (ms), count: ``histogram(10, 12, 5,  12, 20, 80)``.

    A bin is met in proportion to its count; within it every value is equally likely.
    """

    bins: tuple[float, ...] = field(metadata=parsed_by(number(), rest=True))

    def __post_init__(self) -> None:
        rows = self._rows()
        if len(self.bins) % 3 or any(high < low or count < 0 for low, high, count in rows):
            raise ValueError("histogram: each bin is LOW, HIGH, COUNT with LOW <= HIGH and COUNT >= 0")
        if any(later[0] < row[1] for row, later in pairwise(rows)):
            raise ValueError("histogram: bins must follow each other without overlap")
        if not sum(count for _, _, count in rows) > 0:
            raise ValueError("histogram: all bins are empty")

    def _rows(self) -> list[tuple[float, float, float]]:
        return list(zip(self.bins[::3], self.bins[1::3], self.bins[2::3], strict=False))

    def quantile(self) -> Quantile:
        lows, highs, counts = np.array([row for row in self._rows() if row[2]]).T
        edges = np.array([0.0, *accumulate(counts.tolist())]) / math.fsum(counts.tolist())

        def values(u: Array) -> Array:
            at = np.minimum(np.searchsorted(edges, u, side="right") - 1, lows.size - 1)
            share = np.clip((u - edges[at]) / (edges[at + 1] - edges[at]), 0.0, 1.0)
            drawn: Array = lows[at] + (highs[at] - lows[at]) * share
            return drawn

        return values


class QuantilePoint(NamedTuple):
    share: float
    value: float


def _quantile_point(text: str) -> QuantilePoint:
    parts = text.split()
    if len(parts) != 2:
        raise ValueError(f"{text!r} is not 'PERCENT% VALUE'")
    return QuantilePoint(probability(parts[0]), number()(parts[1]))


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Straight lines between measured percentiles: ``quantiles(0% 12, 50% 16, 99% 30, 100% 44)``."""

    points: tuple[QuantilePoint, ...] = field(metadata=parsed_by(_quantile_point, rest=True))

    def __post_init__(self) -> None:
        shares, values = [point.share for point in self.points], [point.value for point in self.points]
        if shares[0] != 0 or shares[-1] != 1 or shares != sorted(set(shares)) or values != sorted(values):
            raise ValueError("quantiles: must rise from 0% to 100%, in order")

    def quantile(self) -> Quantile:
        shares, values = np.array(self.points).T
        slopes = np.diff(values) / np.diff(shares)

        def between(u: Array) -> Array:
            at = np.searchsorted(shares, u, side="right") - 1
            line: Array = values[at] + slopes[at] * (u - shares[at])
            return line

        return between


class Component(NamedTuple):
    weight: float
    distribution: Distribution


def _component(text: str) -> Component:
    weight, _, rest = text.partition(" ")
    if not rest:
        raise ValueError(f"{text!r} is not 'WEIGHT DIST', as in '90% normal(16,2)'")
    return Component(probability(weight), distribution(rest))


@dataclass(frozen=True, slots=True)
class Mixture:
    """One of several distributions: ``mixture(90% normal(16,2), 10% uniform(30,80))``; weights add up to 100 %."""

    components: tuple[Component, ...] = field(metadata=parsed_by(_component, rest=True))

    def __post_init__(self) -> None:
        total = math.fsum(component.weight for component in self.components)
        if abs(total - 1) > 1e-9 or any(not component.weight for component in self.components):
            raise ValueError(f"mixture: weights must be above 0 and add up to 100%, not {100 * total:g}%")

    def quantile(self) -> Quantile:
        weights = np.array([component.weight for component in self.components])
        edges = np.array([0.0, *accumulate(weights.tolist()[:-1])])
        parts = [component.distribution.quantile() for component in self.components]

        def values(u: Array) -> Array:
            which = np.searchsorted(edges, u, side="right") - 1
            rest = np.clip((u - edges[which]) / weights[which], LEAST, MOST)
            mixed = np.empty_like(u)
            for number_, part in enumerate(parts):
                chosen = which == number_
                mixed[chosen] = part(rest[chosen])
            return mixed

        return values


@dataclass(frozen=True, slots=True)
class Limited:
    """``inner`` moved by ``shift``, then held within ``min`` and ``max`` (values beyond become the limit)."""

    inner: Distribution
    shift: float = field(default=0.0, metadata=_ANY)
    min: float = field(default=-math.inf, metadata=_ANY)
    max: float = field(default=math.inf, metadata=_ANY)

    def __post_init__(self) -> None:
        if self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}")

    def quantile(self) -> Quantile:
        inner = self.inner.quantile()
        return lambda u: np.clip(inner(u) + self.shift, self.min, self.max)


DISTRIBUTIONS: dict[str, type[Distribution]] = {
    "constant": Constant,
    "uniform": Uniform,
    "normal": Normal,
    "truncnormal": TruncatedNormal,
    "lognormal": Lognormal,
    "gamma": Gamma,
    "exponential": Exponential,
    "weibull": Weibull,
    "pareto": Pareto,
    "paretonormal": ParetoNormal,
    "empirical": Empirical,
    "histogram": Histogram,
    "quantiles": Quantiles,
    "mixture": Mixture,
}
LIMITS = ("shift", "min", "max")
"""Named arguments that every distribution takes."""


def distribution(text: str) -> Distribution:
    """Parse one DIST; a bare number is a constant. Raises ValueError."""
    return Constant(number()(text)) if is_bare(text) else distribution_of(call(text))


def is_bare(text: str) -> bool:
    """Whether a DIST is written as a number alone."""
    return text[:1] in "0123456789.-"


def distribution_of(parts: Call) -> Distribution:
    """The distribution that a call names."""
    if parts.name not in DISTRIBUTIONS:
        raise ValueError(f"{parts.name!r} is no distribution; {suggestion(parts.name, DISTRIBUTIONS)}")
    limits = {key: text for key, text in parts.named.items() if key in LIMITS}
    own = {key: text for key, text in parts.named.items() if key not in LIMITS}
    inner = bind(DISTRIBUTIONS[parts.name], parts._replace(named=own))
    return _limited(inner, parts.name, limits) if limits else inner


def _limited(inner: Distribution, name: str, limits: dict[str, str]) -> Distribution:
    values = {key: number()(text) for key, text in limits.items()}
    try:
        return Limited(inner, **values)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _ordered(name: str, low: float, high: float) -> None:
    if low > high:
        raise ValueError(f"{name}: low {low:g} is above high {high:g}")
