"""The four-header-row CSV of the oscillation test-case library, and its untidy relatives."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from support.recordings import blocks_of, read

from pmutools.c37118 import Format
from pmutools.c37118.batch import Batch
from pmutools.errors import SourceError
from pmutools.formats import open_source
from pmutools.formats.ieee_csv import DEFAULT_START_NS
from pmutools.timebase import NS, parse_utc

START = parse_utc("2016-06-17T13:00:00Z")
TWO_LINES = """\
Time,Sub:1:Ln:1,Sub:1:Ln:1,Sub:1:Ln:1,Sub:1:Ln:1,Sub:1:Ln:1,Sub:2:Gen:G1,Sub:2:Gen:G1,Sub:2:Gen:G1
T,F,VM,VA,IM,IA,F,VM,VA
Sec,Hz,kV,Deg,A,Deg,HZ,KV,DEG
2016-06-17 13:00:00,Ln:1,Ln:1,Ln:1,Ln:1,Ln:1,Gen,Gen,Gen
0.000000,60.01,200.5,30,100,-150,59.99,199,0
0.033333,60.02,200.6,31,101,-149,59.98,198,1
0.066667,60.03,200.7,32,102,-148,59.97,197,2
"""


def batch_in(path: Path, text: str) -> tuple[Batch, dict[str, int]]:
    path.write_text(text)
    source = open_source(path)
    (block,) = blocks_of(source)
    assert source.kind == "ieee-csv"
    return block.batch, source.defects()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ISO-NE_case1.csv"


def test_lines_become_stations_of_one_stream(path: Path) -> None:
    batch, defects = batch_in(path, TWO_LINES)
    config = batch.config
    assert defects == {}
    assert [s.name for s in config.stations] == ["Sub:1:Ln:1", "Sub:2:Gen:G1"]
    assert [[(p.name, p.kind) for p in s.phasors] for s in config.stations] == [[("V", "V"), ("I", "I")], [("V", "V")]]
    assert all(s.format == Format(15) and s.fnom_hz == 60 for s in config.stations)
    assert (config.data_rate, config.time_base) == (30, 1_000_000)
    assert batch.time_ns.tolist() == [START, START + 33_333_000, START + 66_667_000]
    assert batch.frequency.tolist() == [[60.01, 59.99], [60.02, 59.98], [60.03, 59.97]]
    assert np.abs(batch.phasors[0]).tolist() == pytest.approx([200_500, 100, 199_000])
    assert np.degrees(np.angle(batch.phasors[:, 1])).tolist() == pytest.approx([-150, -149, -148])
    assert batch.valid.all()


def test_its_frames_can_be_played(path: Path) -> None:
    path.write_text(TWO_LINES)
    messages = read(path)
    assert len(messages) == 4
    assert messages[0].config is not None
    assert {len(message.frame.data) for message in messages[1:]} == {messages[0].config.frame_size}


@pytest.mark.parametrize(("unit", "factor"), [("V", 1.0), ("KV", 1e3), ("kv", 1e3), ("", 1.0), ("pu", 1.0)])
def test_units_of_voltage(unit: str, factor: float, path: Path) -> None:
    batch, _ = batch_in(path, f"Time,A,A\nT,VM,VA\nSEC,{unit},RAD\n0,2.5,{math.pi / 2}\n1,2.5,0\n")
    assert batch.phasors[0, 0] == pytest.approx(2.5j * factor)
    assert np.isnan(batch.frequency).all()


@pytest.mark.parametrize(
    ("unit", "cell", "expected"), [("mHz", "59990", 59.99), ("mHz", "-10", 59.99), ("Hz", "0.5", 60.5)]
)
def test_frequency_in_millihertz_and_as_a_deviation(unit: str, cell: str, expected: float, path: Path) -> None:
    batch, _ = batch_in(path, f"Time,A\nT,F\nSec,{unit}\n0,{cell}\n0.1,{cell}\n")
    assert batch.frequency[:, 0].tolist() == pytest.approx([expected] * 2)


@pytest.mark.parametrize(
    "cell",
    ["2016-06-17 13:00:00", "6/17/2016 13:00", "06/17/2016 1:00:00 PM", "17-Jun-2016 13:00:00", "2016-06-17T13:00:00Z"],
)
def test_dates(cell: str, path: Path) -> None:
    batch, _ = batch_in(path, f"Time,A\nT,F\nSec,Hz\n{cell},Ln:1\n0,60\n2.5,60\n")
    assert batch.time_ns.tolist() == [START, START + 2_500_000_000]


@pytest.mark.parametrize(
    ("row", "first", "expected"),
    [
        ("Ln:x,Ln:1\n", "0.5", DEFAULT_START_NS + NS // 2),
        ("1900-01-01 00:00:00,Ln:1\n", "0", DEFAULT_START_NS),
        ("", "0", DEFAULT_START_NS),
        (",Ln:1\n", "1466168400.25", START + NS // 4),
        ("", "2016-06-17 13:00:00.5", START + NS // 2),
    ],
)
def test_times_without_a_date(row: str, first: str, expected: int, path: Path) -> None:
    batch, _ = batch_in(path, f"Time,A\nT,F\nSec,Hz\n{row}{first},60\n")
    assert batch.time_ns[0] == expected


def test_untidy_rows_are_read_and_counted(path: Path) -> None:
    text = (
        "Time , A ,A,A,,\r\n T,f,vm,va,,\r\nsec , hz,kV,deg,,\r\n\r\n"
        "0,60,1,0,,\r\n0.1, ,1,\r\n0.2,60,#VALUE!,0,7\r\n,60,1,0\r\n0.4,60,1,0,,\r\n"
    )
    batch, defects = batch_in(path, text)
    assert batch.time_ns.tolist() == [DEFAULT_START_NS + k * NS // 10 for k in (0, 1, 2, 4)]
    assert np.isnan(batch.frequency[:, 0]).tolist() == [False, True, False, False]
    assert np.isnan(batch.phasors[:, 0]).tolist() == [False, True, True, False]
    assert batch.stat[:, 0].tolist() == [0, 0x8000, 0, 0]
    assert defects == {"ragged rows": 1, "unreadable cells": 1, "rows without a time": 1}


def test_pairs_by_label_and_columns_without_a_partner(path: Path) -> None:
    text = (
        "Time,S,S,S,S,S,S,S,S,S\nT,IM,VA,F,IM,VM,IA,IA,P,VM\nSec,A,Deg,Hz,A,kV,Deg,Deg,MW,kV\n"
        ",Ln:1,Bus,Bus,Ln:2,Bus,Ln:2,Ln:1,Ln:1,Spare\n0,10,1,60,20,230,22,11,5,9\n"
    )
    batch, _ = batch_in(path, text)
    (station,) = batch.config.stations
    assert [(p.name, p.kind) for p in station.phasors] == [("I Ln:1", "I"), ("I Ln:2", "I"), ("V", "V")]
    assert np.abs(batch.phasors[0]).tolist() == pytest.approx([10, 20, 230e3])
    assert np.degrees(np.angle(batch.phasors[0])).tolist() == pytest.approx([11, 22, 1])
    assert [a.name for a in station.analogs] == ["P Ln:1", "VM Spare"]
    assert batch.analogs[0].tolist() == [5, 9e3]


def test_a_name_with_several_frequencies_is_several_stations(path: Path) -> None:
    text = "Time,S,S,S,S,S,S\nT,F,VM,VA,F,VM,VA\nSec,Hz,V,Deg,Hz,V,Deg\n,a,a,a,b,b,b\n0,60,1,0,61,2,0\n"
    batch, _ = batch_in(path, text)
    assert [s.name for s in batch.config.stations] == ["S a", "S b"]
    assert batch.frequency.tolist() == [[60, 61]]
    assert batch.phasors.tolist() == [[1, 2]]


def test_names_that_end_in_their_kind_and_kinds_of_jsis(path: Path) -> None:
    text = (
        "Time,Bus1_VMP,Bus1_VAP,Bus1_F,Bus1_IPM,Bus1_IPA,Bus1_DF\nT,VMP,VAP,F,IPM,IPA,DF\n"
        "Sec,kV,Deg,Hz,A,Deg,Hz/s\n0,1,0,50,3,0,0.5\n"
    )
    batch, _ = batch_in(path, text)
    (station,) = batch.config.stations
    assert (station.name, station.fnom_hz) == ("Bus1", 50)
    assert [p.name for p in station.phasors] == ["V", "I"]
    assert batch.rocof.tolist() == [[0.5]]


def test_many_rows_come_in_blocks(path: Path) -> None:
    rows = "".join(f"{k / 30:.6f},60,{k}\n" for k in range(20_000))
    path.write_text("Time,A,A\nT,F,P\nSec,Hz,MW\n" + rows)
    blocks = blocks_of(open_source(path))
    assert len(blocks) > 1
    assert np.concatenate([block.batch.analogs[:, 0] for block in blocks]).tolist() == list(range(20_000))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("Time,A\nT,F\nSec,RPM\n0,60\n", r":3: column 2 \(F\) has unit 'RPM'; use one of hz, mhz"),
        ("Time,A\nT,F\nSec,Hz\n", "no rows of numbers"),
        ("Time,A\nT,F\nSec,Hz\nLn:x,Ln:1\nnone,60\n", "no rows of numbers"),
    ],
)
def test_what_cannot_be_read_says_where(text: str, problem: str, path: Path) -> None:
    path.write_text(text)
    with pytest.raises(SourceError, match=problem) as raised:
        open_source(path)
    assert str(path) in str(raised.value)
