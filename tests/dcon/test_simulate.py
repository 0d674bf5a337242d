"""``dcon simulate``: Table II through bytes, the delay sweep, and runs that are functions of their plan."""

from __future__ import annotations

import cmath
import json
import math
import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dcon.cli import dcon
from dcon.columns.read import read_columns
from dcon.core.differentiator import coefficients, response
from dcon.core.params import RATES
from dcon.core.values import Event
from dcon.limiter import MW_PER_V
from dcon.replay.replay import replay
from dcon.session.reader import SessionReader
from dcon.sim.delays import split
from dcon.sim.judging import why_unjudged
from dcon.sim.plan import Plan
from dcon.sim.simulate import SCHEDULE_MW, simulate
from pmutools.c37118 import decode_config
from pmutools.cli.shell import run
from pmutools.grid.modal import SEPARATED_FROM_ALBERTA, SINGLE_MODE
from pmutools.grid.theory import closed_loop_eigenvalue, frequency_and_damping
from pmutools.impair.profile import parse_profile

Capsys = pytest.CaptureFixture[str]
KEYS = (
    *("scenario", "plant", "gain_mw_per_mhz", "delay_ms", "rate_hz", "seed", "duration_s", "mode"),
    *("mode_reason", "open_loop", "peak_command_mw", "final_state", "events"),
)


def differentiator(s: complex, rate: int = 60) -> complex:
    """The controller's, over true frequency."""
    return response(coefficients(rate), cmath.exp(s / rate)) * 2 * math.pi / s


