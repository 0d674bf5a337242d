"""``dcon run`` on loopback: its processes, PMUs from ``pmu play``, a gateway that takes the command, an operator."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from support.emulator import Gateway
from support.feeding import player, recording, spawn
from support.iio import volts
from support.live import free_ports
from support.swing import MS, Streams

from dcon.core.values import Pdci
from dcon.drivers import line_status
from dcon.limiter import MW_PER_V
from dcon.link import paths
from dcon.link.keys import add_key, read_keys
from dcon.server.client import Client, order
from pmutools.errors import SourceError
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.timebase import NS

ROOT = Path(__file__).parents[2]
NAMES = ("N1", "S1")
PATIENCE_S = 30.0
PATIENT = """gps_holdover_s = 0.5
gap_ms = 500
latency_max_ms = 500
"""
"""Limits of ``[supervisor]`` for a machine that stands still now and then."""
WAY = {
    "FAULT": ("release", "reset"),
    "ESTOP": ("release", "reset"),
    "STANDBY": ("reset", "ack", "closed_loop", "arm"),
    "ARMED": ("activate",),
    "ACTIVE": (),
}
"""The orders that lead from each state to the next on the way to ACTIVE."""
PROCESSES = {
    "watchdog": "dcon.watchdog",
    "server": "dcon.cli server",
    "platform": "dcon.cli platform",
    "front": "dcon.front",
    "aides": "dcon.aides",
}
"""What is on the command line of each that every run has."""
DRIVES = {"output": "dcon.cli output"}
"""The same of the one that drives a device."""


class Around(threading.Thread):
    """What a site tells, ten times a second: the clock's lock, and the status of a line that obeys."""

    def __init__(self, run_dir: Path, line_port: int, driven_mw: Callable[[], float]) -> None:
        super().__init__(daemon=True)
        self._driven_mw = driven_mw
        self.gps_age_s: float | None = 0.0
        """None where somebody else tells."""
        self.in_service = True
        self._control, self._line = paths.Sender(run_dir / paths.CONTROL), ("127.0.0.1", line_port)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._over = threading.Event()

    def run(self) -> None:
        number = 0
        while not self._over.wait(0.1):
            number += 1
            news = {"kind": "gps", "age_s": self.gps_age_s, "source": "test", "detail": ""}
            if self.gps_age_s is not None:
                self._control.send(json.dumps(news).encode())
            line = Pdci(time.time_ns(), 2000.0 + self._driven_mw(), self.in_service, True, 2000.0)
            with suppress(OSError):
                self._sock.sendto(line_status.encode(number, line), self._line)

    def close(self) -> None:
        self._over.set()
        self.join()
        self._sock.close()


