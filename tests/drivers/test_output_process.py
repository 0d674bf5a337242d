"""The output process: from the watchdog's datagrams to a DAC or a Modbus device, and back."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.iio import counts, iio_device
from support.modbus_device import modbus_device, wait_for
from support.run_folder import in_thread, is_socket, listening, send

from dcon.cli import dcon
from dcon.link.beats import LoopState
from dcon.link.command import CommandOut, encode
from dcon.link.notify import Notifier
from dcon.link.paths import CONTROL, OUTPUT, WATCHDOG, prepare
from dcon.output.outlet import CLOSED
from dcon.output.process import OutputProcess
from dcon.places import destination
from dcon.sections import Output
from pmutools.cli.shell import run
from pmutools.errors import SettingsError, SourceError

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="IIO and run folders are Linux's"),
]
ZERO, FIVE = 32768, 49152
PMUS = "[pmu A]\nurl = udp://127.0.0.1:1\nside = north\n[pmu B]\nurl = udp://127.0.0.1:2\nside = south\n"


def command(sequence: int, volts: float, flags: int = CLOSED | 1) -> bytes:
    return encode(CommandOut(sequence, 0, 12.5 * volts, volts, flags))


def iio_output(device: Path, hold_ms: float = 100.0) -> Output:
    return Output(destination(f"iio://{device}?readback=0&settle_ms=0.2"), hold_ms)


@contextmanager
def driving(output: Output, run_dir: Path) -> Iterator[OutputProcess]:
    process = OutputProcess(output, prepare(run_dir))
    with in_thread(process.run, process.stop):
        yield process


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return prepare(tmp_path / "run")


def test_a_command_reaches_the_dac_and_its_readback_both_who_judge(tmp_path: Path, folder: Path) -> None:
    device = iio_device(tmp_path)
    with listening(folder, WATCHDOG, CONTROL) as (watchdog, control), driving(iio_output(device, 1000.0), folder):
        for sequence, volts in ((7, 5.0), (8, -5.0), (9, 5.0)):
            send(folder, OUTPUT, command(sequence, volts))
            wait_for(lambda wanted=sequence: control.readbacks() and control.readbacks()[-1].sequence == wanted)
            assert control.readbacks()[-1].volts == pytest.approx(volts, abs=1e-3)
        wait_for(lambda: len(watchdog.readbacks()) == 3)
        assert watchdog.readbacks() == control.readbacks()
        assert counts(device) == FIVE
    assert counts(device) == ZERO, "it ends at 0 V"
    assert not (folder / OUTPUT).exists()


def test_it_goes_to_0_v_by_itself(tmp_path: Path, folder: Path) -> None:
    device = iio_device(tmp_path)
    (device / "out_voltage0_raw").write_text("1234")
    with driving(iio_output(device, 60.0), folder) as process:
        wait_for(lambda: counts_or_none(device) == ZERO)
        drive_until(folder, device, 5.0, FIVE)
        began = time.monotonic()
        wait_for(lambda: counts_or_none(device) == ZERO)
        assert time.monotonic() - began < 1
        assert process.outlet.holds >= 1


def counts_or_none(device: Path) -> int | None:
    """The fake is a plain file: a write to it may be seen half done."""
    try:
        return counts(device)
    except ValueError:
        return None


def drive_until(folder: Path, device: Path, volts: float, expected: int) -> None:
    """Command again and again, as a controller does: what came while the process had no processor is not driven."""
    sequence = 0

    def driven() -> bool:
        nonlocal sequence
        sequence += 1
        send(folder, OUTPUT, command(sequence, volts))
        time.sleep(0.01)
        return counts_or_none(device) == expected

    wait_for(driven)


def test_what_is_not_let_through_is_0_v_and_nonsense_is_counted(tmp_path: Path, folder: Path) -> None:
    device = iio_device(tmp_path)
    with driving(iio_output(device, 1000.0), folder) as process:
        send(folder, OUTPUT, command(1, 5.0))
        wait_for(lambda: counts_or_none(device) == FIVE)
        for nonsense in (
            b"",
            b"DCN1",
            command(2, 9.0)[:-1] + b"x",
            os.urandom(5000),
            command(1, -5.0),
            command(0, -5.0),
        ):
            send(folder, OUTPUT, nonsense)
        wait_for(lambda: sum(process.outlet.refused.values()) == 6)
        assert counts(device) == FIVE
        send(folder, OUTPUT, command(2, 5.0, flags=1))
        wait_for(lambda: counts_or_none(device) == ZERO)
    assert process.outlet.refused["old"] == 2


def test_its_loop_beats_and_says_so_when_the_device_is_gone(tmp_path: Path, folder: Path) -> None:
    device = iio_device(tmp_path)
    with listening(folder, WATCHDOG) as (watchdog,), driving(iio_output(device, 50.0), folder) as process:
        wait_for(lambda: len(watchdog.beats("output")) >= 20)
        beats = watchdog.beats("output")
        assert [counter for _, counter, _ in beats] == list(range(len(beats)))
        assert {state for *_, state in beats} == {LoopState.RUNNING}
        assert beats[-1][0] - beats[0][0] < 20 * 200_000_000
        (device / "out_voltage0_raw").rename(device / "gone")
        wait_for(lambda: watchdog.beats("output")[-1][2] == LoopState.FAILED)
        assert "out_voltage0_raw: No such file" in process.driver.trouble
        (device / "gone").rename(device / "out_voltage0_raw")
        wait_for(lambda: watchdog.beats("output")[-1][2] == LoopState.RUNNING)
        process.stop()
        wait_for(lambda: watchdog.beats("output")[-1][2] == LoopState.ENDING)


def test_over_modbus_and_with_the_device_gone_no_readback_comes(folder: Path) -> None:
    with modbus_device() as device, listening(folder, WATCHDOG) as (watchdog,):
        output = Output(destination(f"modbus://127.0.0.1:{device.port}?timeout_ms=50"), 1000.0)
        with driving(output, folder) as process:
            send(folder, OUTPUT, command(1, 5.0))
            wait_for(lambda: watchdog.readbacks())
            assert watchdog.readbacks()[-1][::2] == (1, 5.0) and device.registers[0] == 5000
            device.stop()
            for sequence in range(2, 12):
                send(folder, OUTPUT, command(sequence, 5.0))
                time.sleep(0.01)  # the rhythm of a controller
            wait_for(lambda: process.driver.trouble)
            beats = len(watchdog.beats("output"))
            wait_for(lambda: len(watchdog.beats("output")) > beats + 5)
            assert [readback.sequence for readback in watchdog.readbacks()] == [1]
        assert process.driver.trouble, "0 V could not be left"


def test_a_slow_bus_answers_for_the_commands_that_it_carried_out(folder: Path) -> None:
    """Two round trips of 30 ms each: three of four commands are overtaken, and none is answered for another."""
    with modbus_device(slow_s=0.03) as device, listening(folder, WATCHDOG) as (watchdog,):
        output = Output(destination(f"modbus://127.0.0.1:{device.port}?timeout_ms=500"), 1000.0)
        with driving(output, folder):
            sequence = 0
            while len(watchdog.readbacks()) < 4:
                sequence += 1
                assert sequence < 500
                send(folder, OUTPUT, command(sequence, sequence / 100))
                time.sleep(0.016)  # the rhythm of a controller
            for readback in watchdog.readbacks():
                assert readback.volts == pytest.approx(readback.sequence / 100)


def test_systemd_is_told_that_it_is_ready_alive_and_stopping(tmp_path: Path, folder: Path) -> None:
    name = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service:
        service.bind(name)
        service.settimeout(20)
        process = OutputProcess(iio_output(iio_device(tmp_path)), folder, notifier=Notifier({"NOTIFY_SOCKET": name}))
        with in_thread(process.run, process.stop):
            assert service.recv(200) == b"READY=1\nWATCHDOG=1\nSTATUS=0 commands, 0 read back"
            assert service.recv(200).startswith(b"WATCHDOG=1\nSTATUS=")
        while service.recv(200) != b"STOPPING=1":
            pass


def test_a_second_process_has_no_place(tmp_path: Path, folder: Path) -> None:
    device = iio_device(tmp_path)
    with driving(iio_output(device), folder), pytest.raises(SourceError, match=r"output.in: another process"):
        OutputProcess(iio_output(device), folder)
    OutputProcess(iio_output(device), folder).driver.close()


@pytest.mark.parametrize(
    ("url", "message"), [(None, "has no url"), ("udp://127.0.0.1:9", "the watchdog sends datagrams itself")]
)
def test_what_needs_no_such_process(url: str | None, message: str, folder: Path) -> None:
    with pytest.raises(SettingsError, match=message):
        OutputProcess(Output(None if url is None else destination(url)), folder)
    assert not (folder / OUTPUT).exists()


# --- as a command ------------------------------------------------------------------------------------------------


@contextmanager
def command_line(device: Path, run_dir: Path, hold_ms: int = 100) -> Iterator[subprocess.Popen[str]]:
    ini = device.parent / "dcon.ini"
    ini.write_text(f"{PMUS}[output]\nurl = iio://{device}?readback=0\nhold_ms = {hold_ms}\n")
    arguments = [sys.executable, "-m", "dcon.cli", "output", "--json", "--ini", str(ini), "--run-dir", str(run_dir)]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: is_socket(run_dir / OUTPUT) or process.poll() is not None)
        yield process
    finally:
        process.kill()
        process.communicate()


def test_ended_it_leaves_0_v_and_killed_it_leaves_the_last_value(tmp_path: Path) -> None:
    device, run_dir = iio_device(tmp_path), tmp_path / "run"
    with command_line(device, run_dir, 1000) as process:
        wait_for(lambda: counts_or_none(device) == ZERO)
        send(run_dir, OUTPUT, command(1, 5.0))
        wait_for(lambda: counts_or_none(device) == FIVE)
        process.send_signal(signal.SIGTERM)
        data, said = process.communicate(timeout=10)
        assert process.returncode == 0, said
        assert "1 commands, 1 read back" in said and counts(device) == ZERO
        summary = json.loads(data)
        assert (summary["commands"], summary["readbacks"], summary["failed"], summary["trouble"]) == (1, 1, 0, "")
    with command_line(device, run_dir, 1000) as process:
        send(run_dir, OUTPUT, command(1, 5.0))
        wait_for(lambda: counts_or_none(device) == FIVE)
        process.kill()
        process.wait(10)
    assert counts(device) == FIVE, "only the relays take it off the line"
    with command_line(device, run_dir):  # its place is free again, and it begins at 0 V
        wait_for(lambda: counts_or_none(device) == ZERO)


def test_stopped_and_continued_it_does_not_drive_what_had_queued(tmp_path: Path) -> None:
    device, run_dir = iio_device(tmp_path), tmp_path / "run"
    with command_line(device, run_dir, 100) as process:
        drive_until(run_dir, device, 1.0, 36045)
        process.send_signal(signal.SIGSTOP)
        wait_for(lambda: Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T")
        for sequence in range(10_000, 10_004):
            send(run_dir, OUTPUT, command(sequence, 5.0))
        time.sleep(0.3)  # longer than it may hold
        process.send_signal(signal.SIGCONT)
        wait_for(lambda: counts_or_none(device) == ZERO)
        process.send_signal(signal.SIGTERM)
        data, _ = process.communicate(timeout=10)
        assert json.loads(data)["refused"]["slept"] >= 4


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ini = tmp_path / "dcon.ini"
    ini.write_text(f"{PMUS}[output]\nurl = iio:///nowhere/iio:device0\n")
    assert run(dcon(), ["output", "--ini", str(ini), "--run-dir", str(tmp_path / "run")]) == 1
    assert (
        capsys.readouterr().err
        == "dcon: /nowhere/iio:device0: no such device; see ls -d /sys/bus/iio/devices/iio:device*\n"
    )
    ini.write_text(f"{PMUS}[output]\nurl = udp://127.0.0.1:9\n")
    assert run(dcon(), ["output", "--ini", str(ini), "--run-dir", str(tmp_path / "run")]) == 2
    tmp_path.chmod(0o755)
    assert run(dcon(), ["output", "--ini", str(ini), "--run-dir", str(tmp_path)]) == 1
    assert "others may enter it" in capsys.readouterr().err
