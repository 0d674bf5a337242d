"""Starts the demo's processes, waits for them, and judges the session they leave."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from dcon.demo.course import Course
from dcon.demo.judge import read_traces, summarise
from dcon.link.children import launch
from dcon.link.keys import add_key, read_keys
from dcon.server.client import Client, order
from dcon.session.parts import free_path
from dcon.sim.plan import ini_of
from pmutools import timebase
from pmutools.errors import PmuError, SourceError
from pmutools.grid.pmu_model import fleet
from pmutools.net.endpoint import Endpoint, Scheme

LEAD_S = 3.0
"""From the launch of the grid to second 0 of the course: it imports and binds in that time."""
READY_S = 60.0
"""For the processes of the controller to find each other; some 3 s on a machine that has nothing else to do."""
GRACE_S = 15.0
END_S = 20.0
"""For a process that was asked to end: it ramps down, and closes its log."""
WHOLE = sys.platform == "linux"
"""All processes of the platform; elsewhere the controller is alone, and its orders are given beforehand."""
PORTS = range(20_000, 32_000)
"""Below those that systems give out by themselves."""
ENDED = 130
"""Exit code of ``dcon run`` that was asked to end."""
LAST_BYTES = 1 << 14
"""Of what a process has said, as much is looked at for its last line."""
WHO = "demo"
PATIENT = "\n".join(
    f"{key} = 1000"
    for key in ("status_timeout_ms", "fast_timeout_ms", "command_timeout_ms", "stamp_max_ms", "late_max_ms")
)
"""Of the watchdog: a desktop that does something else pauses for longer than a controller of a line may."""


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
    log: str = "session.mcap"
    """In ``out``; where there is one already, :func:`perform` takes the next name."""

    @property
    def log_path(self) -> Path:
        return self.out / self.log


def free_ports(count: int) -> int:
    """The first of ``count`` consecutive UDP ports that are free now on loopback.

    Where it begins to look depends on the process: of two demos that start at once, none takes what the other found.
    """
    room = len(PORTS) - count
    for k in range(0, room, count):
        base = PORTS[(os.getpid() * count + k) % room]
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


@dataclass(frozen=True, slots=True)
class Site:
    """Where everything of one run is."""

    ini: Path
    work: Path
    """Of files that are gone after the run: the operator's key, sockets, the watchdog's log, what the processes say."""
    command_port: int
    status_port: int
    pmu_port: int
    """Of the first PMU; the others follow."""
    server_port: int

    @property
    def keys(self) -> Path:
        return self.work / "keys.ini"

    @property
    def server(self) -> Endpoint:
        return Endpoint(Scheme.TCP, "127.0.0.1", self.server_port)


def perform(demo: Demo, tell: Callable[[str, float], None] = lambda text, seconds: None) -> dict[str, Any]:
    """Run the demo and leave ``session.mcap``, ``summary.json``, ``demo.png`` and ``dcon.ini`` in ``demo.out``.

    The session log of a demo before is kept: the next is ``session-2.mcap``. ``tell`` is given what is going on and the
    seconds from the start. Returns what :func:`report` does. Raises DemoError where a process fails, SourceError where
    the folder cannot be written.
    """
    pmus = fleet()
    base = free_ports(len(pmus) + 2)
    try:
        demo.out.mkdir(parents=True, exist_ok=True)
        with _alone(demo.out), tempfile.TemporaryDirectory(prefix="dcon-demo-") as work:
            site = Site(demo.out / "dcon.ini", Path(work), base, base + 1, base + 2, free_tcp_port())
            demo = replace(demo, log=free_path(demo.log_path).name)
            add_key(site.keys, WHO)
            site.ini.write_text(
                ini_of(
                    pmus,
                    gain_mw_per_mhz=demo.gain_mw_per_mhz,
                    deadband_mhz=0.0,
                    init_s=demo.course.init_s,
                    urls=[f"udp://127.0.0.1:{site.pmu_port + number}" for number in range(len(pmus))],
                    pdci=f"url = udp://127.0.0.1:{site.status_port}" if WHOLE else "required = no",
                    extra=_extra(demo, site),
                )
            )
            return _perform(demo, site, tell)
    except PmuError:
        raise
    except OSError as error:
        raise SourceError(f"--out {demo.out}: {error.strerror}") from None


def _extra(demo: Demo, site: Site) -> str:
    """The rest of the initialisation file."""
    output = f"\n[output]\nurl = udp://127.0.0.1:{site.command_port}\n"
    if not WHOLE:
        return output
    return output + "\n".join(
        (
            f"[watchdog]\nrequired = yes\nlog = {site.work / 'watchdog.jsonl'}\n{PATIENT}",
            f"[server]\nrequired = yes\nlisten = 127.0.0.1:{site.server_port}\nkeys = {site.keys}",
            f"[log]\npath = {demo.log_path.absolute()}",
            "",
        )
    )


def free_tcp_port() -> int:
    """A TCP port that is free now on loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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


def _perform(demo: Demo, site: Site, tell: Callable[[str, float], None]) -> dict[str, Any]:
    course = demo.course
    processes: dict[str, Child] = {}
    try:
        start_ns = _second_zero()
        processes["controller"] = _launch(_controller(demo, site, start_ns), site.work / "controller.txt")
        if WHOLE:
            _await_controller(processes["controller"], site)
            start_ns = _second_zero()
        processes["grid"] = _launch(_grid(demo, site, start_ns), site.work / "grid.txt")
        _wait(processes, start_ns, course, tell, _operator(site) if WHOLE else None)
    finally:
        for process, _ in processes.values():
            if process.poll() is None:
                process.terminate()
        for process, _ in processes.values():
            _reap(process)
    tell("reading the session log", course.end_s)
    return report(demo, start_ns)


