"""``dcon analyze``: what is found in simulated sessions is what was simulated; what cannot be read is said."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.sessions import log_configs, log_tick

from dcon.analysis.analysis import analyze, analyze_all
from dcon.analysis.course import Stretch
from dcon.analysis.figures import SHADES, bars, thinned
from dcon.analysis.report import main_findings
from dcon.cli import dcon
from dcon.session.head import Head
from dcon.session.reader import SessionReader
from dcon.session.rolling import RollingWriter
from dcon.sim.plan import START_NS, Plan
from dcon.sim.simulate import simulate
from pmutools.cli.shell import run
from pmutools.report import theme

Capsys = pytest.CaptureFixture[str]


ROWS = {"state": "states", "mode": "modes", "active": "active_instances"}
"""Of the timeline, by their word, and where they are in the JSON."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sessions")


@pytest.fixture(scope="module")
def closed(folder: Path) -> Path:
    simulate(Plan(gain_mw_per_mhz=9), str(folder / "closed.mcap"))
    return folder / "closed.mcap"


@pytest.fixture(scope="module")
def faulty(folder: Path) -> Path:
    simulate(Plan(faults=("stream-stop",), duration_s=20), str(folder / "faulty.mcap"))
    return folder / "faulty.mcap"


@pytest.fixture(scope="module")
def report(closed: Path, folder: Path) -> tuple[Path, dict[str, Any]]:
    simulate(Plan(control=False), str(folder / "open.mcap"))
    out = folder / "report"
    assert run(dcon(), ["analyze", str(closed), str(folder / "open.mcap"), "--out", str(out), "--quiet"]) == 0
    return out, json.loads((out / "analysis.json").read_text())


def test_rows_of_the_timeline_are_named_not_coloured_alone(report: tuple[Path, dict[str, Any]]) -> None:
    """In the picture and on the page."""
    out, told = report
    closed, _ = told["sessions"]
    names = [f"{kind} {each['name']}" for kind, key in ROWS.items() for each in closed[key] if each["name"]]
    assert {"state ACTIVE", "mode closed_loop"} < set(names) and any(name.startswith("active N") for name in names)
    drawn, page = (out / "figures" / "01-timeline.svg").read_text(), (out / "report.html").read_text()
    assert all(f">{name}</text>" in drawn and f'"{name}"' in page for name in names)


@pytest.mark.parametrize(
    ("gain", "frequency_hz", "damping"), [(0, 0.425, 7.8), (9, 0.4326, 10.43), (12, 0.4352, 11.31)]
)
def test_the_damping_of_table_2(folder: Path, gain: float, frequency_hz: float, damping: float) -> None:
    path = folder / f"k{gain}.mcap"
    simulate(Plan(gain_mw_per_mhz=gain), str(path))
    (found,) = analyze([path]).ringdowns
    assert found.mode is not None and found.closed == bool(gain) and found.gain_mw_per_mhz == gain
    assert found.mode.frequency_hz.median == pytest.approx(frequency_hz, abs=0.0005)
    assert found.mode.damping_percent.median == pytest.approx(damping, abs=0.02)
    assert found.mode.fits == found.mode.tried


def test_the_mode_that_has_lost_its_damping(folder: Path) -> None:
    """Fig. 20: 0 % without control, 4.1 % with it, of sessions of full length."""
    paths = [folder / "bc-open.mcap", folder / "bc-closed.mcap"]
    for path, control in zip(paths, (False, True), strict=True):
        simulate(Plan("bc-us-separation", gain_mw_per_mhz=12, control=control), str(path))
    outcome = analyze_all(paths)
    opened, closed = outcome.comparison
    assert not opened.closed and opened.frequency_hz == pytest.approx(0.37, abs=0.0005)
    assert opened.damping_percent == pytest.approx(0, abs=0.005)
    assert closed.gain_mw_per_mhz == 12 and closed.gained_percent == pytest.approx(4.08, abs=0.02)
    assert main_findings(outcome)[0].startswith("In open loop: 0.3700 Hz, damping 0.00 %")
    assert outcome.sessions[0].noise_mhz < 0.01


def test_a_session_that_is_probed_to_its_end_was_closed_all_the_same(folder: Path) -> None:
    path = folder / "probing.mcap"
    simulate(Plan("probing", duration_s=12), str(path))
    (found,) = analyze([path]).ringdowns
    assert (found.closed, found.gain_mw_per_mhz, found.mode) == (True, 9.0, None)


