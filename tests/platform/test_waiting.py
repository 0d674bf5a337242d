"""Frames wait for their tick, and a flood of them costs a tick no more than it may."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dcon.platform.waiting import FRAMES_A_TICK, LATEST_NS, WAITING, Waiting
from pmutools.c37118 import Frame
from pmutools.flow import StampSource

TICK_NS = 10**18


def frame(arrival_ns: int | None) -> Frame:
    return Frame(b"", arrival_ns, StampSource.KERNEL, 0)


def test_what_came_after_the_tick_waits_for_the_next() -> None:
    waiting = Waiting()
    for arrival_ns in (TICK_NS - 1, TICK_NS, TICK_NS + 1, TICK_NS + 2):
        waiting.add("N1", frame(arrival_ns))
    assert [f.arrival_ns for f in waiting.take(TICK_NS)["N1"]] == [TICK_NS - 1, TICK_NS]
    assert waiting.take(TICK_NS) == {}
    assert [f.arrival_ns for f in waiting.take(TICK_NS + 1)["N1"]] == [TICK_NS + 1]
    assert len(waiting) == 1


def test_a_stamp_from_far_ahead_is_a_mistake_and_does_not_wait() -> None:
    waiting = Waiting()
    waiting.add("N1", frame(TICK_NS + LATEST_NS + 1))
    assert len(waiting.take(TICK_NS)["N1"]) == 1 and len(waiting) == 0


def test_a_flood_in_the_name_of_one_pmu_is_bounded_and_counted_and_the_others_lose_nothing() -> None:
    waiting = Waiting()
    for _ in range(10_000):
        waiting.add("N1", frame(TICK_NS))
    waiting.add("S1", frame(TICK_NS))
    assert len(waiting) == WAITING + 1 and waiting.crowded == 10_000 - WAITING
    taken = waiting.take(TICK_NS)
    assert {name: len(frames) for name, frames in taken.items()} == {"N1": FRAMES_A_TICK, "S1": 1}


@given(st.lists(st.tuples(st.sampled_from("NS"), st.integers(-5, 60)), max_size=200))
def test_each_frame_is_taken_once_in_its_turn(arrivals: list[tuple[str, int]]) -> None:
    waiting = Waiting()
    for name, arrival_ns in arrivals:
        waiting.add(name, frame(TICK_NS + arrival_ns))
    taken: list[tuple[str, int]] = []
    for k in range(200):
        for name, frames in waiting.take(TICK_NS + k).items():
            assert len(frames) <= FRAMES_A_TICK
            assert all((f.arrival_ns or 0) <= TICK_NS + k for f in frames)
            taken += [(name, (f.arrival_ns or 0) - TICK_NS) for f in frames]
    assert sorted(taken) == sorted(arrivals) and len(waiting) == 0 and waiting.crowded == 0
