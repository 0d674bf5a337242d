"""The delay stage: sums, traces, courses, correlation, order."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from support.impairment import PERIOD_NS, delays_ms, frame, options, pipeline, play

from pmutools.draws import Draws
from pmutools.impair import Fate, Pipeline, parse_profile
from pmutools.impair.blocks import ANCHOR
from pmutools.impair.delays import DrawnTerms
from pmutools.impair.distributions import distribution
from pmutools.impair.stages import parse_setting

N = 20_000


def delays(text: str, count: int = N, seed: int = 1) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array(delays_ms(play(pipeline(f"delay={text}", seed=seed), count)))


def test_constant() -> None:
    rows = play(pipeline("delay=constant(16)"), 3)
    assert rows == play(pipeline("delay=16"), 3)
    assert [row.offset_ns for row in rows] == [k * PERIOD_NS + 16_000_000 for k in range(3)]
    assert {row.faults for row in rows} == {"delay:16ms"}


def test_terms_add_up_and_are_independent() -> None:
    total = delays("normal(44, 1.3) + constant(15) + exponential(1)")
    assert abs(total.mean() - 60) < 5 * math.sqrt((1.3**2 + 1) / N)
    assert abs(total.var() - (1.3**2 + 1)) < 5 * math.sqrt((2 * 1.3**4 + 8 + 4 * 1.3**2) / N)


def test_a_term_that_is_added_leaves_the_others_alone() -> None:
    alone = delays("normal(100, 5)", 500)
    assert np.allclose(delays("normal(100, 5) + constant(7)", 500), alone + 7, atol=2e-6)
    both = delays("normal(100, 5) + exponential(3)", 500)
    second = both - alone
    assert second.min() > 0 and abs(second.mean() - 3) < 5 * 3 / math.sqrt(500)
    lines = np.array(delays_ms(play(pipeline(options("delay=normal(100,5)", "delay=constant(7)")), 500)))
    assert np.allclose(lines, alone + 7, atol=2e-6)


def test_trace_is_by_index_and_loops() -> None:
    assert delays("trace(10, 20, 30)", 7).tolist() == [10, 20, 30, 10, 20, 30, 10]
    assert delays_ms(play(pipeline("delay=trace(10, 20, 30)"), 2, first=4)) == [20, 30]


def test_courses_follow_stream_time() -> None:
    step = delays("step(1, 5, 50)", 120)
    assert step[:60].tolist() == [5] * 60 and step[61:].tolist() == [50] * 59
    ramp = delays("ramp(1, 2, 0, 60)", 180)
    assert ramp[:61].max() < 1e-6 and np.allclose(ramp[60:121], np.arange(61), atol=1e-3) and set(ramp[121:]) == {60}
    wave = delays("sinusoid(20, 10, 1, 90)", 120)
    assert np.allclose(wave, 20 + 10 * np.cos(2 * np.pi * np.arange(120) / 60), atol=1e-5)
    both = delays("normal(100, 5) + step(0.5, 0, 10)", 60)
    assert np.allclose(both - delays("normal(100, 5)", 60), [0] * 31 + [10] * 29, atol=2e-6)


def test_diurnal_goes_by_the_utc_hour_of_the_recorded_stamp() -> None:
    """The same every day, highest at its peak and lowest twelve hours away, whatever the stream time."""
    faults = pipeline("delay=diurnal(20, 8, peak=18)")
    day_ns = 86_400 * 10**9
    for hour, expected in ((18, 28), (6, 12), (0, 20), (12, 20), (21, 20 + 8 / math.sqrt(2))):
        for days in (0, 17_000):
            stamp_ns = days * day_ns + hour * 3600 * 10**9
            (row,) = faults.apply(0, frame(0), 0, stamp_ns=stamp_ns)
            assert row.delay_ns == round(expected * 1e6)
    hours = np.arange(24 * 60) / 60
    found = [faults.apply(0, frame(0), 0, stamp_ns=round(h * 3600e9))[0].delay_ns / 1e6 for h in hours]
    assert abs(np.mean(found) - 20) < 1e-6 and abs(np.std(found) - 8 / math.sqrt(2)) < 1e-5
    (row,) = Pipeline(options("delay=diurnal(20, 8)"), "N1").apply(0, frame(0), 0, 18 * 3600 * 10**9)
    assert row.delay_ns == 28_000_000


def test_courses_go_by_stream_time_not_by_speed() -> None:
    faults = pipeline("delay=step(1, 5, 50)")
    (row,) = faults.apply(0, frame(0), 100_000_000, 2_000_000_000)
    assert (row.offset_ns, row.delay_ns) == (150_000_000, 50_000_000)


def test_a_negative_sum_is_sent_at_once() -> None:
    values = delays("normal(0, 5)", 2000)
    assert values.min() == 0
    assert abs(np.mean(values == 0) - 0.5) < 5 * math.sqrt(0.25 / 2000)
    assert {row.faults for row in play(pipeline("delay=constant(-4)"), 3)} == {""}


@pytest.mark.parametrize("rho", [0.25, 0.5, 0.9])
def test_correlation_leaves_the_distribution_exact(rho: float) -> None:
    """netem's mixing would narrow the spread to 0.77, 0.58 and 0.23 of what was asked for."""
    values = delays(f"uniform(10, 30) corr={rho}")
    effective = N * (1 - rho) / (1 + rho)
    assert stats.kstest(values, stats.uniform(10, 20).cdf).statistic < math.sqrt(math.log(2e6) / (2 * effective))
    assert abs(values.std() - 20 / math.sqrt(12)) < 5 * 20 / math.sqrt(12) / math.sqrt(effective)
    z = stats.norm.ppf(np.clip((values - 10) / 20, 1e-9, 1 - 1e-9))
    for lag in (1, 2):
        found = np.corrcoef(z[lag:], z[:-lag])[0, 1]
        assert abs(found - rho**lag) < 5 / math.sqrt(effective)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