def test_a_square_pulse_is_fitted_after_it(folder: Path) -> None:
    path = folder / "square.mcap"
    simulate(Plan("square-pulse", gain_mw_per_mhz=9), str(path))
    (found,) = analyze([path]).ringdowns
    assert (found.begin_ns - START_NS) / 1e9 > 13.5
    assert found.mode is not None
    assert found.mode.damping_percent.median == pytest.approx(10.43, abs=0.1)


def test_json_says_what_the_log_says(report: tuple[Path, dict[str, Any]], closed: Path) -> None:
    told = report[1]["sessions"][0]
    ticks = list(SessionReader(closed).ticks())
    assert told["timing"]["ticks"] == len(ticks) == 1800
    assert [state["name"] for state in told["states"]] == ["INIT", "STANDBY", "ARMED", "ACTIVE"]
    assert told["commands"]["peak_mw"] == max(abs(tick.record.command_mw) for tick in ticks)
    assert told["events_total"] == sum(len(tick.record.events) for tick in ticks)
    assert [order["name"] for order in told["orders"]] == ["closed_loop", "arm", "activate"]
    assert told["gaps"] == told["damage"] == told["notes"] == []
    frames = [sum(frame.name == pmu["name"] for tick in ticks for frame in tick.frames) for pmu in told["pmus"]]
    assert [pmu["received"] for pmu in told["pmus"]] == frames and not any(pmu["lost"] for pmu in told["pmus"])
    assert told["pmus"][0]["delay_ms"]["p50"] == pytest.approx(60, abs=0.01)
    effective = told["delay_budget"][-1]
    assert effective["name"] == "Effective" and effective["mean_ms"] == pytest.approx(82, abs=0.05)
    rows = report[1]["comparison"]
    assert [row["loop"] for row in rows] == ["open", "closed"]
    assert rows[1]["gained_percent"] == pytest.approx(2.63, abs=0.02)
    assert report[1]["between"][0]["why"] == "the sessions overlap"


def test_the_page_is_whole_and_loads_nothing(report: tuple[Path, dict[str, Any]]) -> None:
    out, _ = report
    page = (out / "report.html").read_text()
    assert "default-src &#39;none&#39;" in page
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=", page)
    for name in set(re.findall(r'href="(figures/[^"]+)"', page)):
        assert (out / name).stat().st_size > 1000
    for words in ("Open loop against closed", "Timeline", "Delay budget", "Changes of the active instance"):
        assert words in page
    assert {path.name for path in out.iterdir()} == {"report.html", "analysis.json", "figures"}


def test_a_stream_that_stops(faulty: Path) -> None:
    session = analyze([faulty])
    switches = [(each.from_instance, each.to_instance) for each in session.switches]
    assert switches == [("", "N1-S1"), ("N1-S1", "N2-S1")]
    assert "arrival_gap N1" in session.switches[1].why and abs(session.switches[1].step_mw) < 2
    assert ("arrival_gap", "N1") in {(entry.name, entry.subject) for entry in session.register}
    assert session.flags["arrival_gap"][0].begin_ns == pytest.approx(START_NS + 10.1e9, abs=0.1e9)
    uses = {use.name: use for use in session.instances}
    assert uses["N1-S1"].active == pytest.approx(0.5, abs=0.01) and uses["N1-S1"].disabled_times == 1
    assert uses["N2-S1"].active == pytest.approx(0.5, abs=0.01) and uses["N2-S1"].disabled_times == 0


def test_frames_lost_and_doubled_are_counted(tmp_path: Path) -> None:
    from pmutools.impair.profile import parse_profile

    profile = parse_profile("[stream N2]\ndrop = 100-109\n[stream S3]\nduplicate = 20%\n", "test")
    simulate(Plan(profile=profile, duration_s=10), str(tmp_path / "s.mcap"))
    pmus = {pmu.name: pmu for pmu in analyze([tmp_path / "s.mcap"]).pmus}
    assert (pmus["N2"].lost, pmus["N2"].longest_gap_s) == (10, pytest.approx(10 / 60))
    assert 80 < pmus["S3"].duplicated < 160 and pmus["S3"].lost == 0
    assert pmus["N1"].lost == pmus["N1"].duplicated == 0


