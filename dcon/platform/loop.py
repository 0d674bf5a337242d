"""The control loop in real time.

One thread: between ticks it receives and parses, at the tick it computes, drives the output, then logs. The frames a
tick consumes are those parsed when its time has come, and the log says which they were.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from dcon.core.rows import CORE
from dcon.core.values import Record
from dcon.drivers.udp_command import UdpCommandDriver
from dcon.engine import Engine
from dcon.platform.orders import OrderBook, TimedOrder
from dcon.platform.schedule import TickGrid
from dcon.session.codec import Timing
from dcon.session.log import SessionWriter
from dcon.settings import Settings, Site
from pmutools import linux
from pmutools.c37118 import Frame, FrameType, Message, StreamConfig
from pmutools.clock import Clock, SystemClock, utc_offset
from pmutools.errors import SettingsError
from pmutools.flow import Chunk
from pmutools.net.dialogue import LinkEvent
from pmutools.net.endpoint import Endpoint
from pmutools.net.receiver import Receivers

LOG = logging.getLogger(__name__)
SPIN_NS = 200_000
CLOCK_CHECK_TICKS = 60
FIFO_PRIORITY = 10
COARSE_NS = 1_200_000
"""Selectors wait in whole milliseconds: the last stretch before a deadline is slept exactly."""


@dataclass
class Summary:
    """How a session went."""

    ticks: int = 0
    late_over_1ms: int = 0
    skipped_ticks: int = 0
    """Ticks whose time had passed before the loop came to them."""
    frames: int = 0
    unread: dict[str, int] = field(default_factory=dict)
    own_drops: int = 0
    final_state: str = ""


def endpoint_of(site: Site) -> Endpoint:
    """Where a PMU's stream is received from, its IDCODE included."""
    return site.url if site.idcode is None else replace(site.url, idcode=site.idcode)


class Platform:
    """A session from sockets to sockets. Sockets are open once this is made, so that nothing sent later is missed."""

    def __init__(self, settings: Settings, *, clock: Clock | None = None) -> None:
        """Raises SourceError where a port cannot be bound or a host is unknown."""
        self.settings = settings
        self.clock = clock or SystemClock(spin_ns=SPIN_NS)
        self.engine = Engine(settings.params, settings.sites)
        self.receivers = Receivers([endpoint_of(site) for site in settings.sites], self.clock)
        self.driver = UdpCommandDriver(settings.output.url) if settings.output.url is not None else None
        self.summary = Summary()
        self._frames: dict[str, list[Frame]] = {}
        self._configs: list[tuple[str, bytes, int]] = []
        self._known: dict[str, StreamConfig] = {}

    def run(
        self,
        log_path: str,
        *,
        orders: Sequence[TimedOrder] = (),
        start_ns: int | None = None,
        duration_s: float | None = None,
        observe: Callable[[Record], None] | None = None,
    ) -> Summary:
        """Run until ``duration_s`` after ``start_ns`` (POSIX UTC; now unless given), or until interrupted.

        ``orders`` count from ``start_ns``. The output is driven to 0 V at the end, however it comes. Raises
        SourceError where the log cannot be written, SettingsError where a PMU's first configuration cannot be used.
        """
        start_ns = self.clock.realtime_ns() if start_ns is None else start_ns
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        settings = self.settings
        writer = SessionWriter(
            log_path,
            ini_text=settings.text,
            configs={},
            metadata={"start_ns": str(start_ns)},
            pmus=[site.name for site in settings.sites],
            instances=settings.params.instance_names,
            flags=CORE.names,
        )
        prepare(fifo=settings.platform.fifo)
        try:
            with writer:
                self._loop(writer, OrderBook(orders, start_ns), end_ns, observe)
        finally:
            gc.unfreeze()
            self._stop()
        self.summary.unread = dict(self.engine.unread)
        self.summary.final_state = str(self.engine.state.system)
        return self.summary

    def _loop(
        self, log: SessionWriter, book: OrderBook, end_ns: int | None, observe: Callable[[Record], None] | None
    ) -> None:
        clock, summary = self.clock, self.summary
        grid = TickGrid(self.settings.params.tick_hz, round(self.settings.platform.phase_ms * 1e6))
        offset = utc_offset(clock)
        index = grid.after(clock.realtime_ns())
        while True:
            tick_ns = grid.time_ns(index)
            if end_ns is not None and tick_ns > end_ns:
                return
            deadline_ns = offset.monotonic_ns(tick_ns)
            self._receive_until(deadline_ns)
            started_ns = clock.monotonic_ns()
            orders = book.due(tick_ns)
            frames, self._frames = self._frames, {}
            tick = self.engine.tick(frames, orders, tick_ns)
            if self.driver is not None:
                self.driver.send(tick_ns, tick.record.output_v)
            done_ns = clock.monotonic_ns()
            for name, frame, time_ns in self._configs:
                log.config(name, frame, time_ns)
            self._configs = []
            timing = Timing((done_ns - started_ns) / 1e3, (started_ns - deadline_ns) / 1e3)
            log.tick(tick.record, tick.frames, orders, timing=timing)
            if observe is not None:
                observe(tick.record)
            summary.ticks += 1
            summary.frames += len(tick.frames)
            summary.late_over_1ms += started_ns - deadline_ns > 1_000_000
            index += 1
            if summary.ticks % CLOCK_CHECK_TICKS == 0:  # follow a slewed or stepped UTC
                offset = utc_offset(clock, 3)
            passed = grid.after(offset.realtime_ns(clock.monotonic_ns())) - index
            if passed > 0:
                summary.skipped_ticks += passed
                index += passed

    def _receive_until(self, deadline_ns: int) -> None:
        """Receive and parse until shortly before ``deadline_ns``, then wait for it exactly and take what has come."""
        while (left_ns := deadline_ns - self.clock.monotonic_ns()) > 2 * COARSE_NS:
            self._take(self.receivers.poll(left_ns - COARSE_NS))
        self.clock.sleep_until(deadline_ns)
        self._take(self.receivers.poll(0))

    def _take(self, items: list[Chunk | LinkEvent]) -> None:
        for item in items:
            if not isinstance(item, Chunk):
                self.summary.own_drops += item.datagrams
                LOG.info("%s %s %s", item.kind, item.where, item.detail)
            for found in self.receivers.parse(item):
                if isinstance(found, Message):
                    self._route(found)

    def _route(self, message: Message) -> None:
        frame, flow, config = message
        for owner in self.receivers.owners(flow, frame.idcode):
            name = self.settings.sites[owner].name
            if frame.type is FrameType.DATA:
                self._frames.setdefault(name, []).append(frame)
            elif config is not None and frame.type is not FrameType.CFG1 and self._known.get(name) != config:
                problem = self.engine.reconfigure(name, config)
                if problem is not None and name not in self._known:
                    raise SettingsError(problem)
                self._known[name] = config
                self._configs.append((name, frame.data, frame.arrival_ns or 0))

    def _stop(self) -> None:
        if self.driver is not None:
            self.driver.send(self.clock.realtime_ns(), 0.0)
            self.driver.close()
        self.receivers.close()


def prepare(*, fifo: bool) -> None:
    """Make this process fit for a fixed rhythm, as far as it may: no collector, little timer slack, FIFO, locked."""
    gc.collect()
    gc.freeze()
    linux.timer_slack()
    if problem := linux.lock_memory():
        LOG.info("memory is not locked: %s", problem)
    if fifo and (problem := linux.fifo(FIFO_PRIORITY)):
        LOG.warning("running at the normal scheduling policy: %s", problem)
