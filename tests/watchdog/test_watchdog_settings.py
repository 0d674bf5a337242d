"""``[watchdog]`` of the initialisation file, as it reaches the process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from dcon.cli.watchdog import arguments
from dcon.effective import effective
from dcon.sections import Watchdog
from dcon.settings import Settings, parse
from dcon.watchdog.__main__ import config_of
from dcon.watchdog.files import Lines
from dcon.watchdog.limits import BOUNDS, Limits, Rules
from dcon.watchdog.loop import Config
from pmutools.errors import SettingsError

PMUS = "[pmu A]\nurl = udp://h:1\nside = north\n[pmu B]\nurl = udp://h:2\nside = south\n"


def settings(text: str) -> Settings:
    return parse(PMUS + text, "dcon.ini")


def test_defaults_are_those_of_the_process() -> None:
    assert config_of(arguments(settings(""), "run")) == Config("run", status=("control.in", "status.in"))
    assert Watchdog().rules == Rules()


def test_everything_that_is_set_arrives() -> None:
    text = """
[output]
url = udp://127.0.0.1:4790
[watchdog]
beats = control,udp
readback = required
status = control.in
estop_a = /a
estop_b = /b
contact_a = /c
contact_b = /d
relay_a = /e
relay_b = -f
drive = pulse
fifo = no
log = /tmp/x.log
log_mb = 2
"""
    values = {name: (low + high) / 2 for name, (low, high) in BOUNDS.items()}
    text += "".join(f"{name} = {value!r}\n" for name, value in values.items())
    assert config_of(arguments(settings(text), "run")) == Config(
        "run",
        "udp://127.0.0.1:4790",
        ("control.in",),
        Rules(Limits(**values), ("control", "udp"), True),
        Lines("/a", "/b", "/c", "/d", "/e", "-f", True),
        "/tmp/x.log",
        2_000_000,
        False,
    )


@pytest.mark.parametrize("url", ["iio:///sys/bus/iio/devices/iio:device0", "modbus://127.0.0.1:502"])
def test_what_the_output_process_drives_leaves_to_its_socket(url: str) -> None:
    assert config_of(arguments(settings(f"[output]\nurl = {url}\n"), "run")).output == "output.in"


def test_every_limit_is_a_key_with_its_bounds() -> None:
    keys = {item.name for item in fields(Watchdog)}
    assert set(Limits._fields) <= keys
    for name, (low, high) in BOUNDS.items():
        for bad in (low - 1, high * 2):
            with pytest.raises(SettingsError, match=rf"\[watchdog\] {name}: .* is out of range; it must be {low:g} to"):
                settings(f"[watchdog]\n{name} = {bad!r}\n")
    assert {row.key for row in effective(settings("")) if row.section == "watchdog"} == keys


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("beats = control,kontrol", "[watchdog] beats: 'kontrol' is not one of control, udp, parse"),
        ("readback = yes", "[watchdog] readback: 'yes' is not one of auto, required"),
        ("drive = pwm", "[watchdog] drive: 'pwm' is not one of level, pulse"),
        ("estop = /a", "[watchdog] estop: unknown key; did you mean"),
    ],
)
def test_a_mistake_says_where(line: str, text: str) -> None:
    with pytest.raises(SettingsError) as caught:
        settings(f"[watchdog]\n{line}\n")
    assert str(caught.value).startswith(f"dcon.ini:8: {text}")


@pytest.mark.realtime
def test_the_command_becomes_the_process(tmp_path: Path) -> None:
    ini = tmp_path / "dcon.ini"
    ini.write_text(PMUS + "[watchdog]\nstatus =\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "dcon.cli", "watchdog", "--ini", str(ini), "--run-dir", str(tmp_path / "run")],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    try:
        event = json.loads(process.stderr.readline())
        while event["event"] == "warning":
            event = json.loads(process.stderr.readline())
        assert (event["event"], event["pid"]) == ("start", process.pid)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=10) == 0
        assert json.loads(process.stderr.readlines()[-1])["event"] == "end"
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def test_the_command_tells_a_mistake_in_a_line(tmp_path: Path) -> None:
    ini = tmp_path / "dcon.ini"
    ini.write_text(PMUS)
    folder = tmp_path / "open"
    folder.mkdir()
    os.chmod(folder, 0o777)
    command = [sys.executable, "-m", "dcon.cli", "watchdog", "--ini", str(ini), "--run-dir", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert done.returncode == 1
    assert (
        done.stderr == f"dcon watchdog: {folder}: others may write into it; chmod 700 it, or name another run folder\n"
    )
