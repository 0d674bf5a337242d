"""The ring buffer: what is recorded around a trigger, for how long, and within which memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.reading import START_NS, Item, Rounds, block, rounds_of, stamps_in, stream

from pmutools.clock import VirtualClock
from pmutools.formats import Sink, open_sink, open_source
from pmutools.timebase import NS
from pmutools.tools.reader import read
from pmutools.tools.reader.conditions import parse_triggers
from pmutools.tools.reader.ring import EVENT_NS, Ring, Window
from pmutools.tools.reader.watch import Watch

CONFIG = stream(7)
PER_ROUND = 12
"""Frames, about; at 50 frames/s a round of 0.25 s has 12.5."""
WINDOW = Window(NS, NS)
HIGH = {"frequency": np.full((12, 1), 60.9)}


@dataclass
class Run:
    """A ring and what it told."""

    out: Path
    triggers: str = "freq>60.5"
    options: dict[str, Any] = field(default_factory=lambda: {"window": WINDOW})
    told: list[str] = field(default_factory=list)

    def __call__(self, given: list[list[Item]], **more: Any) -> Ring:
        source = Rounds(given)
        self.ring = Ring(
            self.out,
            lambda path: open_sink(path, journal=True),
            Watch(parse_triggers(self.triggers)),
            source.clock,
            tell=self.told.append,
            **self.options,
        )
        read(source, self.ring, **more)  # type: ignore[arg-type]
        self.ring.close()
        return self.ring


def with_high(count: int, *places: int) -> list[list[Item]]:
    """Rounds, those at ``places`` with a high frequency."""
    return [
        [block(CONFIG, PER_ROUND, first=number * PER_ROUND, **(HIGH if number in places else {}))]
        for number in range(count)
    ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mcap", ".pcapng", ".jsonl", ".c37118.gz"])
def test_an_event_has_what_came_before_it_and_after_it(suffix: str, tmp_path: Path) -> None:
    run = Run(tmp_path / f"event{suffix}")
    ring = run(with_high(20, 8))
    (path,) = ring.paths
    slots = stamps_in(path)
    assert slots == list(range(3 * PER_ROUND, 13 * PER_ROUND)), "1 s before the round of the trigger, and after it"
    assert path.name == f"event-20160908T170512.920Z{suffix}"
    assert run.told == [
        f"trigger freq>60.5: PMU 7 (stream 7) 60.9 Hz at 2016-09-08T17:05:12.920000000Z -> {path}",
        f"recorded {path}",
    ]
    assert list(tmp_path.iterdir()) == [path]
    assert open_source(path).defects() == {}


def test_nothing_is_written_where_nothing_happens(tmp_path: Path) -> None:
    assert Run(tmp_path / "event.csv")(with_high(20)).paths == []
    assert list(tmp_path.iterdir()) == []


def test_a_trigger_during_an_event_extends_it(tmp_path: Path) -> None:
    run = Run(tmp_path / "event.csv")
    (path,) = run(with_high(30, 8, 11)).paths
    assert stamps_in(path) == list(range(3 * PER_ROUND, 16 * PER_ROUND))
    assert sum(line.startswith("trigger") for line in run.told) == 2


def test_two_events_are_two_files(tmp_path: Path) -> None:
    ring = Run(tmp_path / "event.csv")(with_high(40, 8, 30))
    assert [stamps_in(path)[0] // PER_ROUND for path in ring.paths] == [3, 25]
    assert ring.events == 2


def test_a_condition_that_holds_extends_the_event_but_not_for_ever(tmp_path: Path) -> None:
    long = with_high(30, *range(8, 20))
    (path,) = Run(tmp_path / "event.csv")(long).paths
    assert stamps_in(path)[-1] // PER_ROUND == 23
    stuck: list[list[Item]] = [[block(CONFIG, 12, **HIGH)], *[[] for _ in range(4 * (EVENT_NS // NS) + 20)]]
    run = Run(tmp_path / "stuck.csv")
    source_end = 4 * (EVENT_NS // NS)
    run(stuck)
    assert run.told[-1].startswith("recorded")
    assert run.ring.events == 1
    assert len(stuck) > source_end


def test_an_end_in_the_middle_keeps_the_event(tmp_path: Path) -> None:
    (path,) = Run(tmp_path / "event.parquet")(with_high(10, 9)).paths
    assert stamps_in(path) == list(range(4 * PER_ROUND, 10 * PER_ROUND))


def test_someone_asks_for_it(tmp_path: Path) -> None:
    run = Run(tmp_path / "event.csv", "signal")
    asked: list[bool] = []

    def observe(found: object) -> None:
        asked.append(run.ring.fire("signal") if len(asked) == 8 else run.ring.fire("key"))

    (path,) = run(with_high(20), observe=observe).paths
    assert asked.count(True) == 1
    assert stamps_in(path) == list(range(3 * PER_ROUND, 13 * PER_ROUND))
    assert run.told[0].startswith("trigger signal: at 2016-09-08T17:05:")


def test_only_so_many_recordings_of_this_run_are_kept(tmp_path: Path) -> None:
    (tmp_path / "event-20160101T000000.000Z.csv").write_text("of another run")
    run = Run(tmp_path / "event.csv", options={"window": WINDOW, "keep": 2})
    ring = run(with_high(100, 8, 30, 50, 70))
    assert len(ring.paths) == 2
    assert ring.events == 4
    assert len(list(tmp_path.iterdir())) == 3


def test_events_of_one_moment_have_names_of_their_own(tmp_path: Path) -> None:
    for _ in range(2):
        Run(tmp_path / "event.csv")(with_high(20, 8))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "event-20160908T170512.920Z-2.csv",
        "event-20160908T170512.920Z.csv",
    ]


def test_several_streams_become_tables_in_a_folder(tmp_path: Path) -> None:
    other = stream(8)
    given = [[*one, *two] for one, two in zip(with_high(20, 8), rounds_of(other, 20), strict=True)]
    ring = Run(tmp_path / "event.csv")(given)
    assert [path.parent.name for path in ring.paths] == ["event-20160908T170512.920Z"] * 2


def test_the_memory_of_the_history_is_bounded_and_that_is_told(tmp_path: Path) -> None:
    run = Run(tmp_path / "event.csv", options={"window": Window(60 * NS, NS), "history_bytes": 10_000})
    ring = run(with_high(40, 30))
    assert ring._history.nbytes <= 10_000
    assert any("the history is full" in line and "not 60 s" in line for line in run.told)
    (path,) = ring.paths
    slots = stamps_in(path)
    assert slots == list(range(slots[0], 35 * PER_ROUND)), "what there was, without a gap"


class SlowSink:
    """A sink that takes time."""

    wants = "blocks"

    def __init__(self, clock: VirtualClock, path: Path) -> None:
        self.clock, self.paths, self.frames = clock, [path], 0

    def write(self, item: Any) -> None:
        self.clock.advance(80_000_000)
        self.frames += len(item.batch)

    def flush(self) -> None: ...
    def close(self) -> None: ...


def test_a_long_history_is_written_little_by_little(tmp_path: Path) -> None:
    """So that what comes meanwhile is not kept waiting; all of it is written in the end."""
    source = Rounds(with_high(80, 40))
    sinks: list[SlowSink] = []

    def begin(path: Path) -> Sink:
        sinks.append(SlowSink(source.clock, path))
        return sinks[-1]  # type: ignore[return-value]

    ring = Ring(
        tmp_path / "event.csv", begin, Watch(parse_triggers("freq>60.5")), source.clock, window=Window(5 * NS, NS)
    )
    took = []
    before = source.clock.monotonic_ns()
    for found in source.rounds():
        before = source.clock.monotonic_ns()
        ring.take(found)
        took.append(source.clock.monotonic_ns() - before)
    ring.close()
    assert max(took) <= 100_000_000 + 80_000_000
    assert sinks[0].frames >= PER_ROUND * (20 + 1 + 2)


def test_times_are_those_of_the_clock_that_is_handed_in() -> None:
    assert Rounds([]).clock.realtime_ns() == START_NS
