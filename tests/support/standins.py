"""What stands in for the watchdog's clock, lines, sockets, threads and system, so that each call is the test's own."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

from support.guarded import RELEASED

from dcon.link import beats, command
from dcon.watchdog import latch, loop
from dcon.watchdog.core import Decision
from dcon.watchdog.limits import Rules
from dcon.watchdog.loop import Config
from dcon.watchdog.memory import MS, Driven, Inputs, Item, Memory, State

T0_NS = 5_000 * MS
UTC_NS = 1_700_000_000_123_456_789


class Instead:
    """A module with some of its names replaced; what is replaced is seen by those only who ask here."""

    def __init__(self, module: ModuleType, **names: Any) -> None:
        self._module = module
        vars(self).update(names)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class Calls(list[tuple[Any, ...]]):
    """Calls that were made, by their arguments; each gives the next of ``results``, or raises it; the last goes on."""

    def __init__(self, *results: Any) -> None:
        super().__init__()
        self.results = list(results) or [None]

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        self.append((*arguments, *named.values()))
        result = self.results.pop(0) if len(self.results) > 1 else self.results[0]
        if isinstance(result, BaseException):
            raise result
        return result


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        before = os.umask(0)
        try:
            yield Path(name)
        finally:
            os.umask(before)


class Clock:
    """In the place of the module ``time``; one that is asked without end says so."""

    def __init__(self) -> None:
        self.now_ns, self.left = T0_NS, 500
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        self.left -= 1
        assert self.left
        return self.now_ns

    def time_ns(self) -> int:
        return UTC_NS + self.now_ns

    def sleep(self, s: float) -> None:
        self.slept.append(s)
        self.now_ns += round(s * 1e9)


class Wires:
    """In the place of the lines."""

    def __init__(self) -> None:
        self.drive = Calls(Driven(True))

    def read(self) -> Inputs:
        return RELEASED


class Kept:
    """In the place of the latch."""

    def __init__(self, path: str, causes: int) -> None:
        self.causes, self.trouble = causes, ""
        self.hold, self.close = Calls(), Calls()


class Log:
    """In the place of the report."""

    dropped = 0

    def __init__(self, path: str, max_bytes: int) -> None:
        self.lines: list[dict[str, Any]] = []
        self.close = Calls()

    def line(self, **fields: Any) -> None:
        self.lines.append(fields)


class Told:
    """In the place of systemd."""

    def __init__(self) -> None:
        self.tell = Calls()


def heard(sock: socket.socket) -> list[bytes]:
    """All that waits."""
    datagrams = []
    while True:
        try:
            datagrams.append(sock.recv(4096))
        except BlockingIOError:
            return datagrams


class Dog:
    """A watchdog in a folder of its own, and all that it touches."""

    def __init__(self, path: Path, latched: int) -> None:
        if latched:
            (path / latch.NAME).write_bytes(latch.text_of(latched))
        self.path, self.clock, self.wires = path, Clock(), Wires()
        self.told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.left = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        for sock, name in ((self.told, "control.in"), (self.left, "output.in")):
            sock.setblocking(False)
            sock.bind(str(path / name))
        with patch.multiple(loop, time=self.clock, Report=Log, Latch=Kept, Notify=Told):
            self.it: Any = loop.Watchdog(Config(str(path), lines=self.wires))  # type: ignore[arg-type]

    def round(self, tick: bool, decision: Decision, at_ns: int = 0, late_ms: float = 0.0) -> list[Item]:
        """A round that decides so, ``at_ns`` after the start; gives its news."""
        self.clock.now_ns = T0_NS + at_ns
        got: list[Item] = []

        def step(rules: Rules, before: Memory, news: list[Item], now_ns: int) -> tuple[Memory, Decision]:
            got.extend(news)
            return before._replace(now_ns=now_ns, state=decision.state, late_ms=late_ms), decision

        with patch.multiple(loop, time=self.clock, step=step):
            self.it._round(tick)
        return got

    def end(self) -> dict[str, Any]:
        """End it; the line that it leaves."""
        with patch.multiple(loop, time=self.clock):
            self.it._end()
        return dict(self.it._report.lines[-1])

    def statuses(self) -> list[beats.WatchdogStatus]:
        statuses = [beats.decode_status(datagram) for datagram in heard(self.told)]
        return [status for status in statuses if status is not None]

    def commands(self) -> list[command.CommandOut]:
        commands = [command.decode(datagram) for datagram in heard(self.left)]
        return [sent for sent in commands if sent is not None]


@contextmanager
def kennel(latched: int = 0) -> Iterator[Dog]:
    with folder() as path:
        path.chmod(0o700)
        dog = Dog(path, latched)
        try:
            yield dog
        finally:
            for sock in (dog.told, dog.left, dog.it._inbox, dog.it._output._sock, dog.it._listeners[0]._sock):
                sock.close()


def decided(state: State = State.OPEN, a: bool = False, b: bool = False, **more: Any) -> Decision:
    return Decision(state, a, b, 7, True, 0, None, False, ())._replace(**more)


class Wake:
    """In the place of an event: what happens in each wait is a list that ends."""

    def __init__(self) -> None:
        self.script: list[Callable[[], object]] = []
        self.waits, self.set, self.clear = Calls(), Calls(), Calls()

    def wait(self, timeout_s: float | None = None) -> None:
        self.waits(timeout_s)
        self.script.pop(0)()


class Threads:
    """In the place of ``threading``: a thread runs when it is told to."""

    Event = Wake

    def __init__(self) -> None:
        self.start, self.join, self.stack_size = Calls(), Calls(), Calls()
        self.Thread = Calls(SimpleNamespace(start=self.start, join=self.join))
