"""One suite over every format that is written: what goes in comes back, but for the losses declared here."""

from __future__ import annotations

import random
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.captures import REAL_CAPTURES, capture_path
from support.frames import random_stream
from support.recordings import blocks_of, data_of, messages_of, read, write, written
from support.wire import command_frame, header_frame

from pmutools.c37118 import Frame, FrameType, Message
from pmutools.c37118.batch import Batch, joined
from pmutools.errors import PmuError, SourceError
from pmutools.flow import Flow, StampSource
from pmutools.formats import open_sink, open_source

FIRST = Flow("udp", "192.0.2.11:4713", "192.0.2.1:4801")
SECOND = Flow("tcp", "192.0.2.12:4712", "192.0.2.1:50000")


@dataclass(frozen=True)
class Case:
    """A format, and what it loses of a recording: any of ``LOSSES``."""

    suffix: str
    loses: frozenset[str]
    options: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return "-".join([self.suffix, *map(str, self.options.values())])


LOSSES = {
    "flow": "addresses: each stream comes back as a flow of the file",
    "arrival": "arrival times",
    "stamp source": "who took them (of configurations: a log too)",
    "other frames": "headers and commands",
    "repeats": "configurations sent again",
    "bytes": "FORMAT and configuration: what comes back is float, with the same values",
    "until closed": "readable before it was closed",
}
CAPTURE = frozenset({"stamp source"})
RAW = frozenset({"flow", "arrival", "stamp source"})
TABLE = frozenset({"flow", "other frames", "repeats"})
OBJECTS = frozenset({"other frames", "repeats", "bytes"})
CASES = [
    *(Case(suffix, CAPTURE) for suffix in (".pcap", ".pcapng", ".pcap.gz", ".pcapng.zst")),
    *(Case(suffix, RAW) for suffix in (".c37118", ".PmuCapture", ".c37118.gz", ".c37118.zst")),
    Case(".mcap", frozenset({"flow", "other frames"})),
    *(Case(".arrow", TABLE, {"phasors": style}) for style in ("polar", "rect")),
    *(Case(".parquet", TABLE | {"until closed"}, {"phasors": style}) for style in ("polar", "rect")),
    *(Case(".csv", TABLE | {"bytes"}, {"phasors": style}) for style in ("polar", "rect")),
    *(Case(suffix, TABLE | {"bytes"}) for suffix in (".csv.gz", ".csv.zst")),
    *(
        Case(suffix, frozenset({"other frames", "repeats", "bytes"}))
        for suffix in (".jsonl", ".jsonl.gz", ".jsonl.zst")
    ),
]
every_format = pytest.mark.parametrize("case", CASES, ids=str)


def recording(seed: int = 1, *, second: bool = True) -> list[Message]:
    """Two streams, one of a concentrator; a header, a command and a configuration repeated in between."""
    rng = random.Random(seed)
    options: dict[str, Any] = {"frames": 30, "absent": 0.1, "scaled_floats": False, "time_base": 1_000_000}
    one = messages_of(random_stream(rng, formats=[0b0100], idcode=7, data_rate=50, **options), flow=FIRST)
    if not second:
        return one
    two = random_stream(rng, formats=[0b1110, 0b0000, 0b1000], idcode=60, data_rate=50, **options)
    others = [Frame(command_frame(60, 2), 1_700_000_000 * 10**9, StampSource.KERNEL, 0)]
    others += [Frame(header_frame(60, "a concentrator"), 1_700_000_000 * 10**9, StampSource.KERNEL, 0)]
    opening, *rest = messages_of(two, flow=SECOND)
    extra = [Message(frame, SECOND, opening.config) for frame in others]
    again = one[0]._replace(frame=one[0].frame._replace(arrival_ns=one[15].frame.arrival_ns))
    merged = list(chain.from_iterable(zip([*one[:15], again, *one[15:-1]], [opening, *rest], strict=True)))
    return [*merged[:4], *extra, *merged[4:]]


