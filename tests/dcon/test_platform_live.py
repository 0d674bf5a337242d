"""``dcon platform`` as a process on loopback: real sockets, real clocks, real signals, judged by its own log.

All sessions of this module run at the same time, fed by the same emulated PMUs, so that it takes seconds.
"""

from __future__ import annotations

import json
import random
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest
from support.emulator import Emulator, Gateway
from support.live import free_udp_port
from support.swing import Streams, peak_after

from dcon.cli import dcon
from dcon.core.values import InstanceState, Mode, SystemState
from dcon.limiter import SLEW_MW_PER_S
from dcon.link.command import CommandOut
from dcon.replay.replay import replay
from dcon.session.reader import LoggedTick, SessionReader
from pmutools.cli.shell import run
from pmutools.timebase import NS, format_utc

pytestmark = pytest.mark.realtime
FOUR, TWO = ("N1", "N2", "S1", "S2"), ("N1", "S1")
ARMED = ("1.8:arm", "2.0:activate")
CHANGE_S, FLOOD_S, END_S = 2.4, 3.0, 4.4
"""Seconds from the common start."""
SEEN_S = 0.16
"""From a swing to the command that answers: 40 ms on the way, 104 ms in the filter, the tick."""


@dataclass
class Session:
    """A controller process and what it leaves."""

    folder: Path
    names: tuple[str, ...]
    ports: dict[str, int]
    gateway: Gateway = field(default_factory=Gateway)
    process: subprocess.Popen[str] | None = None
    out: str = ""
    err: str = ""
    commands: list[CommandOut] = field(default_factory=list)

    @property
    def log(self) -> Path:
        return self.folder / "s.mcap"

    def start(self, start_ns: int, *arguments: str, ini: str | None = None) -> None:
        urls = [f"udp://127.0.0.1:{self.ports[name]}" for name in self.names]
        extra = f"\n[output]\nurl = udp://127.0.0.1:{self.gateway.port}\n[platform]\nfifo = no\n"
        text = Streams(self.names).ini(urls=urls, extra=extra) if ini is None else ini
        (self.folder / "dcon.ini").write_text(text)
        self.gateway.start()
        command = [sys.executable, "-m", "dcon.cli", "platform", "--ini", str(self.folder / "dcon.ini"), "--json"]
        command += ["--log", str(self.log), "--start", format_utc(start_ns), *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def end(self) -> None:
        assert self.process is not None
        try:
            self.out, self.err = self.process.communicate(timeout=20)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
            self.commands = self.gateway.close()

    @property
    def code(self) -> int | None:
        assert self.process is not None
        return self.process.returncode

    def ticks(self) -> list[LoggedTick]:
        return list(SessionReader(self.log).ticks())


@dataclass
class Sessions:
    start_ns: int
    signal_s: float
    """When the signals come: the command is far from 0."""
    whole: Session
    stopped: Session
    killed: Session
    foreign: Session
    slow: Session


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sessions]:
    made = []
    for names in (FOUR, TWO, TWO, TWO, TWO):
        folder = tmp_path_factory.mktemp("live")
        made.append(Session(folder, names, {name: free_udp_port() for name in names}))
    start_ns = (time.time_ns() // NS + 4) * NS  # time to start five interpreters, on a busy machine too
    signal_s = (peak_after(start_ns + round((3.3 - SEEN_S) * NS)) - start_ns) / NS + SEEN_S
    told = Sessions(start_ns, signal_s, *made)
    sixty = {name: [each.ports[name] for each in made[:4] if name in each.ports] for name in FOUR}
    try:
        orders = [word for order in ARMED for word in ("--order", order)]
        told.whole.start(start_ns, "--duration", str(END_S), *orders, "--order", "3.3:disarm")
        told.stopped.start(start_ns, "--order", "1.7:closed_loop", *orders)
        told.killed.start(start_ns, "--order", "1.7:closed_loop", *orders)
        wrong = Streams(TWO).ini(urls=[f"udp://127.0.0.1:{told.foreign.ports[name]}" for name in TWO])
        told.foreign.start(start_ns, ini=wrong.replace("idcode = 101", "idcode = 999") + "[platform]\nfifo = no\n")
        told.slow.start(start_ns, "--duration", "4")
        with Emulator(sixty) as emulator, Emulator({name: [told.slow.ports[name]] for name in TWO}, rate=50):
            _sleep_until(start_ns, CHANGE_S)
            emulator.slim("N2")
            _sleep_until(start_ns, FLOOD_S)
            _flood(told.whole.ports["N1"], 0.3)
            _sleep_until(start_ns, signal_s)
            for session, number in ((told.stopped, signal.SIGTERM), (told.killed, signal.SIGKILL)):
                assert session.process is not None
                session.process.send_signal(number)
            assert told.foreign.process is not None
            told.foreign.process.send_signal(signal.SIGINT)
            for session in made:
                session.end()
        yield told
    finally:
        for session in made:
            if session.process is not None and session.process.poll() is None:
                session.process.kill()
                session.process.wait()


def _sleep_until(start_ns: int, seconds: float) -> None:
    time.sleep(max((start_ns - time.time_ns()) / NS + seconds, 0))


def _flood(port: int, seconds: float) -> None:
    """Random bytes, cut and bent frames, other senders: some thousand datagrams a second."""
    rng = random.Random(1)
    frame = Streams(("N1",)).data("N1", time.time_ns())
    end = time.monotonic() + seconds
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        while time.monotonic() < end:
            for _ in range(10):
                kind = rng.randrange(4)
                data = rng.randbytes(rng.choice((0, 1, 40, 1400))) if kind == 0 else bytearray(frame)
                if kind == 1:
                    data = data[: rng.randrange(len(data))]
                elif kind == 2:
                    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)  # type: ignore[index]
                elif kind == 3:
                    data = data[:2] + rng.randbytes(12) + data[14:]
                sock.sendto(bytes(data), ("127.0.0.1", port))
            time.sleep(0.003)


