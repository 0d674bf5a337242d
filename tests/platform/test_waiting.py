"""Frames wait for their tick, and a flood of them costs a tick no more than it may."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dcon.control.waiting import BYTES_A_TICK, CONFIGS, CONFIGS_NS, FRAMES_A_TICK, LATEST_NS, WAITING, Waiting
from pmutools.c37118 import Frame
from pmutools.flow import StampSource

TICK_NS = 10**18


def frame(arrival_ns: int | None, nbytes: int = 0) -> Frame:
    return Frame(bytes(nbytes), arrival_ns, StampSource.KERNEL, 0)


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


@given(st.lists(st.integers(1, 20_000), max_size=60))
def test_long_frames_are_taken_by_their_bytes_and_one_always_is(sizes: list[int]) -> None:
    waiting, taken = Waiting(), list[int]()
    for size in sizes:
        waiting.add("N1", frame(TICK_NS, size))
    while found := waiting.take(TICK_NS).get("N1", []):
        assert sum(len(f.data) for f in found[:-1]) < BYTES_A_TICK and len(found) <= FRAMES_A_TICK
        taken += [len(f.data) for f in found]
    assert taken == sizes


def test_long_configurations_are_taken_one_a_tick_and_short_ones_together() -> None:
    waiting = Waiting()
    for name, nbytes in (("N1", 15_000), ("N2", 16_400), ("S1", 500), ("S2", 500)):
        waiting.add_config(name, frame(1, nbytes))
    ticks = [[name for name, _ in waiting.configs(k)] for k in range(4)]
    assert ticks == [["N1", "S1", "S2"], ["N2"], [], []]


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


def test_of_the_configurations_of_a_tick_the_newest_of_each_pmu_counts_and_the_rest_is_counted() -> None:
    waiting = Waiting()
    given = [Frame(bytes([number]), 1, StampSource.KERNEL, 0) for number in range(6)]
    for name, one in zip(("N1", "S1", "N1", "N1", "S1"), given, strict=False):
        waiting.add_config(name, one)
    assert waiting.configs(0) == [("N1", given[3]), ("S1", given[4])] and waiting.overtaken == 3
    assert waiting.configs(0) == []


def test_more_configurations_of_a_pmu_than_it_may_have_wait_and_its_frames_are_not_read_meanwhile() -> None:
    waiting = Waiting()
    for now_ns in range(CONFIGS):
        waiting.add_config("N1", frame(now_ns))
        assert len(waiting.configs(now_ns)) == 1
    waiting.add_config("N1", frame(100))
    waiting.add_config("S1", frame(101))
    assert [name for name, _ in waiting.configs(100)] == ["S1"]
    for name in ("N1", "S1"):
        waiting.add(name, frame(TICK_NS))
    assert list(waiting.take(TICK_NS)) == ["S1"] and waiting.crowded == 1
    waiting.add_config("N1", frame(102))
    assert waiting.configs(CONFIGS_NS - 1) == []
    assert waiting.configs(CONFIGS_NS) == [("N1", frame(102))] and waiting.overtaken == 1
    waiting.add("N1", frame(TICK_NS))
    assert list(waiting.take(TICK_NS)) == ["N1"]
