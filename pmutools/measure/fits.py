"""Distributions fitted to what was measured, as text of the impairment grammar: ``normal(44.1, 1.3)``.

Each family is fitted to the histogram by an estimator of its own (below). What is judged is the text itself, read back
by :mod:`pmutools.impair`: its Kolmogorov-Smirnov distance, and whether its tail holds
(:mod:`pmutools.measure.likeness`). The fit is, of the families whose tail holds, the simplest whose distance is within
a quarter, or 0.005, of the best one's. Where none holds, or the best is above :data:`POOR` and above what chance makes
of so few values (1.36/√n, at the 5 % level), the histogram itself stands in, and the nearest family is told beside it.

=========== ==========================================================================================
constant    where all lies within a microsecond or two
uniform     least and largest
normal      maximum likelihood; or median and the middle 68 %, where a few outliers spoil that
exponential maximum likelihood from the least value on
lognormal   shift by quantiles; mean and sd of the logarithm
gamma       shift by quantiles, or 0; maximum likelihood by Minka's approximation
weibull     shift by the least value; maximum likelihood by Newton's method, or by two quantiles
pareto      probability-weighted moments of the excess over the least value (Hosking and Wallis 1987)
=========== ==========================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.impair.quantiles import normal_cdf
from pmutools.measure.binned import histogram_text
from pmutools.measure.delay import DelayCounts
from pmutools.measure.histogram import NS_PER_MS, Histogram, ms
from pmutools.measure.likeness import Allowed, TailError, allowed, ks_distance, tail_error
from pmutools.timebase import NS

POOR = 0.05
"""A KS distance above this is no likeness."""
UNLIKELY_NS = 10 * NS
LIKE = 1.25
LIKE_MARGIN = 0.005
_CHANCE = 1.36
_ENOUGH = 50

Floats = npt.NDArray[np.float64]


def typical(delays: DelayCounts) -> tuple[Histogram, str]:
    """What to fit, and its name: the delays, or where most are below zero or above 10 s, which is a clock's error and
    leaves them coarse, those above their floor.
    """
    middle = delays.delay.quantile_ns(0.5)
    return (delays.delay, "delay") if middle is None or 0 <= middle < UNLIKELY_NS else (delays.pdv, "pdv")


class Fit(NamedTuple):
    """A distribution in ms, its KS distance from what was measured, and where its quantiles are furthest off.

    ``nearest``, of a histogram that stands in: what it stands in for.
    """

    text: str
    ks: float
    frames: int
    tail: TailError
    nearest: Fit | None = None

    @property
    def name(self) -> str:
        return self.text.partition("(")[0]

    @property
    def params(self) -> list[str]:
        """As the grammar writes them: numbers, and ``key=number``."""
        return [part.strip() for part in self.text.partition("(")[2].rstrip(")").split(",")]

    @property
    def unlike(self) -> bool:
        """As a whole, not in its tail alone."""
        return self.ks > _most_ks(self.frames)

    @property
    def fault(self) -> str:
        """Why it is not exported; nothing where it may be."""
        if self.unlike:
            return f"its KS distance is {self.ks:.3f}"
        return "" if self.tail.holds else f"its {self.tail.words}"

    def to_json(self) -> dict[str, object]:
        long = len(self.params) > 8
        return {
            "name": self.name,
            "params": [] if long else self.params,
            "ks": self.ks,
            "text": self.text,
            "tail_error_ms": self.tail.error_ms,
            "tail_error_at": self.tail.at,
            "tail_holds": self.tail.holds,
            "nearest": self.nearest.to_json() if self.nearest else None,
        }


class _Sample(NamedTuple):
    """Bins' middles in ms, and the share of each."""

    middle: Floats
    weight: Floats
    least: float
    most: float
    mean: float
    sd: float

    def quantile(self, share: float) -> float:
        return float(np.interp(share, np.cumsum(self.weight) - self.weight / 2, self.middle))

    def average(self, values: Floats) -> float:
        return float(values @ self.weight)