@pytest.mark.parametrize(
    "text",
    ["lognormal(6, 6, shift=20)", "pareto(2, 6)", "histogram(40, 45, 800,  45, 50, 190,  70, 72, 9,  99, 100, 1)"],
)
def test_correlation_leaves_the_tail_exact(text: str, rho: float) -> None:
    """As many frames lie beyond a quantile as should; correlated ones come in clusters, so their number varies more."""
    count = 200_000
    draws, quantile = Draws(1, "N1", "delay"), distribution(text).quantile()
    terms = DrawnTerms({0: distribution(text)}, draws, corr=rho)
    terms.begin(0)
    values = np.array(terms.run(0, count)) / 1e6
    for share in (0.01, 0.5, 0.99, 0.9985):
        beyond = np.mean(values > quantile(np.array([share]))[0])
        spread = math.sqrt(share * (1 - share) / count * (1 + rho) / (1 - rho))
        assert abs(beyond - (1 - share)) < 4 * spread + 1e-6


def test_correlation_goes_on_over_blocks_and_starts_afresh_at_anchors() -> None:
    z = (delays("normal(100, 5) corr=90%", ANCHOR + 3000) - 100) / 5
    fresh = (z[1:] - 0.9 * z[:-1]) / math.sqrt(1 - 0.81)
    assert np.abs(fresh).max() < 6
    assert abs(fresh.std() - 1) < 5 / math.sqrt(2 * len(fresh))


def test_jumps_and_gaps_do_not_shift_correlated_delays() -> None:
    straight = delays("normal(100, 5) corr=70%", 3000)
    faults = pipeline("delay=normal(100, 5) corr=70%")
    for first in (2000, 100, 2999, 1500):
        assert delays_ms(play(faults, 1, first)) == [straight[first]]


def test_frames_overtake_unless_order_is_kept() -> None:
    free, kept = (play(pipeline(f"delay=uniform(0, 50){order}"), 2000) for order in ("", " order=keep"))
    assert any(later.offset_ns < row.offset_ns for row, later in pairwise(free))
    assert all(later.offset_ns >= row.offset_ns for row, later in pairwise(kept))
    latest = 0
    for row, fifo in zip(free, kept, strict=True):
        latest = max(latest, row.offset_ns)
        assert fifo.offset_ns == latest
        assert fifo.offset_ns - fifo.delay_ns == row.index * PERIOD_NS


def test_each_copy_has_its_own_delay() -> None:
    rows = play(pipeline(options("delay=normal(100, 5)", "duplicate=100% count=2")), 300)
    by_copy = [delays_ms(row for row in rows if row.copy == copy) for copy in range(3)]
    assert by_copy[0] == delays("normal(100, 5)", 300).tolist()
    for copy in (1, 2):
        assert abs(np.corrcoef(by_copy[0], by_copy[copy])[0, 1]) < 5 / math.sqrt(300)


