"""CSV tables: the text itself, files made by hand, and what is inferred from them."""

from __future__ import annotations

import gzip
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.captures import capture_path
from support.recordings import blocks_of, read, write

from pmutools.c37118 import Format, FrameType, decode_config
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.errors import SourceError
from pmutools.formats import open_source
from pmutools.formats.infer import STANDARD_RATES, data_rate_of, nominal_hz_of
from pmutools.timebase import NS, from_ns, parse_utc, slot_time_ns, to_ns

HEAD = "time,arrival_ns,stamp_source,idcode,time_quality"
ROW = "2016-09-08T17:05:11.{:09d}Z,,capture,7,0"


def table(path: Path, columns: str, *cells: str, head: str = HEAD, step_ns: int = 20_000_000) -> Path:
    """A CSV of one row a string of cells, 50 a second."""
    rows = [f"{ROW.format(number * step_ns)},{cell}" for number, cell in enumerate(cells)]
    path.write_text("\n".join([f"{head},{columns}", *rows, ""]))
    return path


def batch_in(path: Path) -> Batch:
    (block,) = blocks_of(open_source(path))
    return block.batch


# --- the text ---------------------------------------------------------------------------------------------------


def test_text_of_a_real_recording(tmp_path: Path) -> None:
    (path,) = write(tmp_path / "out.csv", read(capture_path("C37.118_1PMU_UDP.pcap")))
    header, first = path.read_text().splitlines()[:2]
    assert header == (
        "time,arrival_ns,stamp_source,idcode,time_quality,PMU1.stat,PMU1.freq_hz,PMU1.rocof_hz_s,"
        "PMU1.VA.mag,PMU1.VA.deg,PMU1.VB.mag,PMU1.VB.deg,PMU1.VC.mag,PMU1.VC.deg,PMU1.WORD1"
    )
    assert first.startswith(
        "2008-08-01T16:18:11.580000000Z,1218023578629213000,capture,60,0,0,50,0,100.07758331298828,-89.8022"
    )


def test_names_with_commas_and_absent_values(tmp_path: Path) -> None:
    source = table(tmp_path / "a.csv", '"A, B.freq_hz","A, B.V.mag","A, B.V.deg"', "50.5,,", ",1,90")
    (path,) = write(tmp_path / "b.csv", open_source(source).blocks())
    assert path.read_text().splitlines() == [
        f'{HEAD},"A, B.stat","A, B.freq_hz","A, B.rocof_hz_s","A, B.V.mag","A, B.V.deg"',
        "2016-09-08T17:05:11.000000000Z,,capture,7,0,0,50.5,,,",
        "2016-09-08T17:05:11.020000000Z,,capture,7,0,0,,,1,90",
    ]


# --- files made by hand -----------------------------------------------------------------------------------------


def test_configuration_is_inferred(tmp_path: Path) -> None:
    columns = "N1.stat,N1.freq_hz,N1.VA.mag,N1.VA.deg,N1.IA.mag,N1.IA.deg,N1.P,N1.WORD1"
    path = table(tmp_path / "a.csv", columns, *["0,49.99,230e3,0,100,-30,5.5,3"] * 4)
    opening, *_ = open_source(path).items()
    assert opening.frame.type is FrameType.CFG2  # type: ignore[union-attr]
    config = decode_config(opening.frame.data)[1]  # type: ignore[union-attr]
    (station,) = config.stations
    assert (config.idcode, config.time_base, config.data_rate) == (7, 1_000_000, 50)
    assert (station.name, station.idcode, station.format, station.fnom_hz) == ("N1", 7, Format(15), 50.0)
    assert [(p.name, p.kind) for p in station.phasors] == [("VA", "V"), ("IA", "I")]
    assert [a.name for a in station.analogs] == ["P"]
    assert all(0 < len(label) <= 16 for label in station.digitals[0].labels)


def test_rectangular_columns_make_a_rectangular_format(tmp_path: Path) -> None:
    batch = batch_in(table(tmp_path / "a.csv", "N1.V.re,N1.V.im", "3,4", "5,-12"))
    assert batch.config.stations[0].format == Format(14)
    assert batch.phasors[:, 0].tolist() == [3 + 4j, 5 - 12j]


def test_plain_file_of_a_spreadsheet(tmp_path: Path) -> None:
    """Byte order mark, blanks around cells, CRLF, a blank line, trailing commas, other spellings of time."""
    path = tmp_path / "bus7.csv"
    path.write_bytes(
        "\ufefftime, freq_hz, V.mag, V.deg,,\r\n"
        "2016-09-08 17:05:11,60.01, 1.5 ,90,,\r\n\r\n"
        "2016-09-08T17:05:11.1+00:00,60.02,1.5,-90,,\r\n".encode()
    )
    source = open_source(path)
    (block,) = blocks_of(source)
    assert source.defects() == {}
    batch = block.batch
    assert batch.config.stations[0].name == "bus7"
    assert batch.config.data_rate == 10
    assert batch.time_ns.tolist() == [parse_utc("2016-09-08T17:05:11Z"), parse_utc("2016-09-08T17:05:11.1Z")]
    assert batch.phasors[:, 0].tolist() == [1.5j, -1.5j]
    assert batch.arrival_ns.tolist() == [NO_TIME] * 2


