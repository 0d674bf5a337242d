"""A watchdog as a real process, with a receiver of its commands and its status, and the platforms that beat to it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from dcon.link.beats import WatchdogStatus, decode_status
from dcon.link.command import CommandOut, decode

DEADLINE_S = 20.0


def until(condition: Callable[[], Any], what: str = "") -> Any:
    """Wait until a condition holds, and give what it gave."""
    deadline = time.monotonic() + DEADLINE_S
    while not (value := condition()):
        assert time.monotonic() < deadline, what or "it did not come in time"
        time.sleep(0.002)
    return value


class Dog:
    """The process, and what is heard of it."""

    def __init__(self, folder: Path, process: subprocess.Popen[bytes], log: Path) -> None:
        self.folder, self.process, self.log = folder, process, log
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.status: WatchdogStatus | None = None
        self.commands: list[CommandOut] = []

    def listen(self) -> None:
        """Take what was sent."""
        with suppress(BlockingIOError):
            while True:
                self.status = decode_status(self.told.recv(64))
        with suppress(BlockingIOError):
            while True:
                command = decode(self.udp.recv(64))
                assert command is not None
                self.commands.append(command)

    def events(self) -> list[dict[str, Any]]:
        """Whole lines of its log."""
        lines = self.log.read_bytes().split(b"\n")[:-1] if self.log.exists() else []
        return [json.loads(line) for line in lines]

    def event(self, name: str) -> dict[str, Any]:
        """The first event of a name; it is waited for."""

        def found() -> dict[str, Any] | None:
            assert self.process.poll() is None or name == "end", f"it has ended: {self.events()}"
            return next((event for event in self.events() if event["event"] == name), None)

        event: dict[str, Any] = until(found, f"no {name}: {self.events()}")
        return event

    def see(self, condition: Callable[[WatchdogStatus], bool]) -> WatchdogStatus:
        """A status for which a condition holds; it is waited for."""

        def found() -> bool:
            self.listen()
            return self.status is not None and condition(self.status)

        until(found, f"last seen {self.status}, {self.events()}")
        assert self.status is not None
        return self.status

    def send(self, *datagrams: bytes) -> None:
        """To its inbox."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            for datagram in datagrams:
                out.sendto(datagram, str(self.folder / "watchdog.in"))

    def signal(self, number: int) -> int:
        """Send the process a signal; gives CLOCK_MONOTONIC ns just before."""
        now_ns = time.monotonic_ns()
        self.process.send_signal(number)
        return now_ns


@contextmanager
def watchdog(folder: Path, *arguments: str, **popen: Any) -> Iterator[Dog]:
    """A watchdog that sends to a UDP socket here and writes its log beside the folder; killed at the end."""
    log = folder.parent / "watchdog.log"
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind(("127.0.0.1", 0))
    folder.mkdir(mode=0o700, exist_ok=True)
    told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    told.bind(str(folder / "status.in"))
    output = f"udp://127.0.0.1:{udp.getsockname()[1]}"
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "dcon.watchdog", "--run-dir", str(folder), "--output", output),
            *("--status", "control.in,status.in", "--log", str(log), *arguments),
        ],
        **popen,
    )
    dog = Dog(folder, process, log)
    for old, new in ((dog.udp, udp), (dog.told, told)):
        old.close()
        new.setblocking(False)
    dog.udp, dog.told = udp, told
    try:
        dog.event("start")
        yield dog
    finally:
        process.kill()
        process.wait()
        udp.close()
        told.close()


@contextmanager
def beating(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A platform, or a flood; killed at the end."""
    command = [sys.executable, "-m", "support.beating", str(folder), *arguments]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))})
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        (folder / "control.in").unlink(missing_ok=True)


@contextmanager
def closed(folder: Path, *arguments: str) -> Iterator[tuple[Dog, subprocess.Popen[bytes]]]:
    """A watchdog and a platform, brought to closed relays and 5 V."""
    with ExitStack() as stack:
        dog = stack.enter_context(watchdog(folder, *arguments))
        process = stack.enter_context(beating(folder))
        dog.see(lambda status: status.closed)
        until(lambda: (dog.listen(), dog.commands and dog.commands[-1].output_v == 5.0)[1], "5 V did not come")
        yield dog, process
