"""The watchdog as a process: clock, sockets, files and relays around :func:`dcon.watchdog.core.step`.

A round comes each 10 ms, and at once when a datagram comes, but not within a millisecond of the last: at most 1,000
rounds a second of at most 64 datagrams, whatever floods in. Files are read and driven in the rounds that are due.
"""

from __future__ import annotations

import os
import select
import signal
import time
from contextlib import suppress
from types import FrameType
from typing import Any, Final, NamedTuple

from dcon.watchdog import codec, links
from dcon.watchdog.core import Decision, Event, estop_bits, step
from dcon.watchdog.files import Lines
from dcon.watchdog.latch import NAME, Latch, found
from dcon.watchdog.limits import TICK_MS, Rules
from dcon.watchdog.memory import MS, Item, ages_ms, begun
from dcon.watchdog.notify import ALIVE, READY, STOPPING, Notify
from dcon.watchdog.report import Report
from dcon.watchdog.rules import BIT, names_of
from dcon.watchdog.system import go_realtime

TICK_NS: Final = int(TICK_MS * MS)
ROUND_NS: Final = MS
"""Rounds are at least so far apart."""
ALIVE_NS: Final = 1000 * MS
"""So often systemd is told, where it has asked for it."""
ENDING: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Config(NamedTuple):
    """What ``python -m dcon.watchdog`` is told."""

    folder: str
    output: str = "output.in"
    status: tuple[str, ...] = ("control.in",)
    rules: Rules = Rules()
    lines: Lines = Lines()
    log: str = ""
    log_bytes: int = 10_000_000
    fifo: bool = True


