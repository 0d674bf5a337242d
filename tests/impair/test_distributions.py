"""Every DIST against its theory: the whole distribution within the DKW bound, its moments within standard errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pmutools.draws import Draws
from pmutools.impair.distributions import DISTRIBUTIONS, distribution
from pmutools.impair.quantiles import LEAST, MOST, Array

N = 40_000
U = Draws(20, "N1", "delay").uniforms(0, N)
DKW = math.sqrt(math.log(2e6) / (2 * N))
"""P(largest distance of the empirical CDF > this) <= 1e-6, whatever the distribution (Massart's constant)."""


def sample(text: str) -> Array:
    return distribution(text).quantile()(U)


def lognormal(mean: float, sd: float) -> Any:
    variance = math.log1p((sd / mean) ** 2)
    return stats.lognorm(math.sqrt(variance), scale=mean * math.exp(-variance / 2))


CONTINUOUS = {
    "uniform(5, 9)": stats.uniform(5, 4),
    "normal(16, 2)": stats.norm(16, 2),
    "truncnormal(44, 1.3, 40, 48)": stats.truncnorm(-4 / 1.3, 4 / 1.3, 44, 1.3),
    "truncnormal(0, 1, 3, 9)": stats.truncnorm(3, 9),
    "truncnormal(0, 1, -9, -3)": stats.truncnorm(-9, -3),
    "lognormal(16, 4)": lognormal(16, 4),
    "lognormal(1, 1.5, shift=15)": lognormal(1, 1.5),
    "gamma(16, 8)": stats.gamma(4, scale=4),
    "gamma(2, 4)": stats.gamma(0.25, scale=8),
    "exponential(5)": stats.expon(scale=5),
    "exponential(5, shift=10)": stats.expon(scale=5),
    "weibull(0.8, 16)": stats.weibull_min(0.8, scale=16),
    "weibull(2, 16)": stats.weibull_min(2, scale=16),
    "pareto(3, 10)": stats.pareto(3, scale=10),
}


@pytest.mark.parametrize("text", CONTINUOUS)
def test_against_theory(text: str) -> None:
    shift = float(text.partition("shift=")[2].rstrip(")") or 0)
    theory, values = CONTINUOUS[text], np.sort(sample(text)) - shift
    ideal = theory.cdf(values)
    ranks = np.arange(N + 1) / N
    assert max(np.max(ranks[1:] - ideal), np.max(ideal - ranks[:-1])) < DKW
    assert abs(values.mean() - theory.mean()) < 5 * theory.std() / math.sqrt(N)


@pytest.mark.parametrize("text", [text for text in CONTINUOUS if "shift" not in text])
def test_quantiles_invert_the_theory(text: str) -> None:
    ours, u = distribution(text).quantile()(U), U
    assert np.allclose(ours, CONTINUOUS[text].ppf(u), rtol=1e-6, atol=1e-9)


def test_means_and_deviations_are_those_asked_for() -> None:
    for text in ("normal(16, 2)", "lognormal(16, 2)", "gamma(16, 2)"):
        values = sample(text)
        assert abs(values.mean() - 16) < 5 * 2 / math.sqrt(N)
        kurtosis = stats.kurtosis(values, fisher=False)
        assert abs(values.std() - 2) < 5 * 2 * math.sqrt((kurtosis - 1) / (4 * N))


def test_constant_and_discrete() -> None:
    assert set(sample("constant(16)").tolist()) == {16.0}
    values, counts = np.unique(sample("empirical(10, 20, 20, 40)"), return_counts=True)
    assert values.tolist() == [10.0, 20.0, 40.0]
    for count, p in zip(counts.tolist(), (0.25, 0.5, 0.25), strict=True):
        assert abs(count / N - p) < 5 * math.sqrt(p * (1 - p) / N)


def test_histogram_is_its_bins() -> None:
    """Bins in proportion to their counts, uniform within; an empty bin and a gap are never met."""
    text, bins = "histogram(10, 12, 5, 12, 14, 80, 14, 18, 0, 20, 30, 15)", ((10, 12, 5), (12, 14, 80), (20, 30, 15))
    values = sample(text)
    mean = sum(count * (low + high) / 2 for low, high, count in bins) / 100
    square = sum(count * ((high - low) ** 2 / 12 + ((low + high) / 2) ** 2) for low, high, count in bins) / 100
    sd = math.sqrt(square - mean**2)
    assert abs(values.mean() - mean) < 5 * sd / math.sqrt(N)
    assert abs(values.std() / sd - 1) < 5 * math.sqrt((stats.kurtosis(values, fisher=False) - 1) / (4 * N))
    for low, high, count in bins:
        part = values[(values >= low) & (values <= high)]
        assert abs(part.size / N - count / 100) < DKW
        bound = math.sqrt(math.log(2e6) / (2 * part.size))
        assert stats.kstest(part, stats.uniform(low, high - low).cdf).statistic < bound
    assert not ((values > 14) & (values < 20)).any()


def test_a_histogram_of_the_histogram_gives_it_back() -> None:
    """What the characterizer counts in bins is played back with the same counts."""
    counts, edges = np.histogram(sample("gamma(16, 8)"), bins=40)
    triples = [f"{low}, {high}, {count}" for low, high, count in zip(edges, edges[1:], counts, strict=False)]
    again, _ = np.histogram(sample(f"histogram({', '.join(triples)})"), bins=edges)
    assert np.abs(np.cumsum(again) - np.cumsum(counts)).max() / N < DKW


@pytest.mark.parametrize("text", [text for text in CONTINUOUS if math.isfinite(CONTINUOUS[text].stats("k"))])
def test_deviations(text: str) -> None:
    """Standard error of a standard deviation by the theory's own fourth moment (where it has one)."""
    theory, values = CONTINUOUS[text], sample(text)
    kurtosis = max(float(theory.stats("k")) + 3, float(stats.kurtosis(values, fisher=False)))
    assert abs(values.std() / theory.std() - 1) < 5 * math.sqrt((kurtosis - 1) / (4 * N))


def test_a_pareto_with_a_cap() -> None:
    """No mean of its own at shape 1; capped at c it has scale * (1 + ln(c/scale)), and P(cap) = scale/c."""
    values = sample("pareto(1, 10, max=1000)")
    mean, second = 10 * (1 + math.log(100)), 2 * 10 * 1000 - 100
    assert abs(values.mean() - mean) < 5 * math.sqrt((second - mean**2) / N)
    assert values.min() >= 10 and values.max() == 1000
    assert abs(np.mean(values == 1000) - 0.01) < 5 * math.sqrt(0.01 * 0.99 / N)
    for share in (0.1, 0.5, 0.9):
        assert abs(np.mean(values <= 10 / (1 - share)) - share) < DKW


def test_measured_percentiles() -> None:
    values = sample("quantiles(0% 12, 50% 16, 99% 30, 100% 44)")
    for percent, value in ((0, 12), (50, 16), (99, 30), (100, 44), (25, 14)):
        share = np.mean(values <= value)
        assert abs(share - percent / 100) <= DKW
    assert values.min() >= 12 and values.max() <= 44


def test_mixture_is_exact_in_weights_and_components() -> None:
    values = sample("mixture(90% normal(16, 2), 10% uniform(100, 200))")
    far = values > 60
    assert abs(far.mean() - 0.1) < 5 * math.sqrt(0.09 / N)
    for part, theory in ((values[~far], stats.norm(16, 2)), (values[far], stats.uniform(100, 100))):
        assert stats.kstest(part, theory.cdf).statistic < math.sqrt(math.log(2e6) / (2 * part.size))


def test_paretonormal_is_netems_table_as_a_formula() -> None:
    """Both parts from one draw, clipped at 4: its mean and deviation by numerical integration of that definition."""
    u = (np.arange(200_000) + 0.5) / 200_000
    pareto = np.minimum(4, ((1 - u) ** (-1 / 3) - 1.5) * 4 / 3)
    ideal = 0.25 * np.clip(stats.norm.ppf(u), -4, 4) + 0.75 * pareto
    values = sample("paretonormal(16, 2)")
    sd = 2 * ideal.std()
    assert abs(values.mean() - (16 + 2 * ideal.mean())) < 5 * sd / math.sqrt(N)
    assert values.max() <= 16 + 2 * 4
    assert np.allclose(distribution("paretonormal(0, 1)").quantile()(u), ideal, atol=1e-12)


def test_limits() -> None:
    values = sample("normal(44, 1.3, min=43, max=44.5)")
    assert values.min() == 43 and values.max() == 44.5
    assert abs(np.mean(values == 43) - stats.norm.cdf(-1 / 1.3)) < DKW
    inside = (values > 43) & (values < 44.5)
    assert np.array_equal(values[inside], sample("normal(44, 1.3)")[inside])


WIDE = [
    "constant(-5)",
    *CONTINUOUS,
    "gamma(1, 4.4)",
    "pareto(0.05, 1)",
    "weibull(0.05, 1)",
    "lognormal(1, 1e6)",
    "paretonormal(0, 1)",
    "empirical(1)",
    "histogram(1, 1, 5)",
    "histogram(-1, 2, 1e-9, 3, 4, 1)",
    "quantiles(0% 1, 100% 1)",
    "mixture(1e-9 constant(1), 0.999999999 constant(2))",
]


@pytest.mark.parametrize("text", WIDE)
def test_finite_at_the_outermost_draws(text: str) -> None:
    """And the same alone as in a batch."""
    quantile = distribution(text).quantile()
    u = np.concatenate([[LEAST, MOST, 0.5], U[:300]])
    values = quantile(u)
    assert np.isfinite(values).all()
    assert values.tolist() == [quantile(np.array([one]))[0] for one in u.tolist()]


def test_every_distribution_is_tested() -> None:
    assert {text.partition("(")[0] for text in WIDE} >= set(DISTRIBUTIONS) - {"mixture"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nromal(16, 2)", "'nromal' is no distribution; did you mean 'normal'?"),
        ("normal(16)", "sd is missing; write normal(mean, sd)"),
        ("normal(16, -2)", "normal sd: -2 is out of range; it must be at least 0"),
        ("uniform(9, 5)", "uniform: low 9 is above high 5"),
        ("truncnormal(0, 1, 50, 60)", "truncnormal: nothing of the normal lies between low and high; move them"),
        ("gamma(1, 100)", "gamma: mean/sd must be 0.23 to 100; beyond 100 use normal"),
        ("mixture(90% normal(16,2))", "mixture: weights must be above 0 and add up to 100%, not 90%"),
        ("mixture(normal(16,2))", "mixture components: 'normal(16,2)' is not 'WEIGHT DIST'"),
        ("mixture(100% nrmal(16,2))", "mixture components: 'nrmal' is no distribution; did you mean 'normal'?"),
        ("quantiles(0% 1, 50% 3, 99% 2, 100% 9)", "quantiles: must rise from 0% to 100%, in order"),
        ("quantiles(5)", "quantiles points: '5' is not 'PERCENT% VALUE'"),
        ("histogram(1, 2)", "histogram: each bin is LOW, HIGH, COUNT with LOW <= HIGH and COUNT >= 0"),
        ("histogram(2, 1, 5)", "histogram: each bin is LOW, HIGH, COUNT with LOW <= HIGH and COUNT >= 0"),
        ("histogram(1, 3, 5, 2, 4, 1)", "histogram: bins must follow each other without overlap"),
        ("histogram(1, 2, 0)", "histogram: all bins are empty"),
        ("normal(16, 2, min=5, max=4)", "normal: min 5 is above max 4"),
        ("normal(16, 2, max=x)", "'x' is not a number"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        distribution(text)
    assert str(error.value).startswith(message)
