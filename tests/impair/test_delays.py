"""The delay stage: sums, traces, courses, correlation, order."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats
from support.impairment import PERIOD_NS, delays_ms, frame, options, pipeline, play

from pmutools.impair.blocks import ANCHOR
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