def _normal(sample: _Sample) -> Iterator[str]:
    yield _text("normal", sample.mean, sample.sd)
    low, middle, high = (sample.quantile(share) for share in (0.1586553, 0.5, 0.8413447))
    if high > low:
        yield _text("normal", middle, (high - low) / 2)


def _uniform(sample: _Sample) -> Iterator[str]:
    yield _text("uniform", sample.least, sample.most)


def _exponential(sample: _Sample) -> Iterator[str]:
    if sample.mean > sample.least:
        yield _text("exponential", sample.mean - sample.least, shift=sample.least)


def _shifts(sample: _Sample) -> Iterator[float]:
    """Where a skewed distribution may begin: by three quantiles that a shift alone moves together; at 0."""
    for share in (0.005, 0.05):
        low, middle, high = sample.quantile(share), sample.quantile(0.5), sample.quantile(1 - share)
        if (bend := low + high - 2 * middle) > 0:
            shift = (low * high - middle * middle) / bend
            if shift < sample.least:
                yield shift
    for share in (0.02, 0.0002):
        yield sample.least - share * (sample.most - sample.least) - 1e-4
    if sample.least > 0:
        yield 0.0


def _lognormal(sample: _Sample) -> Iterator[str]:
    for shift in _shifts(sample):
        logs = np.log(np.maximum(sample.middle - shift, 1e-6))
        mean = sample.average(logs)
        variance = sample.average((logs - mean) ** 2)
        if variance < 9 and abs(shift) < 1e5:
            centre = math.exp(mean + variance / 2)
            yield _text("lognormal", centre, centre * math.sqrt(math.expm1(variance)), shift=shift)


def _gamma(sample: _Sample) -> Iterator[str]:
    best, least = None, math.inf
    for shift in _shifts(sample):
        excess = np.maximum(sample.middle - shift, 1e-6)
        mean = sample.average(excess)
        s = math.log(mean) - sample.average(np.log(excess))
        if s <= 0:
            continue
        shape = (3 - s + math.sqrt((s - 3) ** 2 + 24 * s)) / (12 * s)
        if not 0.06 <= shape <= 9e3:
            continue
        # its exact quantiles cost 30 ms: choose by Wilson and Hilferty's approximation
        z = (np.cbrt(excess / mean) - 1 + 1 / (9 * shape)) * (3 * math.sqrt(shape))
        cdf = np.array([normal_cdf(value) for value in z.tolist()])
        distance = float(np.abs(cdf - np.cumsum(sample.weight) + sample.weight / 2).max())
        if distance < least:
            best, least = _text("gamma", mean, mean / math.sqrt(shape), shift=shift), distance
    if best is not None and least < 3 * POOR:
        yield best


def _weibull(sample: _Sample) -> Iterator[str]:
    excess = np.maximum(sample.middle - sample.least + 1e-4 * (sample.most - sample.least), 1e-6)
    logs = np.log(excess)
    mean_log, shape = sample.average(logs), 1.0
    for _ in range(50):
        powers = excess**shape
        total, first = sample.average(powers), sample.average(powers * logs)
        second = sample.average(powers * logs * logs)
        value = first / total - 1 / shape - mean_log
        slope = second / total - (first / total) ** 2 + 1 / shape**2
        step = value / slope
        shape = min(max(shape - step, shape / 3, 0.06), shape * 3, 50.0)
        if abs(step) < 1e-9 * shape:
            break
    yield _text("weibull", shape, sample.average(excess**shape) ** (1 / shape), shift=sample.least)
    scale, late = (sample.quantile(share) - sample.least for share in (1 - 1 / math.e, 0.99))
    if late > scale > 0 and (shape := math.log(math.log(100)) / math.log(late / scale)) >= 0.06:
        yield _text("weibull", shape, scale, shift=sample.least)


