"""What the machine does to a measurement: stalls and steps of its clock, in time that a test moves."""

from __future__ import annotations

import time

import pytest

from pmutools import host
from pmutools.clock import SystemClock, VirtualClock
from pmutools.host import ClockStep, Heartbeat, HostLog, Stall
from pmutools.timebase import NS

MS = 1_000_000
UTC_NS = 1_700_000_000 * NS


def beating(clock: VirtualClock, log: HostLog, for_ns: int, every_ns: int = 10 * MS) -> None:
    for _ in range(for_ns // every_ns):
        clock.advance(every_ns)
        log.beat()


def test_beats_that_come_are_no_news() -> None:
    clock = VirtualClock(UTC_NS)
    log = HostLog(clock)
    beating(clock, log, 10 * NS)
    beating(clock, log, 10 * NS, every_ns=50 * MS)
    assert (log.stalled, log.stalls, list(log.news())) == (0, (), [])


def test_a_gap_is_a_stall_with_its_beginning_and_length() -> None:
    clock = VirtualClock(UTC_NS)
    log = HostLog(clock)
    beating(clock, log, NS)
    clock.advance(51 * MS)
    log.beat()
    beating(clock, log, NS)
    clock.advance(3 * NS)
    log.beat()
    first = Stall(NS, UTC_NS + NS, 51 * MS)
    second = Stall(2 * NS + 51 * MS, UTC_NS + 2 * NS + 51 * MS, 3 * NS)
    assert log.stalls == (first, second)
    assert (log.stalled, log.stalled_ns) == (2, 3 * NS + 51 * MS)
    assert list(log.news()) == [first, second]
    assert list(log.news()) == [], "told once"


@pytest.mark.parametrize("step_ns", [2 * MS, -2 * MS, 3600 * NS, -NS])
def test_a_clock_that_is_set_is_seen_within_a_second(step_ns: int) -> None:
    clock = VirtualClock(UTC_NS)
    log = HostLog(clock)
    beating(clock, log, 5 * NS)
    clock.step(step_ns)
    beating(clock, log, 2 * NS)
    assert [step.step_ns for step in log.steps] == [step_ns]
    (told,) = log.news()
    assert isinstance(told, ClockStep)
    assert told.utc_ns == UTC_NS + told.monotonic_ns + step_ns
    assert 5 * NS < told.monotonic_ns <= 6 * NS
    assert not log.stalled


def test_what_slewing_does_is_no_step() -> None:
    clock = VirtualClock(UTC_NS)
    log = HostLog(clock)
    for _ in range(20):
        clock.step(500_000)  # half a millisecond a second: as fast as clocks are slewed
        beating(clock, log, NS)
    assert not log.steps


def test_what_is_kept_is_bounded_and_the_counts_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "KEPT", 10)
    clock = VirtualClock(UTC_NS)
    log = HostLog(clock)
    for _ in range(25):
        clock.advance(100 * MS)
        log.beat()
    assert (len(log.stalls), log.stalled, len(list(log.news()))) == (10, 25, 10)


def test_a_new_start_forgets_the_time_between() -> None:
    clock = VirtualClock(UTC_NS)
    log = HostLog(clock)
    clock.advance(NS)
    clock.step(NS)
    log.start()
    beating(clock, log, 2 * NS)
    assert not log.stalls
    assert not log.steps


@pytest.mark.realtime
def test_the_thread_beats_while_much_is_done_and_ends() -> None:
    """A busy interpreter is no stall: the thread has its turn every few milliseconds."""
    log = HostLog(SystemClock())
    beats = 0
    beat = log.beat

    def counted() -> None:
        nonlocal beats
        beats += 1
        beat()

    log.beat = counted  # type: ignore[method-assign]
    heartbeat = Heartbeat(log)
    end = time.monotonic() + 5
    while beats < 5 and time.monotonic() < end:
        sum(range(1000))
    heartbeat.stop()
    assert beats >= 5
    assert not heartbeat._thread.is_alive()
