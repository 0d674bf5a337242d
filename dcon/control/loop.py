"""The control loop in real time.

At the tick it takes the frames and news that have come, computes, drives the output, then logs. A tick consumes the
frames that had arrived by its time, and the log says which they were; so a tick that runs late decides what it would
have decided in time, and ticks that the machine slept through are made up for. Where frames, news, command and log come
from and go to is its ends' affair (:mod:`dcon.control.ports`).

The session ends at its time, when asked to, or where its ends are in trouble: the command ramps to 0 first, as after
an operator's ``disarm``. Anything else that goes wrong ends it at once, but for a log that the disk has no room for:
that is told, and control goes on. The last datagram says 0 V.
"""

from __future__ import annotations

import gc
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache

from dcon.control.orders import OrderBook, TimedOrder
from dcon.control.ports import Ends, Log, Told
from dcon.control.schedule import TickGrid
from dcon.control.summary import Summary
from dcon.control.waiting import Waiting
from dcon.core.rows import CORE
from dcon.core.system import ENGAGED, Trigger
from dcon.core.values import Order, SystemState
from dcon.engine import Engine, Tick
from dcon.link.command import RELAYS
from dcon.link.counts import total
from dcon.link.crossing import Item, PmuFrameIn
from dcon.link.failure import Failure
from dcon.session import checkpoint
from dcon.session.codec import Timing
from dcon.session.encode import tick_entries
from dcon.session.head import Head
from dcon.settings import Settings
from pmutools.c37118 import Frame, StreamConfig, decode_config
from pmutools.clock import Clock, UtcOffset, utc_offset
from pmutools.errors import SettingsError, WireError
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.realtime import go_realtime
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
SPIN_NS = 200_000
EARLY_NS = 2_000_000
"""So long before a tick, what is there already is taken: the tick itself has only to take what came since."""
CLOCK_CHECK_TICKS = 60
COUNTS_NS = NS
"""What was counted is logged so often."""
CATCH_UP_S = 1
"""Ticks missed for longer are left out: whatever they would have held up has gone wrong by then."""
TOLD = 10
"""Warnings of one kind about streams, or of configurations of one PMU; more of it go to the verbose log."""
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
WORDS = {LinkKind.NOTHING: "", LinkKind.NO_CONFIG: "no configuration for its data: "}
"""What goes before the detail, where that is not the kind itself."""
_DISARM = (Order(str(Trigger.DISARM)),)


