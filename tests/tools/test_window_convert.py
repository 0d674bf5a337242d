"""Parts of recordings, and several as one: the same by frame and by block, whatever the format."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.captures import capture_path
from support.frames import random_stream
from support.playing import START_NS, interleaved, number, play, recording, stamp_ns, stream
from support.recordings import data_of, messages_of, write, written

from pmutools.c37118 import FrameType, Message
from pmutools.c37118.demux import Loss
from pmutools.c37118.framer import Skipped, SkipReason
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block, gather
from pmutools.parsers import Place, parse_place
from pmutools.timebase import NS
from pmutools.tools.convert import convert
from pmutools.tools.recordings import open_recordings
from pmutools.tools.window import FOREVER, Window

STEP_NS = NS // 50


def times_of_items(window: Window, messages: list[Message]) -> list[int]:
    return [
        stamp_ns(item.frame.data, item.config)
        for item in window.items(messages)
        if isinstance(item, Message) and item.frame.type is FrameType.DATA
    ]


def times_of_blocks(window: Window, messages: list[Message], frames: int = 7) -> list[int]:
    blocks = window.blocks(gather(iter(messages), frames))
    return [int(ns) for block in blocks if isinstance(block, Block) for ns in block.batch.time_ns]


# --- moments


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("12.5", Place(12_500_000_000, relative=True)),
        ("0", Place(0, relative=True)),
        ("-3", Place(-3 * NS, relative=True)),
        ("2016-09-08T17:05:11Z", Place(START_NS, relative=False)),
        ("2016-09-08 19:05:11.25+02:00", Place(START_NS + 250_000_000, relative=False)),
    ],
)
def test_a_moment_is_seconds_into_the_source_or_utc(text: str, moment: Place) -> None:
    assert parse_place(text) == moment


@pytest.mark.parametrize("text", ["", "now", "nan", "inf", "2016-13-40T00:00:00Z", "12:30"])
def test_what_is_no_moment_is_told(text: str) -> None:
    with pytest.raises(ValueError, match="is no time; write seconds into the source"):
        parse_place(text)


def test_a_moment_beyond_all_stamps_is_for_ever() -> None:
    assert times_of_items(Window(end=parse_place("1e200")), recording(stream(), 5)) != []
    assert times_of_blocks(Window(start=parse_place("-1e200")), recording(stream(), 5)) != []


# --- windows


@given(
    start=st.none() | st.integers(-5, 60),
    end=st.none() | st.integers(-5, 60),
    duration=st.none() | st.integers(1, 60),
    idcodes=st.sets(st.sampled_from((1, 2, 9))),
    utc=st.booleans(),
    order=st.permutations(range(30)),
)
def test_items_and_blocks_keep_what_lies_in_the_window(
    start: int | None, end: int | None, duration: int | None, idcodes: set[int], utc: bool, order: list[int]
) -> None:
    messages = interleaved(recording(stream(1), 30, slots=order), recording(stream(2), 20, first_slot=7))
    first = next(stamp_ns(m.frame.data, m.config) for m in messages if m.frame.type is FrameType.DATA)

    def moment(slots: int | None) -> Place | None:
        if slots is None:
            return None
        return Place(slots * STEP_NS + (first if utc else 0), relative=not utc)

    def window() -> Window:
        return Window(moment(start), moment(end), None if duration is None else duration * STEP_NS, idcodes)

    low = first + start * STEP_NS if start is not None else -FOREVER
    high = first + end * STEP_NS if end is not None else FOREVER
    if duration is not None:
        high = min(high, max(low, first) + duration * STEP_NS)
    expected = sorted(
        stamp_ns(m.frame.data, m.config)
        for m in messages
        if m.frame.type is FrameType.DATA
        and (not idcodes or m.frame.idcode in idcodes)
        and low <= stamp_ns(m.frame.data, m.config) < high
    )
    assert sorted(times_of_items(window(), messages)) == expected
    assert sorted(times_of_blocks(window(), messages)) == expected


def test_the_first_stamp_is_the_sources_not_that_of_the_stream_picked() -> None:
    messages = interleaved(recording(stream(1), 100), recording(stream(2), 100, first_slot=50))
    window = {"start": parse_place("1.5"), "idcodes": [2]}
    for times in (times_of_items(Window(**window), messages), times_of_blocks(Window(**window), messages)):  # type: ignore[arg-type]
        assert times[0] == START_NS + 75 * STEP_NS


def test_other_frames_and_losses_pass_whatever_their_time() -> None:
    messages: list[Message | Loss] = list(recording(stream(), 10))
    messages.append(Loss(Skipped(SkipReason.BAD_CHK, 0, 5), messages[0].flow))
    kept = list(Window(start=parse_place("100")).items(messages))
    assert kept == [messages[0], messages[-1]]
    assert list(Window(start=parse_place("100")).blocks(gather(iter(messages)))) == kept


# --- conversions


@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".c37118", ".mcap", ".parquet", ".arrow"])
def test_every_format_to_every_other_keeps_the_frames(suffix: str, tmp_path: Path) -> None:
    described = random_stream(random.Random(4), stations=2, frames=40, data_rate=50, absent=0, scaled_floats=False)
    first = tmp_path / f"first{suffix}"
    write(first, messages_of(described))
    for number_, other in enumerate((".c37118", ".parquet", ".mcap", ".pcap")):
        out = tmp_path / f"out{number_}{other}"
        with open_sink(out) as sink:
            result = convert(open_source(first), sink, Window())
        assert (result.frames, result.streams, result.losses) == (40, 1, {})
        again = [item for item in open_source(written(out)).items() if isinstance(item, Message)]
        assert data_of(again) == list(described.data)


@pytest.mark.parametrize("suffix", [".pcap", ".parquet"])
def test_recordings_are_merged_on_time_whatever_their_order(suffix: str, tmp_path: Path) -> None:
    config = stream(5)
    flow = recording(config, 0)[0].flow
    names = []
    for part in range(3):
        name = tmp_path / f"part{part}{suffix}"
        write(name, recording(config, 50, first_slot=50 * part, latency_ns=5_000_000, flow=flow))
        names.append(name)
    source = open_recordings([names[2], names[0], names[1]])
    stamps = [
        stamp_ns(item.frame.data, item.config)
        for item in source.items()
        if isinstance(item, Message) and item.frame.type is FrameType.DATA
    ]
    assert stamps == [START_NS + k * STEP_NS for k in range(150)]
    assert source.tally.frames[FrameType.DATA] == 150


def test_relative_times_count_from_the_earliest_of_several_recordings(tmp_path: Path) -> None:
    for name, slot in (("late", 100), ("early", 0)):
        write(tmp_path / f"{name}.parquet", recording(stream(3 + slot), 50, first_slot=slot))
    source = open_recordings([tmp_path / "late.parquet", tmp_path / "early.parquet"])
    blocks = [b for b in Window(start=parse_place("2.5")).blocks(source.blocks()) if isinstance(b, Block)]
    assert {int(block.batch.time_ns[0]) for block in blocks} == {START_NS + 125 * STEP_NS}


def test_losses_of_every_source_are_told(tmp_path: Path) -> None:
    good = recording(stream(), 20)
    (tmp_path / "bad.c37118").write_bytes(b"".join([*(m.frame.data for m in good[:9]), b"junk", good[9].frame.data]))
    write(tmp_path / "good.c37118", good)
    with open_sink(tmp_path / "out.c37118") as sink:
        result = convert(open_recordings([tmp_path / "bad.c37118", tmp_path / "good.c37118"]), sink, Window())
    assert (result.frames, result.losses) == (29, {"bytes skipped, no-sync": 4})


def test_a_real_capture_survives_every_way_through(tmp_path: Path) -> None:
    path = capture_path("C37.118_1PMU_UDP.pcap")
    recorded = data_of(item for item in open_source(path).items() if isinstance(item, Message))
    at: Path = path
    for name in ("a.parquet", "b.pcapng", "c.arrow", "d.mcap", "e.c37118.gz"):
        out = tmp_path / name
        with open_sink(out) as sink:
            assert convert(open_source(at), sink, Window()).frames == 356
        at = out
    assert data_of(item for item in open_source(at).items() if isinstance(item, Message)) == recorded


def test_what_was_converted_plays_as_the_original(tmp_path: Path) -> None:
    """The player needs no capture: a table with its configuration is enough."""
    source = recording(stream(9, name="TABLE"), 50, latency_ns=3_000_000)
    write(tmp_path / "table.parquet", source)
    items: Any = list(open_source(tmp_path / "table.parquet").items())
    played = play(items)
    assert [number(sent.frame) for sent in played.data] == [*range(50)]
    late = [played.began_ns + left - stamp for left, stamp in zip(played.times(), played.stamps(), strict=True)]
    assert set(late) == {3_000_000}, "the table has the arrivals"
    assert [t.name for t in played.reel.tracks] == ["TABLE"]
