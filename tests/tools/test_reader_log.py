"""Frames of a round in order of arrival, none before its configuration; steps done in another thread."""

from __future__ import annotations

import threading
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.reading import ROUND_NS, Item, Rounds, block, flow_of, recording, rounds_of, stamps_in, stream

from pmutools.c37118 import FrameType, Message
from pmutools.errors import SourceError
from pmutools.formats import open_sink, open_source
from pmutools.timebase import NS
from pmutools.tools.reader import Reading, read
from pmutools.tools.reader.log import Shown, messages_of
from pmutools.tools.reader.steps import Direct, Threaded

SEVEN, EIGHT = stream(7), stream(8)


def config_of(idcode: int, arrival_ns: int | None = None) -> Message:
    message = recording(stream(idcode), 0)[0]
    return message._replace(frame=message.frame._replace(arrival_ns=arrival_ns), flow=flow_of(idcode))


def kinds(messages: list[Message]) -> list[tuple[int, str]]:
    return [(message.frame.idcode, message.frame.type.name) for message in messages]


def test_frames_of_several_streams_come_in_order_of_arrival() -> None:
    one, two = block(SEVEN, 5, latency_ns=40_000_000), block(EIGHT, 5, latency_ns=50_000_000)
    found = list(messages_of([one, two], {}))
    data = [message for message in found if message.frame.type is FrameType.DATA]
    assert [message.frame.idcode for message in data] == [7, 8] * 5
    arrivals = [message.frame.arrival_ns or 0 for message in data]
    assert arrivals == sorted(arrivals)


def test_a_configuration_is_made_up_once_where_none_was_shown() -> None:
    shown: Shown = {}
    first = kinds(list(messages_of([block(SEVEN, 2)], shown)))
    second = kinds(list(messages_of([block(SEVEN, 2, first=2)], shown)))
    changed = kinds(list(messages_of([block(stream(7, cfgcnt=1), 2, first=4)], shown)))
    assert first == changed == [(7, "CFG2"), (7, "DATA"), (7, "DATA")]
    assert second == [(7, "DATA"), (7, "DATA")]


def test_data_that_had_to_wait_come_after_the_configuration_that_came_later() -> None:
    late = block(SEVEN, 3)
    when = int(late.batch.arrival_ns[-1]) + 1
    other = block(EIGHT, 3, latency_ns=10_000_000)
    found = list(messages_of([config_of(7, when), config_of(8, 0), late, other], {}))
    assert kinds(found) == [(8, "CFG2"), *[(8, "DATA")] * 3, (7, "CFG2"), *[(7, "DATA")] * 3]
    assert [message.frame.arrival_ns for message in found[-3:]] == late.batch.arrival_ns.tolist()


def test_frames_without_an_arrival_keep_their_place(tmp_path: Path) -> None:
    found = list(messages_of([config_of(7), block(SEVEN, 3)], {}))
    assert kinds(found) == [(7, "CFG2"), *[(7, "DATA")] * 3]


# --- reading


def test_what_was_read_is_counted_stream_by_stream(tmp_path: Path) -> None:
    given = [[*one, *two] for one, two in zip(rounds_of(SEVEN, 4), rounds_of(EIGHT, 4), strict=True)]
    told: list[int] = []
    with open_sink(tmp_path / "log.mcap") as sink:
        reading = read(Rounds(given), sink, lambda now: told.append(now.frames), round_ns=ROUND_NS)  # type: ignore[arg-type]
    described = reading.to_json()
    assert described["frames"] == 96
    assert [(each["name"], each["idcode"], each["frames"]) for each in described["streams"]] == [
        ("PMU 7", 7, 48),
        ("PMU 8", 8, 48),
    ]
    first = described["streams"][0]
    assert first["flow"] == "udp 192.0.2.7:4713 > 192.0.2.1:4713"
    assert (first["first_time"], first["last_time"]) == (
        "2016-09-08T17:05:11.000000000Z",
        "2016-09-08T17:05:11.940000000Z",
    )
    assert first["last_time_ns"] - first["first_time_ns"] == 47 * NS // 50
    assert told == [96]


