"""Tails: fits that miss them are found out, histograms keep them, and what is exported plays them again."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp
from support.impairment import delays_ms, pipeline, play
from support.measured import arranged, batch, measured, stamps

from pmutools.draws import Draws
from pmutools.formats import open_source
from pmutools.formats.source import Block
from pmutools.impair.distributions import distribution
from pmutools.impair.profile import parse_profile
from pmutools.measure.binned import histogram_text
from pmutools.measure.fits import best_fit
from pmutools.measure.histogram import NS_PER_MS, Histogram
from pmutools.measure.likeness import allowed, tail_error
from pmutools.measure.profile import profile_text
from pmutools.measure.stream import Identity

COUNT = 20_000
Values = np.ndarray[tuple[int], np.dtype[np.float64]]


def drawn(text: str, count: int = COUNT, stage: str = "a") -> Values:
    values: Values = distribution(text).quantile()(Draws(7, "stream", stage).uniforms(0, count))
    return values


def histogram(values_ms: Values) -> Histogram:
    return Histogram((values_ms * 1e6).astype(np.int64))


def late(share: float, by_ms: float = 30.0, count: int = COUNT) -> Values:
    """Normal delays of which a few come much later."""
    return drawn("normal(44, 1.3)", count) + by_ms * (drawn("uniform(0, 1)", count, "late") < share)


# --- what is found out


def test_a_tail_that_ks_does_not_see() -> None:
    fit = best_fit(histogram(late(0.01)))
    assert fit is not None and fit.nearest is not None
    assert fit.name == "histogram" and fit.tail.holds
    assert fit.nearest.ks < 0.02 and not fit.nearest.unlike
    assert fit.nearest.tail.at == "p99.9"
    assert fit.nearest.tail.measured_ms == pytest.approx(74, abs=4)
    assert fit.nearest.tail.error_ms < -20
    told = fit.to_json()
    assert told["tail_holds"] is True and abs(told["tail_error_ms"]) < 0.5  # type: ignore[arg-type]
    assert told["nearest"] == fit.nearest.to_json()
    assert list(told)[:3] == ["name", "params", "ks"]


def test_few_frames_bound_a_high_quantile_from_below() -> None:
    """1200 frames cannot tell p99.9; but eight of them 30 ms late are no normal distribution."""
    values = drawn("normal(44, 1.3)", 1200)
    held = {row.at: row for row in allowed(histogram(values))}
    assert held["p99.9"].high == math.inf
    assert held["p99.9"].low == pytest.approx(np.sort(values)[-5], rel=2e-3)
    assert math.isfinite(held["p99"].high)
    fit = best_fit(histogram(values))
    assert fit is not None and fit.name == "normal"
    values[:8] += 30
    fit = best_fit(histogram(values))
    assert fit is not None and fit.nearest is not None and not fit.nearest.tail.holds


def test_one_outlier_leaves_the_fit() -> None:
    values = drawn("normal(44, 1.3)")
    values[0] += 300
    fit = best_fit(histogram(values))
    assert fit is not None and fit.name == "normal" and fit.tail.holds


def test_a_tail_that_is_too_heavy_does_not_hold_either() -> None:
    found = histogram(drawn("normal(44, 1.3)", 1200))
    error = tail_error("mixture(99.5% normal(44, 1.3), 0.5% uniform(100, 300))", allowed(found))
    assert not error.holds and error.at == "max" and error.error_ms > 50


@pytest.mark.parametrize("text", ["normal(44.1, 1.3)", "lognormal(4, 5, shift=14)", "weibull(0.7, 5, shift=10)"])
@pytest.mark.parametrize("count", [1000, 200_000])
def test_a_true_likeness_is_exported(text: str, count: int) -> None:
    fit = best_fit(histogram(drawn(text, count)))
    assert fit is not None
    assert fit.name == text.partition("(")[0] and fit.tail.holds and fit.nearest is None


def test_what_is_drawn_agrees_with_its_own_distribution_mostly() -> None:
    """Four intervals of 95 %, each widened by 5 %: few of many draws miss one."""
    text, missed = "lognormal(4, 5, shift=14)", 0
    for number in range(60):
        found = histogram(drawn(text, 2000, str(number)))
        missed += not tail_error(text, allowed(found)).holds
    assert missed <= 9


# --- the histogram


@settings(max_examples=60)
@given(
    st.lists(st.integers(-(10**8), 10**9), min_size=1, max_size=300),
    st.integers(1, 40),
    st.sampled_from([0.5, 0.9, 0.99, 0.999, 1.0]),
)
def test_the_histogram_keeps_quantiles_to_a_bin(values: list[int], times: int, share: float) -> None:
    found = Histogram(np.array(values * times, np.int64))
    text = histogram_text(found)
    rows = np.array(distribution(text).bins).reshape(-1, 3)  # type: ignore[attr-defined]
    assert rows[:, 2].sum() == found.count
    assert rows[0, 0] == pytest.approx(found.min_ns / NS_PER_MS, abs=1e-6, rel=1e-8)  # type: ignore[operator]
    assert rows[-1, 1] == pytest.approx(found.max_ns / NS_PER_MS, abs=1e-6, rel=1e-8)  # type: ignore[operator]
    rank = max(1, math.ceil(share * found.count - 1e-9))
    told = distribution(text).quantile()(np.array([(rank - 0.5) / found.count]))[0]
    exact = sorted(values * times)[rank - 1] / NS_PER_MS
    low, high, _ = rows[np.searchsorted(np.cumsum(rows[:, 2]), rank)]
    assert low - 1e-6 <= told <= high + 1e-6
    assert low - 1e-5 <= exact <= high + 1e-5


@pytest.mark.parametrize("count", [1200, 20_000, 500_000])
@pytest.mark.parametrize(
    "text", ["normal(44, 1.3)", "pareto(2, 6)", "mixture(99% normal(44, 1.3), 1% uniform(70, 80))"]
)
def test_the_histogram_has_narrow_tails_and_few_bins(text: str, count: int) -> None:
    values = drawn(text, count)
    told = histogram_text(histogram(values))
    assert told.count(",") < 3 * (80 + 8 * math.log(2 * count) + 60)
    quantile, ranked = distribution(told).quantile(), np.sort(values)
    for beyond in (count // 100, count // 1000, 10, 1):
        played = float(quantile(np.array([1 - (beyond + 0.5) / count]))[0])
        near = ranked[[-1 - round(1.3 * beyond) - 1, -1 - math.floor(0.7 * beyond)]]
        assert near[0] * 0.999 <= played <= near[1] * 1.001


# --- measured, exported, played, measured


def real() -> Values:
    """Delays of a recording's first stream."""
    blocks = (item for item in open_source("captures/cjb-8pmu.pcap").blocks() if isinstance(item, Block))
    batches = [block.batch for block in blocks if block.batch.config.idcode == 101]
    return np.concatenate([(part.arrival_ns - part.time_ns) / NS_PER_MS for part in batches])