class Platform:
    """A session, from its ends to its ends."""

    def __init__(
        self,
        settings: Settings,
        ends: Ends,
        clock: Clock,
        *,
        ticked: Callable[[Tick, int], object] = lambda tick, now_ns: None,
    ) -> None:
        """``ticked`` is called once a tick is logged, with the monotonic time."""
        self.settings = settings
        self.ends = ends
        self.clock = clock
        self.engine = Engine(settings.params, settings.sites)
        self.summary = Summary()
        self.stopping = False
        self._ticked = ticked
        self._told = Counter[LinkKind]()
        self._unusable = Counter[str]()
        self._waiting = Waiting()
        self._configs: list[tuple[str, bytes, int]] = []
        self._counted_ns = 0

    def stop(self) -> None:
        """Ask for the end of :meth:`run`, from a signal handler too."""
        self.stopping = True

    def run(
        self, *, orders: Sequence[TimedOrder] = (), start_ns: int | None = None, duration_s: float | None = None
    ) -> Summary:
        """Run until ``duration_s`` after ``start_ns`` (POSIX UTC; now unless given), or until :meth:`stop`.

        ``orders`` count from ``start_ns``. Raises SourceError where the log cannot be begun, SettingsError where a
        PMU's first configuration cannot be used and no instance is READY yet; later that is an event.
        """
        start_ns = self.clock.realtime_ns() if start_ns is None else start_ns
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        settings = self.settings
        head = Head(
            settings.text,
            tuple(site.name for site in settings.sites),
            settings.params.instance_names,
            CORE.names,
            {"start_ns": str(start_ns)},
            settings.probe_file,
        )
        prepare(fifo=settings.platform.fifo)
        log: Log | None = None
        try:
            log = self.ends.open_log(head)
            self.ends.wait(lambda: self.stopping)
            self._loop(log, OrderBook(orders, start_ns), end_ns)
        finally:
            gc.unfreeze()
            self.ends.command.send(self.clock.realtime_ns(), 0.0)
            if log is not None:
                log.close()
            self.ends.close()
        self._sum_up(log)
        return self.summary

    def _loop(self, log: Log, book: OrderBook, end_ns: int | None) -> None:
        clock, summary, engine = self.clock, self.summary, self.engine
        frames, news, command = self.ends.frames, self.ends.news, self.ends.command
        grid = TickGrid(self.settings.params.tick_hz, round(self.settings.platform.phase_ms * 1e6))
        offset = utc_offset(clock)
        index = grid.after(clock.realtime_ns())
        overrun: bool | None = None
        while True:
            tick_ns = grid.time_ns(index)
            ending = self.stopping or bool(summary.trouble) or (end_ns is not None and tick_ns > end_ns)
            if ending and engine.state.system not in ENGAGED:
                return
            deadline_ns = offset.monotonic_ns(tick_ns)
            if (early_ns := deadline_ns - EARLY_NS) > clock.monotonic_ns():
                frames.wait(early_ns)
                self._take(frames.take())
                news.listen(clock.monotonic_ns())
            frames.wait(deadline_ns)
            started_ns = clock.monotonic_ns()
            self._take(frames.take())
            for name, frame in self._waiting.configs(started_ns):
                self._configure(name, frame)
            told = news.told(started_ns)
            summary.trouble = summary.trouble or told.trouble
            orders = self._orders(book.due(tick_ns), told, ending)
            surroundings = told.surroundings
            if overrun is not None:
                surroundings = surroundings._replace(overrun=overrun)
            tick = engine.tick(self._waiting.take(tick_ns), orders, tick_ns, surroundings)
            record = tick.record
            command.send(tick_ns, record.output_v, RELAYS if record.state in ENGAGED else 0)
            done_ns = clock.monotonic_ns()
            self._write(log, tick, orders, Timing((done_ns - started_ns) / 1e3, (started_ns - deadline_ns) / 1e3))
            summary.ticks += 1
            summary.frames += len(tick.readings)
            summary.late_over_1ms += started_ns - deadline_ns > 1_000_000
            summary.caught_up_ticks += started_ns >= offset.monotonic_ns(grid.time_ns(index + 1))
            self._ticked(tick, done_ns)
            index += 1
            if self.settings.platform.judge_overruns:
                overrun = done_ns >= offset.monotonic_ns(grid.time_ns(index))
            if summary.ticks % CLOCK_CHECK_TICKS == 0:
                offset = self._follow_utc(offset)
            index = self._next(grid, index, offset)

    def _orders(self, timed: tuple[Order, ...], told: Told, ending: bool) -> tuple[Order, ...]:
        """The tick's orders; at the end only what brings the command down, and the emergency stop."""
        if not ending:
            return timed + told.orders
        stops = tuple(order for order in told.orders if order.name == Trigger.ESTOP)
        return stops + (() if self.engine.state.system is SystemState.RAMPDOWN else _DISARM)

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

    def _write(self, log: Log, tick: Tick, orders: Sequence[Order], timing: Timing) -> None:
        configs, self._configs = self._configs, []
        for name, frame, time_ns in configs:
            log.config(name, frame, time_ns)
        names, record = self.settings.params.instance_names, tick.record
        counts, is_due = None, checkpoint.is_due(self.summary.ticks, self.settings.params.tick_hz)
        if record.tick_ns - self._counted_ns >= COUNTS_NS:
            self._counted_ns, counts = record.tick_ns, self._counts()
        entries = tick_entries(
            *(names, record, tick.readings, orders),
            timing=timing,
            counts=counts,
            surroundings=tick.surroundings,
            memory=tick.memory if is_due else None,
        )
        log.write(entries, record.tick_ns)

    def _counts(self) -> dict[str, int]:
        """What was counted by now, here and by who tells this loop."""
        ends, waiting = self.ends, self._waiting
        own = {
            "crowded": waiting.crowded,
            "overtaken_configs": waiting.overtaken,
            "unread": sum(self.engine.unread.values()),
            "unsent": ends.command.failed,
        }
        return total(vars(ends.frames.counts), ends.news.counts, own)

    def _take(self, items: Sequence[Item]) -> None:
        sites = self.settings.sites
        for item in items:
            match item:
                case PmuFrameIn(pmu, frame, False):
                    self._waiting.add(sites[pmu].name, frame)
                case PmuFrameIn(pmu, frame, True):
                    self._waiting.add_config(sites[pmu].name, frame)
                case LinkEvent():
                    self._tell(item)
                case Failure():
                    raise item.error

    def _tell(self, news: LinkEvent) -> None:
        self._told[news.kind] += 1
        level = logging.WARNING if news.kind in TROUBLE and self._told[news.kind] <= TOLD else logging.INFO
        LOG.log(level, "%s: %s%s", news.label or news.where, WORDS.get(news.kind, f"{news.kind} "), news.detail)

    def _configure(self, name: str, frame: Frame) -> None:
        engine = self.engine
        try:
            config = _decoded(frame.data)
        except WireError:  # it was decoded before it was handed on
            return
        known = engine.configs.get(name)
        if known == config:
            return
        if (problem := engine.reconfigure(name, config)) is not None:
            self._unusable[name] += 1
            none = not engine.bindings and len(self._unusable) == len(engine.params.pmus)
            if none and known is None and engine.state.system is SystemState.INIT:
                raise SettingsError(problem)  # not one can be used: it is the settings that are wrong
            LOG.log(logging.WARNING if self._unusable[name] <= TOLD else logging.INFO, "%s", problem)
        self._configs.append((name, frame.data, frame.arrival_ns or 0))

    def _sum_up(self, log: Log) -> None:
        summary = self.summary
        summary.counts, summary.unread = self._counts(), dict(self.engine.unread)
        summary.final_state = str(self.engine.state.system)
        summary.session, summary.unlogged_ticks = log.session, log.unlogged_ticks
        summary.log_parts = list(map(str, log.parts))


@lru_cache(maxsize=1)
def _decoded(data: bytes) -> StreamConfig:
    """PMUs of one stream have one configuration, and it takes long."""
    return decode_config(data)[1]


def prepare(*, fifo: bool) -> None:
    """Make this process fit for a fixed rhythm, and log what could not be had."""
    missing = go_realtime(fifo=fifo)
    if missing.memory:
        LOG.info("memory is not locked: %s", missing.memory)
    if missing.fifo:
        LOG.warning("running at the normal scheduling policy: %s", missing.fifo)
