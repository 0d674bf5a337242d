"""Distributions fitted to what was measured, as text of the impairment grammar: ``normal(44.1, 1.3)``.

Each family is fitted to the histogram by an estimator of its own (below); what is judged is the text itself, read back
by :mod:`pmutools.impair`: its goodness is the Kolmogorov-Smirnov distance, the largest difference of the two
distribution functions. The fit is the simplest family whose distance is within a quarter, or 0.005, of the best one's.
Where the best is above :data:`POOR`, and above what chance makes of so few values (1.36/√n, at the 5 % level), none of
them is like what was measured, and the histogram itself stands in.

=========== ==========================================================================================
constant    where all lies within a microsecond or two
uniform     least and largest
normal      maximum likelihood; or median and the middle 68 %, where a few outliers spoil that
exponential maximum likelihood from the least value on
lognormal   shift by quantiles; mean and sd of the logarithm
gamma       shift by quantiles, or 0; maximum likelihood by Minka's approximation
weibull     shift by the least value; maximum likelihood by Newton's method
pareto      probability-weighted moments of the excess over the least value (Hosking and Wallis 1987)
=========== ==========================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.impair.distributions import distribution
from pmutools.impair.quantiles import normal_cdf
from pmutools.measure.delay import DelayCounts
from pmutools.measure.histogram import NS_PER_MS, Histogram, ms
from pmutools.timebase import NS

POOR = 0.05
"""A KS distance above this is no likeness."""
UNLIKELY_NS = 10 * NS
LIKE = 1.25
LIKE_MARGIN = 0.005
MOST_BINS = 120
"""Of an exported histogram."""
_CHANCE = 1.36
_ENOUGH = 50
_QUANTILES = 4001

Floats = npt.NDArray[np.float64]


def typical(delays: DelayCounts) -> tuple[Histogram, str]:
    """What to fit, and its name: the delays, or where most are below zero or above 10 s, which is a clock's error and
    leaves them coarse, those above their floor.
    """
    middle = delays.delay.quantile_ns(0.5)
    return (delays.delay, "delay") if middle is None or 0 <= middle < UNLIKELY_NS else (delays.pdv, "pdv")


class Fit(NamedTuple):
    """A distribution in ms, and its KS distance from what was measured."""

    text: str
    ks: float
    frames: int

    @property
    def name(self) -> str:
        return self.text.partition("(")[0]

    @property
    def params(self) -> list[str]:
        """As the grammar writes them: numbers, and ``key=number``."""
        return [part.strip() for part in self.text.partition("(")[2].rstrip(")").split(",")]

    def to_json(self) -> dict[str, object]:
        long = len(self.params) > 8
        return {"name": self.name, "params": [] if long else self.params, "ks": self.ks, "text": self.text}


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
    found = []
    for family in FAMILIES.values():
        candidates = [Fit(text, ks_distance(text, measured), measured.count) for text in family(sample)]
        if candidates:
            found.append(min(candidates, key=lambda fit: fit.ks))
    return found


def best_fit(measured: Histogram) -> Fit | None:
    """The fit by the rule of this module; None of fewer than 50 values."""
    if measured.count < _ENOUGH or measured.min_ns is None or measured.max_ns is None or measured.mean_ns is None:
        return None
    if measured.max_ns - measured.min_ns <= 2000:
        return Fit(_text("constant", measured.mean_ns / NS_PER_MS), 0.0, measured.count)
    sample = _sample(measured)
    assert sample is not None
    first = min((ks_distance(text, measured), text) for text in _normal(sample))
    if first[0] <= LIKE_MARGIN:  # no other can beat it
        return Fit(first[1], first[0], measured.count)
    found = fits(measured)
    least = min((fit.ks for fit in found), default=1.0)
    if least > max(POOR, _CHANCE / math.sqrt(measured.count)):
        text = histogram_text(measured)
        return Fit(text, ks_distance(text, measured), measured.count)
    return next(fit for fit in found if fit.ks <= max(least * LIKE, least + LIKE_MARGIN))


def histogram_text(measured: Histogram, most_bins: int = MOST_BINS) -> str:
    """What was measured, as ``histogram(low, high, count, ...)`` in ms, of so many bins of about equal count.

    Wide stretches where nothing was measured lie between bins, so there may be up to twice as many.
    """
    bins = measured.bins()
    low = np.maximum(bins.low_ns, measured.min_ns or 0)
    high = np.minimum(bins.high_ns, measured.max_ns or 0)
    groups = np.minimum((np.cumsum(bins.count) - bins.count) * most_bins // max(1, measured.count), most_bins - 1)
    gaps = (
        np.concatenate(([0], (low[1:] - high[:-1] > (high[-1] - low[0]) // most_bins).cumsum())) if len(low) else groups
    )
    starts = np.flatnonzero(np.diff(groups * (len(low) + 1) + gaps, prepend=-1))
    rows = []
    for first, end in zip(starts, [*starts[1:], len(low)], strict=True):
        rows.append(f"{low[first] / NS_PER_MS:.9g}, {high[end - 1] / NS_PER_MS:.9g}, {bins.count[first:end].sum()}")
    return f"histogram({',  '.join(rows)})"


def quantile_table(text: str) -> tuple[Floats, Floats]:
    """Shares (Q,), close together at both ends, and the values in ms that those shares of ``text`` do not exceed."""
    draws = 1 / (1 + np.exp(-np.linspace(-16, 16, _QUANTILES)))
    return draws, distribution(text).quantile()(draws)


def ks_distance(text: str, measured: Histogram) -> float:
    """The largest difference of the distribution functions of ``text`` (ms) and of what was measured."""
    bins = measured.bins()
    share = np.cumsum(bins.count) / measured.count
    edges = np.minimum(bins.high_ns, measured.max_ns or 0) / NS_PER_MS
    draws, values = quantile_table(text)
    at = np.interp(edges, values, draws, left=0.0, right=1.0)
    below = np.interp(bins.low_ns / NS_PER_MS, values, draws, left=0.0, right=1.0)
    before = np.concatenate(([0.0], share[:-1]))
    return float(max(np.abs(at - share).max(), np.abs(below - before).max()))


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