def keep(case: Case, messages: Sequence[Message]) -> list[Message]:
    """What the case is to keep of ``messages``."""
    seen = set()
    kept = []
    for message in messages:
        kind = message.frame.type
        if "other frames" in case.loses and kind in (FrameType.HEADER, FrameType.COMMAND):
            continue
        if "repeats" in case.loses and kind.is_config:
            if message.frame.idcode in seen:
                continue
            seen.add(message.frame.idcode)
        kept.append(message)
    return kept


def by_stream(messages: Sequence[Message]) -> dict[int, list[Message]]:
    streams: dict[int, list[Message]] = {}
    for message in messages:
        streams.setdefault(message.frame.idcode, []).append(message)
    return streams


def compare(case: Case, before: Sequence[Message], after: Sequence[Message], *, exact: bool = True) -> None:
    """Stream by stream: bytes (of a configuration: its content), times and flows, as far as the case keeps them."""
    expected, found = by_stream(keep(case, before)), by_stream(after)
    assert found.keys() == expected.keys()
    for idcode, messages in expected.items():
        assert len(found[idcode]) == len(messages)
        for old, new in zip(messages, found[idcode], strict=True):
            assert new.frame.type is old.frame.type
            if old.frame.type.is_config and "repeats" in case.loses:
                assert "bytes" in case.loses or new.config == old.config
                continue
            if exact and "bytes" not in case.loses:
                assert new.frame.data == old.frame.data
            if "arrival" not in case.loses:
                assert new.frame.arrival_ns == old.frame.arrival_ns
            if "stamp source" not in case.loses and not old.frame.type.is_config:
                assert new.frame.stamp_source is old.frame.stamp_source
            if "flow" not in case.loses:
                assert new.flow == old.flow


def columns(path: Path) -> dict[int, Batch]:
    """Each stream's numbers, all its blocks together."""
    parts: dict[int, list[Batch]] = {}
    for block in blocks_of(open_source(path)):
        parts.setdefault(block.batch.config.idcode, []).append(block.batch)
    return {idcode: joined(batches) for idcode, batches in parts.items() if len({b.config for b in batches}) == 1}