def _pareto(sample: _Sample) -> Iterator[str]:
    excess = np.maximum(sample.middle - sample.least, 0.0)
    above = 1 - (np.cumsum(sample.weight) - sample.weight / 2)
    whole, upper = sample.average(excess), sample.average(excess * above)
    if whole <= 2 * upper:
        return
    index, spread = 2 - whole / (whole - 2 * upper), 2 * whole * upper / (whole - 2 * upper)
    if 0.01 < index < 0.95:
        scale = spread / index
        yield _text("pareto", 1 / index, scale, shift=sample.least - scale)


FAMILIES: dict[str, Callable[[_Sample], Iterator[str]]] = {
    "normal": _normal,
    "exponential": _exponential,
    "uniform": _uniform,
    "gamma": _gamma,
    "lognormal": _lognormal,
    "weibull": _weibull,
    "pareto": _pareto,
}
"""Simplest first."""


def fits(measured: Histogram) -> list[Fit]:
    """The best of each family, in the order of :data:`FAMILIES`; of few values none."""
    sample = _sample(measured)
    if sample is None or sample.sd <= 0:
        return []
    held_to, found = allowed(measured), list[Fit]()
    for family in FAMILIES.values():
        candidates = [_judged(text, measured, held_to) for text in family(sample)]
        if candidates:
            found.append(min(candidates, key=lambda fit: (not fit.tail.holds, fit.ks)))
    return found


def nearest(found: Sequence[Fit]) -> Fit | None:
    """Of those that are like it as a whole (or else of all) the one that is least off in its quantiles."""
    return min(found, key=lambda fit: (fit.unlike, fit.tail.score), default=None)


def best_fit(measured: Histogram) -> Fit | None:
    """The fit by the rule of this module; None of fewer than 50 values."""
    if measured.count < _ENOUGH or measured.min_ns is None or measured.max_ns is None or measured.mean_ns is None:
        return None
    held_to = allowed(measured)
    if measured.max_ns - measured.min_ns <= 2000:
        return _judged(_text("constant", measured.mean_ns / NS_PER_MS), measured, held_to)._replace(ks=0.0)
    sample = _sample(measured)
    assert sample is not None
    first = min((_judged(text, measured, held_to) for text in _normal(sample)), key=lambda fit: fit.ks)
    if first.ks <= LIKE_MARGIN and first.tail.holds:  # no other can beat it
        return first
    found = fits(measured)
    holding = [fit for fit in found if fit.tail.holds]
    least = min((fit.ks for fit in holding), default=1.0)
    if least > _most_ks(measured.count):
        stand_in = _judged(histogram_text(measured), measured, held_to)
        return stand_in._replace(nearest=nearest(found))
    return next(fit for fit in holding if fit.ks <= max(least * LIKE, least + LIKE_MARGIN))


def _judged(text: str, measured: Histogram, held_to: list[Allowed]) -> Fit:
    return Fit(text, ks_distance(text, measured), measured.count, tail_error(text, held_to))


def _most_ks(count: int) -> float:
    """A larger distance is no likeness."""
    return max(POOR, _CHANCE / math.sqrt(count))


def _sample(measured: Histogram) -> _Sample | None:
    if measured.count < _ENOUGH or measured.min_ns is None or measured.max_ns is None:
        return None
    bins = measured.bins()
    low, high = np.maximum(bins.low_ns, measured.min_ns), np.minimum(bins.high_ns, measured.max_ns)
    return _Sample(
        (low + high) / 2 / NS_PER_MS,
        bins.count / measured.count,
        measured.min_ns / NS_PER_MS,
        measured.max_ns / NS_PER_MS,
        (measured.mean_ns or 0.0) / NS_PER_MS,
        ms(measured.sd_ns) or 0.0,
    )


def _text(name: str, *values: float, shift: float = 0.0) -> str:
    told = [f"{value:.6g}" for value in values]
    if shift:
        told.append(f"shift={shift:.6g}")
    return f"{name}({', '.join(told)})"
