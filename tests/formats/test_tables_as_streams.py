"""Tables that say little: what is made of them is a valid stream, with CFG-2 and CFG-3, and keeps its stamps."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from support.recordings import blocks_of, data_of, read, write

from pmutools.c37118 import FrameType, Message, decode_config
from pmutools.c37118.batch import Batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Demux
from pmutools.c37118.session import served
from pmutools.errors import SettingsError
from pmutools.flow import Chunk, Flow
from pmutools.formats import open_source
from pmutools.timebase import NS, format_utc, parse_utc, to_ns

START = parse_utc("2016-09-08T17:05:11Z")
NAMES = (
    "Näsudden 1",
    "変電所",  # nine bytes
    "Umspannwerk Süd-Ost 110 kV",
    "Umspannwerk Süd-Ost 220 kV",
    "A.B",
    "😀😀😀😀😀",
)
RAGGED_NS = (0, 99_000_000, 203_000_001, 300_999_999, 655_000_000, 700_000_000)


def names_of(config: StreamConfig) -> list[list[str]]:
    """Stations, and each one's phasors and analogs, as name spaces."""
    spaces = [[station.name for station in config.stations]]
    for station in config.stations:
        spaces += [[channel.name for channel in station.phasors], [channel.name for channel in station.analogs]]
    return spaces


def hold_valid(path: Path, batch: Batch) -> None:
    """All three configurations can be made and say the same names; the frames decode under CFG-2 and CFG-3."""
    config = batch.config
    for names in names_of(config):
        assert len(set(names)) == len(names)
        assert all(0 < len(name.encode()) <= 16 for name in names)
    offered = served(config)
    raw = b"".join(data_of(read(path)))
    for kind in (FrameType.CFG2, FrameType.CFG3):
        assert names_of(decode_config(offered.frames[kind])[1]) == names_of(config)
        demux = Demux()
        items = demux.feed(Chunk(offered.frames[kind] + raw, None, Flow("file", "x")))
        assert all(isinstance(item, Message) for item in items)
        assert len(items) == 1 + len(batch)
    assert decode_config(offered.frames[FrameType.CFG1])[1].stations == config.stations


def wide(path: Path, stations: tuple[str, ...], stamps_ns: tuple[int, ...] = RAGGED_NS) -> Path:
    columns = {
        f"{name}.{column}": value
        for name in stations
        for column, value in (
            ("freq_hz", 49.99),
            ("Spannung L1 Sammelschiene 1.mag", 63_500.0),
            ("Spannung L1 Sammelschiene 1.deg", -30.0),
            ("Spannung L1 Sammelschiene 2.mag", 63_400.0),
            ("Spannung L1 Sammelschiene 2.deg", 30.0),
            ("Wirkleistung Δ", 12.5),
            ("WORD1", 5.0),
        )
    }
    if path.suffix == ".csv":
        head = ",".join(["time", *(f'"{name}"' for name in columns)])
        rows = [",".join([format_utc(START + at), *map(str, columns.values())]) for at in stamps_ns]
        path.write_text("\n".join([head, *rows]), encoding="utf-8")
    else:
        import pyarrow as pa
        from pyarrow import parquet

        values = {name: [value] * len(stamps_ns) for name, value in columns.items()}
        parquet.write_table(pa.table({"time_ns": [START + at for at in stamps_ns]} | values), path)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_wide_tables_become_valid_streams(suffix: str, tmp_path: Path) -> None:
    path = wide(tmp_path / f"a{suffix}", NAMES)
    (block,) = blocks_of(open_source(path))
    batch = block.batch
    hold_valid(path, batch)
    stations = batch.config.stations
    assert [station.name for station in stations] == [
        "Näsudden 1",
        "変電所",
        "Umspannwerk Süd",
        "Umspannwerk S#2",
        "A.B",
        "😀😀😀😀",
    ]
    assert [p.name for p in stations[0].phasors] == ["Spannung L1 Samm", "Spannung L1 Sa#2"]
    assert [a.name for a in stations[0].analogs] == ["Wirkleistung Δ"]
    assert np.abs(batch.phasors[0, :2]).tolist() == pytest.approx([63_500, 63_400])
    assert batch.digitals[:, 0].tolist() == [5] * 6
    assert (batch.config.data_rate, stations[0].fnom_hz) == (10, 50.0)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_stamps_stay_as_they_are(suffix: str, tmp_path: Path) -> None:
    """To the tick of TIME_BASE on the wire, to the nanosecond in columns; nothing is put on the grid."""
    path = wide(tmp_path / f"a{suffix}", ("N",))
    (block,) = blocks_of(open_source(path))
    config = block.batch.config
    assert (block.batch.time_ns - START).tolist() == list(RAGGED_NS)
    frames = [message.frame.data for message in read(path) if message.frame.type is FrameType.DATA]
    stamps = [to_ns(*struct.unpack(">II", frame[6:14]), config.time_base) for frame in frames]
    assert [abs(stamp - START - at) <= 500 for stamp, at in zip(stamps, RAGGED_NS, strict=True)] == [True] * 6


