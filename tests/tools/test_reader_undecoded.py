"""Data frames for which no configuration comes: kept by what holds bytes, counted by all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.playing import START_NS, recording
from support.reading import ROUND_NS, Item, Rounds, block, stamps_in, stream

from pmutools.c37118 import Message
from pmutools.c37118.demux import Bounds, Demux, Loss
from pmutools.flow import Chunk, StampSource
from pmutools.formats import open_sink, open_source
from pmutools.timebase import NS
from pmutools.tools.reader import Reading, read
from pmutools.tools.reader.conditions import parse_triggers
from pmutools.tools.reader.log import Log
from pmutools.tools.reader.ring import Ring, Window
from pmutools.tools.reader.rolling import Rolling
from pmutools.tools.reader.split import Split
from pmutools.tools.reader.watch import Watch

BYTES = (".pcapng", ".pcap", ".mcap", ".c37118", ".c37118.gz")
LATENCY_NS = 40_000_000
FRAMES = [message.frame.data for message in recording(stream(9), 20, announced=False)]


def given_up() -> list[Item]:
    """The frames of stream 9, which never says what they mean."""
    demux = Demux()
    messages = recording(stream(9), 20, latency_ns=LATENCY_NS, announced=False)
    found = [part for each in messages for part in demux.feed(chunk_of(each))]
    return [*found, *demux.close()]


def chunk_of(message: Message) -> Chunk:
    return Chunk(message.frame.data, message.frame.arrival_ns, message.flow, StampSource.KERNEL)


def read_into(out: Path, given: list[list[Item]], **options: bool) -> tuple[Reading, Log]:
    with open_sink(out, **options) as sink:  # type: ignore[arg-type]
        log = Log(sink)
        return read(Rounds(given), log), log  # type: ignore[arg-type]


def undecoded_in(path: Path) -> list[tuple[bytes, int | None]]:
    """Of a recording: frames without a configuration, with their arrivals."""
    losses = [item for item in open_source(path).items() if isinstance(item, Loss)]
    return [(loss.undecoded.data, loss.undecoded.arrival_ns) for loss in losses if loss.undecoded is not None]


@pytest.mark.parametrize("suffix", BYTES)
def test_bytes_keep_what_has_no_configuration(suffix: str, tmp_path: Path) -> None:
    out = tmp_path / f"log{suffix}"
    reading, log = read_into(out, [[block(stream(7))], given_up()])
    assert (reading.frames, reading.undecoded, log.undecoded) == (12, 20, 20)
    assert reading.skipped == {"no-config": sum(map(len, FRAMES))}
    found = undecoded_in(out)
    assert [data for data, _ in found] == FRAMES
    if not suffix.startswith(".c37118"):
        arrivals = [arrival_ns for _, arrival_ns in found]
        assert arrivals == [START_NS + k * NS // 50 + LATENCY_NS for k in range(20)]
    assert stamps_in(out) == list(range(12)), "the others are read as ever"


@pytest.mark.parametrize("suffix", BYTES)
def test_a_configuration_found_afterwards_decodes_them(suffix: str, tmp_path: Path) -> None:
    read_into(tmp_path / f"log{suffix}", [given_up()])
    blocks = list(open_source(tmp_path / f"log{suffix}", configs=[stream(9)]).blocks())
    assert sum(len(each.batch) for each in blocks if not isinstance(each, Message | Loss)) == 20


@pytest.mark.parametrize("suffix", [".pcapng", ".c37118"])
def test_a_file_for_each_stream_has_one_for_them_too(suffix: str, tmp_path: Path) -> None:
    read_into(tmp_path / f"log{suffix}", [[block(stream(7))], given_up()], per_stream=True)
    assert sorted(path.name for path in (tmp_path / "log").iterdir()) == [f"PMU_7-7{suffix}", f"stream-9{suffix}"]
    assert len(undecoded_in(tmp_path / "log" / f"stream-9{suffix}")) == 20


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".arrow"])
def test_tables_only_count_them(suffix: str, tmp_path: Path) -> None:
    reading, log = read_into(tmp_path / f"log{suffix}", [[block(stream(7))], given_up()])
    assert (reading.undecoded, log.undecoded) == (20, 0)


def test_json_lines_have_them_as_skipped_with_their_bytes(tmp_path: Path) -> None:
    read_into(tmp_path / "log.jsonl", [[block(stream(7))], given_up()])
    objects = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    skipped = [each for each in objects if each["type"] == "skipped"]
    assert [bytes.fromhex(each["wire"]) for each in skipped] == FRAMES
    assert {(each["reason"], each["idcode"], each["stamp_source"]) for each in skipped} == {("no-config", 9, "kernel")}
    assert stamps_in(tmp_path / "log.jsonl") == list(range(12))


def test_numbered_files_hold_them_though_nothing_else_came(tmp_path: Path) -> None:
    rounds = Rounds([given_up()])
    rolling = Rolling(tmp_path / "log.pcapng", open_sink, Split(span_ns=NS), rounds.clock.realtime_ns)
    read(rounds, rolling)  # type: ignore[arg-type]
    rolling.close()
    assert rolling.undecoded == len(undecoded_in(tmp_path / "log-0001.pcapng")) == 20


def test_an_event_has_those_that_were_given_up_in_it(tmp_path: Path) -> None:
    rounds = Rounds([given_up(), [], [block(stream(7))], [], [], []])
    watch, window = Watch(parse_triggers("signal")), Window(ROUND_NS, ROUND_NS)
    ring = Ring(tmp_path / "log.pcapng", open_sink, watch, rounds.clock, window=window)
    assert ring.fire("signal")
    read(rounds, ring)  # type: ignore[arg-type]
    ring.close()
    (path,) = ring.paths
    assert ring.undecoded == len(undecoded_in(path)) == 20


def test_what_waits_is_bounded_and_the_oldest_go_first() -> None:
    """So a file is in order, and what is decoded in the end is what came last before the configuration."""
    demux = Demux(bounds=Bounds(held_bytes=5 * len(FRAMES[0])))
    config, *data = recording(stream(9), 20, latency_ns=LATENCY_NS)
    found = [part for message in data for part in demux.feed(chunk_of(message))]
    assert demux.pending == 5 * len(FRAMES[0])
    assert [part.undecoded.data for part in found if isinstance(part, Loss) and part.undecoded] == FRAMES[:15]
    released = demux.feed(chunk_of(config))
    assert [part.frame.data for part in released if isinstance(part, Message)] == [config.frame.data, *FRAMES[15:]]
    assert demux.tally.fed == demux.tally.framed + demux.tally.skipped_bytes
