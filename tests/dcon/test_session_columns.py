"""A session as columns: what the reader of single ticks gives, of whole, cut, damaged and live logs."""

from __future__ import annotations

import gc
import math
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sessions import (
    INSTANCES,
    PMUS,
    T0,
    bits,
    log_tick,
    log_watchdog,
    open_session,
    random_ticks,
    write_session,
)
from support.virtual_platform import stream, virtual_platform

from dcon.columns import read as columns_module
from dcon.columns.read import read_columns
from dcon.columns.tables import INSTANCE_STATES, MODES, STAMP_SOURCES, STATES, UNKNOWN, SessionColumns
from dcon.link.bundle import Entry
from dcon.session.codec import Watchdog
from dcon.session.encode import tick_entries
from dcon.session.head import Head
from dcon.session.parts import Paths
from dcon.session.reader import LoggedTick, SessionReader
from dcon.session.rolling import RollingWriter
from dcon.session.writer import SessionWriter
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.errors import SourceError
from pmutools.schema.log_writer import LogWriter


def compare(paths: Paths) -> tuple[SessionColumns, list[LoggedTick]]:
    """Every column against :class:`SessionReader`, floats by their bits."""
    reader = SessionReader(paths)
    ticks = list(reader.ticks())
    session = read_columns(paths)
    assert session.damage == reader.damage
    assert (session.pmus, session.instances, session.flags) == (reader.pmus, reader.instances, reader.flags)
    assert session.ini_text == reader.ini_text and session.metadata == reader.metadata
    tick, instance = session.tick, session.instance
    assert len(tick.tick_ns) == len(ticks)
    nan = math.nan
    for row, logged in enumerate(ticks):
        record, timing, pdci = logged.record, logged.timing, logged.pdci
        assert (STATES[tick.state[row]], MODES[tick.mode[row]]) == (record.state, record.mode)
        assert tick.active[row] == (-1 if record.active is None else record.active)
        assert (tick.tick_ns[row], int(tick.flags[row])) == (record.tick_ns, record.flags)
        plain = (
            *(tick.gain_mw_per_mhz[row], tick.delta_f_mhz[row], tick.command_mw[row], tick.output_v[row]),
            *(tick.probe_mw[row], tick.compute_us[row], tick.late_us[row], tick.pdci_mw[row]),
            *(*tick.f_hz[row], *tick.age_ms[row], *instance.delta_f_mhz[row], *instance.command_mw[row]),
        )
        assert bits(tuple(map(float, plain))) == bits(
            (
                *(record.gain_mw_per_mhz, record.delta_f_mhz, record.command_mw, record.output_v, record.probe_mw),
                *((timing.compute_us, timing.late_us) if timing else (nan, nan)),
                pdci.power_mw if pdci else nan,
                *(*record.f_hz, *record.age_ms),
                *(each.delta_f_mhz for each in record.instances),
                *(each.command_mw for each in record.instances),
            )
        )
        assert [INSTANCE_STATES[code] for code in instance.state[row]] == [each.state for each in record.instances]
    for name in {frame.name for logged in ticks for frame in logged.frames} | session.pmu.keys():
        compare_frames(session, name, ticks)
    assert [tuple(event) for event in session.events] == [
        (logged.record.tick_ns, *event) for logged in ticks for event in logged.record.events
    ]
    assert [bits(tuple(order)) for order in session.orders] == [
        bits((logged.record.tick_ns, *order)) for logged in ticks for order in logged.orders
    ]
    assert [bits((at, *flag)) for at, flag in session.flag_changes] == [
        bits((logged.record.tick_ns, *flag)) for logged in ticks for flag in logged.record.flag_changes
    ]
    losses = [row for row, logged in enumerate(ticks) if logged.after_loss]
    assert [row for row in session.gaps if row < len(ticks)] == losses
    return session, ticks