def test_the_four_header_rows_become_a_valid_stream(tmp_path: Path) -> None:
    path = tmp_path / "case.csv"
    name = "Umspannwerk Süd-Ost"
    rows = [
        ",".join(["Time", *[name] * 5, *[f"{name} 2"] * 3]),
        "T,F,VM,VA,IM,IA,F,VM,VA",
        "Sec,Hz,kV,Deg,A,Deg,Hz,kV,Deg",
        "2016-06-17 13:00:00,Ln:1,Ln:1,Ln:1,Ln:1,Ln:1,Ln:1,Ln:1,Ln:1",
        *(f"{at},50.01,200,30,100,-150,49.99,199,0" for at in (0.0, 0.04, 0.08, 0.1234)),
    ]
    path.write_text("\n".join(rows), encoding="utf-8")
    (block,) = blocks_of(open_source(path))
    hold_valid(path, block.batch)
    assert [station.name for station in block.batch.config.stations] == ["Umspannwerk Süd", "Umspannwerk S#2"]
    assert block.batch.time_ns[-1] % NS == 123_400_000


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_rate_and_a_nominal_frequency_are_chosen(suffix: str, tmp_path: Path) -> None:
    path = wide(tmp_path / f"a{suffix}", ("N",))
    for rate, fnom_hz in ((25, 60.0), (-2, 50.0), (None, 60.0), (1, None)):
        (block,) = blocks_of(open_source(path, data_rate=rate, fnom_hz=fnom_hz))
        assert block.batch.config.data_rate == (rate or 10)
        assert block.batch.config.stations[0].fnom_hz == (fnom_hz or 50.0)
        assert (block.batch.time_ns - START).tolist() == list(RAGGED_NS)


def test_the_four_header_rows_with_a_chosen_frequency(tmp_path: Path) -> None:
    """Deviations are from the nominal frequency that was chosen."""
    path = tmp_path / "case.csv"
    path.write_text("Time,Bus\nT,F\nSec,Hz\n0,0.01\n0.1,0.02\n")
    (block,) = blocks_of(open_source(path, data_rate=30, fnom_hz=50))
    assert block.batch.frequency[:, 0].tolist() == pytest.approx([50.01, 50.02])
    assert (block.batch.config.data_rate, block.batch.config.stations[0].fnom_hz) == (30, 50.0)


def test_a_recording_that_brings_its_configuration_has_its_rate(tmp_path: Path) -> None:
    from test_open_formats import MESSAGES

    for suffix in (".pcap", ".c37118", ".mcap", ".parquet", ".arrow"):
        (path,) = write(tmp_path / f"a{suffix}", MESSAGES)
        for options in ({"data_rate": 25}, {"fnom_hz": 60.0}):
            with pytest.raises(SettingsError, match=f"a{suffix} brings its configuration"):
                open_source(path, **options)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="brings its configuration"):
        open_source(tmp_path, data_rate=25)


def test_rates_and_frequencies_that_there_are_not(tmp_path: Path) -> None:
    path = wide(tmp_path / "a.csv", ("N",))
    for rate in (0, 40_000, -40_000):
        with pytest.raises(SettingsError, match="1 to 32767"):
            open_source(path, data_rate=rate)
    with pytest.raises(SettingsError, match="50 and 60"):
        open_source(path, fnom_hz=16.7)


def test_a_known_configuration_keeps_its_rate(tmp_path: Path) -> None:
    from test_open_formats import MESSAGES

    (path,) = write(tmp_path / "a.csv", MESSAGES)
    config = MESSAGES[0].config
    assert config is not None
    with pytest.raises(SettingsError, match="brings its configuration"):
        open_source(path, configs=[config], data_rate=25)
