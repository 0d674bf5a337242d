"""The watchdog as a process: killed, stopped, flooded, and its own log says when the relays opened."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.dogs import Dog, beating, closed, until, watchdog

from dcon.link.beats import (
    LoopName,
    LoopState,
    Readback,
    Verb,
    WatchdogState,
    encode_beat,
    encode_readback,
    encode_word,
)
from dcon.link.command import CommandOut, decode, encode
from dcon.watchdog import loop
from dcon.watchdog.core import step
from dcon.watchdog.files import Lines
from dcon.watchdog.links import Refused, bind_inbox, drain, output, run_folder
from dcon.watchdog.loop import TICK_NS

BOUND_MS = 120.0
"""From the end of a 60 Hz loop to open relays."""
SILENT = ("command_silent", "control_silent", "udp_silent", "parse_silent")
CALM = ("--limit", "late_max_ms=1000")
"""A machine that is shared pauses now and then: what is not judged here shall not trip."""


def opening_ms(dog: Dog, since_ns: int, *causes: str) -> float:
    """From ``since_ns`` to the trip, less what the machine kept the watchdog waiting, by its own log."""
    event = dog.event("trip")
    assert {found["rule"] for found in event["causes"]} & set(causes), event
    return float((event["monotonic_ns"] - since_ns) / 1e6 - max(0.0, event["late_ms"]))


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_relays_open_in_time_when_the_controller_dies_or_hangs(number: signal.Signals, tmp_path: Path) -> None:
    with closed(tmp_path / "run", *CALM) as (dog, controller):
        killed_ns = time.monotonic_ns()
        controller.send_signal(number)
        took_ms = opening_ms(dog, killed_ns, *SILENT)  # killed between two datagrams, some are older
        assert 50 < took_ms <= BOUND_MS
        status = dog.see(lambda status: not status.closed)
        assert status.state is WatchdogState.TRIPPED
        dog.see(lambda status: {"command_silent", "control", "udp", "parse", "gps"} <= set(status.causes))
        dog.listen()
        last = dog.commands[-1]
        assert (last.output_v, last.flags) == (0.0, 0)
        driven = [command for command in dog.commands if command.flags == 3]
        assert {command.output_v for command in driven} <= {0.0, 5.0} and driven[-1].output_v == 5.0


@pytest.mark.realtime
def test_one_loop_that_hangs_is_enough(tmp_path: Path) -> None:
    """The beats of ``pdci`` come, and its counter stands: seen from the outside, on a folder with one process."""
    limits = (*CALM, "--limit", "slow_timeout_ms=200", "--beats", "control")
    with closed(tmp_path / "run", *limits) as (dog, _):
        dog.send(encode_beat(LoopName.SERVER, 1, 0), encode_beat(LoopName.OUTPUT, 1, 0))
        begun_ns = time.monotonic_ns()
        while not any(event["event"] == "trip" for event in dog.events()):
            dog.send(encode_beat(LoopName.OUTPUT, 1, 0))
            time.sleep(0.02)
        assert 150 < opening_ms(dog, begun_ns, "output_stuck") < 400


@pytest.mark.realtime
def test_readbacks_that_fall_silent_open_the_relays(tmp_path: Path) -> None:
    with closed(tmp_path / "run", *CALM) as (dog, _):
        dog.listen()
        last = dog.commands[-1]
        begun_ns = time.monotonic_ns()
        dog.send(encode_readback(Readback(last.sequence, begun_ns, last.output_v)))
        assert 100 < opening_ms(dog, begun_ns, "readback_silent") <= 220


@pytest.mark.realtime
def test_killing_the_watchdog_stops_the_pulses_and_the_commands(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a", "b")]
    for path in files:
        path.write_text("0\n")
    relays = [f"--relay-a={files[0]}", f"--relay-b={files[1]}"]
    with closed(tmp_path / "run", *CALM, "--pulse", *relays) as (dog, _):
        seen = {path: {path.read_bytes() for _ in range(200) if not time.sleep(0.001)} for path in files}
        assert all(levels >= {b"1\n", b"0\n"} for levels in seen.values())
        dog.signal(signal.SIGKILL)
        dog.process.wait()
        dog.listen()
        heard = len(dog.commands)
        held = [path.read_bytes() for path in files]
        time.sleep(5 * TICK_NS / 1e9)
        dog.listen()
        assert [path.read_bytes() for path in files] == held and len(dog.commands) == heard


@pytest.mark.realtime
def test_a_watchdog_that_was_stopped_trips_when_it_goes_on(tmp_path: Path) -> None:
    with closed(tmp_path / "run") as (dog, _):
        dog.signal(signal.SIGSTOP)
        time.sleep(0.2)
        dog.signal(signal.SIGCONT)
        event = dog.event("trip")
        assert "late" in {found["rule"] for found in event["causes"]}


@pytest.mark.realtime
def test_sigterm_opens_the_relays_then_sends_zero_then_ends(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a", "b")]
    for path in files:
        path.write_text("0\n")
    with closed(tmp_path / "run", *CALM, f"--relay-a={files[0]}", f"--relay-b={files[1]}") as (dog, _):
        assert [path.read_bytes() for path in files] == [b"1\n"] * 2
        dog.signal(signal.SIGTERM)
        assert dog.process.wait(timeout=10) == 0
        assert [path.read_bytes() for path in files] == [b"0\n"] * 2
        dog.listen()
        assert (dog.commands[-1].output_v, dog.commands[-1].flags) == (0.0, 0)
        assert dog.status is not None and not (dog.status.relay_a or dog.status.relay_b or dog.status.healthy)
        assert dog.status.estop_released  # to end is no emergency
        assert dog.event("end")["relays_opened"] is True
        assert not (dog.folder / "watchdog.in").exists()


@pytest.mark.realtime
def test_what_leaves_is_numbered_without_a_gap_and_stamped_now(tmp_path: Path) -> None:
    with closed(tmp_path / "run", *CALM) as (dog, _):
        until(lambda: (dog.listen(), len(dog.commands) > 60)[1])
        numbers = [command.sequence for command in dog.commands]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert abs(dog.commands[-1].time_ns - time.time_ns()) < 2e9
        assert all(command.command_mw == command.output_v * 12.5 for command in dog.commands)
    with watchdog(tmp_path / "again") as later:  # a receiver passes over what is below
        until(lambda: (later.listen(), later.commands)[1])
        assert 0 < (later.commands[0].sequence - numbers[-1]) % 2**32 < 2**31


@pytest.mark.realtime
def test_an_emergency_stop_by_word_and_its_way_back(tmp_path: Path) -> None:
    with closed(tmp_path / "run", *CALM) as (dog, controller):
        dog.send(encode_word(Verb.ESTOP, "Ann Ödegård"))
        status = dog.see(lambda status: status.state is WatchdogState.TRIPPED)
        assert not status.estop_released and dog.event("estop")["who"] == "Ann Ödegård"
        dog.send(encode_word(Verb.RESET, "Ann"))
        assert dog.event("refused")["causes"][0]["rule"] == "estop_software"
        dog.send(encode_word(Verb.ESTOP_RELEASE, "Ann"), encode_word(Verb.RESET, "Ann"))
        dog.event("reset")
        dog.see(lambda status: status.state is WatchdogState.OPEN)
        controller.kill()  # it went on asking, and the relays stayed open
        assert [event["event"] for event in dog.events()].count("close") == 1


@pytest.mark.realtime
def test_lines_of_the_emergency_stop_are_files(tmp_path: Path) -> None:
    lines = [tmp_path / name for name in ("a", "b")]
    for path in lines:
        path.write_text("1\n")
    with closed(tmp_path / "run", *CALM, f"--estop-a={lines[0]}", f"--estop-b={lines[1]}") as (dog, _):
        pressed_ns = time.monotonic_ns()
        lines[1].write_text("0\n")
        assert opening_ms(dog, pressed_ns, "estop_b") < 50
        assert dog.see(lambda status: "estop_discrepancy" in status.causes).estop_a


# --- floods ------------------------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_garbage_opens_the_relays_at_once(tmp_path: Path) -> None:
    with closed(tmp_path / "run", *CALM) as (dog, _):
        begun_ns = time.monotonic_ns()
        dog.send(b"x" * 40)
        assert opening_ms(dog, begun_ns, "malformed") < 50


@pytest.mark.realtime
def test_a_flood_delays_no_opening_and_costs_a_bounded_number_of_rounds(tmp_path: Path) -> None:
    line = tmp_path / "line"
    line.write_text("1\n")
    folder = tmp_path / "run"
    with watchdog(folder, *CALM, f"--estop-a={line}", "--limit", "malformed_max=1e6") as dog:
        with beating(folder, "flood=10000"):
            begun_ns = dog.event("start")["monotonic_ns"]
            assert dog.event("refused")["who"] == "flood"
            time.sleep(1.0)
            pressed_ns = time.monotonic_ns()
            line.write_text("0\n")
            assert opening_ms(dog, pressed_ns, "estop_a") < 50
            dog.signal(signal.SIGTERM)
            assert dog.process.wait(timeout=10) == 0
        end = dog.event("end")
        seconds = (end["monotonic_ns"] - begun_ns) / 1e9
        assert end["datagrams"] > 500
        assert end["rounds"] <= 1100 * seconds  # a millisecond apart, and ticks


@pytest.mark.realtime
def test_a_log_that_nobody_reads_holds_nothing_up(tmp_path: Path) -> None:
    """The log is a pipe that is full: statuses go on, and what could not be told is counted."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(folder / "control.in"))
        told.settimeout(10)
        process = subprocess.Popen(
            [sys.executable, "-m", "dcon.watchdog", "--run-dir", str(folder), "--status", "control.in"],
            stderr=os.open(pipe, os.O_WRONLY),
        )
        try:
            told.recv(64)
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
                for _ in range(2000):  # each is refused, in a line of some 700 bytes
                    out.sendto(encode_word(Verb.RESET, "op"), str(folder / "watchdog.in"))
            told.setblocking(False)
            last_ns = until(lambda: _newest(told))
            time.sleep(0.1)
            assert _newest(told) - last_ns > 50e6
            process.terminate()
            assert process.wait(timeout=10) == 0
            lines = os.read(reader, 1 << 20).split(b"\n")
            first = [json.loads(line)["event"] for line in lines[:5]]
            assert "start" in first and 10 < len(lines) < 1000
        finally:
            process.kill()
            process.wait()
            os.close(reader)