class Running:
    """One ``dcon run`` with all that is around it."""

    def __init__(
        self,
        folder: Path,
        extra: str = "",
        names: tuple[str, ...] = NAMES,
        device: Path | None = None,
        *,
        supervisor: str = PATIENT,
        platform: str = "",
        time_source: str = "none",
        **law: Any,
    ) -> None:
        """``extra`` goes to the end of the initialisation file, ``names`` are PMUs of the fleet.

        ``device`` is a fake of an IIO device that is driven, instead of the gateway. ``supervisor`` and
        ``platform`` are lines of those sections, ``law`` keywords of :func:`~dcon.sim.plan.ini_of`.
        """
        self.folder = folder
        self.names = names
        self.device = device
        self.run_dir = folder / "run"
        self.keys = folder / "keys.ini"
        *self.ports, line_port, self.server_port = free_ports(len(names) + 2)
        self.gateway = Gateway()
        self.server = Endpoint(Scheme.TCP, "127.0.0.1", self.server_port)
        add_key(self.keys, "ann")
        self.operator = read_keys(self.keys)["ann"]
        urls = [f"udp://127.0.0.1:{port}?source=127.0.0.1" for port in self.ports]
        self.ini = folder / "site.ini"
        settings = f"""
[output]
url = {f"iio://{device}?readback=0&settle_ms=0.2" if device else f"udp://127.0.0.1:{self.gateway.port}"}
[platform]
time_source = {time_source}
gps_required = yes
{platform}[supervisor]
{supervisor}[watchdog]
required = yes
log = {self.watchdog_log}
[server]
required = yes
listen = 127.0.0.1:{self.server_port}
keys = {self.keys}
[log]
path = {self.log}
{extra}"""
        line = f"url = udp://127.0.0.1:{line_port}"
        self.ini.write_text(Streams(names).ini(urls=urls, pdci=line, extra=settings, **law))
        self.around = Around(self.run_dir, line_port, self.driven_mw)
        self._processes: list[subprocess.Popen[bytes]] = []
        self.run: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> Path:
        return self.folder / "session.mcap"

    def driven_mw(self) -> float:
        """By the line now."""
        if self.device is not None:
            return volts(self.device) * MW_PER_V
        return self.gateway.commands[-1].command_mw if self.gateway.commands else 0.0

    @property
    def watchdog_log(self) -> Path:
        return self.folder / "watchdog.jsonl"

    # --- starting and ending

    @property
    def to(self) -> list[str]:
        """Where the PMUs are awaited, as a player is told it."""
        configs = Streams(self.names).configs
        return [
            f"udp://127.0.0.1:{port}?idcode={configs[name].idcode}"
            for name, port in zip(self.names, self.ports, strict=True)
        ]

    def start(self, *arguments: str) -> None:
        """PMUs in a steady swing for ever, and :meth:`begin`."""
        played = recording(self.folder / "swing.c37118", self.names)
        self._processes.append(player(self.folder, played, self.to, "--delay", "normal(60,1)", "--loop", "0"))
        self.begin(*arguments)

    def begin(self, *arguments: str) -> None:
        """All but the PMUs."""
        self.gateway.start()
        self.around.start()
        words = ("run", "--ini", str(self.ini), "--run-dir", str(self.run_dir), *arguments)
        self.run = spawn(self.folder, "dcon.cli", *words)
        self._processes.append(self.run)

    def end(self) -> int:
        """Ask ``dcon run`` to end; its exit code."""
        assert self.run is not None
        self.run.terminate()
        code = self.run.wait(PATIENCE_S)
        self.close()
        return code

    def close(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.kill()
            process.wait(5)
        if self.around.is_alive():
            self.around.close()
        if self.gateway.is_alive():
            self.gateway.close()

    # --- looking

    def said(self) -> str:
        """All that the processes wrote to stderr."""
        return (self.folder / "stderr").read_text(errors="replace")

    def summary(self) -> dict[str, Any]:
        """What ``dcon run --json`` wrote at its end."""
        found: dict[str, Any] = json.loads((self.folder / "stdout").read_text().splitlines()[-1])
        return found

    def status(self) -> dict[str, Any]:
        with Client(self.server) as client:
            return client.ask({"ask": "status"})

    def until(self, holds: Callable[[dict[str, Any]], bool], what: str = "") -> dict[str, Any]:
        """The status, once ``holds``; fails where that takes too long, or ``dcon run`` has ended."""
        end_s = time.monotonic() + PATIENCE_S
        status: dict[str, Any] = {}
        while time.monotonic() < end_s:
            assert self.run is not None and self.run.poll() is None, self.said()
            with suppress(SourceError):
                status = self.status()
                if holds(status):
                    return status
            time.sleep(0.05)
        raise AssertionError(f"never came true: {what}; {status}; {self.said()}")

    def in_state(self, *states: str) -> dict[str, Any]:
        """The status once the controller that is connected now is in one of ``states``."""
        return self.until(lambda now: now["controller_connected"] and now["state"] in states, f"in {states}")

    def restarts(self) -> int:
        """Of processes that ``dcon run`` has started again, so far."""
        return self.said().count("started again in")

    def watchdog_events(self) -> list[dict[str, Any]]:
        lines = self.watchdog_log.read_text().splitlines() if self.watchdog_log.exists() else []
        return [json.loads(line) for line in lines if line.endswith("}")]

    def pid(self, name: str) -> int:
        """Of a process, by what it is; it must be there."""
        assert self.run is not None
        found = [pid for pid in descendants(self.run.pid) if (PROCESSES | DRIVES)[name] in command_line(pid)]
        assert len(found) == 1, (name, found)
        return found[0]

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Send a signal; the monotonic time of that, ns."""
        pid = self.pid(name)
        at_ns = time.monotonic_ns()
        os.kill(pid, number)
        return at_ns

    def caught_up(self) -> None:
        """Wait until the server has what the controller has just decided."""
        self.until(lambda now: now["controller_connected"] and time.time_ns() - now["tick_ns"] < NS // 4, "caught up")

    # --- ordering

    def order(self, name: str, **given: Any) -> dict[str, Any]:
        return order(self.server, self.operator, name, now_ns=time.time_ns(), **given)

    def obeyed(self, name: str, **given: Any) -> None:
        """An order that must be taken; one that comes too early for its permissives is given again."""
        end_s = time.monotonic() + PATIENCE_S
        answer: dict[str, Any] = {}
        while time.monotonic() < end_s:
            with suppress(SourceError):
                answer = self.order(name, **given)
                if "accepted" in answer:
                    return
            time.sleep(0.1)
        raise AssertionError(f"{name}: {answer}; {self.status()['flags']}; {self.said()}")

    def activate(self, least_v: float = 0.5) -> None:
        """From wherever it is: ACTIVE in closed loop, with closed relays and at least so much driven.

        A machine that pauses may trip it on the way: then from there.
        """
        end_s = time.monotonic() + PATIENCE_S
        while (state := self.in_state(*WAY)["state"]) != "ACTIVE":
            assert time.monotonic() < end_s, (self.status(), self.said())
            for name in WAY[state]:
                with suppress(SourceError):
                    self.order(name)
            changed_s = time.monotonic() + 1.0
            while self.status()["state"] == state and time.monotonic() < changed_s:
                time.sleep(0.05)
        self.until(lambda now: now["state"] == "ACTIVE" and abs(now["output_v"]) >= least_v, "a command")


def descendants(pid: int) -> Iterator[int]:
    """Children, and theirs; of all threads."""
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for word in (task / "children").read_text().split():
                yield int(word)
                yield from descendants(int(word))


def command_line(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""


FLOOD = """
import socket, sys, time
port, seconds, sources, per_s = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3:], 10_000
datagrams = [bytes.fromhex(word) for word in sys.stdin.read().split()]
socks = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for source in sources]
for sock, source in zip(socks, sources):
    sock.bind((source, 0))