TERMS = st.sampled_from(
    ["constant(5)", "-3", "normal(0, 5)", "uniform(0, 30)", "trace(1, -2, 3)", "gamma(4, 2)", "histogram(1, 2, 1)"]
)
RUNS = st.lists(st.tuples(st.integers(0, 3 * ANCHOR), st.integers(1, 700)), min_size=1, max_size=4)


@settings(max_examples=60, deadline=None)
@given(st.lists(TERMS, max_size=3), st.sampled_from(["", " corr=50%"]), RUNS)
def test_delays_of_many_frames_are_those_of_each(terms: list[str], corr: str, runs: list[tuple[int, int]]) -> None:
    """In any order of indices, over block borders, anchors and jumps."""
    profile = options(f"delay={' + '.join(terms)}{corr}") if terms else options()
    many, single = pipeline(profile), pipeline(profile)
    index = np.concatenate([np.arange(first, first + count) for first, count in runs])
    found = many.delays_ns(index)
    assert found is not None and found.dtype == np.int64 and found.min() >= 0
    some = np.unique(np.linspace(0, index.size - 1, 200).astype(int))
    rows = [single.apply(int(index[at]), b"\xaa\x01", 7) for at in some]
    assert [(row.delay_ns, row.offset_ns, row.fate) for (row,) in rows] == [
        (found[at], found[at] + 7, Fate.SENT) for at in some
    ]
    assert many.clear is (not terms)
    assert pipeline(profile).delays_ns(np.arange(0)) is not None


@pytest.mark.parametrize(
    "text",
    [
        "loss=0%",
        "drop=5",
        "duplicate=1%",
        "reorder=1%",
        "rate=1M",
        "slot=5",
        "corrupt=1%",
        "disable=5..6",
        "config=count()",
        "segment=1% split",
        "delay=step(1, 2, 3)",
        "delay=diurnal(1, 2)",
        "delay=5 order=keep",
        "delay=5 when=3",
        "delay=1\n2",
    ],
)
def test_where_more_than_the_index_counts_frames_go_one_by_one(text: str) -> None:
    faults = pipeline(text)
    assert faults.delays_ns(np.arange(3)) is None and not faults.clear


def test_a_short_cut_waits_for_the_timeline_and_comes_back_after_it() -> None:
    faults = pipeline(parse_profile("[at 1]\ndo = disable N1\n[at 2]\ndo = enable N1\n     pause 5\n", "t.ini"))
    assert not faults.clear
    play(faults, 100, close=False)
    assert not faults.clear and faults.delays_ns(np.arange(3)) is None
    play(faults, 100, 100, close=False)
    assert faults.clear and faults.delays_ns(np.arange(3)).tolist() == [0, 0, 0]
    elsewhere = pipeline(parse_profile("[at 1]\ndo = disable S1\n     seek 5\n", "t.ini"))
    assert elsewhere.clear


def test_only_the_selected_frames() -> None:
    values = delays("constant(16) when=10-19,every 50", 100)
    assert np.flatnonzero(values).tolist() == [0, *range(10, 20), 50]


def test_control_frames_are_not_delayed_unless_selected() -> None:
    from support.impairment import CONFIG_FRAME

    (row,) = pipeline("delay=constant(16)").apply(0, CONFIG_FRAME, 0)
    assert row.delay_ns == 0
    (row,) = pipeline("delay=constant(16) when=type config").apply(0, CONFIG_FRAME, 0)
    assert row.delay_ns == 16_000_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nromal(16,2)", "'nromal' is no delay; did you mean 'normal'?"),
        ("normal(16,2) +", "'normal(16,2) +' has an empty item; remove the extra '+'"),
        ("normal(16,2) corr=100%", "corr: 100% would freeze the delay; stay below"),
        ("normal(16,2) corr=5", "corr: 5 is not a probability; did you mean 5%?"),
        ("normal(16,2) order=fifo", "order: 'fifo' is not one of free, keep"),
        ("normal(16,2) colour=red", "there is no 'colour'; did you mean 'corr'?"),
        ("corr=5%", "the value is missing; write VALUE [corr=...] [order=...] [when=...]"),
        ("ramp(2, 1, 0, 60)", "ramp: end must be after start"),
        ("trace()", "values is missing; write trace(values)"),
        ("16ms", "'16ms' is not a number"),
        ("", "no value; write 'none' to switch the stage off"),
        ("normal(16,2) corr=1% corr=2%", "corr= is given twice"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_setting("delay", text)
    assert str(error.value) == message