def _second_zero() -> int:
    return (time.time_ns() // timebase.NS + 1) * timebase.NS + round(LEAD_S * timebase.NS)


def _await_controller(child: Child, site: Site) -> None:
    """Until the server has heard a tick; raises DemoError where that does not happen."""
    end_s = time.monotonic() + READY_S
    while time.monotonic() < end_s:
        if child.process.poll() is not None:
            raise DemoError(f"the controller process failed: {_last_words(child)}")
        with suppress(SourceError), Client(site.server) as client:
            if client.ask({"ask": "status"})["state"] is not None:
                return
        time.sleep(0.1)
    raise DemoError(f"the controller is not ready after {READY_S:g} s; is the machine overloaded?")


def _operator(site: Site) -> Callable[[str], None]:
    """Who gives an order, and wants to hear that it was taken."""
    key = read_keys(site.keys)[WHO]

    def give(name: str) -> None:
        answer = order(site.server, key, name, why="the demo's course", now_ns=time.time_ns())
        if "accepted" not in answer:
            raise DemoError(f"{name} was not accepted: {answer.get('refused') or answer}")

    return give


def report(demo: Demo, start_ns: int) -> dict[str, Any]:
    """Judge the session that began at ``start_ns``: writes ``summary.json`` and the picture, returns the summary.

    ``picture`` in it is null where matplotlib is not installed.
    """
    traces = read_traces(str(demo.log_path), start_ns)
    summary = summarise(traces, demo.course, demo.gain_mw_per_mhz)
    summary["session"] = str(demo.log_path)
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


def _controller(demo: Demo, site: Site, start_ns: int) -> list[str]:
    """With all its processes it runs until it is told to end; alone it is told everything now."""
    if WHOLE:
        return [*("-m", "dcon.cli", "run", "--quiet", "--ini", str(site.ini), "--run-dir", str(site.work / "run"))]
    orders = [f"{timed.at_ns / 1e9:g}:{timed.order.name}" for timed in demo.course.orders]
    return [
        *("-m", "dcon.cli", "platform", "--quiet", "--ini", str(site.ini), "--log", str(demo.log_path)),
        *("--start", timebase.format_utc(start_ns), "--duration", f"{demo.course.end_s:g}"),
        *(word for order in orders for word in ("--order", order)),
    ]


def _grid(demo: Demo, site: Site, start_ns: int) -> list[str]:
    return [
        *("-m", "dcon.demo.grid", "--start-ns", str(start_ns)),
        *("--command-port", str(site.command_port), "--pmu-port", str(site.pmu_port)),
        *("--status-port", str(site.status_port)),
        *("--open-loop-s", repr(demo.course.open_loop_s), "--swing-s", repr(demo.course.swing_s)),
        *("--profile", demo.profile, "--noise-rad", repr(demo.noise_rad), "--seed", str(demo.seed)),
    ]


class Child(NamedTuple):
    """A process of the demo."""

    process: subprocess.Popen[str]
    said: Path
    """What it writes to its standard error: a file, so that it never waits for somebody to read."""


def _launch(arguments: list[str], said: Path) -> Child:
    """A process that ends with this one, even where this one is killed, or interrupted before it knows of the other."""
    quiet = subprocess.DEVNULL
    with said.open("ab") as file:
        if WHOLE:
            process = launch(arguments, dies_by=signal.SIGTERM, stdout=quiet, stderr=file.fileno())
        else:
            process = subprocess.Popen([sys.executable, *arguments], stdin=quiet, stdout=quiet, stderr=file, text=True)
    return Child(process, said)


def _wait(
    processes: dict[str, Child],
    start_ns: int,
    course: Course,
    tell: Callable[[str, float], None],
    give: Callable[[str], None] | None,
) -> None:
    """Until all have ended; ``give`` is called with the course's orders as their times come."""
    said = ""
    deadline_ns = start_ns + round((course.end_s + GRACE_S) * timebase.NS)
    orders = deque(course.orders if give is not None else ())
    while any(process.poll() is None for process, _ in processes.values()):
        _check(processes)
        now_ns = time.time_ns()
        if now_ns > deadline_ns:
            raise DemoError("the processes did not end in time; is the machine overloaded?")
        seconds = (now_ns - start_ns) / timebase.NS
        text = phase(course, seconds)
        if text != said:
            said = text
            tell(text, seconds)
        if give is not None and not orders and seconds >= course.end_s:
            give = None
            processes["controller"].process.terminate()
        if give is not None and orders and now_ns - start_ns >= orders[0].at_ns:
            give(orders.popleft().order.name)
            continue
        time.sleep(0.02)
    _check(processes)


def _check(processes: dict[str, Child]) -> None:
    """Raises DemoError where one has failed."""
    for name, child in processes.items():
        if child.process.poll() not in (None, 0, ENDED if name == "controller" and WHOLE else 0):
            raise DemoError(f"the {name} process failed: {_last_words(child)}")


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


def _last_words(child: Child) -> str:
    with child.said.open("rb") as file:
        file.seek(max(0, child.said.stat().st_size - LAST_BYTES))
        lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else f"exit code {child.process.returncode}"


def _reap(process: subprocess.Popen[str]) -> None:
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
