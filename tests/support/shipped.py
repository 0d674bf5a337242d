"""A control process without control: it ships ticks made at random, and keeps what it shipped to compare with."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from support.sessions import CONFIGS, HEAD, INSTANCES, PERIOD_NS, T0, Tick, bits, random_ticks

from dcon.core.values import Event, Order
from dcon.link.paths import SERVER
from dcon.link.shipper import Ring, Shipper
from dcon.link.shipping import Shipping
from dcon.server.recorder import Recorder
from dcon.session.codec import Watchdog
from dcon.session.encode import tick_entries, watchdog_entry
from dcon.session.reader import SessionReader
from pmutools.timebase import NS

INI = """[pmu N1]
url = udp://127.0.0.1:1
side = north
[pmu S1]
url = udp://127.0.0.1:2
side = south
"""
TICKS = [tick._replace(record=tick.record._replace(events=())) for tick in random_ticks(300)]


def tick_at(number: int, begun_ns: int = T0) -> Tick:
    """Any number of ticks, from those that were made; POSIX UTC of the first."""
    tick = TICKS[number % len(TICKS)]
    tick_ns = begun_ns + number * PERIOD_NS
    frames = tuple(frame._replace(tick_ns=tick_ns) for frame in tick.frames)
    return tick._replace(record=tick.record._replace(tick_ns=tick_ns), frames=frames, pdci=None)


class FakeControl:
    """Ships tick after tick; ``ring`` bounds what it keeps."""

    def __init__(self, folder: Path, session: int = 7, ring: Ring | None = None) -> None:
        self.shipper = Shipper(session, HEAD.pieces(session), Ring(600 * NS, 64 << 20) if ring is None else ring)
        self.shipping = Shipping(folder / SERVER, self.shipper)
        self.ticks = 0
        self.begun_ns = T0
        """POSIX UTC of the first tick."""
        self.watchdog: Watchdog | None = None
        """Logged with each tick, where there is one."""
        for name, frame in CONFIGS.items():
            self.shipper.config(name, frame, T0, time.monotonic_ns())

    def tick(self, orders: tuple[Order, ...] = (), events: tuple[Event, ...] = ()) -> None:
        """Make and ship the next tick, and serve the connection, as a control process does."""
        tick = tick_at(self.ticks, self.begun_ns)
        record = tick.record._replace(events=events)
        given = orders or tick.orders
        entries = tick_entries(
            INSTANCES, record, tick.frames, given, timing=tick.timing, surroundings=tick.surroundings
        )
        if self.watchdog is not None:
            entries.append(watchdog_entry(self.watchdog))
        now_ns = time.monotonic_ns()
        self.shipper.tick(record.tick_ns, entries, now_ns)
        self.ticks += 1
        self.shipping.service(now_ns)

    def until(self, done: Callable[[], bool], what: str, seconds: float = 20.0) -> None:
        """Serve the connection until ``done``."""
        eventually(done, what, seconds, lambda: self.shipping.service(time.monotonic_ns()))

    def settled(self) -> None:
        """Everything has been acknowledged."""
        self.until(lambda: len(self.shipper.ring) == 0, "not everything was acknowledged")


def eventually(
    done: Callable[[], bool], what: str, seconds: float = 20.0, meanwhile: Callable[[], object] = lambda: None
) -> None:
    deadline = time.monotonic() + seconds
    while not done():
        meanwhile()
        assert time.monotonic() < deadline, what
        time.sleep(0.002)


def same_ticks(reader: SessionReader, numbers: Iterable[int]) -> None:
    """The log holds the ticks of these numbers, bit for bit and no other; events of the log itself apart."""
    back = list(reader.ticks())
    wanted = [tick_at(number) for number in numbers]
    assert [tick.record.tick_ns for tick in back] == [tick.record.tick_ns for tick in wanted]
    for got, tick in zip(back, wanted, strict=True):
        record = got.record._replace(events=tuple(e for e in got.record.events if e.subject != "log"))
        told = (tick.record._replace(events=record.events), tick.frames, tick.orders, tick.timing, tick.surroundings)
        assert bits((record, got.frames, got.orders, got.timing, got.surroundings)) == bits(told)


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class ServerProcess:
    """``dcon server`` as a process, with a log ``session.mcap`` in its folder."""

    def __init__(self, folder: Path, *extra: str) -> None:
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.run_dir = folder / "run"
        self.log = folder / "session.mcap"
        self.port = free_port()
        ini = folder / "dcon.ini"
        lines = [INI, "[server]", f"listen = 127.0.0.1:{self.port}", *extra, "[log]", f"path = {self.log}", ""]
        ini.write_text("\n".join(lines))
        self.arguments = [sys.executable, "-m", "dcon.cli", "server", "--ini", str(ini), "--run-dir", str(self.run_dir)]
        self.process = self._start()

    def _start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(self.arguments, stderr=subprocess.PIPE, text=True)

    def again(self) -> None:
        self.process = self._start()

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()

    def end(self) -> int:
        """As an operator would."""
        self.process.terminate()
        _, self.said = self.process.communicate(timeout=20)
        return self.process.returncode

    def listens(self) -> None:
        def there() -> bool:
            assert self.process.poll() is None, self.process.communicate()[1]
            with socket.socket() as sock:
                return sock.connect_ex(("127.0.0.1", self.port)) == 0

        eventually(there, "the server does not listen")


def recorder_in(folder: Path, **limits: float) -> Recorder:
    run = folder / "run"
    run.mkdir(exist_ok=True)
    return Recorder(str(folder / "session.mcap"), run, **limits)
