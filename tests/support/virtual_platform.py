"""The real-time loop without sockets and clocks: a platform whose time, streams and output are scripted."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import pytest
from support.swing import MS, START_NS, Streams

from dcon.control import loop
from dcon.control.alone import OwnFrames
from dcon.control.loop import Platform
from dcon.control.orders import TimedOrder, parse_order
from dcon.control.ports import Ends
from dcon.control.summary import Summary
from dcon.core.values import Record
from dcon.front.receiving import KEPT, Reception
from dcon.replay.replay import replay
from dcon.session.head import Head
from dcon.session.reader import SessionReader
from dcon.session.rolling import RollingWriter
from pmutools.c37118 import Demux, Loss, Message, StreamConfig
from pmutools.c37118.config import encode_config
from pmutools.clock import VirtualClock
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.net.dialogue import LinkEvent
from pmutools.timebase import NS

STREAMS = Streams(("N1", "N2", "S1"))
FLOWS = {pmu.name: Flow("udp", f"192.0.2.{pmu.idcode}:4713", "192.0.2.1:4801") for pmu in STREAMS.pmus}
ORDERS = tuple(map(parse_order, ("0.8:closed_loop", "0.9:arm", "1.0:activate")))
Item = Chunk | LinkEvent


class Clock(VirtualClock):
    """Things can be made to happen while the loop sleeps."""

    def __init__(self) -> None:
        super().__init__(START_NS - 10 * MS)
        self._events: deque[tuple[float, Callable[[], object]]] = deque()

    @property
    def passed_s(self) -> float:
        return self.monotonic_ns() / NS

    def at(self, passed_s: float, act: Callable[[], object]) -> None:
        """``act`` when so many seconds have passed; in order of time."""
        self._events.append((passed_s, act))

    def pause(self, passed_s: float, for_s: float) -> None:
        """The machine sleeps."""
        self.at(passed_s, lambda: self.advance(round(for_s * NS)))

    def set(self, passed_s: float, by_s: float) -> None:
        """UTC is stepped."""
        self.at(passed_s, lambda: self.step(round(by_s * NS)))

    def sleep_until(self, deadline_ns: int, /) -> None:
        super().sleep_until(deadline_ns)
        while self._events and self._events[0][0] <= self.passed_s:
            self._events.popleft()[1]()


class Script:
    """In the place of ``Receivers``: what arrives at which time, demultiplexed as there."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.demux = Demux(bounds=KEPT)
        self.waiting: deque[tuple[int, Item]] = deque()
        self.closed = False
        self.unwanted = self.undecodable = self.held = 0
        self.endpoints = ()

    def play(self, items: Iterable[tuple[int, Item]]) -> None:
        """Items with their arrival, in ns of unstepped UTC."""
        self.waiting = deque(sorted(items, key=lambda entry: entry[0]))

    def poll(self, timeout_ns: int | None) -> list[Item]:
        clock = self.clock
        end_ns = clock.monotonic_ns() + (timeout_ns or 0)
        if self.waiting and (due_ns := self._at(self.waiting[0][0])) <= end_ns:
            super(Clock, clock).sleep_until(due_ns)
            ready = []
            while self.waiting and self._at(self.waiting[0][0]) <= clock.monotonic_ns():
                ready.append(self.waiting.popleft()[1])
            return ready
        super(Clock, clock).sleep_until(end_ns)
        return []

    def _at(self, arrival_ns: int) -> int:
        return arrival_ns - START_NS + 10 * MS

    def parse(self, item: Item) -> list[Message | Loss]:
        return self.demux.feed(item) if isinstance(item, Chunk) else []

    def owners(self, flow: Flow, idcode: int) -> tuple[int, ...]:
        return tuple(k for k, pmu in enumerate(STREAMS.pmus) if pmu.idcode == idcode and FLOWS[pmu.name] == flow)

    def close(self) -> None:
        self.closed = True


class Driver:
    """In the place of the UDP driver."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.sent: list[tuple[int, float, float]] = []
        """(tick, volts, seconds that had passed)."""
        self.failed = 0
        self.closed = False

    def send(self, time_ns: int, output_v: float, flags: int = 0) -> None:
        self.sent.append((time_ns, output_v, self.clock.passed_s))

    def close(self) -> None:
        self.closed = True


def config_chunk(name: str, arrival_ns: int, config: StreamConfig | None = None) -> tuple[int, Item]:
    frame = encode_config(config or STREAMS.streams[name].config)
    return arrival_ns, Chunk(frame, arrival_ns, FLOWS[name], StampSource.KERNEL)


def stream(seconds: float, names: Iterable[str] = STREAMS.streams) -> list[tuple[int, Item]]:
    """Configurations, then the frames, 60 ms late each."""
    items = [config_chunk(name, START_NS) for name in names]
    for slot in range(round(seconds * 60)):
        for name in names:
            frame = STREAMS.frame(name, slot, delay_ms=60.0 + 0.1 * slot % 3)
            arrival_ns = frame.arrival_ns or 0
            items.append((arrival_ns, Chunk(frame.data, arrival_ns, FLOWS[name], StampSource.KERNEL)))
    return items


class Bench:
    """A platform on a script."""

    def __init__(self, path: Path, items: Iterable[tuple[int, Item]], platform: str = "") -> None:
        self.path = path
        self.clock = Clock()
        self.script = Script(self.clock)
        self.script.play(items)
        self.driver = Driver(self.clock)
        settings = STREAMS.settings(extra=f"\n[output]\nurl = udp://127.0.0.1:9\n[platform]\nfifo = no\n{platform}")

        def open_log(head: Head) -> RollingWriter:
            return RollingWriter(self.path, head)

        frames = OwnFrames(Reception(self.script), self.clock)  # type: ignore[arg-type]
        self.platform = Platform(settings, Ends(frames, open_log, self.driver), self.clock)

    def run(self, duration_s: float | None, orders: Sequence[TimedOrder] = ORDERS) -> Summary:
        return self.platform.run(orders=orders, start_ns=START_NS, duration_s=duration_s)

    @property
    def records(self) -> list[Record]:
        return [tick.record for tick in SessionReader(self.path).ticks()]

    def steps_mw(self) -> list[float]:
        return [abs(b[1] - a[1]) * 12.5 for a, b in pairwise(self.driver.sent)]

    def ended_well(self) -> None:
        """0 V was the last word, nothing is left open, and the log replays bit for bit."""
        assert self.driver.sent[-1][1] == 0.0
        assert self.driver.closed and self.script.closed
        result = replay(str(self.path))
        assert (result.different, result.stopped) == (0, ""), str(result.first)


def virtual_platform(
    path: Path, items: Iterable[tuple[int, Item]], monkeypatch: pytest.MonkeyPatch, platform: str = ""
) -> Bench:
    """``platform`` are more lines of ``[platform]``."""
    monkeypatch.setattr(loop, "prepare", lambda *, fifo: None)
    return Bench(path, items, platform)
