"""JSON lines, as ``pmu dump --json`` prints them, made frames again."""

from __future__ import annotations

import gzip
import json
import random
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.frames import Described, random_stream, streams
from support.recordings import blocks_of, data_of, messages_of, read

from pmutools.c37118 import Message
from pmutools.c37118.session import served
from pmutools.errors import PmuError, SettingsError, SourceError
from pmutools.formats import open_source
from pmutools.formats.describe import describe
from pmutools.formats.source import gather

OPTIONS: dict[str, Any] = {"time_base": 1_000_000, "data_rate": 50, "idcode": 7}


def lines_of(messages: Iterable[Message]) -> list[str]:
    return [json.dumps(describe(message)) for message in messages]


def dumped(path: Path, messages: Iterable[Message]) -> Path:
    content = "\n".join(lines_of(messages)).encode() + b"\n"
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    return path


@given(stream=streams(frames=3, scaled_floats=False, **OPTIONS), kind=st.sampled_from(["cfg2", "cfg3"]))
@settings(max_examples=60, deadline=None)
def test_frames_come_back(stream: Described, kind: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    """The configuration, and the numbers; PHSCALE's user byte is not printed, -0 and NaN have no payload."""
    path = tmp_path_factory.mktemp("jsonl") / "a.jsonl"
    messages = messages_of(stream, kind)
    source = open_source(dumped(path, messages))
    (after,) = blocks_of(source)
    (before,) = [item for item in gather(messages) if not isinstance(item, Message)]
    one, other = before.batch, after.batch
    assert (source.kind, source.defects()) == ("jsonl", {})
    if kind == "cfg2":
        assert other.config == one.config
    assert other.config.frame_size == one.config.frame_size
    for name in ("time_ns", "arrival_ns", "time_quality", "stat", "digitals", "valid"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    for name in ("phasors", "frequency", "rocof", "analogs"):
        assert np.allclose(getattr(one, name), getattr(other, name), rtol=1e-12, atol=0, equal_nan=True), name
    served(other.config)


@pytest.mark.parametrize("suffix", [".jsonl", ".JSONL", ".jsonl.gz"])
def test_integers_come_back_byte_for_byte(suffix: str, tmp_path: Path) -> None:
    candidates = (random_stream(random.Random(seed), formats=[0, 0], **OPTIONS) for seed in range(200))
    stream = next(
        stream
        for stream in candidates
        if all(phasor.phunit & 0xFFFFFF for station in stream.spec.stations for phasor in station.phasors)
    )
    path = dumped(tmp_path / f"a{suffix}", messages_of(stream))
    assert data_of(read(path)) == list(stream.data)


def test_several_streams_and_a_changed_configuration(tmp_path: Path) -> None:
    options: dict[str, Any] = {"time_base": 1000, "data_rate": 50}
    one = messages_of(random_stream(random.Random(1), formats=[0b1110], frames=9, idcode=7, **options))
    two = messages_of(random_stream(random.Random(2), formats=[0b1110], frames=5, idcode=8, **options))
    new = messages_of(random_stream(random.Random(3), stations=2, frames=4, idcode=7, **options))
    blocks = blocks_of(open_source(dumped(tmp_path / "a.jsonl", [*one, *two, *new])))
    assert [(block.batch.config.idcode, len(block.batch)) for block in blocks] == [(7, 9), (8, 5), (7, 4)]
    assert blocks[2].batch.config == new[0].config


def bare(number: int, **more: Any) -> str:
    """A data object with what the data model names, of a program that is not ours."""
    station = {
        "name": "Umspannwerk Köln-Nord",
        "stat": 0,
        "phasors": [
            {"name": "V1", "kind": "V", "re": 100.0 + number, "im": None},
            {"name": "V1", "kind": "I", "re": 1, "im": 2},
        ],
        "frequency": 50.01,
        "rocof": None,
        "analogs": [1.5],
        "digitals": [3],
    }
    time_ns = 1_700_000_000 * 10**9 + number * 40_000_000
    return json.dumps({"type": "data", "idcode": 9, "time_ns": time_ns, "stations": [station]} | more)


def test_without_a_configuration_one_is_inferred(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text("\n".join(bare(number) for number in range(5)))
    (block,) = blocks_of(open_source(path))
    batch, config = block.batch, block.batch.config
    (station,) = config.stations
    assert (config.idcode, config.data_rate, station.fnom_hz) == (9, 25, 50.0)
    assert len(station.name.encode()) <= 16
    assert [(p.name, p.kind) for p in station.phasors] == [("V1", "V"), ("V1#2", "I")]
    assert batch.phasors[:, 1].tolist() == [1 + 2j] * 5
    assert np.isnan(batch.phasors[:, 0]).all()
    assert np.isnan(batch.rocof).all()
    assert (batch.analogs[0, 0], batch.digitals[0, 0]) == (1.5, 3)
    served(config)
    (block,) = blocks_of(open_source(path, data_rate=50, fnom_hz=60))
    assert (block.batch.config.data_rate, block.batch.config.stations[0].fnom_hz) == (50, 60.0)


def test_a_rate_is_not_chosen_where_there_is_one(tmp_path: Path) -> None:
    path = dumped(tmp_path / "a.jsonl", messages_of(random_stream(random.Random(1), **OPTIONS)))
    with pytest.raises(SettingsError, match="brings its configuration"):
        open_source(path, data_rate=25)


def test_lines_that_are_no_objects_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    wrong = json.loads(bare(3))
    wrong["stations"][0]["analogs"] = ["x"]
    lines = [
        "nonsense",
        "[1]",
        '{"type":"other"}',
        bare(0),
        bare(1, time_ns=None),
        bare(2, idcode=None),
        json.dumps(wrong),
        '{"type":"cfg2","idcode":9}',
        '{"type":"header","text":"x"}',
        bare(4, time_ns=None, time="2023-11-14T22:13:20.16Z"),
        bare(5)[:-9],
    ]
    path.write_text("\n".join(lines))
    source = open_source(path)
    (block,) = blocks_of(source)
    assert len(block.batch) == 2
    assert source.defects() == {
        "lines that are no objects of pmu dump": 4,
        "data without a time or IDCODE": 2,
        "unreadable configurations": 1,
        "data that do not fit their configuration": 1,
    }


def test_nothing_in_it_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text("hello\n")
    with pytest.raises(SourceError, match="holds no data objects") as raised:
        open_source(path)
    assert "\n" not in str(raised.value)


def test_damage_never_escapes(tmp_path: Path) -> None:
    rng = random.Random(1)
    path = dumped(tmp_path / "a.jsonl", messages_of(random_stream(rng, frames=6, **OPTIONS)))
    content = path.read_bytes()
    for _ in range(150):
        damaged = bytearray(content)
        for _ in range(rng.choice((1, 3, 20))):
            damaged[rng.randrange(len(damaged))] = rng.choice(b'0123456789-.eE,:[]{}"anul\n\xff')
        path.write_bytes(damaged[: rng.choice((len(damaged), rng.randrange(len(damaged)) + 1))])
        try:
            source = open_source(path)
            for item in source.items():
                assert item
            source.defects()
        except PmuError as error:
            assert "\n" not in str(error)
