"""COMTRADE: phasor records as they are, waveforms estimated, and everything that can be wrong with the files."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.comtrade_files import Analog, Recording, Status, sample, three_phases, wave
from support.recordings import blocks_of, data_of, read

from pmutools.c37118 import FrameType, decode_config
from pmutools.c37118.batch import Batch
from pmutools.c37118.config_kinds import as_kind
from pmutools.c37118.session import served
from pmutools.errors import PmuError, SettingsError, SourceError
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block
from pmutools.timebase import NS, parse_utc

START = parse_utc("2016-06-17T13:00:00Z")
FORMS = ("ASCII", "BINARY", "BINARY32", "FLOAT32")


def opened(path: Path, **options: Any) -> tuple[Batch, dict[str, int]]:
    """All numbers of a record, as one batch, and its defects."""
    source = open_source(path, **options)
    assert source.kind == "comtrade"
    blocks = [block.batch for block in blocks_of(source)]
    config = blocks[0].config
    columns = {
        name: np.concatenate([getattr(block, name) for block in blocks])
        for name in ("time_ns", "phasors", "frequency", "rocof", "analogs", "digitals", "stat", "time_quality")
    }
    first = blocks[0]
    whole = Batch(
        config,
        columns["time_ns"],
        np.concatenate([block.arrival_ns for block in blocks]),
        np.concatenate([block.stamp_source for block in blocks]),
        columns["time_quality"],
        columns["stat"],
        columns["phasors"],
        columns["frequency"],
        columns["rocof"],
        columns["analogs"],
        columns["digitals"],
        np.concatenate([block.valid for block in blocks]),
    )
    assert first.config == whole.config
    return whole, source.defects()


def tve(found: np.ndarray[Any, Any], expected: np.ndarray[Any, Any]) -> float:
    """Total vector error, the largest, in percent."""
    return float(np.max(np.abs(found - expected) / np.abs(expected)) * 100)


def truth(batch: Batch, rms: float, degrees: float, hz: float, nominal: float = 50.0) -> np.ndarray[Any, Any]:
    """The synchrophasor of a cosine that has this angle at START."""
    since = (batch.time_ns - START) / NS
    return rms * np.exp(1j * (math.radians(degrees) + 2 * np.pi * (hz - nominal) * since))


# --- waveforms --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [800, 1000, 4800, 5000, 20_000])
@pytest.mark.parametrize("hz", [48.0, 49.5, 50.0, 50.5, 52.0])
def test_steady_state(rate: int, hz: float, tmp_path: Path) -> None:
    """TVE: below 0.001 % at nominal, 0.05 % within 2 Hz; 1 % is what the standard asks of a PMU."""
    analogs = three_phases(63_500, 33, hz, step=5.0) + three_phases(400, -20, hz, letter="I", unit="A", step=0.05)
    path = Recording(analogs, rates=((rate, rate // 2),), form="BINARY32").write(tmp_path / "a.cfg")
    batch, defects = opened(path)
    assert defects == {}
    station = batch.config.stations[0]
    assert (station.name, station.fnom_hz, batch.config.data_rate) == ("NORTH", 50.0, 50)
    names = ["VA", "VB", "VC", "IA", "IB", "IC", "V1", "I1"]
    assert [(p.name, p.kind) for p in station.phasors] == [(name, name[0]) for name in names]
    limit = 0.005 if hz == 50 else 0.05
    for column, (rms, degrees) in enumerate(
        [(63_500, 33), (63_500, -87), (63_500, 153), (400, -20), (400, -140), (400, 100), (63_500, 33), (400, -20)]
    ):
        assert tve(batch.phasors[:, column], truth(batch, rms, degrees, hz)) < limit, names[column]
    assert np.abs(batch.frequency - hz).max() < 0.001
    assert np.abs(batch.rocof).max() < 0.02
    # three cycles of the half second are spent on windows
    assert batch.time_ns.tolist() == [START + k * 20_000_000 for k in range(2, 24)][: len(batch)]
    assert len(batch) >= 22


@pytest.mark.parametrize("hz", [58.0, 60.0, 61.7])
def test_a_60_hz_grid_and_a_single_voltage(hz: float, tmp_path: Path) -> None:
    """Without three phases the frequency comes from the strongest voltage, and ripples a little off nominal."""
    analogs = [Analog("small", wave(10, 0, hz), "V"), Analog("BUS", wave(110, 5, hz), "kV", step=0.01)]
    path = Recording(analogs, rates=((3840, 3840),), line_hz=60.0).write(tmp_path / "a.cfg")
    batch, _ = opened(path)
    assert batch.config.data_rate == 60
    assert [p.name for p in batch.config.stations[0].phasors] == ["small", "BUS"]
    assert tve(batch.phasors[:, 1], truth(batch, 110_000, 5, hz, 60.0)) < 0.1
    assert np.abs(batch.frequency - hz).max() < 0.005
    assert np.abs(batch.rocof).max() < 0.1


def test_a_ramp_of_frequency(tmp_path: Path) -> None:
    """1 Hz/s about nominal."""
    course = [
        Analog(
            f"V{p}",
            lambda at, turn=turn: 100 * math.sqrt(2) * math.cos(2 * math.pi * (49.5 * at + at * at / 2) + turn),
            "V",
            p,
        )
        for p, turn in (("A", 0.0), ("B", -2 * math.pi / 3), ("C", 2 * math.pi / 3))
    ]
    batch, _ = opened(Recording(course, rates=((5000, 5000),)).write(tmp_path / "a.cfg"))
    since = (batch.time_ns - START) / NS
    assert np.abs(batch.frequency[:, 0] - (49.5 + since)).max() < 0.002
    assert np.abs(batch.rocof[:, 0] - 1.0).max() < 0.05


def test_instants_lie_on_the_grid_of_utc_whatever_the_start(tmp_path: Path) -> None:
    start = "17/06/2016,12:59:59.987654"
    analogs = [Analog("V", wave(100, 40, 50.0, offset=0.012346), "V")]
    path = Recording(analogs, rates=((6400, 3200),), start=start).write(tmp_path / "a.cfg")
    batch, _ = opened(path)
    assert set(((batch.time_ns - START) % 20_000_000).tolist()) == {0}
    assert batch.time_ns[0] == START + 20_000_000  # the first with a cycle and a half before it
    assert tve(batch.phasors[:, 0], truth(batch, 100, 40, 50.0)) < 0.01
    batch, _ = opened(path, data_rate=10)
    assert batch.config.data_rate == 10
    assert batch.time_ns.tolist() == [START + k * NS // 10 for k in range(1, 5)]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["a.cfg", "A.CFG", "a.cff"])
def test_forms_of_files(form: str, name: str, tmp_path: Path) -> None:
    """Units, ratios, skew and status bits are the same in all of them, whichever file is named."""
    analogs = [
        Analog("UA", wave(63.5, 10), "kV", "A", step=0.004),
        Analog("IA", wave(2, -20), "A", "A", step=0.001, ratio=(600, 1, "S")),
        Analog("IB", wave(700, -140), "A", "B", step=0.05, ratio=(600, 1, "P"), skew_us=250),
        Analog("OIL", lambda at: 40 + at, "degC", step=0.01),
    ]
    statuses = [Status(f"S{k}", lambda at, k=k: at >= k / 100, normal=k % 2) for k in range(18)]
    path = Recording(analogs, statuses, ((2000, 1000),), form=form).write(tmp_path / name)
    for other in (path, path.with_suffix(".DAT" if name == "A.CFG" else ".dat")):
        if not other.exists():
            continue
        batch, defects = opened(other)
        assert defects == {}
        assert tve(batch.phasors[:, 0], truth(batch, 63_500, 10, 50)) < 0.02
        assert tve(batch.phasors[:, 1], truth(batch, 1200, -20, 50)) < 0.1
        assert tve(batch.phasors[:, 2], truth(batch, 700, -140, 50)) < 0.02
        assert batch.analogs[:, 0] == pytest.approx(40 + (batch.time_ns - START) / NS, abs=0.011)
        word = [sum(1 << k for k in range(16) if at >= k / 100) for at in ((batch.time_ns - START) / NS + 1e-9)]
        assert batch.digitals[:, 0].tolist() == word
        first, second = batch.config.stations[0].digitals
        assert first.labels == tuple(f"S{k}" for k in range(16))
        assert (first.normal, first.valid) == (0xAAAA, 0xFFFF)
        assert (second.labels[:3], second.normal, second.valid) == (("S16", "S17", ""), 2, 3)


def test_names_of_waveforms_that_look_like_parts_of_phasors(tmp_path: Path) -> None:
    analogs = [Analog("VOLTAGE A PHASE", wave(100, 0), "V"), Analog("L1 IM", wave(5, 0), "A")]
    batch, _ = opened(Recording(analogs, rates=((1000, 500),)).write(tmp_path / "a.cfg"))
    assert [p.name for p in batch.config.stations[0].phasors] == ["VOLTAGE A PHASE", "L1 IM"]
    assert np.abs(batch.phasors[0]).tolist() == pytest.approx([100, 5], rel=1e-3)


def test_two_rates_in_one_record(tmp_path: Path) -> None:
    """Fast about the event, slow after it: each stretch by itself, none where samples are too few."""
    analogs = three_phases(100, 0, 50.2)
    fast_slow = ((4000, 2001), (1000, 2501), (100, 2601))
    batch, defects = opened(Recording(analogs, rates=fast_slow).write(tmp_path / "a.cfg"))
    assert tve(batch.phasors[:, 3], truth(batch, 100, 0, 50.2)) < 0.05
    since_ms = ((batch.time_ns - START) // 1_000_000).tolist()
    assert since_ms == [*range(40, 461, 20), *range(540, 961, 20)]
    assert list(defects) == ["samples fewer than 8 a cycle"]


def test_stamped_samples_and_a_gap(tmp_path: Path) -> None:
    path = Recording(three_phases(100, 0, 50.2), rates=((4000, 4000),), stamped=True).write(tmp_path / "a.cfg")
    batch, _ = opened(path)
    assert tve(batch.phasors[:, 3], truth(batch, 100, 0, 50.2)) < 0.05
    rows = path.with_suffix(".dat").read_text().splitlines()
    path.with_suffix(".dat").write_text("\n".join(rows[:2000] + rows[2100:]))
    batch, defects = opened(path)
    assert tve(batch.phasors[:, 3], truth(batch, 100, 0, 50.2)) < 0.05
    gap_ms = {int(t) for t in (batch.time_ns - START) // 1_000_000}
    assert not gap_ms & set(range(471, 555))
    assert defects == {"samples missing at the end": 100}


def test_samples_counted_from_zero(tmp_path: Path) -> None:
    path = Recording([Analog("V", wave(100, 30))], rates=((1000, 500),)).write(tmp_path / "a.cfg")
    data = path.with_suffix(".dat")
    rows = [line.split(",", 1) for line in data.read_text().splitlines()]
    data.write_text("\n".join(f"{int(number) - 1},{rest}" for number, rest in rows))
    batch, defects = opened(path)
    assert defects == {}
    assert tve(batch.phasors[:, 0], truth(batch, 100, 30, 50)) < 0.01


def test_missing_samples_are_no_numbers(tmp_path: Path) -> None:
    def holed(at: float) -> float:
        return math.nan if 0.2 < at < 0.21 else wave(100, 0)(at)

    for form in ("ASCII", "BINARY", "BINARY32"):
        batch, _ = opened(Recording([Analog("V", holed)], rates=((2000, 1000),), form=form).write(tmp_path / "a.cfg"))
        absent = np.isnan(batch.phasors[:, 0])
        assert 2 <= absent.sum() <= 4
        assert (batch.stat[absent & np.isnan(batch.frequency[:, 0]), 0] == 0x8000).all()
        assert tve(batch.phasors[~absent, 0], truth(batch, 100, 0, 50)[~absent]) < 0.1


def test_the_sample(tmp_path: Path) -> None:
    batch, _ = opened(sample().write(tmp_path / "a.cfg"))
    magnitudes = np.abs(batch.phasors)
    fault = (batch.time_ns - START) == 240_000_000
    assert magnitudes[fault, 0] == pytest.approx([20_000], rel=0.01)
    assert magnitudes[fault, 3] == pytest.approx([7200], rel=0.01)
    assert magnitudes[0, :3] == pytest.approx([63_500] * 3, rel=1e-3)
    assert sorted(set(batch.digitals[:, 0].tolist())) == [0, 1, 2, 3]
    details = batch.config.stations[0].details
    assert details is not None
    assert (details.service_class, details.window_us) == ("P", 40_000)


# --- records of phasors -----------------------------------------------------------------------------------------


def constant(value: float) -> Callable[[float], float]:
    return lambda at: value


STYLES: dict[str, list[tuple[str, str, str, float, float]]] = {
    "annex": [
        ("N1:V1LPM", "Pm", "kV", 288.7, 0.01),
        ("N1:V1LPM", "Pa", "deg", -30.0, 0.01),
        ("N1:F", "F", "Hz", 60.02, 0.001),
        ("N1:DF", "df", "Hz/s", -0.05, 0.001),
        ("N1:MW", "", "MW", 512.0, 0.1),
    ],
    "openpdc": [
        ("N1:V1LPM:PM", "", "kV", 288.7, 0.01),
        ("N1:V1LPM:PA", "", "Degrees", -30.0, 0.01),
        ("N1:FQ", "", "Hz", 60.02, 0.001),
        ("N1:DF", "", "Hz/sec", -0.05, 0.001),
        ("N1:MW", "", "MW", 512.0, 0.1),
    ],
    "words": [
        ("N1.V1LPM_MAG", "", "V", 288_700.0, 10.0),
        ("N1.V1LPM_ANG", "", "rad", math.radians(-30), 0.0001),
        ("N1:FREQ", "", "mHz", 60_020.0, 2.0),
        ("N1:ROCOF", "", "Hz/s", -0.05, 0.001),
        ("N1.MW", "", "MW", 512.0, 0.1),
    ],
    "rectangular": [
        ("N1:V1LPM:PR", "", "kV", 288.7 * math.cos(math.radians(30)), 0.01),
        ("N1:V1LPM:PI", "", "kV", -288.7 * math.sin(math.radians(30)), 0.01),
        ("N1:Frequency", "", "Hz", 0.02, 0.001),
        ("N1:DFDT", "", "", -0.05, 0.001),
        ("N1:MW", "", "MW", 512.0, 0.1),
    ],
}


@pytest.mark.parametrize("style", STYLES)
def test_phasors_by_any_name(style: str, tmp_path: Path) -> None:
    analogs = [
        Analog(name, constant(value), unit, phase, step=step) for name, phase, unit, value, step in STYLES[style]
    ]
    statuses = [Status("N1:TRIP", lambda at: at > 1.0)]
    path = Recording(analogs, statuses, ((30, 90),), line_hz=60.0).write(tmp_path / "a.cfg")
    batch, defects = opened(path)
    assert defects == {}
    (station,) = batch.config.stations
    assert (station.name, batch.config.data_rate, station.fnom_hz) == ("N1", 30, 60.0)
    assert [(p.name, p.kind) for p in station.phasors] == [("V1LPM", "V")]
    assert [a.name for a in station.analogs] == ["MW"]
    expected = 288_700 * np.exp(-1j * math.radians(30))
    assert np.abs(batch.phasors - expected).max() < 20
    assert batch.frequency[:, 0] == pytest.approx(60.02, abs=2e-3)
    assert batch.rocof[:, 0] == pytest.approx(-0.05, abs=1e-6)
    assert batch.analogs[:, 0] == pytest.approx(512)
    assert batch.digitals[:, 0].tolist() == [0] * 31 + [1] * 59
    assert station.digitals[0].labels[0] == "TRIP"
    assert np.abs(np.diff(batch.time_ns) - NS / 30).max() < 2


def test_several_stations_and_names_that_repeat(tmp_path: Path) -> None:
    analogs = []
    for station in ("NORTH", "SOUTH"):
        for name, value in (("V", 100.0), ("V", 200.0), ("IA", 5.0)):
            analogs.append(Analog(f"{station}:{name}", constant(value), "A" if name == "IA" else "V", "Am"))
            analogs.append(Analog(f"{station}:{name}", constant(value / 10), "deg", "Aa"))
        analogs.append(Analog(station, constant(50.1), "Hz", "F", step=0.001))
    analogs.append(Analog("odd angle", constant(1.0), "deg"))
    batch, _ = opened(Recording(analogs, rates=((50, 100),), station="LIBRARY").write(tmp_path / "a.cfg"))
    stations = batch.config.stations
    assert [s.name for s in stations] == ["NORTH", "SOUTH", "LIBRARY"]
    assert [[(p.name, p.kind) for p in s.phasors] for s in stations] == [
        [("V", "V"), ("V#2", "V"), ("IA", "I")],
        [("V", "V"), ("V#2", "V"), ("IA", "I")],
        [],
    ]
    assert np.abs(batch.phasors[0]).tolist() == pytest.approx([100, 200, 5] * 2)
    assert np.degrees(np.angle(batch.phasors[0])).tolist() == pytest.approx([10, 20, 0.5] * 2)
    assert batch.frequency[0, :2].tolist() == pytest.approx([50.1, 50.1])
    assert [a.name for a in stations[2].analogs] == ["odd angle"]


def test_a_slow_record_without_phasors_is_of_analogs(tmp_path: Path) -> None:
    analogs = [Analog("P", constant(3.0), "MW"), Analog("VA", constant(100.0), "V", "A")]
    batch, _ = opened(Recording(analogs, rates=((10, 50),)).write(tmp_path / "a.cfg"))
    assert [a.name for a in batch.config.stations[0].analogs] == ["P", "VA"]
    assert batch.analogs[0].tolist() == pytest.approx([3.0, 100.0])


@pytest.mark.parametrize(
    ("start", "year", "codes", "expected"),
    [
        ("17/06/2016,13:00:00.000000", "1999", None, START),
        ("06/17/16,13:00:00.000000", "1991", None, START),
        ("17/06/2016,13:00:00.123456789", "2013", ("0,0", "0,0"), START + 123_456_789),
        ("17/06/2016,13:00:00", "1999", None, START),
        ("17/06/2016,18:30:00.000000", "2013", ("+5h30,+5h30", "4,0"), START),
        ("17/06/2016,05:00:00.000000", "2013", ("-8,-8", "4,0"), START),
        ("17/06/2016,13:00:00.000000", "2013", ("x,x", "B,3"), START),
        (",", "1999", None, parse_utc("2000-01-01T00:00:00Z")),
        ("00/00/0000,00:00:00.000000", "1999", None, parse_utc("2000-01-01T00:00:00Z")),
    ],
)
def test_when_it_was(start: str, year: str, codes: tuple[str, str] | None, expected: int, tmp_path: Path) -> None:
    analogs = [Analog("V:PM", constant(1.0)), Analog("V:PA", constant(1.0), "deg")]
    recording = Recording(analogs, rates=((50, 10),), start=start, year=year, codes=codes)
    batch, defects = opened(recording.write(tmp_path / "a.cfg"))
    assert batch.time_ns[0] == expected
    assert batch.time_ns[1] == expected + 20_000_000
    assert set(batch.time_quality.tolist()) == {int(codes[1][0], 16) if codes else 0}
    assert bool(defects) == (expected == parse_utc("2000-01-01T00:00:00Z"))


# --- what comes of it -------------------------------------------------------------------------------------------


def test_it_plays_and_converts(tmp_path: Path) -> None:
    path = sample().write(tmp_path / "a.cfg")
    messages = read(path)
    assert messages[0].frame.type is FrameType.CFG2
    config = decode_config(messages[0].frame.data)[1]
    assert len(data_of(messages)) == len(opened(path)[0])
    offered = served(config)
    assert decode_config(offered.frames[FrameType.CFG3])[1] == as_kind(config, FrameType.CFG3)
    with open_sink(tmp_path / "b.parquet") as sink:
        for item in open_source(path).blocks():
            assert isinstance(item, Block)
            sink.write(item)
    (copy,) = blocks_of(open_source(tmp_path / "b.parquet"))
    assert np.abs(copy.batch.phasors - opened(path)[0].phasors).max() < 0.01


def test_a_folder_reads_a_record_once(tmp_path: Path) -> None:
    sample().write(tmp_path / "a.cfg")
    (block,) = blocks_of(open_source(tmp_path))
    assert len(block.batch) == 22


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda cfg, dat: (cfg, None), "no a.dat beside it"),
        (lambda cfg, dat: (None, dat), "no a.cfg beside it"),
        (lambda cfg, dat: (cfg, dat[:20]), "no samples"),
        (lambda cfg, dat: (cfg, dat[:900]), "too short"),
        (lambda cfg, dat: (cfg.replace("kV", "MW").replace(",A,0.", ",MW,0."), dat), "no channel in V"),
        (lambda cfg, dat: (cfg.replace("BINARY", "BINARY64"), dat), "BINARY64"),
        (lambda cfg, dat: (cfg.replace("8,6A,2D", "x"), dat), "second line"),
        (lambda cfg, dat: (cfg.replace("8,6A,2D", "8,999999999A,2D"), dat), "second line"),
        (lambda cfg, dat: (cfg.replace("800,400", "800,x"), dat), "no readable COMTRADE"),
        (lambda cfg, dat: ("[section]\nkey = value\n", dat), "second line"),
        (lambda cfg, dat: ("\r\n".join(cfg.splitlines()[:13]), dat), "cut"),
        (lambda cfg, dat: (cfg.replace("\r\n50\r\n", "\r\n16.7\r\n"), dat), "choose a nominal frequency"),
    ],
)
def test_what_cannot_be_read_is_one_line(
    change: Callable[[str, bytes], tuple[str | None, bytes | None]], problem: str, tmp_path: Path
) -> None:
    path = sample().write(tmp_path / "a.cfg")
    data = path.with_suffix(".dat")
    header, samples = change(path.read_bytes().decode(), data.read_bytes())
    for file, content in ((path, header), (data, samples)):
        file.unlink()
        if content is not None:
            file.write_bytes(content if isinstance(content, bytes) else content.encode())
    named = path if path.exists() else data
    with pytest.raises(SourceError, match=problem) as raised:
        list(open_source(named).items())
    assert "\n" not in str(raised.value)
    assert str(tmp_path) in str(raised.value)


def test_samples_that_are_hours_apart_cost_nothing(tmp_path: Path) -> None:
    """Instants are sought where there are samples, not all through the time that the record spans."""
    rates = ((1000, 200), (0.0001, 1000))
    batch, defects = opened(Recording(three_phases(100, 0), rates=rates).write(tmp_path / "a.cfg"))
    assert 5 <= len(batch) <= 8
    assert defects["samples fewer than 8 a cycle"] > 700


def test_neither_stamps_nor_a_rate(tmp_path: Path) -> None:
    path = Recording(three_phases(100, 0), rates=((1000, 200),)).write(tmp_path / "a.cfg")
    path.write_text(path.read_text().replace("1000,200", "0,200"))
    with pytest.raises(SourceError, match="no readable COMTRADE record"):
        open_source(path)


def test_rates_that_cannot_be_estimated(tmp_path: Path) -> None:
    path = sample().write(tmp_path / "a.cfg")
    for rate in (-1, 300):
        with pytest.raises(SettingsError, match="1 to 240"):
            open_source(path, data_rate=rate)


@pytest.mark.parametrize("form", FORMS)
def test_a_cut_record_gives_what_there_is(form: str, tmp_path: Path) -> None:
    recording = Recording(three_phases(100, 0), [Status("S", lambda at: False)], ((1000, 1000),), form=form)
    path = recording.write(tmp_path / "a.cfg")
    data = path.with_suffix(".dat")
    content = data.read_bytes()
    whole, _ = opened(path)
    data.write_bytes(content[: len(content) * 2 // 3 + 1])
    cut, defects = opened(path)
    assert 30 <= len(cut) < len(whole)
    assert np.array_equal(cut.phasors[:-1], whole.phasors[: len(cut) - 1])
    assert 330 <= defects["samples missing at the end"] <= 340


def test_more_samples_than_the_header_counts_and_unreadable_ones(tmp_path: Path) -> None:
    path = Recording(three_phases(100, 0), rates=((1000, 1000),)).write(tmp_path / "a.cfg")
    path.write_text(path.read_text().replace("1000,1000", "1000,900"))
    data = path.with_suffix(".dat")
    rows = data.read_text().splitlines()
    rows[850] = "851,850000,1,2"
    rows[851] = "852,851000,1,nonsense,3"
    data.write_text("\n".join(rows) + "\x1a")
    batch, defects = opened(path)
    assert defects == {"samples beyond the last that the header counts": 100, "unreadable samples": 2}
    assert batch.time_ns[-1] == START + 800_000_000


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("suffix", [".cfg", ".cff"])
def test_damage_never_escapes_as_anything_but_an_error_of_one_line(form: str, suffix: str, tmp_path: Path) -> None:
    rng = random.Random(form + suffix)
    recording = Recording(three_phases(100, 0), [Status("S", lambda at: at > 0.1)], ((1000, 200),), form=form)
    path = recording.write(tmp_path / f"a{suffix}")
    files = [file for file in (path, path.with_suffix(".dat")) if file.exists()]
    contents = [file.read_bytes() for file in files]
    for _ in range(120):
        for file, content in zip(files, contents, strict=True):
            damaged = bytearray(content)
            for _ in range(rng.choice((0, 1, 3, 10))):
                damaged[rng.randrange(min(len(damaged), 600))] = rng.choice(b"0123456789,.-\r\nAx\xff\0")
            file.write_bytes(bytes(damaged[: rng.choice((len(damaged), rng.randrange(1, len(damaged) + 1)))]))
        try:
            source = open_source(path)
            for item in source.blocks():
                assert item
            source.defects()
        except PmuError as error:
            assert "\n" not in str(error)
