"""The demo: its pieces one by one, children that fail, and one whole run on a shortened course."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.live import free_udp_port
from support.running import descendants

from dcon.cli import dcon
from dcon.core.values import Pdci
from dcon.demo import conductor
from dcon.demo.conductor import Demo, DemoError, free_ports, perform, phase, report
from dcon.demo.course import BRAKE_S, Course
from dcon.demo.grid import SILENCE_NS, LiveGrid
from dcon.demo.judge import PAPER, judge, read_traces, summarise
from dcon.drivers import line_status
from dcon.link.command import CommandOut, encode
from dcon.sim.plan import START_NS, Plan
from dcon.sim.simulate import simulate
from pmutools.cli.shell import run
from pmutools.errors import SourceError
from pmutools.grid.scenarios import SCENARIOS
from pmutools.timebase import NS

SHORT = Course(open_loop_s=3.2, swing_s=6.5, init_s=0.8)
KEYS = {
    *("gain_mw_per_mhz", "open_loop", "closed_loop", "peak_command_mw", "final_state", "ticks", "frames"),
    *("delay_ms", "wake_up_late_us", "compute_us", "session", "picture"),
}


# --- the course --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("course", [Course(), SHORT, Course(swing_s=20)])
def test_a_course_is_in_order(course: Course) -> None:
    ordered = [order.at_ns / NS for order in course.orders]
    assert ordered == sorted(ordered)
    assert [order.order.name for order in course.orders] == [
        *("arm", "activate", "disarm", "closed_loop", "arm", "activate", "disarm")
    ]
    assert course.init_s < ordered[0] < course.open_loop_s < course.arm_s < course.closed_loop_s < course.disarm_s
    assert course.disarm_s < course.end_s == course.scenario.duration_s
    assert ordered[5] + 1 < course.closed_loop_s  # the transfer is over when the second brake comes
    assert [(pulse.start_s, pulse.stop_s) for pulse in course.scenario.pulses] == [
        (at, at + BRAKE_S) for at in (course.open_loop_s, course.closed_loop_s)
    ]
    for brake_s, next_s in ((course.open_loop_s, course.arm_s), (course.closed_loop_s, course.disarm_s)):
        start_s, stop_s = course.judged(brake_s)
        assert brake_s + BRAKE_S < start_s < stop_s - 4 and stop_s <= next_s


def test_a_phase_for_every_time() -> None:
    course = Course()
    said = [phase(course, seconds / 10) for seconds in range(-50, 700)]
    assert len(dict.fromkeys(said)) == 6
    assert "open loop" in phase(course, course.open_loop_s + 0.1)
    assert "closed loop" in phase(course, course.closed_loop_s + 0.1)


def test_ports_that_are_free_together() -> None:
    first = free_ports(9)
    held = []
    try:
        for port in range(first, first + 9):
            held.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            held[-1].bind(("127.0.0.1", port))
        assert free_ports(9) not in range(first - 8, first + 9)
    finally:
        for sock in held:
            sock.close()


# --- judging a session -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated session of the short course, both swings with the loop closed."""
    folder = tmp_path_factory.mktemp("judge")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENARIOS, "demo", SHORT.scenario)
        simulate(Plan("demo", gain_mw_per_mhz=12, noise_rad=1e-4), str(folder / "session.mcap"))
    return folder


def test_a_swing_is_judged_from_the_log_alone(closed: Path) -> None:
    traces = read_traces(str(closed / "session.mcap"), START_NS)
    assert len(traces.tick_s) == round(SHORT.end_s * 60)
    assert len(traces.time_s) == pytest.approx(SHORT.end_s * 60, abs=6)
    assert np.allclose(np.diff(traces.time_s), 1 / 60, atol=2e-6)
    assert traces.delay_ms == pytest.approx(60.0, abs=1e-3)
    assert traces.final_state == "ACTIVE"
    for brake_s in (SHORT.open_loop_s, SHORT.closed_loop_s):
        swing = judge(traces, SHORT, brake_s)
        assert swing is not None
        assert swing.frequency_hz == pytest.approx(0.435, abs=0.004)
        assert swing.damping_percent == pytest.approx(11.3, abs=0.5)
        assert swing.r2 > 0.98
        start_s, stop_s = SHORT.judged(brake_s)
        outside = (traces.time_s < start_s) | (traces.time_s >= stop_s)
        wild = replace(traces, delta_f_mhz=np.where(outside, 1e3 * np.sin(traces.time_s * 9), traces.delta_f_mhz))
        assert judge(wild, SHORT, brake_s) == swing