class Watchdog:
    """All that a run holds. Raises :class:`~dcon.watchdog.links.Refused` for what it cannot have."""

    def __init__(self, config: Config) -> None:
        links.run_folder(config.folder)
        self._rules, self._lines = config.rules, config.lines
        self._output = links.output(config.output, config.folder)
        self._listeners = links.listeners(config.status, config.folder)
        try:
            self._report = Report(config.log, config.log_bytes)
        except OSError as error:
            raise links.Refused(f"{config.log}: {error.strerror}; name a log that can be written") from None
        self._inbox = links.bind_inbox(config.folder)  # the last that may fail: who has it is the watchdog
        self._path = os.path.join(config.folder, links.INBOX)
        latch = os.path.join(config.folder, NAME)
        latched = found(latch)
        self._latch, self._trouble = Latch(latch, latched), ""
        self._notify = Notify()
        self._notified_ns: int | None = None
        now_ns = time.monotonic_ns()
        # a receiver passes over sequences below the last: those of a new process are above those of the old
        self._memory = begun(now_ns, time.time_ns() // MS % codec.WRAP, latched, bool(latched & BIT["estop_software"]))
        self._counter = self._ticks = self._rounds = self._datagrams = 0
        self._driven = self._lines.drive(False, False, 0)
        self._latest_ms, self._latest_ns = 0.0, now_ns
        self._stopping = False

    def stop(self, *_: int | FrameType | None) -> None:
        """End after the round that runs: relays open first, then 0 V, then the end."""
        self._stopping = True

    def warn(self, text: str) -> None:
        """A line of the log."""
        self._report.line(event="warning", text=text)

    def run(self) -> None:
        """Until :meth:`stop`."""
        poller = select.poll()
        poller.register(self._inbox, select.POLLIN)
        due_ns = time.monotonic_ns()
        self._memory = self._memory._replace(now_ns=due_ns)
        self._report.line(
            event="start",
            pid=os.getpid(),
            monotonic_ns=due_ns,
            qlen=_queue_length(),
            state=self._memory.state.name,
            causes=names_of(self._memory.latched),
        )
        try:
            while not self._stopping:
                poller.poll(max(0.0, (due_ns - time.monotonic_ns()) / MS))
                rest_ns = self._memory.now_ns + ROUND_NS - time.monotonic_ns()
                if rest_ns > 0:
                    time.sleep(rest_ns / 1e9)
                tick = time.monotonic_ns() >= due_ns
                self._round(tick)
                if tick:
                    due_ns = max(due_ns + TICK_NS, self._memory.now_ns)
        finally:
            self._end()

    def _round(self, tick: bool) -> None:
        news: list[Item] = [*links.drain(self._inbox)]
        self._datagrams += len(news)
        self._rounds += 1
        if tick:
            news += (self._lines.read(), self._driven)
        now_ns = time.monotonic_ns()
        was = self._memory.state
        self._memory, decision = step(self._rules, self._memory, news, now_ns)
        if tick or decision.state is not was:
            self._ticks += tick
            self._driven = self._lines.drive(decision.relay_a, decision.relay_b, self._ticks)
        self._send(decision, now_ns)
        self._latch.hold(self._memory.latched)
        late_ms = self._memory.late_ms
        if late_ms >= self._latest_ms or now_ns - self._latest_ns > 1000 * MS:
            self._latest_ms, self._latest_ns = late_ms, now_ns
        for event in decision.events:
            self._tell(event, decision, now_ns)
        self._look_at_latch()
        self._tell_systemd(decision, now_ns)

    def _send(self, decision: Decision, now_ns: int) -> None:
        if (forward := decision.forward) is not None:
            time_ns = time.time_ns() if forward.time_ns is None else forward.time_ns
            self._output.send(codec.encode_command(forward.sequence, time_ns, forward.mw, forward.volts, forward.flags))
        if decision.tell:
            relays = decision.relay_a | decision.relay_b << 1
            told = (relays, decision.estop, decision.state, decision.healthy, decision.causes)
            status = codec.encode_status(self._counter, now_ns, *told, ages_ms(self._memory, now_ns))
            self._counter += 1
            for listener in self._listeners:
                listener.send(status)

    def _tell_systemd(self, decision: Decision, now_ns: int) -> None:
        """READY with the first round; then each second that rounds go on."""
        if self._notified_ns is not None and now_ns - self._notified_ns < ALIVE_NS:
            return
        first, self._notified_ns = self._notified_ns is None, now_ns
        status = " ".join((decision.state.name, *names_of(decision.causes)))
        self._notify.tell(*((READY,) if first else ()), ALIVE, f"STATUS={status}")

    def _look_at_latch(self) -> None:
        """Tell where it cannot be kept for a new start; the state of this process does not depend on it."""
        if (trouble := self._latch.trouble) != self._trouble:
            self._trouble = trouble
            self.warn(f"the latch cannot be kept: {trouble}" if trouble else "the latch is kept again")

    def _tell(self, event: Event, decision: Decision, now_ns: int) -> None:
        fields: dict[str, Any] = {"event": event.name, "monotonic_ns": now_ns, "state": decision.state.name}
        if event.who:
            fields["who"] = event.who
        if event.found:
            fields["causes"] = [
                {"rule": rule.name, "value": _plain(value), "limit": limit, "unit": rule.unit, "text": rule.text}
                for rule, value, limit in event.found
            ]
        self._report.line(**fields, late_ms=round(self._latest_ms, 3))

    def _end(self) -> None:
        """Relays first: what a step had decided, or an exception left undone, does not matter any more."""
        driven = self._lines.drive(False, False, 0)
        forward = codec.encode_command(self._memory.sequence, time.time_ns(), 0.0, 0.0, 0)
        self._output.send(forward)
        self._notify.tell(STOPPING)
        memory = self._memory
        estop = estop_bits(memory)
        status = codec.encode_status(self._counter, time.monotonic_ns(), 0, estop, memory.state, False, memory.latched)
        for listener in self._listeners:
            listener.send(status)
        self._latch.close()  # before anybody else may take this one's place, and look for it
        self._look_at_latch()
        self._inbox.close()
        with suppress(OSError):
            os.unlink(self._path)
        self._report.line(
            event="end",
            monotonic_ns=time.monotonic_ns(),
            state=memory.state.name,
            causes=names_of(memory.latched),
            relays_opened=driven.done,
            rounds=self._rounds,
            datagrams=self._datagrams,
            unsent=self._output.failed,
            untold=sum(listener.failed for listener in self._listeners),
            dropped=self._report.dropped,
        )
        self._report.close()


def _plain(value: float) -> float | None:
    """JSON knows no infinity: what is not known is null."""
    return round(value, 6) if abs(value) < float("inf") else None


def _queue_length() -> int | None:
    """Datagrams that the kernel keeps for the inbox, where it tells."""
    try:
        with open("/proc/sys/net/unix/max_dgram_qlen", encoding="ascii") as file:
            return int(file.read())
    except (OSError, ValueError):
        return None


def main(config: Config) -> None:
    """Run until told to end. Raises Refused."""
    watchdog = Watchdog(config)
    for number in ENDING:
        signal.signal(number, watchdog.stop)
    for shortfall in go_realtime(fifo=config.fifo):
        watchdog.warn(shortfall)
    watchdog.run()