def _newest(told: socket.socket) -> int:
    """CLOCK_MONOTONIC of the newest status."""
    at_ns = 0
    while True:
        try:
            at_ns = int.from_bytes(told.recv(64)[8:16], "big")
        except BlockingIOError:
            return at_ns


@pytest.mark.realtime
def test_a_mistake_of_its_own_opens_the_relays_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    relay = tmp_path / "a"
    relay.write_text("1\n")
    rounds = iter(range(5))

    def broken(*arguments: object) -> object:
        if next(rounds) == 4:
            raise ZeroDivisionError
        return step(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "step", broken)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plant:
        plant.bind(("127.0.0.1", 0))
        plant.settimeout(10)
        config = loop.Config(
            str(tmp_path / "run"),
            f"udp://127.0.0.1:{plant.getsockname()[1]}",
            (),
            lines=Lines(relay_a=str(relay)),
            log=str(tmp_path / "log"),
        )
        dog = loop.Watchdog(config)
        relay.write_text("1\n")
        with pytest.raises(ZeroDivisionError):
            dog.run()
        assert relay.read_text() == "0\n"
        plant.setblocking(False)
        last = list(iter(lambda: _received(plant), b""))[-1]
        assert (command := decode(last)) is not None and (command.output_v, command.flags) == (0.0, 0)
    assert not (tmp_path / "run" / "watchdog.in").exists()
    assert '"event": "end"' in (tmp_path / "log").read_text()