def same_values(before: Batch, after: Batch) -> None:
    for name in ("time_ns", "time_quality", "stat", "digitals", "valid"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    for name in ("frequency", "rocof", "analogs"):
        assert np.array_equal(getattr(before, name), getattr(after, name), equal_nan=True), name
    assert np.array_equal(np.isnan(before.phasors), np.isnan(after.phasors))
    assert np.nanmax(np.abs(after.phasors - before.phasors) - 1e-14 * np.abs(before.phasors), initial=0) <= 0


@every_format
def test_streams_come_back(case: Case, tmp_path: Path) -> None:
    before = recording()
    path = tmp_path / f"recording{case.suffix}"
    paths = write(path, before, **case.options)
    assert all(each.exists() for each in paths)
    assert written(path).exists()
    # FORMAT 0b1110 in the polar table: values, not bytes (declared in the formats' own text)
    compare(case, before, read(written(path)), exact=case.options.get("phasors") != "polar")


@every_format
def test_values_come_back(case: Case, tmp_path: Path) -> None:
    path, reference = tmp_path / f"recording{case.suffix}", tmp_path / "reference.pcap"
    write(path, recording(), **case.options)
    write(reference, recording())
    expected, found = columns(reference), columns(written(path))
    assert found.keys() == expected.keys() == {7, 60}
    for idcode, batch in expected.items():
        same_values(batch, found[idcode])
        assert [s.name for s in found[idcode].config.stations] == [s.name for s in batch.config.stations]
        assert found[idcode].config.rate == batch.config.rate


@pytest.mark.parametrize("name", REAL_CAPTURES)
@every_format
def test_real_captures(case: Case, name: str, tmp_path: Path) -> None:
    """Every frame of the real captures, byte for byte where the format has bytes; tables have the values at least."""
    source = capture_path(name)
    before, path = read(source), tmp_path / f"capture{case.suffix}"
    write(path, before, **case.options)
    after = read(path)
    compare(case, before, after, exact=case.options.get("phasors") != "rect")
    same_values(columns(source)[REAL_CAPTURES[name].idcode], columns(path)[REAL_CAPTURES[name].idcode])
    assert len(data_of(after)) == REAL_CAPTURES[name].data


@every_format
def test_unknown_arrivals_stay_unknown(case: Case, tmp_path: Path) -> None:
    """A .pcap alone must have a time: it has that of the stamps."""
    stream = random_stream(random.Random(5), formats=[0b1110], frames=5, idcode=9, time_base=1000)
    path = tmp_path / f"recording{case.suffix}"
    write(path, messages_of(stream, first_ns=None), **case.options)
    arrivals = [message.frame.arrival_ns for message in read(path) if message.frame.type is FrameType.DATA]
    if ".pcap" in case.suffix and ".pcapng" not in case.suffix:
        assert arrivals == [item["time_ns"] for item in stream.expected_data()]
    else:
        assert arrivals == [None] * 5


@every_format
def test_empty_file_is_one_line(case: Case, tmp_path: Path) -> None:
    path = tmp_path / f"nothing{case.suffix}"
    path.write_bytes(b"")
    with pytest.raises(SourceError, match="empty"):
        open_source(path)


@every_format
def test_a_cut_file_gives_what_was_before_the_cut(case: Case, tmp_path: Path) -> None:
    """Or one line that says why not. Nothing is made up, and what is missing is told."""
    before = recording(second=False)
    whole, cut = tmp_path / f"whole{case.suffix}", tmp_path / f"cut{case.suffix}"
    write(whole, before, **case.options)
    content, expected = whole.read_bytes(), data_of(read(whole))
    for size in np.linspace(1, len(content) - 1, 40).astype(int).tolist():
        cut.write_bytes(content[:size])
        try:
            source = open_source(cut)
            found = data_of(item for item in source.items() if isinstance(item, Message))
        except SourceError as error:
            assert "\n" not in str(error)
            assert str(cut) in str(error)
            continue
        if "bytes" in case.loses:  # the last row may have lost digits
            found = found[:-1]
        assert found == expected[: len(found)]
        if len(found) < len(expected) - 1 and source.kind in ("mcap", "arrow"):
            assert source.defects()


@every_format
def test_damage_never_escapes_as_anything_but_a_source_error(case: Case, tmp_path: Path) -> None:
    rng = random.Random(case.suffix)
    path = tmp_path / f"recording{case.suffix}"
    write(path, recording(second=False), **case.options)
    content = path.read_bytes()
    for _ in range(40):
        damaged = bytearray(content)
        for _ in range(rng.choice((1, 3, 30))):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            source = open_source(path)
            for item in source.items():
                assert item
            source.defects()
        except PmuError as error:
            assert "\n" not in str(error)


@every_format
def test_what_was_flushed_can_be_read(case: Case, tmp_path: Path) -> None:
    before, path = recording(second=False), tmp_path / f"recording{case.suffix}"
    half = len(before) // 2
    with open_sink(path, **case.options) as sink:
        pour(sink, before[:half])
        sink.flush()
        snapshot = tmp_path / f"snapshot{case.suffix}"
        shutil.copy(path, snapshot)
        pour(sink, before[half:])
    if "until closed" in case.loses:
        with pytest.raises(SourceError, match="killed"):
            open_source(snapshot)
        return
    found = data_of(item for item in open_source(snapshot).items() if isinstance(item, Message))
    assert found == data_of(read(path))[: half - 1]


def pour(sink: Any, messages: Sequence[Message]) -> None:
    from pmutools.formats.source import gather

    for item in gather(messages) if sink.wants == "blocks" else messages:
        sink.write(item)


@every_format
def test_a_full_disk_is_one_line(case: Case, tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    path = tmp_path / f"recording{case.suffix}"
    path.symlink_to("/dev/full")
    before = recording(second=False)
    with pytest.raises(SourceError, match=f"{path}.*No space left"), open_sink(path, **case.options) as sink:
        for _ in range(200):
            pour(sink, before)


@every_format
def test_a_place_that_cannot_be_written(case: Case, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="nowhere"):
        open_sink(tmp_path / "nowhere" / f"recording{case.suffix}", **case.options)


def test_losses_are_all_declared() -> None:
    assert set().union(*(case.loses for case in CASES)) <= LOSSES.keys()
