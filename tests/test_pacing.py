"""The playback clock and the lateness histogram: exact arithmetic, no drift, mergeable counts."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.clock import VirtualClock
from pmutools.pacing import Lateness, Playback

times = st.integers(0, 10**15)
rates = st.fractions(min_value=Fraction(1, 100), max_value=100, max_denominator=1000)


@settings(deadline=None)
@given(times, times, rates, st.integers(0, 10**13))
def test_media_time_and_target_are_inverse(anchor_ns: int, media_ns: int, rate: Fraction, ahead_ns: int) -> None:
    play = Playback(anchor_ns, media_ns, rate)
    target_ns = play.target_ns(media_ns + ahead_ns)
    assert target_ns is not None
    assert 0 <= ahead_ns - (play.media_at(target_ns) - media_ns) <= rate + 1  # rounding down, once each way


@settings(deadline=None)
@given(rates, st.lists(st.integers(1, 10**9), min_size=1, max_size=50))
def test_deadlines_do_not_accumulate_error(rate: Fraction, gaps_ns: list[int]) -> None:
    play = Playback(1000, 0, rate)
    media_ns = 0
    for gap_ns in gaps_ns:
        media_ns += gap_ns
        assert play.target_ns(media_ns) == 1000 + int(media_ns / rate)


@settings(deadline=None)
@given(times, rates, st.integers(0, 10**12), st.integers(0, 10**12), st.integers(0, 10**12))
def test_pause_takes_no_media_time(start_ns: int, rate: Fraction, a: int, b: int, c: int) -> None:
    play = Playback(start_ns, 0, rate)
    paused = play.pause(start_ns + a)
    assert paused.target_ns(10**18) is None
    assert paused.media_at(start_ns + a + b) == play.media_at(start_ns + a)
    resumed = paused.resume(start_ns + a + b)
    assert resumed.resume(start_ns + 10**15) is resumed
    drift = resumed.media_at(start_ns + a + b + c) - play.media_at(start_ns + a + c)
    assert -1 <= drift <= 0


@settings(deadline=None)
@given(times, rates, rates, st.integers(0, 10**12))
def test_a_change_of_rate_leaves_no_jump(start_ns: int, rate: Fraction, other: Fraction, after_ns: int) -> None:
    play = Playback(start_ns, 0, rate)
    now_ns = start_ns + after_ns
    changed = play.with_rate(now_ns, other)
    assert changed.media_at(now_ns) == play.media_at(now_ns)
    assert changed.target_ns(changed.media_at(now_ns)) == now_ns


def test_seek_and_delay() -> None:
    play = Playback(0, 0, Fraction(2)).seek(10**9, 60 * 10**9)
    assert play.target_ns(62 * 10**9) == 2 * 10**9
    assert play.target_ns(62 * 10**9, delay_ns=5_000_000) == 2 * 10**9 + 5_000_000  # network delay is wall time
    assert play.shift(-7).target_ns(62 * 10**9) == 2 * 10**9 - 7


def test_rate_must_be_positive() -> None:
    with pytest.raises(ValueError, match="not above 0"):
        Playback(0, 0, Fraction(0))


def test_loops_wrap_without_drift_on_a_clock_that_oversleeps() -> None:
    """A 1 s source of 60 frames, looped 100 times by a loop that is always a little late, still ends on time."""
    clock = VirtualClock(monotonic_ns=123)
    frames_ns = [k * 10**9 // 60 for k in range(60)]
    play = Playback(clock.monotonic_ns(), 0)
    for loop in range(100):
        for media_ns in frames_ns:
            target_ns = play.target_ns(media_ns)
            assert target_ns == 123 + loop * 10**9 + media_ns
            clock.sleep_until(target_ns + 70_000)
        play = play.seek(play.target_ns(10**9) or 0, 0)


def _filled(values: list[int], miss_ns: int = 1000) -> Lateness:
    lateness = Lateness(miss_ns)
    for value in values:
        lateness.add(value)
    return lateness


@settings(deadline=None)
@given(st.lists(st.integers(-(10**6), 10**11), min_size=1, max_size=200), st.floats(0, 100))
def test_percentiles_bound_the_exact_ones(values: list[int], percent: float) -> None:
    lateness = _filled(values)
    ranked = sorted(max(value, 0) for value in values)
    exact = ranked[max(math.ceil(percent / 100 * len(ranked)), 1) - 1]
    measured = lateness.percentile_ns(percent)
    beyond = exact > 67 * 10**9  # the last bin holds all of that, and tells the maximum
    assert exact <= measured <= (ranked[-1] if beyond else min(exact * 33 // 32, ranked[-1]))
    assert lateness.max_ns == ranked[-1]
    assert lateness.misses == sum(value > 1000 for value in values)


@settings(deadline=None)
@given(st.lists(st.integers(0, 10**10)), st.lists(st.integers(0, 10**10)))
def test_merged_is_the_same_as_counted_together(one: list[int], other: list[int]) -> None:
    merged = _filled(one)
    merged.merge(_filled(other))
    together = _filled(one + other)
    assert merged.summary() == together.summary()
    assert [merged.percentile_ns(p) for p in range(101)] == [together.percentile_ns(p) for p in range(101)]


def test_summary_of_nothing_and_of_different_misses() -> None:
    assert Lateness(5).summary() == (0, 0, 0, 0, 0)
    with pytest.raises(ValueError, match="do not add"):
        Lateness(5).merge(Lateness(6))
