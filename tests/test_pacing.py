"""The playback clock and the lateness histogram: exact arithmetic, no drift, counts by stream and together."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.clock import VirtualClock
from pmutools.pacing import Lateness, Playback

times = st.integers(0, 10**15)
rates = st.fractions(min_value=Fraction(1, 100), max_value=100, max_denominator=1000)


@settings(deadline=None)
@given(times, times, rates, st.integers(-(10**13), 10**13))
def test_media_time_and_target_are_inverse(anchor_ns: int, media_ns: int, rate: Fraction, ahead_ns: int) -> None:
    """``media_from`` is exactly the first media time that is not due before: what is planned in pieces is all there."""
    play = Playback(anchor_ns, media_ns, rate)
    target_ns = anchor_ns + ahead_ns
    first_ns = play.media_from(target_ns)
    assert play.target_ns(first_ns) >= target_ns > play.target_ns(first_ns - 1)


@settings(deadline=None)
@given(rates, st.lists(st.integers(1, 10**9), min_size=1, max_size=50))
def test_deadlines_do_not_accumulate_error(rate: Fraction, gaps_ns: list[int]) -> None:
    play = Playback(1000, 0, rate)
    media_ns = 0
    for gap_ns in gaps_ns:
        media_ns += gap_ns
        assert play.target_ns(media_ns) == 1000 + int(media_ns / rate)


@settings(deadline=None)
@given(times, times, rates, st.lists(st.integers(0, 10**12), min_size=1, max_size=50).map(sorted))
def test_deadlines_of_a_column_are_those_of_its_rows(
    anchor_ns: int, media_ns: int, rate: Fraction, ahead_ns: list[int]
) -> None:
    play = Playback(anchor_ns, media_ns, rate)
    column = media_ns + np.array(ahead_ns, np.int64)
    assert play.targets_ns(column).tolist() == [play.target_ns(int(row)) for row in column]


@settings(deadline=None)
@given(times, rates, st.integers(0, 10**12), st.integers(0, 10**12), st.integers(0, 10**12))
def test_pause_takes_no_media_time(start_ns: int, rate: Fraction, a: int, b: int, c: int) -> None:
    """A pause is a value that does not run; going on is a new anchor at the media time of the pause."""
    play = Playback(start_ns, 0, rate)
    paused = replace(play, anchor_ns=start_ns + a, media_ns=play.media_from(start_ns + a), running=False)
    assert not paused.running
    resumed = replace(paused, anchor_ns=start_ns + a + b, running=True)
    drift = resumed.media_from(start_ns + a + b + c) - play.media_from(start_ns + a + c)
    assert 0 <= drift <= 1  # rounding up, once more


@settings(deadline=None)
@given(times, rates, rates, st.integers(0, 10**12))
def test_a_change_of_rate_leaves_no_jump(start_ns: int, rate: Fraction, other: Fraction, after_ns: int) -> None:
    play = Playback(start_ns, 0, rate)
    media_ns = play.media_from(start_ns + after_ns)
    now_ns = play.target_ns(media_ns)
    changed = Playback(now_ns, media_ns, other)
    assert changed.target_ns(media_ns) == now_ns
    assert changed.media_from(now_ns) == media_ns


def test_seek_is_a_new_anchor() -> None:
    play = replace(Playback(0, 0, Fraction(2)), anchor_ns=10**9, media_ns=60 * 10**9)
    assert play.target_ns(62 * 10**9) == 2 * 10**9


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
        play = replace(play, anchor_ns=play.target_ns(10**9))


def _filled(values: list[int], miss_ns: int = 1000) -> Lateness:
    lateness = Lateness([miss_ns])
    lateness.add(np.zeros(len(values), np.int32), np.array(values, np.int64))
    return lateness


@settings(deadline=None)
@given(st.lists(st.integers(-(10**6), 10**11), min_size=1, max_size=200))
def test_percentiles_bound_the_exact_ones(values: list[int]) -> None:
    summary = _filled(values).summary()
    ranked = sorted(max(value, 0) for value in values)
    for percent, measured in ((50, summary.p50_ns), (99, summary.p99_ns)):
        exact = ranked[max(math.ceil(percent / 100 * len(ranked)), 1) - 1]
        beyond = exact > 67 * 10**9  # the last bin holds all of that, and tells the maximum
        assert exact <= measured <= (ranked[-1] if beyond else min(exact * 33 // 32, ranked[-1]))
    assert summary.frames == len(values)
    assert summary.max_ns == ranked[-1]
    assert summary.misses == sum(value > 1000 for value in values)


@settings(deadline=None)
@given(st.lists(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 10**10)), max_size=50), max_size=5))
def test_streams_are_counted_apart_and_together(sheets: list[list[tuple[int, int]]]) -> None:
    """However the rows come in columns, each stream has its own, and all together are as one."""
    miss_ns = [10, 10**6, 10**9]
    lateness = Lateness(miss_ns)
    for sheet in sheets:
        streams, late_ns = (
            (np.array(column, np.int64) for column in zip(*sheet, strict=True)) if sheet else (_NONE,) * 2
        )
        lateness.add(streams, late_ns)
    rows = [row for sheet in sheets for row in sheet]
    for stream in range(3):
        alone = _filled([late for other, late in rows if other == stream], miss_ns[stream])
        assert lateness.summary(stream) == alone.summary()
    together = _filled([late for _, late in rows]).summary()
    misses = sum(late > miss_ns[stream] for stream, late in rows)
    assert lateness.summary() == together._replace(misses=misses)


_NONE = np.zeros(0, np.int64)


def test_summary_of_nothing() -> None:
    assert Lateness([5]).summary() == Lateness([]).summary() == (0, 0, 0, 0, 0)
