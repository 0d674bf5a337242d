"""Fits: drawn from the player's own distributions, recognised, and played again as they were."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.measured import START_NS, arranged, batch, measured, rows, stamps

from pmutools.draws import Draws
from pmutools.impair.distributions import distribution
from pmutools.impair.profile import parse_profile
from pmutools.measure.binned import histogram_text
from pmutools.measure.fits import FAMILIES, POOR, best_fit, fits
from pmutools.measure.histogram import Histogram
from pmutools.measure.likeness import ks_distance
from pmutools.measure.profile import loss_text, profile_text
from pmutools.measure.stream import Identity

COUNT = 20_000


def drawn(text: str, stage: str = "a", count: int = COUNT) -> np.ndarray:
    return distribution(text).quantile()(Draws(7, "stream", stage).uniforms(0, count))


def histogram(values_ms: np.ndarray) -> Histogram:
    return Histogram((values_ms * 1e6).astype(np.int64))


def two_sample_ks(one: np.ndarray, other: np.ndarray) -> float:
    edges = np.sort(np.concatenate((one, other)))
    shares = [np.searchsorted(np.sort(sample), edges, side="right") / len(sample) for sample in (one, other)]
    return float(np.abs(shares[0] - shares[1]).max())


LIKE = {
    "normal(44.1, 1.3)": "normal",
    "exponential(3, shift=15)": "exponential",
    "uniform(3, 7)": "uniform",
    "gamma(5, 4, shift=12)": "gamma",
    "lognormal(4, 5, shift=14)": "lognormal",
    "weibull(0.7, 5, shift=10)": "weibull",
    "pareto(3, 6, shift=9)": "pareto",
    "constant(5)": "constant",
    "mixture(50% normal(16,1), 50% normal(40,2))": "histogram",
    "normal(-37000, 2)": "normal",
}


@pytest.mark.parametrize("text", LIKE)
def test_recognised_and_played_again(text: str) -> None:
    values = drawn(text)
    fit = best_fit(histogram(values))
    assert fit is not None
    assert fit.name == LIKE[text]
    assert fit.ks <= 0.012
    again = drawn(fit.text, "b")
    assert two_sample_ks(values, again) < 0.025 or fit.name == "constant"
    assert np.median(again) == pytest.approx(np.median(values), rel=0.02, abs=0.02)


@pytest.mark.parametrize("text", LIKE)
def test_the_histogram_stands_in_for_anything(text: str) -> None:
    values = drawn(text)
    told = histogram_text(histogram(values))
    assert told.count(",") < 3 * (80 + 8 * math.log(2 * COUNT) + 60)
    if "-37000" in text:  # so far out a bin is 16 ms wide
        assert np.ptp(drawn(told, "b")) == pytest.approx(np.ptp(values), rel=0.1)
    else:
        assert two_sample_ks(values, drawn(told, "b")) < 0.025 or text.startswith("constant")


def test_goodness_is_kolmogorov_and_smirnovs() -> None:
    values = drawn("normal(20, 2)")
    exact = np.abs(np.arange(1, COUNT + 1) / COUNT - drawn_cdf(np.sort(values)))
    assert ks_distance("normal(20.5, 2)", histogram(values)) == pytest.approx(exact.max(), abs=2e-3)


def drawn_cdf(values: np.ndarray) -> np.ndarray:
    from pmutools.impair.quantiles import normal_cdf

    return np.array([normal_cdf((value - 20.5) / 2) for value in values.tolist()])


def test_few_values_have_no_fit() -> None:
    assert best_fit(histogram(drawn("normal(20, 2)", count=49))) is None
    assert best_fit(Histogram()) is None
    assert fits(Histogram()) == []


def test_every_family_is_known_to_the_player() -> None:
    found = fits(histogram(drawn("gamma(5, 4, shift=12)")))
    assert {fit.name for fit in found} <= set(FAMILIES)
    assert min(fit.ks for fit in found) < POOR


def test_a_profile_of_a_stream_is_one_that_the_player_reads() -> None:
    slots = np.arange(COUNT)
    kept = slots[(slots % 1000 < 990)]
    frames = batch(stamps(kept.tolist()), drawn("normal(44.1, 1.3)")[: len(kept)])
    text = profile_text([measured(arranged(frames), identity=Identity("N1", 101))])
    profile = parse_profile(text, "exported")
    (rule,) = profile.rules
    assert rule.patterns == ("N1",)
    assert [option for option, _ in rule.settings] == ["delay", "loss"]
    assert "gemodel(0.0960%, 10.0000%)" in text
    exact = profile_text([measured(arranged(frames), identity=Identity("N1", 101))], exact=True)
    assert "histogram(" in exact
    assert parse_profile(exact, "exported").rules


@pytest.mark.parametrize("offset_ms", [-37_000, 37_000])
def test_delays_of_a_wrong_clock_are_exported_above_their_floor(offset_ms: int) -> None:
    frames = batch(stamps(range(2000)), drawn("exponential(3)")[:2000] + offset_ms)
    text = profile_text([measured(arranged(frames))])
    assert "above the floor" in text
    assert parse_profile(text, "exported").rules


def test_losses_as_models() -> None:
    assert loss_text(0, 100, None) is None
    assert loss_text(100, 100, 100.0) is None
    assert loss_text(5, 100, 1.0) == "5.0000%"
    assert loss_text(20, 1000, 4.0) == "gemodel(0.5102%, 25.0000%)"
    frames = batch(stamps(range(100)), 20.0)
    assert "loss" not in profile_text([measured(rows(frames, slice(0, 100)))])
    assert frames.time_ns[0] == START_NS