def compare_frames(session: SessionColumns, name: str, ticks: list[LoggedTick]) -> None:
    frames = [frame for logged in ticks for frame in logged.frames if frame.name == name]
    of = session.pmu[name]
    assert [*zip(*(of.time_ns, of.arrival_ns, of.tick_ns, of.stat, of.time_quality, of.stamp_source), strict=True)] == [
        (f.time_ns, f.arrival_ns or 0, f.tick_ns, f.stat, f.time_quality, STAMP_SOURCES.index(str(f.stamp_source)))
        for f in frames
    ]
    floats = np.array([of.frequency_hz, of.rocof_hz_s]).T.tolist()
    assert bits(tuple(map(tuple, floats))) == bits(tuple((f.frequency_hz, f.rocof_hz_s) for f in frames))
    v1 = np.array([frame.v1 for frame in frames], dtype=np.complex128).reshape(-1)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(of.v1_mag, np.hypot(v1.real, v1.imag), rtol=1e-15)
    np.testing.assert_allclose(of.v1_rad, np.arctan2(v1.imag, v1.real), rtol=1e-15)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("columns") / "s.mcap"
    simulate(Plan("cjb", faults=("irregular", "dropout"), noise_rad=1e-4, duration_s=12), str(path))
    return path


@pytest.fixture(params=[50_000, 700], ids=["one batch", "batches"])
def batches(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns_module, "BATCH_MESSAGES", request.param)


@pytest.mark.usefixtures("batches")
def test_random_ticks(tmp_path: Path) -> None:
    session, ticks = compare(write_session(tmp_path / "s.mcap", random_ticks(400)))
    assert len(ticks) == 400 and session.gaps == [] and session.incomplete_ticks == 0
    assert session.flag("arrival_gap").tolist() == [bool(tick.record.flags & 4) for tick in ticks]
    with pytest.raises(KeyError):
        session.flag("none")


@pytest.mark.usefixtures("batches")
def test_a_simulated_session(simulated: Path) -> None:
    session, ticks = compare(simulated)
    assert len(ticks) == 720 and set(session.pmu) == set(session.pmus)
    assert session.tick.f_hz.shape == (720, 8) and session.instance.state.shape == (720, 16)
    assert session.instance.state.dtype == np.uint8 and session.tick.flags.dtype == np.uint64
    assert np.isfinite(session.tick.pdci_mw).all()
    assert len(session.events) > 30 and [order.name for order in session.orders] == ["closed_loop", "arm", "activate"]


def test_a_session_in_parts(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    ticks = random_ticks(300)
    names = {"pmus": PMUS, "instances": INSTANCES}
    with RollingWriter(path, Head("", **names), max_minutes=1 / 40) as log:
        for tick in ticks:
            log_tick(log, tick.record, tick.frames, tick.orders)
    assert len(log.parts) == 4
    session, back = compare(path)
    assert len(back) == 300 and session.gaps == []
    log.parts[1].unlink()
    session, back = compare([path, *log.parts[2:]])
    assert session.gaps == [91]


@pytest.mark.parametrize("share", [0.2, 0.5, 0.77, 0.999])
def test_a_cut_log(share: float, simulated: Path, tmp_path: Path) -> None:
    data = simulated.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: round(len(data) * share)])
    session, ticks = compare(path)
    assert session.damage.cut and 0 < len(ticks) <= 720
    assert set(session.gaps) <= {len(ticks)}