def replays(session: Session) -> None:
    result = replay(str(session.log))
    assert (result.different, result.stopped, result.problems) == (0, "", []), str(result.first)


def test_ticks_are_consecutive_at_their_phase(sessions: Sessions) -> None:
    session = sessions.whole
    assert session.code == 0, session.err
    ticks = session.ticks()
    numbers = [(tick.record.tick_ns - 4_000_000) * 60 for tick in ticks]
    assert all(abs(number - round(number / NS) * NS) <= 60 for number in numbers)
    assert [round((b - a) / NS) for a, b in pairwise(numbers)] == [1] * (len(ticks) - 1)
    assert ticks[-1].record.tick_ns <= sessions.start_ns + round(END_S * NS)
    assert ticks[0].record.tick_ns < sessions.start_ns + 1.5 * NS and len(ticks) > (END_S - 1.5) * 60
    late_us = [tick.timing.late_us for tick in ticks if tick.timing is not None]
    compute_us = [tick.timing.compute_us for tick in ticks if tick.timing is not None]
    assert len(late_us) == len(ticks)
    assert statistics.median(late_us) < 5_000 and statistics.median(compute_us) < 5_000
    summary = json.loads(session.out)
    assert summary["ticks"] == len(ticks) and summary["skipped_ticks"] == 0
    assert summary["frames"] == sum(len(tick.frames) for tick in ticks)


def test_in_open_loop_commands_are_computed_and_0_mw_is_sent_in_sequence(sessions: Sessions) -> None:
    session = sessions.whole
    records = [tick.record for tick in session.ticks()]
    assert {record.mode for record in records} == {Mode.OPEN_LOOP}
    assert SystemState.ACTIVE in {record.state for record in records}
    assert max(abs(record.command_mw) for record in records) > 15
    assert [command.sequence for command in session.commands] == list(range(len(records) + 1))
    assert [command.time_ns for command in session.commands[:-1]] == [record.tick_ns for record in records]
    assert {(command.command_mw, command.output_v) for command in session.commands} == {(0.0, 0.0)}


def test_frames_are_those_that_were_sent(sessions: Sessions) -> None:
    frames = [frame for tick in sessions.whole.ticks() for frame in tick.frames]
    for name in FOUR:
        own = [frame for frame in frames if frame.name == name]
        assert len(own) > 60 * (END_S - 1.5)
        delays_ms = [((frame.arrival_ns or 0) - frame.time_ns) / 1e6 for frame in own]
        assert min(delays_ms) >= 40 and statistics.median(delays_ms) < 60
        assert {str(frame.stamp_source) for frame in own} <= {"kernel", "user"}


def test_a_changed_configuration_is_an_event_and_the_pmu_is_verified_anew(sessions: Sessions) -> None:
    ticks = sessions.whole.ticks()
    (changed,) = [tick.record for tick in ticks if any(e.name == "config_changed" for e in tick.record.events)]
    assert [event.subject for event in changed.events if event.name == "config_changed"] == ["N2"]
    assert sessions.start_ns + CHANGE_S * NS <= changed.tick_ns <= sessions.start_ns + (CHANGE_S + 0.5) * NS
    of_n2 = [tick.record.instances[2] for tick in ticks]  # N2-S1
    at = [tick.record for tick in ticks].index(changed)
    assert of_n2[at - 1].state is InstanceState.READY
    assert of_n2[at + 1].state is not InstanceState.READY
    sizes = {len(frame.wire) for tick in ticks for frame in tick.frames if frame.name == "N2"}
    assert len(sizes) == 2