def _received(sock: socket.socket) -> bytes:
    try:
        return sock.recv(64)
    except BlockingIOError:
        return b""


# --- how it starts -----------------------------------------------------------------------------------------------


def test_it_imports_the_standard_library_only_and_starts_fast() -> None:
    code = "import dcon.watchdog.__main__, sys, time; print(time.process_time()); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    spent, names = done.stdout.splitlines()
    loaded = {name for name in names.split() if name.partition(".")[0] not in sys.stdlib_module_names}
    ours = {name for name in loaded if name.startswith("dcon")}
    assert all(name == "dcon" or name.startswith("dcon.watchdog") for name in ours)
    assert not loaded & {"numpy", "click", "pmutools"}
    bare = "import time; print(time.process_time())"
    least = min(float(subprocess.check_output([sys.executable, "-c", bare])) for _ in range(3))
    assert float(spent) - least < 0.15


REFUSED = {
    "an output that is none": (["--output", "tcp://h:1"], 1, "tcp://h:1: no output; write udp://HOST:PORT"),
    "an output without a port": (["--output", "udp://h"], 1, "udp://h: no output; write udp://HOST:PORT"),
    "an unknown host": (["--output", "udp://no.such.host.invalid:1"], 1, "unknown host 'no.such.host.invalid'"),
    "a log that cannot be": (["--log", "/nowhere/x.log"], 1, "/nowhere/x.log: No such file or directory; name a log"),
    "a loop that there is not": (["--beats", "control,kontrol"], 2, "'kontrol' is no loop; there are control, udp"),
    "a limit that there is not": (["--limit", "x=1"], 2, "x: no such limit; there are fast_timeout_ms"),
    "a limit out of range": (["--limit", "range_max_v=11"], 2, "range_max_v: 11 is out of range; it must be 0 to 10"),
    "a limit without a number": (["--limit", "range_max_v"], 2, "'range_max_v': write NAME=NUMBER"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_mistake_is_told_in_a_line(name: str, tmp_path: Path) -> None:
    arguments, code, text = REFUSED[name]
    done = subprocess.run(
        [sys.executable, "-m", "dcon.watchdog", "--run-dir", str(tmp_path / "run"), *arguments],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert done.returncode == code and text in done.stderr.splitlines()[-1]


def test_a_second_watchdog_is_refused_and_a_dead_ones_socket_is_replaced(tmp_path: Path) -> None:
    run_folder(str(tmp_path / "run"))
    run_folder(str(tmp_path / "run"))
    folder = str(tmp_path / "run")
    assert os.stat(folder).st_mode & 0o777 == 0o700
    first = bind_inbox(folder)
    with pytest.raises(Refused, match="another watchdog runs there"):
        bind_inbox(folder)
    first.close()  # as by kill -9: the name stays
    second = bind_inbox(folder)
    assert os.stat(tmp_path / "run" / "watchdog.in").st_mode & 0o077 == 0
    second.close()


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(Refused, match="others may write into it; chmod 700 it"):
        run_folder(str(tmp_path / "open"))
    with pytest.raises(Refused, match="No such file or directory; name a run folder"):
        run_folder(str(tmp_path / "no" / "such"))
    (tmp_path / ("x" * 120)).mkdir()
    with pytest.raises(Refused, match="too long; name another run folder"):
        bind_inbox(str(tmp_path / ("x" * 120)))


def test_a_round_takes_a_bounded_number_of_datagrams() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        for sock in (ours, theirs):
            sock.setblocking(False)
        assert drain(ours) == []
        theirs.send(encode(CommandOut(1, time.time_ns(), 12.5, 1.0, 1)))
        theirs.send(encode_beat(LoopName.GPS, 7, 0, LoopState.FAILED))
        command, beat = drain(ours)
        assert command[0] == 1 and beat == (3, 7, 3)


def test_nobody_who_listens_is_no_harm(tmp_path: Path) -> None:
    post = output("output.in", str(tmp_path))
    post.send(b"x")
    assert post.failed == 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        post = output(f"udp://localhost:{free.getsockname()[1]}", "")
        post.send(b"first")
        assert free.recv(16) == b"first"
    for _ in range(5):
        post.send(b"x")
