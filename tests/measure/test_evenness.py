"""How delays depend on each other, frames a second, availability by hour: against sums written out."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from support.measured import MS, START_NS, arranged, batch, config, measured, rows, stamps

from pmutools.measure.evenness import EvennessMeter, RateMeter
from pmutools.measure.hours import HourCounts
from pmutools.timebase import NS, format_utc, slots_array

RATE = Fraction(60)
PERIOD_NS = NS / 60


def drawn(count: int, correlation: float, sd_ms: float = 2.0) -> np.ndarray:
    """Delays in ms of which each depends on the one before."""
    random, values = np.random.default_rng(5), np.empty(count)
    last = 0.0
    for at in range(count):
        last = correlation * last + math.sqrt(1 - correlation**2) * random.normal()
        values[at] = last
    return 44 + sd_ms * values


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_the_correlation_of_successive_delays(correlation: float) -> None:
    """Delays this much alike leave the frames in order, however they are drawn."""
    delays = measured(batch(stamps(range(20_000)), drawn(20_000, correlation))).counts.delays
    assert delays.correlation == pytest.approx(correlation, abs=0.03)


def test_the_correlation_is_of_slots_that_follow_each_other() -> None:
    frames = batch(stamps(range(20_000)), drawn(20_000, 0.8))
    kept = np.random.default_rng(1).random(20_000) > 0.2
    assert measured(rows(frames, kept)).counts.delays.correlation == pytest.approx(0.8, abs=0.03)


def test_a_period_is_found_among_noise_and_losses() -> None:
    count = 20_000
    swing = 3 * np.sin(np.arange(count) * 2 * np.pi / 20)
    frames = batch(stamps(range(count)), 44 + swing + np.random.default_rng(1).normal(0, 1, count))
    kept = np.random.default_rng(2).random(count) > 0.02
    found = measured(arranged(rows(frames, kept))).counts.delays.evenness.peak(PERIOD_NS)
    assert found is not None
    assert found[0] == pytest.approx(3.0, abs=0.05)
    assert found[1] > 0.7


def test_noise_has_no_period_and_few_frames_tell_nothing() -> None:
    noise = measured(batch(stamps(range(20_000)), drawn(20_000, 0.0))).counts.delays.evenness.peak(PERIOD_NS)
    assert noise is not None and noise[1] < 0.1
    assert measured(batch(stamps(range(600)))).counts.delays.evenness.peak(PERIOD_NS) is None


def test_allan_deviation_is_that_of_its_definition() -> None:
    count = 4096
    slot = np.arange(10_000 * 16, 10_000 * 16 + count)
    delay = (np.random.default_rng(1).normal(44, 2, count) * MS).astype(np.int64)
    meter = EvennessMeter()
    for at in range(0, count, 100):
        meter.add(slot[at : at + 100], delay[at : at + 100])
    meter.flush()
    found = meter.counts.allan(PERIOD_NS)
    for level in (0, 1, 5):
        step = 1 << level
        tau_s = step * PERIOD_NS / NS
        phase_s = delay[::step] / NS
        bends = phase_s[2:] - 2 * phase_s[1:-1] + phase_s[:-2]
        deviation = math.sqrt((bends**2).sum() / (2 * len(bends))) / tau_s
        assert found[level] == [pytest.approx(tau_s), pytest.approx(deviation)]
    assert len(found) == 9


def test_allan_deviation_tells_noise_from_a_wandering_clock() -> None:
    count = 40_000
    noise = np.random.default_rng(1).normal(0, 1, count)
    still = measured(batch(stamps(range(count)), 44 + noise)).counts.delays.evenness.allan(PERIOD_NS)
    walk = np.cumsum(np.cumsum(np.random.default_rng(2).normal(0, 1e-3, count)))
    wandering = measured(batch(stamps(range(count)), 44 + noise + walk)).counts.delays.evenness.allan(PERIOD_NS)
    assert still[0][1] / still[8][1] == pytest.approx(2**8, rel=0.15)  # falls as 1/τ
    assert wandering[10][1] > 10 * still[10][1]


def test_rates_over_spans_that_were_seen_whole() -> None:
    """60 a second, but 10 in second 25, and none in seconds 40 to 42."""
    meter = RateMeter()
    begin = START_NS // (60 * NS) * 60 * NS + NS // 2
    arrivals = begin + np.arange(130 * 60) * NS // 60
    second = (arrivals - begin + NS // 2) // NS
    few = (second == 25) & (np.arange(len(arrivals)) % 6 > 0)
    kept = arrivals[~few & ~np.isin(second, (40, 41, 42))]
    for at in range(0, len(kept), 37):
        meter.add(kept[at : at + 37])
    told = meter.counts.to_json()
    assert told["1"] == {"min": 0.0, "max": 60.0}
    assert told["10"] == {"min": pytest.approx(42.0), "max": 60.0}
    assert told["60"] == {"min": 60.0, "max": 60.0}  # the first minute was not seen whole
    meter.restart()
    assert meter.counts.to_json() == told


@pytest.mark.parametrize("rate", [Fraction(60), Fraction(1, 5)])
def test_availability_by_hour(rate: Fraction) -> None:
    """Two and a half hours, of which the second misses a quarter."""
    begin_ns = 1_700_000_000 // 3600 * 3600 * NS + 1800 * NS
    count = int(9000 * rate)
    slots = int(slots_array(np.array([begin_ns]), rate)[0]) + np.arange(count)
    second_hour = (np.arange(count) >= 1800 * rate) & (np.arange(count) < 5400 * rate)
    slots = slots[~(second_hour & (np.arange(count) % 4 == 0))]
    counts = HourCounts()
    for part in np.array_split(slots, 50):
        if len(part):
            counts.add(part, rate)
    told = counts.to_json(rate)
    assert [row["expected"] for row in told] == [1800 * rate, 3600 * rate, 3600 * rate]
    assert [row["share"] for row in told] == [1.0, pytest.approx(0.75, abs=0.002), 1.0]
    assert told[0]["utc"] == format_utc(begin_ns - 1800 * NS)[:13] + "Z"


def test_hours_of_the_meter_add_up() -> None:
    frames = batch(stamps(range(0, 60 * 7200, 600)), of=config())
    result = measured(frames)
    assert sum(result.counts.hours.received.values()) == result.counts.slots.received == 720