def test_every_round_is_shown_before_it_is_recorded(tmp_path: Path) -> None:
    seen: list[int] = []

    def observe(found: Any) -> None:
        seen.append(len(found))

    with open_sink(tmp_path / "log.csv") as sink:
        read(Rounds([*rounds_of(SEVEN, 3), []]), sink, observe=observe)  # type: ignore[arg-type]
    assert seen == [1, 1, 1, 0]


class Refusing:
    """A recorder that fails at the ``count``-th round."""

    def __init__(self, count: int) -> None:
        self.count, self.closed, self.paths = count, False, list[Path]()

    def take(self, found: Any) -> None:
        self.count -= 1
        if not self.count:
            raise SourceError("cannot write x: No space left on device")

    def flush(self) -> None: ...

    def close(self) -> None:
        self.closed = True
        raise SourceError("again")


@pytest.mark.parametrize("threaded", [False, True])
def test_what_is_lost_when_writing_fails_is_said(threaded: bool) -> None:
    recorder = Refusing(10)
    with pytest.raises(SourceError) as raised:
        read(Rounds(rounds_of(SEVEN, 20)), recorder, threaded=threaded, round_ns=ROUND_NS)  # type: ignore[arg-type]
    assert recorder.closed
    text = str(raised.value)
    assert text.startswith("cannot write x: No space left on device; ")
    assert "\n" not in text
    if not threaded:  # there, more has been counted by the time that it is known
        assert "96 frames are kept, up to 2016-09-08T17:05:12.900000000Z; 24 frames that came after it are lost" in text


def test_nothing_kept_is_said_too() -> None:
    with pytest.raises(SourceError, match="nothing was kept: 12 frames are lost"):
        read(Rounds(rounds_of(SEVEN, 20)), Refusing(1))  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".c37118"])
def test_a_thread_of_its_own_writes_the_same(suffix: str, tmp_path: Path) -> None:
    given: list[list[Item]] = rounds_of(SEVEN, 30)
    for threaded in (False, True):
        with open_sink(tmp_path / f"{threaded}{suffix}", journal=True) as sink:
            reading = read(Rounds(given), sink, threaded=threaded)  # type: ignore[arg-type]
        assert (reading.frames, reading.kept) == (360, 360)
    assert stamps_in(tmp_path / f"True{suffix}") == stamps_in(tmp_path / f"False{suffix}")
    assert open_source(tmp_path / f"True{suffix}").defects() == {}


# --- steps


def test_steps_are_done_in_order_before_the_end() -> None:
    for steps in (Direct(), Threaded()):
        done: list[int] = []
        with steps:
            for number in range(100):
                steps.do(partial(done.append, number))
        assert done == list(range(100))


def test_what_a_step_raises_comes_out_once_and_ends_it() -> None:
    done: list[int] = []

    def fail() -> None:
        raise SourceError("no")

    steps = Threaded()
    with pytest.raises(SourceError, match="no"), steps:
        steps.do(lambda: done.append(1))
        steps.do(fail)
        steps.do(lambda: done.append(2))
    assert done == [1]


def test_what_waits_is_bounded() -> None:
    gate, asked = threading.Event(), threading.Event()
    steps = Threaded(limit_bytes=100)
    done: list[int] = []

    def wait() -> None:
        asked.set()
        assert gate.wait(20)

    def fill() -> None:
        for number in range(3):
            steps.do(partial(done.append, number), 60)

    with steps:
        steps.do(wait, 60)
        assert asked.wait(20)
        filler = threading.Thread(target=fill)
        filler.start()
        filler.join(0.2)
        assert filler.is_alive(), "no room for all of them"
        assert steps._queued_bytes <= 160
        gate.set()
        filler.join(20)
    assert done == [0, 1, 2]


def test_an_error_outside_leaves_the_rest_undone() -> None:
    gate = threading.Event()
    done: list[int] = []
    with pytest.raises(KeyError), Threaded() as steps:
        steps.do(lambda: done.append(int(gate.wait(20))))
        for _ in range(10):
            steps.do(lambda: done.append(2))
        gate.set()
        raise KeyError
    assert len(done) <= 11


def test_reading_counts_nothing_twice() -> None:
    reading = Reading(Rounds([]).tally, Rounds([]).name)
    for found in rounds_of(SEVEN, 2):
        reading.count(found)
    assert (reading.frames, len(reading.streams)) == (24, 1)