def test_a_session_that_ended_early_is_not_judged(closed: Path) -> None:
    traces = read_traces(str(closed / "session.mcap"), START_NS)
    early = replace(traces, time_s=traces.time_s[:600], delta_f_mhz=traces.delta_f_mhz[:600])
    summary = summarise(early, SHORT, 12.0)
    assert summary["closed_loop"] is None and summary["open_loop"] is not None
    nothing = np.array([])
    empty = replace(early, time_s=nothing, delta_f_mhz=nothing, output_mw=nothing, delay_ms=nothing, late_us=nothing)
    summary = summarise(empty, SHORT, 12.0)
    assert summary["open_loop"] is None and summary["delay_ms"] is None and summary["peak_command_mw"] == 0.0


def test_the_report_is_a_summary_and_a_picture(closed: Path) -> None:
    summary = report(Demo(closed, 12.0, SHORT), START_NS)
    assert set(summary) == KEYS
    assert json.loads((closed / "summary.json").read_text()) == summary
    for key, gain in (("open_loop", 0.0), ("closed_loop", 12.0)):
        row = summary[key]
        assert set(row) == {"frequency_hz", "damping_percent", "r2", "paper_frequency_hz", "paper_damping_percent"}
        assert (row["paper_frequency_hz"], row["paper_damping_percent"]) == PAPER[gain]
    picture = Path(summary["picture"])
    assert picture == closed / "demo.png"
    data = picture.read_bytes()
    assert data.startswith(b"\x89PNG") and len(data) > 20_000


def test_without_matplotlib_there_is_a_summary_and_a_word(
    closed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "dcon.demo.picture", None)
    monkeypatch.setattr(conductor, "perform", lambda demo, tell: report(Demo(closed, 12.0, SHORT), START_NS))
    assert run(dcon(), ["demo", "--out", str(closed)]) == 0
    out, err = capsys.readouterr()
    assert "11.4 %" in out and "picture" not in out
    assert "no picture: matplotlib is not installed; pip install '.[analysis]'" in err
    assert json.loads((closed / "summary.json").read_text())["picture"] is None