def told(capsys: Capsys, *arguments: str) -> list[dict[str, object]]:
    assert run(dcon(), ["simulate", *arguments, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    return said if isinstance(said, list) else [said]


@pytest.mark.parametrize("rate", RATES)
def test_every_rate_damps_as_its_own_filter_does(rate: int, capsys: Capsys) -> None:
    """A 60 Hz grid whatever the rate; the loop's eigenvalue is worked out with the filter of that rate."""
    (result,) = told(capsys, "cjb", "--rate", str(rate), "--gain", "12", "--duration", "13")
    exact = closed_loop_eigenvalue(
        SINGLE_MODE, SINGLE_MODE[0], 12, delay_s=0.082, feedback=lambda s: differentiator(s, rate)
    )
    hz, ratio = frequency_and_damping(exact)
    mode = result["mode"]
    assert isinstance(mode, dict) and result["rate_hz"] == rate
    assert mode["frequency_hz"] == pytest.approx(hz, abs=0.002)
    assert mode["damping_percent"] == pytest.approx(100 * ratio, abs=0.1)
    assert result["final_state"] == "ACTIVE"


def test_fifty_frames_a_second_of_a_60_hz_grid(tmp_path: Path, capsys: Capsys) -> None:
    told(capsys, "cjb", "--rate", "50", "--duration", "3", "--out", str(tmp_path))
    path = tmp_path / "session.mcap"
    config = decode_config(SessionReader(path).configs["N1"])[1]
    assert (config.rate, config.stations[0].fnom_hz) == (50, 60.0)
    again = replay(path)
    assert (again.ticks, again.different, again.stopped) == (180, 0, "")


def test_a_rate_that_no_pmu_has(capsys: Capsys) -> None:
    assert run(dcon(), ["simulate", "cjb", "--rate", "25"]) == 2
    assert "--rate': 25 is not one of 30, 50, 60, 100, 120 frames/s" in capsys.readouterr().err


@pytest.mark.parametrize(("gain", "hz", "percent"), [(0, 0.425, 7.8), (9, 0.433, 10.3), (12, 0.435, 11.4)])
def test_simulation_rows_of_table_2(gain: float, hz: float, percent: float, capsys: Capsys) -> None:
    (result,) = told(capsys, "cjb", "--gain", str(gain))
    mode, open_loop = result["mode"], result["open_loop"]
    assert isinstance(mode, dict) and isinstance(open_loop, dict)
    assert mode["frequency_hz"] == pytest.approx(hz, abs=1.5e-3)
    assert mode["damping_percent"] == pytest.approx(percent, abs=0.15)
    assert mode["r2"] > 0.9999
    # the judge recovers the plant's own mode far closer than the rows are held to
    assert open_loop["frequency_hz"] == pytest.approx(0.425, abs=1e-5)
    assert open_loop["damping_percent"] == pytest.approx(7.8, abs=0.002)
    assert result["final_state"] == "ACTIVE"
    assert isinstance(result["peak_command_mw"], float) and result["peak_command_mw"] < 125.0


@pytest.mark.parametrize(("delay_ms", "percent"), [(0, 11.73), (113, 11.09), (200, 10.31), (300, 9.16)])
def test_damping_over_delay(delay_ms: float, percent: float) -> None:
    """The row of exact eigenvalues; an ordered delay is no fault to the controller, however long."""
    outcome = simulate(Plan(gain_mw_per_mhz=12, delay_ms=delay_ms, duration_s=18.5))
    assert outcome.mode is not None
    assert outcome.mode.damping_percent == pytest.approx(percent, abs=0.02)
    assert outcome.final_state == "ACTIVE"


@pytest.mark.parametrize("total_ms", [0, 5, 11, 15, 22, 82, 300])
def test_the_parts_of_a_delay_make_the_whole(total_ms: float) -> None:
    parts = split(total_ms)
    assert parts.total_ns == total_ms * 1_000_000
    assert min(parts) >= 0
    assert parts.phase_ns <= 71_000_000  # so that no frame is late, whatever the whole


def test_json_has_the_documented_keys(capsys: Capsys) -> None:
    (result,) = told(capsys, "cjb", "--no-control", "--duration", "12")
    assert tuple(result) == KEYS
    assert result["mode"] is None and result["mode_reason"] == "the loop was open: control was not asked for"
    assert isinstance(result["open_loop"], dict) and set(result["open_loop"]) >= {"frequency_hz", "damping_percent"}
    assert (result["scenario"], result["plant"], result["gain_mw_per_mhz"]) == ("cjb", "modal", 9.0)
    assert (result["delay_ms"], result["seed"], result["duration_s"]) == (82.0, 1, 12.0)
    assert (result["peak_command_mw"], result["final_state"]) == (0.0, "STANDBY")
    assert isinstance(result["events"], list)
    assert {"time_s", "name"} <= set(result["events"][0])
    (result,) = told(capsys, "cjb", "--duration", "1")  # over before the brake
    assert result["mode"] is None and result["open_loop"] is None
    assert result["mode_reason"] == "too short: of the ringdown, from 6.5 s on, 4 s are needed"


def test_a_run_is_a_function_of_plan_and_seed(tmp_path: Path) -> None:
    def log(name: str, seed: int) -> bytes:
        plan = Plan(faults=("table1-delays",), noise_rad=1e-4, duration_s=4, seed=seed)
        simulate(plan, str(tmp_path / name))
        return (tmp_path / name).read_bytes()

    one, again, other = log("one", 1), log("again", 1), log("other", 2)
    assert one == again
    assert one != other


def test_the_seed_draws_the_noise_and_the_faults() -> None:
    def commands(seed: int) -> list[float]:
        return simulate(Plan("ambient", noise_rad=1e-4, duration_s=3, seed=seed)).command_mw

    assert commands(1) == commands(1) != commands(2)


def test_simulated_sessions_begin_initialised_and_rows_are_consecutive(capsys: Capsys) -> None:
    outcome = simulate(Plan(duration_s=5))
    names = {event.name: time_s for time_s, event in reversed(outcome.events)}
    assert names["active"] < 0.2
    assert len(outcome.tick_s) == 300
    assert all(b - a == pytest.approx(1 / 60, abs=1e-6) for a, b in pairwise(outcome.tick_s))


def test_a_sweep_is_every_combination_in_order(tmp_path: Path, capsys: Capsys) -> None:
    sweeps = ("--sweep", "gain=0:12:6", "--sweep", "delay=82:113:31", "--sweep", "noise=0.1:0.1:1")
    rows = told(capsys, "cjb", *sweeps, "--duration", "3", "--out", str(tmp_path / "runs"))
    assert [row["swept"] for row in rows] == [
        {"gain": gain, "delay": delay, "noise": 0.1} for gain in (0.0, 6.0, 12.0) for delay in (82.0, 113.0)
    ]
    assert all(row["swept"]["gain"] == row["gain_mw_per_mhz"] for row in rows)  # type: ignore[index]
    assert json.loads((tmp_path / "runs" / "result.json").read_text()) == rows
    for number, row in enumerate(rows, 1):
        assert row["session"] == str(tmp_path / "runs" / f"session-{number}.mcap")
        plan = Plan(gain_mw_per_mhz=row["gain_mw_per_mhz"], delay_ms=row["delay_ms"], noise_rad=1e-4, duration_s=3)  # type: ignore[arg-type]
        alone = simulate(plan, str(tmp_path / "alone.mcap"))
        assert alone.to_json() == {key: row[key] for key in KEYS}
        assert (tmp_path / "alone.mcap").read_bytes() == Path(str(row["session"])).read_bytes()


def test_a_sweep_is_a_table(capsys: Capsys) -> None:
    arguments = ["cjb", "--sweep", "seed=1:3:1", "--sweep", "deadband=0:0.5:0.5", "--duration", "12"]
    assert run(dcon(), ["simulate", *arguments]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == [
        "seed",
        "deadband",
        "mHz",
        "frequency",
        "Hz",
        "damping",
        "%",
        "peak",
        "MW",
        "final",
        "state",
    ]
    assert [row.split()[:2] for row in rows] == [[str(seed), band] for seed in (1, 2, 3) for band in ("0", "0.5")]
    assert all(row.split()[-1] == "ACTIVE" and len(row) == len(head) for row in rows)


OPEN = {
    "disarmed before": (("--rate", "120", "--fault", "irregular"), "the loop was open: rampdown at "),
    "no frames any more": (("--fault", "all-stop"), "the loop was open: rampdown at 10.1"),
    "disarmed by ringing": (("--plant", "modal-five", "--gain", "40"), "the loop was open: rampdown at 7.4"),
}


@pytest.mark.parametrize(("arguments", "said"), OPEN.values(), ids=OPEN)
def test_a_loop_that_was_open_has_no_closed_loop_mode(arguments: tuple[str, ...], said: str, capsys: Capsys) -> None:
    (result,) = told(capsys, "cjb", *arguments, "--duration", "14")
    assert result["mode"] is None and str(result["mode_reason"]).startswith(said)
    assert isinstance(result["open_loop"], dict)
    assert run(dcon(), ["simulate", "cjb", *arguments, "--duration", "14"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("  closed loop"))
    assert line == f"  closed loop  {result['mode_reason']}"


def test_a_sweep_shows_no_open_loop_in_a_closed_loops_place(capsys: Capsys) -> None:
    arguments = ["simulate", "cjb", "--fault", "all-stop", "--sweep", "gain=9:10:1", "--duration", "14"]
    assert run(dcon(), arguments) == 0
    out, err = capsys.readouterr()
    assert [row.split()[1:3] for row in out.splitlines()[1:]] == [["-", "-"]] * 2
    assert err.count("the loop was open") == 2
    assert run(dcon(), [*arguments, "--no-control"]) == 0
    out, err = capsys.readouterr()
    assert all(float(row.split()[1]) == pytest.approx(0.425, abs=1e-3) for row in out.splitlines()[1:]) and not err


def test_why_a_run_is_not_judged_is_asked_of_the_whole_window() -> None:
    plan = Plan(duration_s=14)  # its ringdown is from 6.5 s on
    ticks = [number / 60 for number in range(14 * 60)]
    active = [(1.0, Event("active", "system", "order"))]
    left = [*active, (9.0, Event("rampdown", "system", "bad")), (10.0, Event("standby", "system", ""))]
    for closed_s, events, said in (
        ((1, 14), active, ""),
        ((6.5, 14), active, ""),
        ((1, 9), left, "the loop was open: rampdown at 9.000 s, bad"),
        ((1, 5), active, "the loop was open: from 6.500 s on"),
        ((7, 14), active, "the loop was open: it was closed from 7.000 s on only, the ringdown begins at 6.5 s"),
        ((20, 30), [], "the loop was open: it was never armed and activated"),
    ):
        closed = [closed_s[0] <= at < closed_s[1] for at in ticks]
        assert why_unjudged(plan, ticks, closed, events) == said
    assert why_unjudged(Plan("probing"), ticks, [True] * len(ticks), []) == "the scenario has no ringdown"


def test_quiet_is_quiet(tmp_path: Path, capsys: Capsys) -> None:
    more: list[str]
    for more in ([], ["--sweep", "seed=1:2:1"], ["--out", str(tmp_path)]):
        assert run(dcon(), ["simulate", "cjb", "--duration", "1", "-q", *more]) == 0
        assert capsys.readouterr() == ("", "")
    assert json.loads((tmp_path / "result.json").read_text())["scenario"] == "cjb"


PROFILE = "[stream N1]\nloss = 1%\n"


@pytest.mark.parametrize("how", ["itself", "a symbolic link", "a hard link"])
@pytest.mark.parametrize("sweep", [False, True], ids=["a run", "a sweep"])
@pytest.mark.parametrize("written", ["result.json", "session"])
def test_what_is_written_is_not_the_profile(
    written: str, sweep: bool, how: str, tmp_path: Path, capsys: Capsys
) -> None:
    name = written if written == "result.json" else "session-1.mcap" if sweep else "session.mcap"
    out = tmp_path / "out"
    out.mkdir()
    profile = out / name if how == "itself" else tmp_path / "p.ini"
    profile.write_text(PROFILE)
    if how == "a symbolic link":
        (out / name).symlink_to(profile)
    elif how == "a hard link":
        (out / name).hardlink_to(profile)
    more = ["--sweep", "seed=1:2:1"] if sweep else []
    arguments = ["simulate", "cjb", "--duration", "1", "--impair", str(profile), "--out", str(out), *more]
    assert run(dcon(), arguments) == 2
    said, said_so = capsys.readouterr().err, ("is an input, and would be", "is there already, and would be")
    assert said.count("\n") == 1 and any(words in said for words in said_so)
    assert profile.read_text() == PROFILE and len(list(out.iterdir())) == 1


def test_a_single_run_leaves_its_result_beside_its_session(tmp_path: Path, capsys: Capsys) -> None:
    (result,) = told(capsys, "cjb", "--duration", "3", "--out", str(tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["result.json", "session.mcap"]
    assert json.loads((tmp_path / "result.json").read_text()) == result
    assert tuple(result) == (*KEYS, "session")


def test_a_mistake_in_one_run_of_a_sweep_is_one_line(capsys: Capsys) -> None:
    arguments = ["cjb", "--plant", "none", "--sweep", "gain=0:12:6", "--duration", "1"]
    assert run(dcon(), ["simulate", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err == "dcon: no plant 'none': one of modal, modal-five\n"


@pytest.mark.realtime
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no process groups here")
def test_ctrl_c_ends_a_sweep_and_its_processes() -> None:
    """Ctrl-C reaches the whole group; the answer is one exit code and no traceback."""
    command = [
        sys.executable,
        "-m",
        "dcon.cli",
        "simulate",
        "cjb",
        "--duration",
        "6",
        "--sweep",
        "seed=1:200:1",
        "--json",
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as sweep:
        assert sweep.stdout is not None
        assert sweep.stdout.readline() == "[\n" and sweep.stdout.readline().startswith('{"scenario"')
        os.killpg(sweep.pid, signal.SIGINT)
        _, said = sweep.communicate(timeout=30)  # to the end of both pipes: every process that had them is gone
        assert (sweep.returncode, said) == (130, "")


def test_the_command_saturates_and_a_gain_beyond_the_operators_is_for_simulation_only(capsys: Capsys) -> None:
    row, over = told(capsys, "cjb", "--sweep", "gain=15:20:5", "--duration", "8")
    assert row["gain_mw_per_mhz"] == 15.0 and over["gain_mw_per_mhz"] == 20.0
    assert over["peak_command_mw"] == 125.0
    assert over["final_state"] == "ACTIVE"


@pytest.mark.parametrize(
    ("fault", "loses"),
    [
        ("corrupt = 2% field=chk", True),
        ("corrupt = 2%", True),
        ("corrupt = 2% field=sync", True),
        ("corrupt = 2% field=idcode", True),
        ("corrupt = 2% truncate(20)", True),
        ("corrupt = 2% field=stat chk=fix", False),
        ("config = add(analogs=2) when=5..7", False),
    ],
)
def test_what_the_wire_damages_never_reaches_the_controller(tmp_path: Path, fault: str, loses: bool) -> None:
    """As live: a frame whose CHK fails, or that is no frame of the stream, is missing."""
    plan = Plan(duration_s=12, profile=parse_profile(f"[stream N1]\n{fault}\n", "profile"))
    path = tmp_path / "s.mcap"
    outcome = simulate(plan, str(path))
    names = {(event.name, event.subject) for _, event in outcome.events}
    assert (("stamp_step", "N1") in names) == loses
    again = replay(path)
    assert again.ticks == 12 * 60
    assert again.different == 0


def test_bc_us_separation_gains_the_papers_damping() -> None:
    """Figure 20: no damping of its own, 4.1 % with control."""
    outcome = simulate(Plan("bc-us-separation", gain_mw_per_mhz=12, duration_s=20))
    assert outcome.mode is not None and outcome.open_loop is not None
    assert outcome.open_loop.damping_percent == pytest.approx(0.0, abs=0.01)
    assert outcome.mode.damping_percent == pytest.approx(4.1, abs=0.1)


def test_bc_alberta_separation_leaves_one_slower_mode_that_is_damped() -> None:
    """Figure 7's case; frequency, damping and residue of this plant are assumed."""
    outcome = simulate(Plan("bc-alberta-separation", gain_mw_per_mhz=6, duration_s=20.5))
    assert outcome.mode is not None and outcome.open_loop is not None
    assert outcome.open_loop[:2] == pytest.approx((0.32, 8.0), abs=1e-3)
    (mode,) = SEPARATED_FROM_ALBERTA
    root = closed_loop_eigenvalue(SEPARATED_FROM_ALBERTA, mode, 6, feedback=differentiator)
    hertz, damping = frequency_and_damping(root)
    assert outcome.mode[:2] == pytest.approx((hertz, 100 * damping), abs=2e-3)
    assert outcome.mode.damping_percent > 10


@pytest.mark.parametrize("control", [True, False])
def test_probing_reaches_the_line_and_is_logged_apart_from_the_command(tmp_path: Path, control: bool) -> None:
    plan = Plan("probing", gain_mw_per_mhz=12, duration_s=25, control=control)
    outcome = simulate(plan, str(tmp_path / "s.mcap"))
    tick = read_columns(tmp_path / "s.mcap").tick
    assert outcome.final_state == "ACTIVE"
    assert not tick.probe_mw[:295].any() and 15 < abs(tick.probe_mw).max() <= 20
    driven_mw = tick.probe_mw + (tick.command_mw if control else 0)
    assert np.allclose(tick.output_v * MW_PER_V, driven_mw, atol=1e-9)
    # the line follows what was driven in the tick before, as long as the grid is looked at
    assert np.allclose(tick.pdci_mw[1:-5] - SCHEDULE_MW, driven_mw[:-6], atol=1e-9)
    assert 1 < max(map(abs, outcome.command_mw)) < 20
    assert replay(tmp_path / "s.mcap").different == 0


def test_a_square_pulse_is_driven_by_the_controller_and_rings_the_mode(tmp_path: Path) -> None:
    outcome = simulate(Plan("square-pulse", gain_mw_per_mhz=0, duration_s=26), str(tmp_path / "s.mcap"))
    tick = read_columns(tmp_path / "s.mcap").tick
    assert (tick.probe_mw.max(), tick.probe_mw.min()) == (125, -125)
    assert not tick.probe_mw[(13 * 60) :].any()
    assert outcome.mode is not None and outcome.mode[:2] == pytest.approx((0.425, 7.8), abs=0.02)


def test_five_modes_keep_table_2() -> None:
    outcome = simulate(Plan(plant="modal-five", gain_mw_per_mhz=12, duration_s=19))
    assert outcome.mode is not None
    assert outcome.mode.frequency_hz == pytest.approx(0.435, abs=1.5e-3)
    assert outcome.mode.damping_percent == pytest.approx(11.3, abs=0.15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cbj"], "no scenario 'cbj': one of cjb, "),
        (["cjb", "--plant", "modul"], "no plant 'modul': one of modal, "),
        (["cjb", "--fault", "stream-stp"], "no fault 'stream-stp'; did you mean 'stream-stop'?"),
        (["cjb", "--impair", "nothing.ini"], "--impair nothing.ini: neither a file nor a ready profile"),
        (["cjb", "--sweep", "gain=0:30"], "--sweep gain=0:30: write gain|delay|deadband|noise|seed=FROM:TO:STEP"),
        (["cjb", "--sweep", "gain=0:30:0"], "write gain"),
        (["cjb", "--sweep", "gain=-3:30:3"], "write gain"),
        (["cjb", "--sweep", "gain=0:nan:3"], "write gain"),
        (
            ["cjb", "--sweep", "delay=0:-1:1"],
            "--sweep delay=0:-1:1: write gain|delay|deadband|noise|seed=FROM:TO:STEP, not",
        ),
        (["cjb", "--sweep", "delay=5:-5:-5"], "not below 0"),
        (["cjb", "--sweep", "delay=0:1_0:5"], "not below 0"),
        (["cjb", "--sweep", "gain=0:२:1"], "not below 0"),
        (["cjb", "--sweep", "plant=0:30:3"], "write gain"),
        (["cjb", "--sweep", "seed=0:1:0.5"], "--sweep seed=0:1:0.5: seeds are whole numbers"),
        (["cjb", "--sweep", "gain=0:1:1", "--sweep", "gain=2:3:1"], "--sweep gain: given twice"),
        (["cjb", "--sweep", "seed=1:200:1", "--sweep", "gain=0:15:0.1"], "--sweep: more than 10000 runs"),
        (["bc-us-separation", "--plant", "modal-five"], "plant 'modal-five' has no condition 'bc-us-separated'"),
        (["cjb", "--impair", "typo.ini"], "--impair: no PMU is called N9; there are N1, N2"),
    ],
)
def test_a_mistake_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("typo.ini").write_text("[stream N9]\nloss = 5%\n")
    assert run(dcon(), ["simulate", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err and err.count("\n") == 1


def test_a_folder_that_cannot_be_made(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "file").write_text("")
    assert run(dcon(), ["simulate", "cjb", "--out", str(tmp_path / "file" / "x")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
