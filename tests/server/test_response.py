"""Gain and lag of the line, against lines whose answer is known."""

from __future__ import annotations

import math
import random

import pytest

from dcon.server.response import LineResponse, Response
from pmutools.timebase import NS

T0 = 1_473_354_311_000_000_000
TICK_NS = 16_666_667


def swing_mw(at_s: float) -> float:
    return 60 * math.sin(2 * math.pi * 0.4 * at_s) + 15 * math.sin(2 * math.pi * 0.9 * at_s)


def watched(
    gain: float = 1.0,
    lag_ms: float = 11.0,
    size: float = 1.0,
    noise_mw: float = 0.0,
    every: int = 1,
    drift: float = 0.0,
) -> LineResponse:
    """30 s of a line that gives ``gain`` times the command, held from tick to tick, after ``lag_ms``."""
    rng = random.Random(5)
    watch = LineResponse()
    commands: list[float] = []
    for number in range(1800):
        tick_ns = T0 + number * TICK_NS
        commands.append(size * swing_mw(number * TICK_NS / NS))
        watch.command(tick_ns, commands[-1])
        if number % every == 0:
            time_ns = tick_ns - rng.randrange(TICK_NS)
            then = (time_ns - round(lag_ms * 1e6) - T0) // TICK_NS
            power = gain * commands[max(then, 0)] + rng.gauss(0, noise_mw)
            watch.line(time_ns, power)
            watch.line(time_ns, 1e6)  # the same report again
    return watch


@pytest.mark.parametrize("gain", [0.5, 0.97, 1.4])
@pytest.mark.parametrize("lag_ms", [2.0, 11.0, 47.0, 180.0])
def test_gain_and_lag_are_those_of_the_line(gain: float, lag_ms: float) -> None:
    found = watched(gain, lag_ms).estimate()
    assert found is not None and found.lag_ms is not None
    assert found.gain == pytest.approx(gain, rel=0.01) and found.lag_ms == pytest.approx(lag_ms, abs=3)


def test_a_noisy_line_that_reports_four_times_a_second() -> None:
    found = watched(1.0, 30.0, noise_mw=10.0, every=15).estimate()
    assert found is not None and found.lag_ms is not None
    assert found.gain == pytest.approx(1.0, rel=0.1) and found.lag_ms == pytest.approx(30.0, abs=30)


def test_a_line_that_does_not_answer_has_no_gain_and_no_lag() -> None:
    assert watched(0.0).estimate() == Response(0.0, None)
    found = watched(0.0, noise_mw=5.0).estimate()
    assert found is not None and abs(found.gain) < 0.05 and found.lag_ms is None


def test_a_line_that_answers_the_wrong_way_has_no_lag_that_is_told() -> None:
    found = watched(-1.0).estimate()
    assert found is not None and (found.lag_ms is None or found.lag_ms > 60)


def test_a_command_that_hardly_moves_tells_nothing() -> None:
    assert watched(size=0.0).estimate() is None and watched(size=0.03).estimate() is None


def test_too_little_is_no_estimate() -> None:
    watch = LineResponse()
    assert watch.estimate() is None
    for number in range(30):
        watch.command(T0 + number * TICK_NS, swing_mw(number / 60))
        watch.line(T0 + number * TICK_NS, math.nan)
    assert watch.estimate() is None


def test_a_line_that_has_stopped_reporting_is_not_known_any_more() -> None:
    watch = watched()
    for number in range(1800, 1800 + 130):
        watch.command(T0 + number * TICK_NS, swing_mw(number / 60))
    assert watch.estimate() is None


def test_a_clock_set_back_begins_anew_and_memory_is_bounded() -> None:
    watch = watched()
    watch.command(T0, 5.0)
    assert watch.estimate() is None
    for number in range(20_000):
        watch.command(T0 + 1 + number, 1.0)
        watch.line(T0 + 1 + number, 1.0)
    assert len(watch._command) == len(watch._line) == 4096