NETWORKS = {
    "normal": (lambda: drawn("normal(44, 1.3)"), "normal"),
    "heavy": (lambda: drawn("lognormal(6, 6, shift=20)"), "lognormal"),
    "late": (lambda: late(0.015), "histogram"),
    "two routes": (lambda: drawn("mixture(70% normal(40, 0.8), 30% normal(60, 3))"), "histogram"),
    "recording": (real, "histogram"),
}


@pytest.mark.parametrize("correlation", [0.0, 0.3])
@pytest.mark.parametrize("name", NETWORKS)
def test_a_tail_is_played_as_it_was_measured(name: str, correlation: float) -> None:
    """Of correlated delays fewer are worth as many: (1 + r)/(1 - r) of them count as one."""
    make, family = NETWORKS[name]
    delays = make()
    result = measured(arranged(batch(stamps(range(len(delays))), delays)), identity=Identity("N1", 101))
    text = profile_text([result])
    assert f"delay = {family}(" in text
    assert ("nearest" in text) == (family == "histogram")
    if correlation:
        text = "\n".join(
            f"{line} corr={correlation:.0%}" if line.startswith("delay") else line for line in text.splitlines()
        )
    again = np.array(delays_ms(play(pipeline(parse_profile(text, "exported")), COUNT)))
    worth = len(again) * (1 - correlation) / (1 + correlation)
    assert ks_2samp(delays, again).statistic < 1.95 * math.sqrt(1 / len(delays) + 1 / worth)  # at the 0.1 % level
    for before, after in zip(allowed(histogram(delays)), allowed(histogram(again)), strict=True):
        if before.at in ("p99", "p99.9"):
            assert before.low <= after.high and after.low <= before.high, before.at
            assert after.measured == pytest.approx(before.measured, rel=0.1)
    if family == "histogram":
        assert again.max() <= delays.max() + 1e-3
        assert again.max() == pytest.approx(delays.max(), rel=0.02)