def test_a_flood_of_garbage_stops_nothing(sessions: Sessions) -> None:
    session = sessions.whole
    assert "Traceback" not in session.err and "error" not in session.err
    at_s = [((tick.record.tick_ns - sessions.start_ns) / NS, tick) for tick in session.ticks()]
    during = [tick for seconds, tick in at_s if FLOOD_S <= seconds < FLOOD_S + 0.3]
    assert len(during) == 18
    assert sum(frame.name == "S1" for tick in during for frame in tick.frames) >= 16
    assert json.loads(session.out)["unread"] == {}


def test_the_session_replays_bit_for_bit(sessions: Sessions) -> None:
    replays(sessions.whole)
    assert run(dcon(), ["replay", str(sessions.whole.log), "--quiet"]) == 0


def test_sigterm_ramps_the_command_down_and_leaves_a_whole_log(sessions: Sessions) -> None:
    session = sessions.stopped
    assert session.code == 130, session.err
    records = [tick.record for tick in session.ticks()]
    down = next(k for k, record in enumerate(records) if record.state is SystemState.RAMPDOWN)
    assert abs(records[down - 1].command_mw) > 15
    assert len(records) - down == pytest.approx(61, abs=2)
    assert records[-1].state is SystemState.STANDBY
    sent = [command.command_mw for command in session.commands]
    assert sent[-1] == 0.0 and session.commands[-1].output_v == 0.0
    assert [command.sequence for command in session.commands] == list(range(len(sent)))
    assert max(abs(b - a) for a, b in pairwise(sent)) <= SLEW_MW_PER_S / 60 + 1e-9
    assert max(map(abs, sent)) > 15
    assert not SessionReader(session.log).damage
    replays(session)
    assert json.loads(session.out)["final_state"] == "STANDBY"


def test_a_log_is_readable_to_its_last_flush_after_kill_9(sessions: Sessions) -> None:
    """Flushed once a second: at most the last second is lost, and what is there replays."""
    session = sessions.killed
    assert session.code == -signal.SIGKILL
    ticks = session.ticks()
    last_s = (ticks[-1].record.tick_ns - sessions.start_ns) / NS
    assert sessions.signal_s - 1.25 < last_s <= sessions.signal_s + 0.1
    result = replay(str(session.log))
    assert result.different == 0 and result.ticks == len(ticks)
    assert "the log has no intact end" in result.stopped


def test_a_wrong_idcode_is_said_and_the_controller_runs(sessions: Sessions) -> None:
    session = sessions.foreign
    assert session.code == 130, session.err
    assert "IDCODE 101 comes from 127.0.0.1:" in session.err
    assert f"asked for: udp://127.0.0.1:{session.ports['N1']}?idcode=999" in session.err
    records = [tick.record for tick in session.ticks()]
    assert records[-1].state is SystemState.INIT
    assert records[-1].age_ms[1] < 200 and records[-1].age_ms[0] != records[-1].age_ms[0]
    replays(session)


def test_50_frames_a_second_end_the_start_in_one_line(sessions: Sessions) -> None:
    session = sessions.slow
    assert session.code == 2
    *before, said = session.err.splitlines()
    told = (
        "no configuration for its data: held until one comes",
        "frames/s, the controller runs at 60",
    )  # where data came first; of one PMU
    assert all(any(words in line for words in told) for line in before)
    assert said.startswith("dcon: PMU ") and "stream" in said
    assert "sends 50 frames/s, the controller runs at 60; set rate = 50 for all PMUs, or the PMU to 60" in said
    assert session.commands[-1].output_v == 0.0


def test_a_port_in_use_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        urls = [f"udp://127.0.0.1:{port}", f"udp://127.0.0.1:{free_udp_port()}"]
        (tmp_path / "dcon.ini").write_text(Streams(TWO).ini(urls=urls))
        assert run(dcon(), ["platform", "--ini", str(tmp_path / "dcon.ini"), "--log", str(tmp_path / "s.mcap")]) == 1
    err = capsys.readouterr().err
    assert f"udp://127.0.0.1:{port}" in err and err.count("\n") == 1
    assert not (tmp_path / "s.mcap").exists()
