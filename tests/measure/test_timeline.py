"""The course of a stream: nothing is lost from it as buckets grow."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from pmutools.c37118.batch import NO_TIME
from pmutools.measure.stream import STATES, Seen, State
from pmutools.measure.timeline import Timeline
from pmutools.timebase import NS

RATE = Fraction(50)
BEGIN = 1_700_000_000 * 50


def seen(first: int, count: int, delay_ns: int, state: State = State.ON_TIME, lost: tuple[int, ...] = ()) -> Seen:
    slot = np.arange(first, first + count) + BEGIN
    time_ns = slot * (NS // 50)
    states = np.full(count, STATES.index(state), np.uint8)
    sources = np.zeros(count, np.uint8)
    delays = np.full(count, delay_ns)
    stat = np.zeros(count, np.uint16)
    return Seen(
        slot, time_ns, time_ns + delay_ns, delays, sources, states, np.array(lost, np.int64) + BEGIN, stat, RATE
    )


def test_buckets_widen_and_keep_every_count() -> None:
    line = Timeline(buckets=8, first_width_ns=NS // 10)
    for second in range(100):
        line.add(seen(50 * second, 49, 20_000_000 + second, lost=(50 * second + 49,)))
    course = line.course()
    assert course is not None and len(course.frames) <= 8
    assert course.width_ns * 8 >= 100 * NS > course.width_ns * 4
    assert course.delayed.sum() == 4900 and course.lost.sum() == 100
    assert course.least_ns[course.delayed > 0].min() == 20_000_000 and course.most_ns.max() == 20_000_099
    assert course.total_ns.sum() == sum(49 * (20_000_000 + second) for second in range(100))


def test_lost_frames_lie_where_they_would_have_come() -> None:
    line = Timeline()
    line.add(seen(0, 50, 5 * NS, lost=()))  # a clock 5 s off
    line.add(seen(51, 50, 5 * NS, lost=(50,)))
    course = line.course()
    assert course is not None
    at = int(np.flatnonzero(course.lost)[0])
    assert abs(course.time_ns[at] - 1_700_000_006 * NS) <= course.width_ns


def test_nothing_at_all() -> None:
    assert Timeline().course() is None
    line = Timeline()
    empty = seen(0, 1, 0)
    line.add(empty._replace(arrival_ns=np.array([NO_TIME]), delay_ns=np.array([NO_TIME])))
    course = line.course()
    assert course is None or not course.delayed.sum()
