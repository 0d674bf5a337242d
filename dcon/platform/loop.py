"""The control loop in real time.

One thread: between ticks it receives and parses, at the tick it computes, drives the output, then logs. A tick consumes
the frames that had arrived by its time, and the log says which they were; so a tick that runs late decides what it
would have decided in time, and ticks that the machine slept through are made up for.

The session ends at its time or when asked to: in both the command ramps to 0 first, as after an operator's ``disarm``.
Anything else that goes wrong ends it at once, but for a log that the disk has no room for: that is told, and control
goes on. The last datagram says 0 V.
"""

from __future__ import annotations

import gc
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from dcon.core.rows import CORE
from dcon.core.system import DRIVING, Trigger
from dcon.core.values import NOTHING, Order, SystemState
from dcon.drivers.udp_command import UdpCommandDriver
from dcon.engine import Engine, Tick
from dcon.platform.orders import OrderBook, TimedOrder
from dcon.platform.schedule import TickGrid
from dcon.session.codec import Timing
from dcon.session.rolling import RollingWriter
from dcon.settings import Settings
from pmutools.c37118 import Frame, FrameType, Message, StreamConfig
from pmutools.clock import Clock, SystemClock, UtcOffset, utc_offset
from pmutools.errors import SettingsError
from pmutools.flow import Chunk
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.receiver import Receivers
from pmutools.realtime import go_realtime
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
SPIN_NS = 200_000
CLOCK_CHECK_TICKS = 60
COARSE_NS = 1_200_000
"""Selectors wait in whole milliseconds: the last stretch before a deadline is slept exactly."""
LATEST_NS = NS
CATCH_UP_S = 1
"""Ticks missed for longer are left out: whatever they would have held up has gone wrong by then."""
TOLD = 10
"""Warnings of one kind about streams; more of it go to the verbose log."""
TROUBLE = frozenset(
    (
        LinkKind.FOREIGN,
        LinkKind.NO_CONFIG,
        LinkKind.NOTHING,
        LinkKind.SILENT,
        LinkKind.LOST,
        LinkKind.FAILED,
        LinkKind.UNANSWERED,
        LinkKind.OWN_DROPS,
    )
)
ENGAGED = DRIVING | {SystemState.ARMED}
"""States that the end of a session leaves by disarming."""
_DISARM = (Order(str(Trigger.DISARM)),)


@dataclass
class Summary:
    """How a session went."""

    ticks: int = 0
    late_over_1ms: int = 0
    caught_up_ticks: int = 0
    """Ticks that ran later than the one after them should have."""
    skipped_ticks: int = 0
    """Ticks left out, after a pause of the machine or a step of UTC."""
    clock_steps: int = 0
    frames: int = 0
    unread: dict[str, int] = field(default_factory=dict)
    own_drops: int = 0
    unsent: int = 0
    """Commands that the system refused to send, or that nobody listened to."""
    unlogged_ticks: int = 0
    """Ticks that the log had no room for."""
    log_parts: list[str] = field(default_factory=list)
    """Files of the session log."""
    final_state: str = ""