def test_swings_that_cannot_be_judged_are_a_failure(
    closed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = report(Demo(closed, 12.0, SHORT), START_NS) | {"closed_loop": None}
    monkeypatch.setattr(conductor, "perform", lambda demo, tell: summary)
    assert run(dcon(), ["demo", "--out", str(closed)]) == 1
    out, err = capsys.readouterr()
    assert "not fitted" in out and "could not be judged" in err


# --- the grid process --------------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_the_grid_takes_good_commands_in_sequence_and_forgets_a_silent_controller() -> None:
    port = free_udp_port()
    grid = LiveGrid(SHORT, START_NS, port, free_ports(8), "table1", 0.0, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:

        def applied(*datagrams: bytes) -> float:
            """The command in effect at the plant, 11 ms after these have come."""
            for datagram in datagrams:
                sock.sendto(datagram, ("127.0.0.1", port))
            grid._take_commands()  # loopback delivers before sendto returns
            grid.grid.advance(max(grid.last_command_ns, grid.grid.time_ns) + 12_000_000)
            return grid.grid.command_mw

        try:
            assert applied(encode(CommandOut(5, 0, 50.0, 4.0))) == 50.0
            bent = bytearray(encode(CommandOut(6, 0, 99.0, 8.0)))
            bent[20] ^= 1
            assert applied(b"", b"garbage" * 9, bytes(bent)) == 50.0
            assert applied(encode(CommandOut(4, 0, -50.0, -4.0))) == 50.0  # late
            assert applied(encode(CommandOut(7, 0, -25.0, -2.0))) == -25.0
            grid._silence(grid.last_command_ns + SILENCE_NS)
            assert grid.last_sequence == 7
            grid._silence(grid.last_command_ns + SILENCE_NS + 1)
            grid.grid.advance(grid.last_command_ns + SILENCE_NS + NS)
            assert grid.grid.command_mw == 0.0
            assert applied(encode(CommandOut(0, 0, 10.0, 0.8))) == 10.0  # a controller that was started anew
            grid._silence(grid.last_command_ns + SILENCE_NS + 1)
            grid.grid.advance(grid.last_command_ns + SILENCE_NS + NS)
            assert applied(encode(CommandOut((1 << 32) - 1, 0, 30.0, 2.4))) == 30.0
            assert applied(encode(CommandOut(0, 0, 20.0, 1.6))) == 20.0  # the number wraps
            assert applied(encode(CommandOut((1 << 32) - 1, 0, 30.0, 2.4))) == 20.0
        finally:
            grid.close()


@pytest.mark.realtime
def test_the_grid_tells_the_status_of_its_line() -> None:
    """What has arrived of the command is on top of the schedule: not what was sent just now."""
    port = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5)
        grid = LiveGrid(SHORT, START_NS, port, free_ports(8), "table1", 0.0, 1, listener.getsockname()[1])
        try:
            grid._tell_status(0, START_NS)
            assert line_status.decode(listener.recv(100)) == (0, Pdci(START_NS, 2000.0, True, True, 2000.0))
            grid.grid.command(-40.0, START_NS)
            grid.grid.advance(START_NS + 10_000_000)
            grid._tell_status(6, START_NS + 10_000_000)
            grid.grid.advance(START_NS + 12_000_000)
            for slot in range(7, 13):
                grid._tell_status(slot, START_NS + 12_000_000)
            told = [line_status.decode(listener.recv(100)) for _ in range(2)]
            assert [status and (status.sequence, status.line.power_mw) for status in told] == [(1, 2000.0), (2, 1960.0)]
            listener.setblocking(False)
            with pytest.raises(BlockingIOError):
                listener.recv(100)
        finally:
            grid.close()


# --- children that fail ------------------------------------------------------------------------------------------

LONG = ["-c", "import time; time.sleep(60)"]


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("failing", "said"),
    [
        (["-c", "import sys; print('first'); sys.exit('last words')"], "last words"),
        (["-m", "dcon.nothing"], "No module named dcon.nothing"),
        (["-c", "raise SystemExit(9)"], "exit code 9"),
        (["-c", "import os; os.kill(os.getpid(), 9)"], "exit code -9"),
    ],
)
@pytest.mark.parametrize("who", ["grid", "controller"])
def test_a_child_that_fails_is_told_and_the_other_is_ended(
    who: str, failing: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[conductor.Child] = []
    launch = conductor._launch

    def launched(arguments: list[str], said: Path) -> conductor.Child:
        started.append(launch(arguments, said))
        return started[-1]

    monkeypatch.setattr(conductor, "_launch", launched)
    monkeypatch.setattr(conductor, "_grid", lambda *args: failing if who == "grid" else LONG)
    monkeypatch.setattr(conductor, "_controller", lambda *args: failing if who == "controller" else LONG)
    monkeypatch.setattr(conductor, "_await_controller", lambda *args: None)
    began = time.monotonic()
    with pytest.raises(DemoError, match=rf"^the {who} process failed: .*{said}$"):
        perform(Demo(tmp_path, course=SHORT))
    assert time.monotonic() - began < 4  # it was asked to end, not waited for
    assert len(started) == 2 and all(child.process.poll() is not None for child in started)


@pytest.mark.realtime
def test_a_child_that_says_much_is_not_held_up_and_its_last_words_are_told(tmp_path: Path) -> None:
    script = "import sys; [print('warning', 'x' * 1000, file=sys.stderr) for _ in range(500)]; sys.exit('last words')"
    child = conductor._launch(["-c", script], tmp_path / "said.txt")
    assert child.process.wait(20) == 1
    assert conductor._last_words(child) == "last words"


@pytest.mark.realtime
def test_a_controller_that_fails_or_hangs_before_it_is_ready_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conductor, "WHOLE", True)
    monkeypatch.setattr(conductor, "_controller", lambda *args: ["-c", "raise SystemExit('no keys')"])
    with pytest.raises(DemoError, match=r"^the controller process failed: no keys$"):
        perform(Demo(tmp_path, course=SHORT))
    monkeypatch.setattr(conductor, "READY_S", 0.5)
    monkeypatch.setattr(conductor, "_controller", lambda *args: LONG)
    with pytest.raises(DemoError, match=r"^the controller is not ready after 0\.5 s"):
        perform(Demo(tmp_path, course=SHORT))


