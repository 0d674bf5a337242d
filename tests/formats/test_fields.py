"""Columns chosen and ordered by the user: in every format of tables, in both forms, and what of it plays back."""

from __future__ import annotations

import csv
import random
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from support.frames import random_stream
from support.recordings import blocks_of, messages_of, read, write

from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Flow
from pmutools.formats import open_sink, open_source
from pmutools.formats.columns import FRAME_COLUMNS, columns_of
from pmutools.formats.fields import Fields, no_such_column, parse_fields
from pmutools.formats.source import gather
from pmutools.formats.table_rows import LongRows, names_of, wide_rows

NAMES = (*FRAME_COLUMNS, "N1.freq_hz", "N1.V1.mag", "N1.V[A].mag", "S1.freq_hz")
STREAM = random_stream(random.Random(7), formats=[0b1110], idcode=7, data_rate=50, time_base=1_000_000, frames=20)
MESSAGES = messages_of(STREAM)
CONFIG = MESSAGES[0].config
assert CONFIG is not None
OWN = [column.name for column in columns_of(CONFIG, "polar")]


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("time", ["time_ns"]),
        ("time_ns", ["time_ns"]),
        ("S1.freq_hz,time", ["S1.freq_hz", "time_ns"]),
        ("*.freq_hz", ["N1.freq_hz", "S1.freq_hz"]),
        ("S1.*, *", ["S1.freq_hz", *[name for name in NAMES if name != "S1.freq_hz"]]),
        ("N1.V[A].mag", ["N1.V[A].mag"]),
        ("N1.V[1].mag", ["N1.V1.mag"]),
        ("?1.freq_hz", ["N1.freq_hz", "S1.freq_hz"]),
        ("nothing", []),
    ],
)
def test_what_a_list_chooses(text: str, chosen: list[str]) -> None:
    assert list(parse_fields(text).chosen(NAMES)) == chosen


def test_a_list_that_is_none() -> None:
    for text in ("", " ", "a,,b"):
        with pytest.raises(ValueError, match=r"names no column|empty item"):
            parse_fields(text)


def test_items_that_fit_nothing_and_what_may_be_meant() -> None:
    fields = parse_fields("time,N1.frq_hz,*.freq_hz,Z*")
    assert fields.unknown(NAMES) == ("N1.frq_hz", "Z*")
    assert no_such_column("N1.frq_hz", NAMES).startswith("no column fits 'N1.frq_hz'; did you mean 'N1.freq_hz'")
    assert no_such_column("Q", NAMES) == "no column fits 'Q'; there are N1.freq_hz, N1.V1.mag, N1.V[A].mag, S1.freq_hz"


def columns_in(path: Path) -> list[str]:
    if path.suffix == ".csv":
        return next(csv.reader(path.open()))
    if path.suffix == ".parquet":
        return list(parquet.read_schema(path).names)
    return list(pa.ipc.open_file(path).schema.names)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".arrow"])
def test_files_have_these_columns_in_this_order(suffix: str, tmp_path: Path) -> None:
    wanted = [OWN[1], "time_ns", *OWN[3:5], "idcode"]
    (path,) = write(tmp_path / f"a{suffix}", MESSAGES, fields=Fields(tuple(wanted)))
    shown = ["time" if name == "time_ns" and suffix == ".csv" else name for name in wanted]
    assert columns_in(path) == shown
    (whole,) = write(tmp_path / f"b{suffix}", MESSAGES)
    one, other = (blocks_of(open_source(each))[0].batch for each in (path, whole))
    assert one.time_ns.tolist() == other.time_ns.tolist()
    assert np.array_equal(one.frequency, other.frequency, equal_nan=True)
    assert one.config.idcode == other.config.idcode == 7


def test_without_a_time_nothing_plays_back(tmp_path: Path) -> None:
    (path,) = write(tmp_path / "a.parquet", MESSAGES, fields=Fields((OWN[1],)))
    assert parquet.read_table(path).num_rows == 20
    with pytest.raises(SourceError, match="no column time_ns"):
        open_source(path)


def test_without_an_idcode_it_is_the_configurations(tmp_path: Path) -> None:
    for suffix in (".parquet", ".arrow"):
        (path,) = write(tmp_path / f"a{suffix}", MESSAGES, fields=Fields(("time_ns", "*.freq_hz")))
        assert {message.frame.idcode for message in read(path)} == {7}


def test_a_stream_with_none_of_them_is_left_out(tmp_path: Path) -> None:
    other = messages_of(
        random_stream(random.Random(8), formats=[0b1110], idcode=8, data_rate=50, time_base=1000, frames=5),
        flow=Flow("udp", "192.0.2.12:1", "192.0.2.1:1"),
    )
    names = set(names_of(CONFIG, "polar")) - set(FRAME_COLUMNS)
    assert other[0].config is not None
    only = sorted(names - set(names_of(other[0].config, "polar")))
    paths = write(tmp_path / "a.csv", [*MESSAGES, *other], fields=Fields(("time_ns", *only)))
    assert paths == [tmp_path / "a.csv"]


def test_columns_of_the_frame_alone_are_had_of_every_stream(tmp_path: Path) -> None:
    (path,) = write(tmp_path / "a.csv", MESSAGES, fields=parse_fields("time,arrival_ns"))
    assert columns_in(path) == ["time", "arrival_ns"]


def test_long_form_has_the_values_of_these_columns(tmp_path: Path) -> None:
    fields = parse_fields("*.freq_hz,*.stat")
    (path,) = write(tmp_path / "a.parquet", MESSAGES, fields=fields, long=True)
    table = parquet.read_table(path)
    assert set(table["quantity"].to_pylist()) == {"freq_hz", "stat"}
    assert table.num_rows == 40
    assert columns_in(path)[:5] == list(FRAME_COLUMNS)


@pytest.mark.parametrize("options", [{"fields": parse_fields("time")}, {"long": True}])
def test_whole_frames_have_no_columns_to_choose(options: dict[str, Any], tmp_path: Path) -> None:
    for suffix in (".pcap", ".c37118", ".mcap", ".jsonl"):
        with pytest.raises(SettingsError, match=r"holds whole frames; fields and long form are for \.parquet, \.arrow"):
            open_sink(tmp_path / f"a{suffix}", **options)
        assert not list(tmp_path.iterdir())


def test_rows_of_many_streams_are_those_of_each(tmp_path: Path) -> None:
    """Long form made of several streams at once, of unlike width."""
    streams = [
        random_stream(random.Random(k), stations=k, idcode=k, data_rate=50, time_base=1000, frames=4) for k in (1, 2, 3)
    ]
    batches = [block.batch for stream in streams for block in gather(messages_of(stream)) if hasattr(block, "batch")]
    for packed in (False, True):
        together = LongRows("polar", packed=packed).rows(batches).to_pylist()
        apart = [row for batch in batches for row in LongRows("polar", packed=packed).rows([batch]).to_pylist()]
        assert repr(together) == repr(apart)  # NaN is itself


def test_each_value_of_long_form_is_that_of_the_wide_table() -> None:
    (batch,) = [block.batch for block in gather(MESSAGES) if hasattr(block, "batch")]
    wide, rows = wide_rows(batch, "rect"), LongRows("rect").rows([batch]).to_pylist()
    for column in columns_of(batch.config, "rect"):
        values = [
            row["value"] for row in rows if (row["station"], row["channel"] or "", row["quantity"]) == column[1:4]
        ]
        assert repr(values) == repr([float(value) for value in wide.column(column.name).to_pylist()])