@pytest.mark.usefixtures("batches")
def test_a_damaged_log(simulated: Path, tmp_path: Path) -> None:
    data = bytearray(simulated.read_bytes())
    for at in (len(data) // 4, len(data) // 2):
        data[at : at + 64] = bytes(64)
    path = tmp_path / "rot.mcap"
    path.write_bytes(data)
    session, ticks = compare(path)
    assert 1 <= len([row for row in session.gaps if row < len(ticks)]) <= 2 and len(ticks) < 720


def test_a_damaged_head_leaves_numbers_for_names(simulated: Path, tmp_path: Path) -> None:
    data = bytearray(simulated.read_bytes())
    at = data.index(b"\x04\x00\x00\x00zstd") - 60
    data[40 : at + 400] = bytes(at + 360)  # metadata, attachments, and the chunk that announces the channels
    path = tmp_path / "head.mcap"
    path.write_bytes(data)
    session = read_columns(path)
    assert session.ini_text == "" and len(session.tick.tick_ns) == 660 and session.pmus[0] == "N1"


def test_a_live_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = virtual_platform(tmp_path / "live.mcap", stream(4), monkeypatch)
    made.run(3)
    session, ticks = compare(made.path)
    assert len(ticks) >= 180
    assert np.isfinite(session.tick.late_us).all() and np.isnan(session.tick.pdci_mw).all()


def test_ticks_that_are_not_whole(tmp_path: Path) -> None:
    ticks = random_ticks(20)
    with open_session(tmp_path / "s.mcap") as log:
        for number, tick in enumerate(ticks):
            if number % 5 == 3:
                alone = [entry for entry in tick_entries(INSTANCES, tick.record) if entry.message == "Tick"]
                log.write(alone, tick.record.tick_ns)
            else:
                log_tick(log, tick.record)
    session = read_columns(tmp_path / "s.mcap")
    assert len(session.tick.tick_ns) == 20 and session.incomplete_ticks == 4
    assert (session.instance.state[3::5] == UNKNOWN).all() and np.isnan(session.instance.command_mw[3::5]).all()
    assert (session.instance.state[4::5] != UNKNOWN).all()


def test_states_of_a_newer_version_and_messages_that_are_none(tmp_path: Path) -> None:
    ticks = random_ticks(30)
    with open_session(tmp_path / "s.mcap") as log:
        for number, tick in enumerate(ticks):
            record: Any = tick.record
            if number == 7:
                record = record._replace(state="HIBERNATING")
            if number == 9:
                log.write([Entry("Tick", "", b"\xff\xff", record.tick_ns, record.tick_ns)], record.tick_ns)
            log_tick(log, record)
    session = read_columns(tmp_path / "s.mcap")
    assert session.tick.state[7] == UNKNOWN and (session.tick.state[8:] != UNKNOWN).all()
    assert len(session.tick.tick_ns) == 30
    assert session.damage.undecodable == 1 and session.gaps == [9]


def test_the_watchdog(tmp_path: Path) -> None:
    seen = Watchdog(T0, False, estop=True, reason="E-stop", heartbeats=(("control", 3.5), ("udp", 1.0)))
    with open_session(tmp_path / "s.mcap") as log:
        log_watchdog(log, seen)
        log_tick(log, random_ticks(1)[0].record)
    assert read_columns(tmp_path / "s.mcap").watchdog == [seen]


def test_tables_may_be_left_out(simulated: Path) -> None:
    session = read_columns(simulated, tables=())
    assert len(session.tick.tick_ns) == 720
    assert (session.pmu, session.events, session.orders) == ({}, [], [])
    assert session.instance.state.shape == (0, 16) and session.incomplete_ticks == 0


def test_a_session_that_ended_before_its_first_tick(tmp_path: Path) -> None:
    session = read_columns(write_session(tmp_path / "s.mcap", []))
    assert session.tick.f_hz.shape == (0, len(PMUS)) and session.instance.state.shape == (0, len(INSTANCES))
    assert session.tick.tick_ns.dtype == np.int64 and session.gaps == []


def foreign(path: Path) -> None:
    with LogWriter(path) as log:
        log.metadata("other", {})


@pytest.mark.parametrize("make", [lambda path: None, lambda path: path.write_text("x"), foreign])
def test_what_is_no_session(make: Callable[[Path], object], tmp_path: Path) -> None:
    make(tmp_path / "x.mcap")
    with pytest.raises(SourceError, match=r"x\.mcap: "):
        read_columns(tmp_path / "x.mcap")


def test_memory_is_that_of_the_columns_and_a_batch(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(columns_module, "BATCH_MESSAGES", 3000)
    path = tmp_path / "long.mcap"
    reader = SessionReader(simulated)
    ticks = list(reader.ticks())[-300:]
    names = {"pmus": reader.pmus, "instances": reader.instances}
    with SessionWriter(path, Head("", **names)) as log:
        for number in range(1500):
            tick = ticks[number % len(ticks)]
            record = tick.record._replace(tick_ns=T0 + number * 16_666_667, events=())
            log_tick(log, record, tick.frames, instances=reader.instances)
    read_columns(simulated)  # what is imported
    tracemalloc.start()
    try:
        session = read_columns(path)
        gc.collect()
        used, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    size = sum(column.nbytes for table in (session.tick, session.instance, *session.pmu.values()) for column in table)
    assert size < 1500 * 1000 and used < 1.1 * size + 3e6  # 216 MB an hour
    assert most < 1.6 * size + 8e6