def test_a_session_in_parts_is_one(closed: Path, tmp_path: Path) -> None:
    reader = SessionReader(closed)
    head = Head(reader.ini_text, reader.pmus, reader.instances, reader.flags)
    with RollingWriter(tmp_path / "s.mcap", head, max_minutes=0.2) as log:
        log_configs(log, reader.configs)
        for tick in reader.ticks():
            log_tick(log, tick.record, tick.frames, tick.orders, instances=reader.instances)
    assert len(log.parts) == 3
    whole, parted = analyze([closed]), analyze_all(log.parts)
    (session,) = parted.sessions
    assert session.ringdowns == whole.ringdowns and session.commands == whole.commands and not session.gaps
    (log.parts[1]).unlink()
    (torn,) = analyze_all([log.parts[0], log.parts[2]]).sessions
    assert len(torn.gaps) == 1 and torn.gaps[0].ticks == pytest.approx(720, abs=1)
    assert torn.gaps[0].why == "lost by the log"


@pytest.mark.parametrize("keep", [0.2, 0.98])
def test_a_cut_log(closed: Path, tmp_path: Path, keep: float) -> None:
    data = closed.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: round(keep * len(data))])
    assert run(dcon(), ["analyze", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 3
    told = json.loads((tmp_path / "out" / "analysis.json").read_text())["sessions"][0]
    assert told["timing"]["ticks"] == pytest.approx(1800 * keep, abs=300)
    assert "no intact end" in told["damage"][0]
    assert "could not be read" in (tmp_path / "out" / "report.html").read_text()


def test_a_rotten_log_says_what_is_missing(closed: Path, tmp_path: Path) -> None:
    data = bytearray(closed.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "rot.mcap").write_bytes(data)
    outcome = analyze_all([tmp_path / "rot.mcap"])
    (session,) = outcome.sessions
    assert outcome.lost and len(session.gaps) == 1 and 30 <= session.gaps[0].ticks <= 120
    assert any("damaged chunk" in note for note in session.notes)


def test_foreign_files_are_said_and_the_rest_is_read(closed: Path, tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "foreign.mcap").write_text("no log")
    (tmp_path / "empty.mcap").touch()
    both = [str(tmp_path / "foreign.mcap"), str(tmp_path / "empty.mcap")]
    assert run(dcon(), ["analyze", *both, str(closed), "--out", str(tmp_path / "out"), "--json"]) == 3
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert [entry["why"].rpartition(": ")[2] for entry in told["unread"]] == ["not an MCAP file", "empty file"]
    assert len(told["sessions"]) == 1 and "not read: " in said.err
    assert run(dcon(), ["analyze", both[0], "--out", str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err == f"dcon: {both[0]}: not an MCAP file\n"
    assert not (tmp_path / "none").exists()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), min_size=1, max_size=400), st.integers(4, 100))
def test_thinning_keeps_the_extremes(values: list[float], most: int) -> None:
    y = np.array(values)
    x = np.arange(len(y), dtype=np.float64)
    at, thin = thinned(x, y, most)
    assert len(thin) <= 2 * most + 2 and (np.diff(at) >= 0).all()
    assert np.array_equal(y[at.astype(np.int64)], thin, equal_nan=True)
    if np.isfinite(y).any():
        assert np.nanmax(thin) == np.nanmax(y) and np.nanmin(thin) == np.nanmin(y)


def test_what_is_too_short_to_be_seen_is_a_shade() -> None:
    """An hour in which a flag is up for one tick in each second, and once for a minute."""
    shown_ms = (START_NS / 1e6, START_NS / 1e6 + 3.6e6)
    ticks = [Stretch("flag", START_NS + k * 10**9, START_NS + k * 10**9 + 10**9 // 60) for k in range(3540)]
    minute = Stretch("flag", START_NS + 3540 * 10**9, START_NS + 3600 * 10**9)
    cell_ms = 3.6e6 / SHADES
    shade, exact = bars("flag", [*ticks, minute], 3, theme.VERMILION, shown_ms)
    assert exact.color == theme.VERMILION and exact.x[:2].tolist() == [minute.begin_ns / 1e6, minute.end_ns / 1e6]
    begins, ends = shade.x[::3], shade.x[1::3]
    assert shade.color == theme.tint(theme.VERMILION, 0.35)
    assert len(begins) == pytest.approx(SHADES * 59 / 60, abs=1)
    assert np.allclose(ends - begins, cell_ms, atol=1e-3)
    assert shade.hover[0].startswith("flag: 9 times, 0.150 s in all")
    lone, itself = bars("flag", ticks[:1], 3, theme.VERMILION, shown_ms)
    assert lone.x[1] - lone.x[0] == pytest.approx(cell_ms) and len(itself.x) == 3
    assert [line.color for line in bars("flag", [minute], 3, theme.VERMILION, shown_ms)] == [theme.VERMILION]
