"""Clocks: virtual time jumps, UTC offsets are bracketed, steps are told from noise, sleeping never ends early."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.clock import Clock, SystemClock, UtcOffset, VirtualClock, utc_offset

MS = 1_000_000


def test_virtual_time_passes_only_by_sleeping() -> None:
    clock = VirtualClock(realtime_ns=10**18, monotonic_ns=5)
    assert (clock.monotonic_ns(), clock.realtime_ns()) == (5, 10**18)
    clock.sleep_until(105)
    assert (clock.monotonic_ns(), clock.realtime_ns()) == (105, 10**18 + 100)
    clock.sleep_until(50)
    assert clock.monotonic_ns() == 105
    clock.advance(10)
    clock.step(-(10**9))
    assert (clock.monotonic_ns(), clock.realtime_ns()) == (115, 10**18 + 110 - 10**9)


def test_virtual_time_does_not_run_backwards() -> None:
    with pytest.raises(ValueError, match="backwards"):
        VirtualClock().advance(-1)


class _SlowReads:
    """A clock whose reads take time, by a list of durations."""

    def __init__(self, durations_ns: list[int]) -> None:
        self._durations = iter(durations_ns)
        self._now_ns = 0

    def _read(self) -> int:
        self._now_ns += next(self._durations)
        return self._now_ns

    def monotonic_ns(self) -> int:
        return self._read()

    def realtime_ns(self) -> int:
        return self._read() + 10**18

    def sleep_until(self, deadline_ns: int, /) -> None:
        raise AssertionError


@settings(deadline=None)
@given(st.lists(st.integers(0, 10**6), min_size=27, max_size=27))
def test_offset_error_is_within_the_bracket_and_the_tightest_wins(durations_ns: list[int]) -> None:
    offset = utc_offset(_SlowReads(durations_ns), tries=9)
    assert abs(offset.offset_ns - 10**18) <= (offset.bracket_ns + 1) // 2
    assert offset.bracket_ns == min(sum(durations_ns[k + 1 : k + 3]) for k in range(0, 27, 3))


@settings(deadline=None)
@given(st.integers(-(10**10), 10**10), st.integers(0, 1000), st.integers(0, 1000))
def test_steps_are_told_from_noise(step_ns: int, bracket_ns: int, later_ns: int) -> None:
    before = UtcOffset(10**18, bracket_ns, 0)
    after = UtcOffset(10**18 + step_ns, later_ns, 10**9)
    told = before.step_ns(after)
    assert told in (0, step_ns)
    assert (told == 0) == (abs(step_ns) <= (bracket_ns + later_ns) // 2)


def test_offset_of_a_stepped_clock() -> None:
    clock = VirtualClock()
    before = utc_offset(clock)
    assert before.monotonic_ns(clock.realtime_ns()) == clock.monotonic_ns()
    assert before.realtime_ns(clock.monotonic_ns()) == clock.realtime_ns()
    clock.advance(10**9)
    assert before.step_ns(utc_offset(clock)) == 0
    clock.step(37 * 10**9)
    assert before.step_ns(utc_offset(clock)) == 37 * 10**9


@pytest.mark.realtime
@pytest.mark.parametrize(
    "clock",
    [SystemClock(), SystemClock(spin_ns=200_000), SystemClock(native=False), SystemClock(native=False, spin_ns=MS)],
    ids=["native", "native-spin", "portable", "portable-spin"],
)
def test_sleep_ends_at_the_deadline_or_later(clock: Clock) -> None:
    late_ns = []
    for _ in range(20):
        deadline_ns = clock.monotonic_ns() + MS
        clock.sleep_until(deadline_ns)
        late_ns.append(clock.monotonic_ns() - deadline_ns)
    assert min(late_ns) >= 0
    assert min(late_ns) < MS, late_ns  # however busy the machine, once in twenty it is on time
    start_ns = clock.monotonic_ns()
    clock.sleep_until(start_ns)
    clock.sleep_until(-1)


@pytest.mark.realtime
def test_system_offset_is_consistent() -> None:
    clock = SystemClock()
    offset = utc_offset(clock)
    assert 0 < offset.bracket_ns < 100 * MS
    between = offset.realtime_ns(clock.monotonic_ns()) - clock.realtime_ns()
    assert abs(between) < 100 * MS