def test_bad_cells_and_rows_are_counted(tmp_path: Path) -> None:
    rows = ["60,1", "sixty,2", "60,3,9", "60", "60,5"]
    path = table(tmp_path / "a.csv", "N1.freq_hz,N1.P", *rows)
    path.write_text(path.read_text() + "yesterday,,capture,7,0,60,6\n")
    source = open_source(path)
    (block,) = blocks_of(source)
    assert block.batch.analogs[:, 0].tolist() == [1, 2, 3, 5]
    assert np.isnan(block.batch.frequency[1, 0])
    assert source.defects() == {"ragged rows": 2, "unreadable cells": 1, "rows without a time": 1}


def test_rows_of_several_idcodes_are_several_streams(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "N1.freq_hz", "60", "61", "62")
    path.write_text(path.read_text().replace(".020000000Z,,capture,7", ".020000000Z,,capture,8"))
    batches = {block.batch.config.idcode: block.batch for block in blocks_of(open_source(path))}
    assert batches[7].frequency[:, 0].tolist() == [60, 62]
    assert batches[8].frequency[:, 0].tolist() == [61]


def test_a_saved_configuration_is_used(tmp_path: Path) -> None:
    """Then frames come back byte for byte even from a CSV."""
    before = read(capture_path("c37_1100_fullclean.pcap"))
    config = next(message.config for message in before if message.frame.type is FrameType.CFG2)
    assert config is not None
    (path,) = write(tmp_path / "a.csv", before)
    after = read(path, [config])
    assert after[0].config == config
    data = [message.frame.data for message in before if message.frame.type is FrameType.DATA]
    assert [message.frame.data for message in after[1:]] == data


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "empty"),
        ("\n\n", "empty"),
        ("a,b,c\n1,2,3\n", ":1: no column time"),
        (f"{HEAD},N1.freq_hz\n", "no rows"),
        (f"{HEAD},N1.freq_hz\nx,,capture,1,0,60\n", r"no rows of measurements \(rows without a time: 1\)"),
        ("time,comment\n2016-09-08T17:05:11Z,hello\n", "no columns of measurements"),
        ('time,"freq_hz\n2016-09-08T17:05:11Z,"60' + "x" * 200_000, "field larger"),
    ],
)
def test_what_cannot_be_read_says_why(text: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(SourceError, match=problem) as raised:
        list(open_source(path).items())
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_cut_compression_gives_the_rows_before_the_cut(tmp_path: Path) -> None:
    plain = table(tmp_path / "a.csv", "N1.freq_hz", *[f"{60 + k / 1000}" for k in range(5000)], step_ns=100_000)
    path = tmp_path / "a.csv.gz"
    content = gzip.compress(plain.read_bytes())
    path.write_bytes(content[: len(content) // 2])
    source = open_source(path)
    rows = sum(len(block.batch) for block in blocks_of(source))
    assert 1000 < rows < 4000
    assert source.defects()["compression damaged"] == 1


# --- rates ------------------------------------------------------------------------------------------------------


@given(st.sampled_from(STANDARD_RATES), st.integers(2, 300), st.sampled_from([1000, 1_000_000, 0xFFFFFF]))
def test_standard_rates_are_found_from_rounded_stamps(rate: int, count: int, time_base: int) -> None:
    times = [slot_time_ns(1_473_354_311 * rate + k, Fraction(rate)) for k in range(count)]
    stamps = [to_ns(*from_ns(time, time_base), time_base) for time in times]
    assert data_rate_of(np.array(stamps)) == rate or (time_base == 1000 and rate > 100 and count < 12)


@given(st.integers(2, 300), st.integers(3, 100))
def test_gaps_repeats_and_slow_streams_do_not_mislead(period_s: int, count: int) -> None:
    times = np.arange(count) * period_s * NS
    assert data_rate_of(times) == -period_s
    assert data_rate_of(np.concatenate((times, times))) == -period_s
    assert data_rate_of(np.array([5, 5, 5])) is None


def test_nominal_frequency() -> None:
    assert nominal_hz_of(np.array([np.nan, 49.2]), 60) == 50
    assert nominal_hz_of(np.array([59.0, 61.0]), 50) == 60
    assert nominal_hz_of(np.array([49.9, 65.536, 65.536]), 50) == 50
    assert nominal_hz_of(np.array([np.nan]), 25) == 50
    assert nominal_hz_of(np.empty(0), None) == 60