begun, sent = time.monotonic(), 0
while sent < seconds * per_s:
    while sent < min(time.monotonic() - begun, seconds) * per_s:
        socks[sent // 8 % len(socks)].sendto(datagrams[sent % len(datagrams)], ("127.0.0.1", port))
        sent += 1
    time.sleep(0.001)
print(time.monotonic() - begun)
"""


@contextmanager
def flood(
    port: int, datagrams: list[bytes], seconds: float, source: str | Sequence[str] = "127.0.0.1"
) -> Iterator[None]:
    """Ten thousand datagrams a second from a process of its own, that many in all, in at most a quarter more.

    Of several sources each sends eight in turn.
    """
    sources = [source] if isinstance(source, str) else source
    arguments = [sys.executable, "-c", FLOOD, str(port), str(seconds), *sources]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(" ".join(data.hex() for data in datagrams))
        process.stdin.close()
        yield
        took_s = float(process.stdout.read())
    assert took_s < 1.25 * seconds, "fewer than 8,000 a second"


def frames_now(name: str, count: int = 100) -> list[bytes]:
    """Good data frames of a PMU with stamps from now on, 1/60 s apart."""
    streams = Streams((name,))
    now_ns = time.time_ns()
    return [streams.data(name, now_ns + k * NS // 60 - 40 * MS) for k in range(count)]