class Platform:
    """A session from sockets to sockets. Sockets are open once this is made, so that nothing sent later is missed."""

    def __init__(self, settings: Settings, *, clock: Clock | None = None) -> None:
        """Raises SourceError where a port cannot be bound or a host is unknown."""
        self.settings = settings
        self.clock = clock or SystemClock(spin_ns=SPIN_NS)
        self.engine = Engine(settings.params, settings.sites)
        self.driver = UdpCommandDriver(settings.output.url) if settings.output.url is not None else None
        try:
            self.receivers = Receivers([site.endpoint for site in settings.sites], self.clock)
        except BaseException:
            if self.driver is not None:
                self.driver.close()
            raise
        self.summary = Summary()
        self.stopping = False
        self._told = Counter[LinkKind]()
        self._frames: dict[str, list[Frame]] = {}
        self._configs: list[tuple[str, bytes, int]] = []

    def stop(self) -> None:
        """Ask for the end of :meth:`run`, from a signal handler too."""
        self.stopping = True

    def run(
        self,
        log_path: str,
        *,
        orders: Sequence[TimedOrder] = (),
        start_ns: int | None = None,
        duration_s: float | None = None,
    ) -> Summary:
        """Run until ``duration_s`` after ``start_ns`` (POSIX UTC; now unless given), or until :meth:`stop`.

        ``orders`` count from ``start_ns``. Raises SourceError where the log cannot be begun, SettingsError where a
        PMU's first configuration cannot be used and no instance is READY yet; later that is an event.
        """
        start_ns = self.clock.realtime_ns() if start_ns is None else start_ns
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        settings = self.settings
        prepare(fifo=settings.platform.fifo)
        try:
            with RollingWriter(
                log_path,
                ini_text=settings.text,
                configs={},
                metadata={"start_ns": str(start_ns)},
                pmus=[site.name for site in settings.sites],
                instances=settings.params.instance_names,
                flags=CORE.names,
                probe_file=settings.probe_file,
                max_mb=settings.log.max_mb,
                max_minutes=settings.log.max_minutes,
            ) as writer:
                self._loop(writer, OrderBook(orders, start_ns), end_ns)
        finally:
            gc.unfreeze()
            self._close()
        self.summary.unread = dict(self.engine.unread)
        self.summary.final_state = str(self.engine.state.system)
        self.summary.unlogged_ticks = writer.unlogged_ticks
        self.summary.log_parts = list(map(str, writer.parts))
        return self.summary

    def _loop(self, log: RollingWriter, book: OrderBook, end_ns: int | None) -> None:
        clock, summary = self.clock, self.summary
        grid = TickGrid(self.settings.params.tick_hz, round(self.settings.platform.phase_ms * 1e6))
        offset = utc_offset(clock)
        index = grid.after(clock.realtime_ns())
        told = NOTHING
        while True:
            tick_ns = grid.time_ns(index)
            ending = self.stopping or (end_ns is not None and tick_ns > end_ns)
            if ending and self.engine.state.system not in ENGAGED:
                return
            deadline_ns = offset.monotonic_ns(tick_ns)
            self._receive_until(deadline_ns)
            started_ns = clock.monotonic_ns()
            orders = book.due(tick_ns)
            if ending:
                orders = () if self.engine.state.system is SystemState.RAMPDOWN else _DISARM
            tick = self.engine.tick(self._arrived(tick_ns), orders, tick_ns, told)
            if self.driver is not None:
                self.driver.send(tick_ns, tick.record.output_v)
            done_ns = clock.monotonic_ns()
            timing = Timing((done_ns - started_ns) / 1e3, (started_ns - deadline_ns) / 1e3)
            self._write(log, tick, orders, timing)
            summary.ticks += 1
            summary.frames += len(tick.readings)
            summary.late_over_1ms += started_ns - deadline_ns > 1_000_000
            summary.caught_up_ticks += started_ns >= offset.monotonic_ns(grid.time_ns(index + 1))
            index += 1
            if self.settings.platform.judge_overruns:
                told = NOTHING._replace(overrun=done_ns >= offset.monotonic_ns(grid.time_ns(index)))
            if summary.ticks % CLOCK_CHECK_TICKS == 0:
                offset = self._follow_utc(offset)
            index = self._next(grid, index, offset)

    def _follow_utc(self, offset: UtcOffset) -> UtcOffset:
        """The present offset: UTC may have been stepped."""
        later = utc_offset(self.clock, 3)
        if moved_ns := offset.step_ns(later):
            self.summary.clock_steps += 1
            LOG.warning("UTC was stepped by %.6f s", moved_ns / 1e9)
        return later

    def _next(self, grid: TickGrid, index: int, offset: UtcOffset) -> int:
        """The tick to run: ``index``, unless the time is far from it."""
        now = grid.after(offset.realtime_ns(self.clock.monotonic_ns()))
        if index - 1 <= now <= index + CATCH_UP_S * grid.rate_hz:
            return index
        self.summary.skipped_ticks += max(now - index, 0)
        return now

    def _arrived(self, tick_ns: int) -> dict[str, list[Frame]]:
        """The frames for a tick, by PMU; those that came after it wait, unless their stamp is a clock's mistake."""
        frames, self._frames = self._frames, {}
        arrived: dict[str, list[Frame]] = {}
        for name, waiting in frames.items():
            for frame in waiting:
                later = tick_ns < (frame.arrival_ns or 0) <= tick_ns + LATEST_NS
                (self._frames if later else arrived).setdefault(name, []).append(frame)
        return arrived

    def _write(self, log: RollingWriter, tick: Tick, orders: Sequence[Order], timing: Timing) -> None:
        configs, self._configs = self._configs, []
        for name, frame, time_ns in configs:
            log.config(name, frame, time_ns)
        log.tick(tick.record, tick.readings, orders, timing=timing, surroundings=tick.surroundings)

    def _receive_until(self, deadline_ns: int) -> None:
        """Receive and parse until shortly before ``deadline_ns``, then wait for it exactly and take what has come."""
        while (left_ns := deadline_ns - self.clock.monotonic_ns()) > 2 * COARSE_NS:
            self._take(self.receivers.poll(left_ns - COARSE_NS))
        self.clock.sleep_until(deadline_ns)
        self._take(self.receivers.poll(0))

    def _take(self, items: list[Chunk | LinkEvent]) -> None:
        for item in items:
            if not isinstance(item, Chunk):
                self._tell(item)
            for found in self.receivers.parse(item):
                if isinstance(found, Message):
                    self._route(found)

    def _tell(self, news: LinkEvent) -> None:
        self.summary.own_drops += news.datagrams
        self._told[news.kind] += 1
        level = logging.WARNING if news.kind in TROUBLE and self._told[news.kind] <= TOLD else logging.INFO
        LOG.log(level, "%s: %s %s", news.where, news.kind, news.detail)

    def _route(self, message: Message) -> None:
        frame, flow, config = message
        for owner in self.receivers.owners(flow, frame.idcode):
            name = self.settings.sites[owner].name
            if frame.type is FrameType.DATA:
                self._frames.setdefault(name, []).append(frame)
            elif config is not None and frame.type.rules_data:
                self._configure(name, config, frame)

    def _configure(self, name: str, config: StreamConfig, frame: Frame) -> None:
        engine = self.engine
        known = engine.configs.get(name)
        if known == config:
            return
        if (problem := engine.reconfigure(name, config)) is not None:
            if known is None and engine.state.system is SystemState.INIT:
                raise SettingsError(problem)
            LOG.warning("%s", problem)
        self._configs.append((name, frame.data, frame.arrival_ns or 0))

    def _close(self) -> None:
        if self.driver is not None:
            self.driver.send(self.clock.realtime_ns(), 0.0)
            self.summary.unsent = self.driver.failed
            self.driver.close()
        self.receivers.close()


def prepare(*, fifo: bool) -> None:
    """Make this process fit for a fixed rhythm, and log what could not be had."""
    missing = go_realtime(fifo=fifo)
    if missing.memory:
        LOG.info("memory is not locked: %s", missing.memory)
    if missing.fifo:
        LOG.warning("running at the normal scheduling policy: %s", missing.fifo)