@pytest.mark.realtime
def test_a_command_port_in_use_ends_the_demo_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = free_ports(9)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", first))
        monkeypatch.setattr(conductor, "free_ports", lambda count: first)
        assert run(dcon(), ["demo", "--out", str(tmp_path), "--quiet"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("dcon: the grid process failed: grid: udp://127.0.0.1:") and err.count("\n") == 1
    assert "in use" in err


@pytest.mark.realtime
def test_a_processes_that_hang_are_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conductor, "GRACE_S", -SHORT.end_s - 5.0)
    monkeypatch.setattr(conductor, "_grid", lambda *args: LONG)
    monkeypatch.setattr(conductor, "_controller", lambda *args: LONG)
    monkeypatch.setattr(conductor, "_await_controller", lambda *args: None)
    with pytest.raises(DemoError, match="did not end in time"):
        perform(Demo(tmp_path, course=SHORT))


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match="--out"):
        perform(Demo(tmp_path / "file" / "x", course=SHORT))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--impair", "tabel1"], "neither a file nor a ready profile; did you mean 'table1'?"),
        (["--duration", "20"], "48"),
        (["--gain", "16"], "15"),
    ],
)
def test_a_mistake_is_told_before_anything_starts(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(dcon(), ["demo", "--out", str(tmp_path / "x"), *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder for what a demo that is killed leaves behind, with room in its name for that of a socket."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="finds the children in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_it(number: signal.Signals, tmp_path: Path, short: Path) -> None:
    command = [sys.executable, "-m", "dcon.cli", "demo", "--out", str(tmp_path), "--quiet"]
    environment = os.environ | {"TMPDIR": str(short)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment) as demo:
        try:
            deadline = time.monotonic() + 60
            while len(ended := list(descendants(demo.pid))) < 7 or not (tmp_path / "session.mcap").exists():
                assert time.monotonic() < deadline and demo.poll() is None
                time.sleep(0.05)
            demo.send_signal(number)
            _, err = demo.communicate(timeout=40)
        finally:
            if demo.poll() is None:
                os.killpg(demo.pid, signal.SIGKILL)
    assert demo.returncode == (130 if number is not signal.SIGKILL else -signal.SIGKILL)
    assert "Traceback" not in err
    deadline = time.monotonic() + 20
    while (left := [pid for pid in ended if Path(f"/proc/{pid}").exists()]) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert left == []


# --- all of it ---------------------------------------------------------------------------------------------------


@pytest.mark.alone
@pytest.mark.slow
@pytest.mark.realtime
def test_the_whole_chain_live_on_a_short_course(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sockets, processes and clocks as in ``dcon demo``; only the data are verified for less than 20 s."""
    monkeypatch.setattr(conductor, "LEAD_S", 1.5)
    told: list[str] = []
    (tmp_path / "session.mcap").write_bytes(b"that of a demo before")
    summary = perform(Demo(tmp_path, 12.0, SHORT), lambda text, seconds: told.append(text))
    assert len(told) == 7
    opened, closed = summary["open_loop"], summary["closed_loop"]
    assert opened["frequency_hz"] == pytest.approx(0.425, abs=0.005)
    assert opened["damping_percent"] == pytest.approx(7.8, abs=0.6)
    assert closed["frequency_hz"] == pytest.approx(0.435, abs=0.008)
    assert closed["damping_percent"] == pytest.approx(11.4, abs=1.0)
    assert closed["damping_percent"] > opened["damping_percent"] + 2
    assert 60 < summary["peak_command_mw"] <= 125
    assert summary["final_state"] == "STANDBY"
    assert summary["delay_ms"]["mean"] == pytest.approx(60, abs=3)
    assert {path.name for path in tmp_path.iterdir()} == {
        *("session.mcap", "session-2.mcap", "summary.json", "demo.png", "dcon.ini")
    }
    assert (tmp_path / "session.mcap").read_bytes() == b"that of a demo before"
    assert summary["session"] == str(tmp_path / "session-2.mcap")
    assert run(dcon(), ["replay", summary["session"], "--quiet"]) == 0
