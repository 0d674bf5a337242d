"""Controller's words, the real watchdog, the output process, a device: whatever dies behind it opens the relays."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.iio import SCALE_MV, iio_device
from support.modbus_device import Device, modbus_device, wait_for
from support.run_folder import Listener, is_socket, listening

from dcon.link.beats import (
    LoopName,
    LoopState,
    Verb,
    WatchdogState,
    WatchdogStatus,
    decode_status,
    encode_beat,
    encode_word,
)
from dcon.link.command import CommandOut, encode
from dcon.link.paths import CONTROL, OUTPUT, WATCHDOG, Sender, prepare

pytestmark = [
    pytest.mark.alone,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="run folders are Linux's"),
]
PMUS = "[pmu A]\nurl = udp://127.0.0.1:1\nside = north\n[pmu B]\nurl = udp://127.0.0.1:2\nside = south\n"
VOLTS = 2.5
LONGEST_MS = 2000
"""For a machine that is busy; the watchdog's own limits are 100 ms for a failed beat and 200 ms for a readback."""


class Controller:
    """Beats and commands 60 times a second, and asks for closed relays from when it is told to."""

    def __init__(self, folder: Path, control: Listener) -> None:
        self.relays = False
        self._control, self._sender = control, Sender(folder / WATCHDOG)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        tick = 0
        while not self._ended.wait(1 / 60):
            tick += 1
            volts = VOLTS if self.relays and self.status is not None and self.status.closed else 0.0
            for loop in (LoopName.CONTROL, LoopName.UDP, LoopName.PARSE):
                self._sender.send(encode_beat(loop, tick, time.monotonic_ns(), LoopState.RUNNING))
            self._sender.send(encode(CommandOut(tick, time.time_ns(), 12.5 * volts, volts, int(self.relays))))

    @property
    def status(self) -> WatchdogStatus | None:
        """The watchdog's last word."""
        for _, data in reversed(list(self._control.heard)):
            if (found := decode_status(data)) is not None:
                return found
        return None

    def say(self, verb: Verb) -> None:
        self._sender.send(encode_word(verb, "test"))

    def close(self) -> None:
        self._ended.set()
        self._thread.join(5)


@contextlib.contextmanager
def guarded(url: str, tmp_path: Path) -> Iterator[tuple[Controller, subprocess.Popen[bytes]]]:
    """All of it with closed relays; gives the controller and the output process."""
    folder = prepare(tmp_path / "run")
    ini = tmp_path / "dcon.ini"
    ini.write_text(f"{PMUS}[output]\nurl = {url}\n")
    beats = "control,udp,parse,output"
    commands = {
        "watchdog": ("dcon.watchdog", "--run-dir", folder, "--readback-required", "--beats", beats, "--no-fifo"),
        "output": ("dcon.cli", "output", "-q", "--ini", ini, "--run-dir", folder),
    }
    processes: dict[str, subprocess.Popen[bytes]] = {}
    with listening(folder, CONTROL) as (control,), contextlib.ExitStack() as ends:
        for name, words in commands.items():
            command = [sys.executable, "-m", *map(str, words)]
            processes[name] = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        for process in processes.values():
            ends.callback(_end, process)
        wait_for(lambda: is_socket(folder / WATCHDOG) and is_socket(folder / OUTPUT), 20)
        controller = Controller(folder, control)
        ends.callback(controller.close)
        _until_closed(controller)
        yield controller, processes["output"]


def _until_closed(controller: Controller) -> None:
    """Reset what was missing at the start, then ask for the relays; again where the machine has been too slow."""

    def closed() -> bool:
        status = controller.status
        if status is None or status.state is WatchdogState.TRIPPED or not status.healthy:
            controller.relays = False
            controller.say(Verb.RESET)
            time.sleep(0.1)
            return False
        controller.relays = True
        return status.closed

    wait_for(closed, 30)


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.pid, signal.SIGCONT)
    process.kill()
    process.wait(10)


def tripped_within(controller: Controller, do: Callable[[], object], causes: set[str]) -> None:
    """``do`` opens the relays, for one of ``causes`` at first."""
    began = time.monotonic_ns()
    do()
    wait_for(lambda: controller.status is not None and controller.status.state is WatchdogState.TRIPPED)
    status = controller.status
    assert status is not None and not status.relay_a and not status.relay_b
    assert causes & set(map(str, status.causes)), status.causes
    assert (time.monotonic_ns() - began) / 1e6 < LONGEST_MS


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_the_output_follows_and_killed_or_stopped_it_opens_the_relays(how: signal.Signals, tmp_path: Path) -> None:
    device = iio_device(tmp_path)
    with guarded(f"iio://{device}?readback=0", tmp_path) as (controller, output):
        expected = round(32768 + VOLTS * 1e3 / SCALE_MV)
        wait_for(lambda: read(device) == expected)
        tripped_within(controller, lambda: output.send_signal(how), {"readback_silent", "output"})
        assert read(device) == expected, "the converter stays where it is: it is the relays that open"


def read(device: Path) -> int | None:
    try:
        return int((device / "out_voltage0_raw").read_text())
    except ValueError:  # half written: the fake is a plain file
        return None


def test_a_converter_that_is_gone_or_stuck_opens_the_relays(tmp_path: Path) -> None:
    gone, stuck = iio_device(tmp_path / "gone"), iio_device(tmp_path / "stuck")
    with guarded(f"iio://{gone}?readback=0", tmp_path / "gone") as (controller, _):
        raw = gone / "out_voltage0_raw"
        tripped_within(controller, lambda: raw.rename(gone / "away"), {"readback_silent", "readback", "output"})

    def stick() -> None:
        (stuck / "in_voltage0_raw").unlink()
        (stuck / "in_voltage0_raw").write_text("60000")

    with guarded(f"iio://{stuck}?readback=0", tmp_path / "stuck") as (controller, _):
        tripped_within(controller, stick, {"readback"})


def slow(device: Device) -> None:
    device.slow_s = 1.0


def refusing(device: Device) -> None:
    from pymodbus.constants import ExcCodes

    device.refuse = ExcCodes.DEVICE_FAILURE


@pytest.mark.parametrize("how", [Device.stop, slow, refusing], ids=["gone", "slow", "refusing"])
def test_a_dead_bus_opens_the_relays(how: Callable[[Device], None], tmp_path: Path) -> None:
    with modbus_device() as device:
        url = f"modbus://127.0.0.1:{device.port}?timeout_ms=100"
        with guarded(url, tmp_path) as (controller, _):
            wait_for(lambda: device.registers[0] == 2500)
            tripped_within(controller, lambda: how(device), {"readback_silent", "output"})
