"""Starts the demo's processes, waits for them, and judges the session they leave."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dcon.demo.course import Course
from dcon.demo.judge import read_traces, summarise
from dcon.sim.plan import ini_of
from pmutools import timebase
from pmutools.errors import PmuError, SourceError
from pmutools.grid.pmu_model import fleet

LEAD_S = 3.0
"""From the launch of the processes to second 0 of the course: they import and bind in that time."""
GRACE_S = 15.0


class DemoError(PmuError):
    """A process of the demo failed; the message holds what it said."""


@dataclass(frozen=True, slots=True)
class Demo:
    """One run of the demo."""

    out: Path
    gain_mw_per_mhz: float = 12.0
    course: Course = field(default_factory=Course)
    profile: str = "table1"
    noise_rad: float = 1e-4
    seed: int = 1

    @property
    def log_path(self) -> Path:
        return self.out / "session.mcap"


def free_ports(count: int) -> int:
    """The first of ``count`` consecutive UDP ports that are free now on loopback."""
    for base in range(47100, 60000, count):
        held: list[socket.socket] = []
        try:
            for port in range(base, base + count):
                probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                held.append(probe)
                probe.bind(("127.0.0.1", port))
            return base
        except OSError:
            continue
        finally:
            for probe in held:
                probe.close()
    raise SourceError(f"no {count} consecutive free UDP ports on 127.0.0.1")


def perform(demo: Demo, tell: Callable[[str, float], None] = lambda text, seconds: None) -> dict[str, Any]:
    """Run the demo and leave ``session.mcap``, ``summary.json``, ``demo.png`` and ``dcon.ini`` in ``demo.out``.

    ``tell`` is given what is going on and the seconds from the start. Returns what :func:`report` does. Raises
    DemoError where a process fails, SourceError where the folder cannot be written.
    """
    pmus, course = fleet(), demo.course
    base = free_ports(len(pmus) + 1)
    command_port, pmu_port = base, base + 1
    ini = demo.out / "dcon.ini"
    try:
        demo.out.mkdir(parents=True, exist_ok=True)
        with _alone(demo.out):
            ini.write_text(
                ini_of(
                    pmus,
                    gain_mw_per_mhz=demo.gain_mw_per_mhz,
                    deadband_mhz=0.0,
                    init_s=course.init_s,
                    urls=[f"udp://127.0.0.1:{pmu_port + number}" for number in range(len(pmus))],
                    extra=f"\n[output]\nurl = udp://127.0.0.1:{command_port}\n",
                )
            )
            return _perform(demo, ini, command_port, pmu_port, tell)
    except PmuError:
        raise
    except OSError as error:
        raise SourceError(f"--out {demo.out}: {error.strerror}") from None


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a folder's demo to this process; raises SourceError where another is running in it."""
    try:
        import fcntl
    except ImportError:  # no advisory locks on this system
        yield
        return
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise SourceError(f"another demo is writing into {folder}; give this one a folder with --out") from None
        yield
    finally:
        os.close(held)


def _perform(
    demo: Demo, ini: Path, command_port: int, pmu_port: int, tell: Callable[[str, float], None]
) -> dict[str, Any]:
    course = demo.course
    start_ns = (time.time_ns() // timebase.NS + 1) * timebase.NS + round(LEAD_S * timebase.NS)
    processes: dict[str, subprocess.Popen[str]] = {}
    try:
        processes["controller"] = _launch(_controller(demo, ini, start_ns))
        processes["grid"] = _launch(_grid(demo, start_ns, command_port, pmu_port))
        _wait(processes, start_ns, course, tell)
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.terminate()
        for process in processes.values():
            _reap(process)
    tell("reading the session log", course.end_s)
    return report(demo, start_ns)


def report(demo: Demo, start_ns: int) -> dict[str, Any]:
    """Judge the session that began at ``start_ns``: writes ``summary.json`` and the picture, returns the summary.

    ``picture`` in it is null where matplotlib is not installed.
    """
    traces = read_traces(str(demo.log_path), start_ns)
    summary = summarise(traces, demo.course, demo.gain_mw_per_mhz)
    try:
        from dcon.demo.picture import draw
    except ImportError:
        summary["picture"] = None
    else:
        summary["picture"] = str(draw(traces, summary, demo.course, demo.out / "demo.png"))
    try:
        (demo.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    except OSError as error:
        raise SourceError(f"--out {demo.out}: {error.strerror}") from None
    return summary


def _controller(demo: Demo, ini: Path, start_ns: int) -> list[str]:
    orders = [f"{order.at_ns / 1e9:g}:{order.order.name}" for order in demo.course.orders]
    return [
        *("-m", "dcon.cli", "platform", "--quiet", "--ini", str(ini), "--log", str(demo.log_path)),
        *("--start", timebase.format_utc(start_ns), "--duration", f"{demo.course.end_s:g}"),
        *(word for order in orders for word in ("--order", order)),
    ]


def _grid(demo: Demo, start_ns: int, command_port: int, pmu_port: int) -> list[str]:
    return [
        *("-m", "dcon.demo.grid", "--start-ns", str(start_ns)),
        *("--command-port", str(command_port), "--pmu-port", str(pmu_port)),
        *("--open-loop-s", repr(demo.course.open_loop_s), "--swing-s", repr(demo.course.swing_s)),
        *("--profile", demo.profile, "--noise-rad", repr(demo.noise_rad), "--seed", str(demo.seed)),
    ]


def _launch(arguments: list[str]) -> subprocess.Popen[str]:
    quiet = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, *arguments], stdin=quiet, stdout=quiet, stderr=subprocess.PIPE, text=True)


def _wait(
    processes: dict[str, subprocess.Popen[str]], start_ns: int, course: Course, tell: Callable[[str, float], None]
) -> None:
    said = ""
    deadline_ns = start_ns + round((course.end_s + GRACE_S) * timebase.NS)
    while any(process.poll() is None for process in processes.values()):
        for name, process in processes.items():
            if process.poll():
                raise DemoError(f"the {name} process failed: {_last_words(process)}")
        now_ns = time.time_ns()
        if now_ns > deadline_ns:
            raise DemoError("the processes did not end in time; is the machine overloaded?")
        seconds = (now_ns - start_ns) / timebase.NS
        text = phase(course, seconds)
        if text != said:
            said = text
            tell(text, seconds)
        time.sleep(0.1)
    for name, process in processes.items():
        if process.returncode:
            raise DemoError(f"the {name} process failed: {_last_words(process)}")


def phase(course: Course, seconds: float) -> str:
    """What is going on, for a person."""
    table = (
        (0.0, "starting grid and controller"),
        (course.open_loop_s, "controller verifies 20 s of data from each PMU"),
        (course.arm_s, "brake 1,400 MW for 0.5 s, open loop: the controller computes, drives nothing"),
        (course.closed_loop_s, "disarming; loop closed, arming, activating"),
        (course.disarm_s, "brake 1,400 MW for 0.5 s, closed loop"),
        (float("inf"), "disarming"),
    )
    return next(text for until_s, text in table if seconds < until_s)


def _last_words(process: subprocess.Popen[str]) -> str:
    said = process.stderr.read() if process.stderr is not None else ""
    lines = [line for line in said.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit code {process.returncode}"


def _reap(process: subprocess.Popen[str]) -> None:
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stderr is not None:
        process.stderr.close()
