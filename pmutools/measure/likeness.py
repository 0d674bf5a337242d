"""How like what was measured a distribution of the impairment grammar is: by its middle (KS), and by its tail.

The Kolmogorov-Smirnov distance, the largest difference of the distribution functions, does not see a tail: a thousandth
of the frames counts for 0.001 of it, however late they are. So a distribution must also *agree* at p50, p90, p99 and
p99.9: its quantile must lie within the larger of

* 5 % of what lies between the measured p1 and that quantile (or p99, if that is further). What every frame takes says
  nothing of a fit, and 5 % is what ``--compare`` tells as no difference;
* what chance leaves open: the 95 % interval of a quantile of so many values, from rank to rank of those measured,
  whatever the distribution (David and Nagaraja, "Order Statistics", 2003, 7.1). Where so few values do not reach the
  upper rank, the quantile is held from below only: 1200 frames cannot say how large p99.9 may be, but that it is no
  less than the fifth largest;

and the largest of so many draws must, in one run of 40 at least, be no more than the largest measured, and these 5 %.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.impair.distributions import distribution
from pmutools.measure.histogram import NS_PER_MS, Histogram, error_ns

AGREE = 0.05
"""A quantile may be wrong by this share of its distance from p1."""
SHARES = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999}
LARGEST = "max"
_Z = 1.96
"""Standard normal at 97.5 %."""
_NONE_BEYOND = -math.log(0.025)
"""Where so many values are expected, there is none in one run of 40 (Poisson)."""
_QUANTILES = 4001

Floats = npt.NDArray[np.float64]


class Allowed(NamedTuple):
    """What was measured at a quantile, and between what a distribution may lie there, in ms."""

    at: str
    share: float
    measured: float
    low: float
    high: float


class TailError(NamedTuple):
    """Where a distribution is furthest from what was measured, by what is allowed there; in ms."""

    at: str
    told_ms: float
    """Its quantile; at ``max`` what the largest of so many draws exceeds in all runs but one of 40."""
    measured_ms: float
    score: float
    """The difference by the allowed one: up to 1 they agree."""

    @property
    def error_ms(self) -> float:
        return self.told_ms - self.measured_ms

    @property
    def holds(self) -> bool:
        return self.score <= 1

    @property
    def words(self) -> str:
        """``p99.9 is 64.8 ms where 77.5 ms was measured``."""
        return f"{self.at} is {self.told_ms:.4g} ms where {self.measured_ms:.4g} ms was measured"


def allowed(measured: Histogram) -> list[Allowed]:
    """What a distribution is held to, by the rule of this module."""
    count, rows = measured.count, list[Allowed]()
    low_end, high_end, largest = (value or 0.0 for value in measured.quantiles_ns((0.01, 0.99, 1.0)))

    def tolerance(value_ns: float) -> float:
        return max(AGREE * (max(value_ns, high_end) - low_end), 2 * error_ns(value_ns))

    for at, share in SHARES.items():
        spread = _Z * math.sqrt(count * share * (1 - share))
        ranks = max(1, math.floor(count * share - spread)), math.ceil(count * share + spread)
        value, low = (found or 0.0 for found in measured.quantiles_ns((share, ranks[0] / count)))
        high = (measured.quantile_ns(ranks[1] / count) or 0.0) if ranks[1] <= count else math.inf
        spare = tolerance(value)
        rows.append(Allowed(at, share, value, min(low, value - spare), max(high, value + spare)))
    rows.append(Allowed(LARGEST, 1 - _NONE_BEYOND / count, largest, -math.inf, largest + tolerance(largest)))
    return [row._replace(**{key: getattr(row, key) / NS_PER_MS for key in ("measured", "low", "high")}) for row in rows]


def tail_error(text: str, held_to: list[Allowed]) -> TailError:
    """The worst of the quantiles of ``text`` (ms)."""
    told = distribution(text).quantile()(np.array([row.share for row in held_to]))
    return max((_error(value, row) for value, row in zip(told.tolist(), held_to, strict=True)), key=lambda e: e.score)


def _error(told: float, row: Allowed) -> TailError:
    room = row.high - row.measured if told > row.measured else row.measured - row.low
    return TailError(row.at, told, row.measured, abs(told - row.measured) / room)


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
