"""The server's process: bundles in, log out (in a thread of its own), operators served, checks made beside the loop."""

from __future__ import annotations

import logging
import os
import selectors
from collections import deque
from collections.abc import Callable
from typing import Any

from dcon.limiter import MW_PER_V
from dcon.link import paths
from dcon.link.beats import LoopName, LoopState
from dcon.link.bundle import Bundle
from dcon.link.keys import read_keys
from dcon.link.news import ServerWord, encode
from dcon.link.notify import ALIVE, READY, STOPPING, Notifier
from dcon.link.orders import Verifier
from dcon.link.paths import Sender
from dcon.link.pulse import Pulse
from dcon.server.desk import Desk
from dcon.server.intake import Intake
from dcon.server.newest import Newest
from dcon.server.operators import Operators
from dcon.server.recorder import Recorder, Report
from dcon.server.response import LineResponse, Response
from dcon.server.scribe import Scribe
from dcon.server.status import LineExpected, to_json
from dcon.server.watchdog_word import WatchdogWord
from dcon.session.head import Head
from dcon.settings import Settings
from pmutools.clock import Clock, SystemClock
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
NEWS_NS = NS // 2
BREATH_NS = NS // 100
SILENT_S = 2.0
"""A disk that holds the log up for longer makes the server silent to the controller: nothing is recorded."""
FRESH_NS = NS // 2
"""A controller whose newest tick is older is not connected, whatever its socket says."""
DATAGRAM_BYTES = 1 << 17


class Server:
    """Sockets are open once this is made. Raises SourceError where one cannot be had, or keys cannot be read."""

    def __init__(
        self,
        settings: Settings,
        folder: str | os.PathLike[str],
        *,
        clock: Clock | None = None,
        notifier: Notifier | None = None,
        begun: Callable[[str], object] = lambda path: None,
    ) -> None:
        """``begun`` is called with the path of a session log once there is one."""
        self.settings = settings
        self.clock = clock or SystemClock()
        self.folder = paths.prepare(folder)
        self.stopping = False
        self._notifier = notifier or Notifier({})
        self._begun = begun
        keys = read_keys(settings.server.keys) if settings.server.keys is not None else {}
        # it remembers no sequences of an earlier life: what was signed before this one is not told to the watchdog
        verifier = Verifier(keys, window_ns=round(settings.server.window_s * NS), floor_ns=self.clock.realtime_ns())
        self._line = LineExpected(
            settings.line_input.url is not None or settings.params.required.line, settings.params.line.status_age_s
        )
        self.newest = Newest(Head(""), self._line)
        self.response = LineResponse()
        self.report = Report()
        self.failures = 0
        self._selector = selectors.DefaultSelector()
        self._reports: deque[Report] = deque(maxlen=1)
        log = settings.log
        recorder = Recorder(log.path, self.folder, max_mb=log.max_mb, max_minutes=log.max_minutes)
        self._scribe = Scribe(recorder, self._reports.append)
        self._intake = Intake(self.folder, self._selector, self._scribe, recorder.resumes, self._opened, self._look)
        self._replies = paths.bind_datagram(self.folder, paths.REPLIES)
        patience_ns = round(settings.watchdog.status_timeout_ms * 1e6)
        self._word = WatchdogWord(paths.bind_datagram(self.folder, paths.STATUS), patience_ns)
        self._selector.register(self._replies, selectors.EVENT_READ, self._reply)
        self._selector.register(self._word.sock, selectors.EVENT_READ, lambda _, now_ns, __: self._word.hear(now_ns))
        self._watchdog = Sender(self.folder / paths.WATCHDOG)
        self._pulse = Pulse(LoopName.SERVER, self._watchdog)
        self._control = Sender(self.folder / paths.CONTROL)
        self.desk = Desk(self.folder, self.status, verifier)
        self.desk.reply_to = str(self.folder / paths.REPLIES)
        self.operators = Operators(settings.server.listen, self.desk, self._selector)
        self._lag_ns: int | None = None
        """Of the newest tick when it came."""
        self._looked_ns = 0
        """When that was, monotonic."""
        self._found: Response | None = None

    def run(self) -> None:
        """Serve until :attr:`stopping`; then write what has come, and end the log."""
        clock = self.clock
        news_ns = clock.monotonic_ns()
        self._notifier.tell(READY)
        try:
            while not self.stopping:
                now_ns = clock.monotonic_ns()
                for key, events in self._selector.select(min(max(self._pulse.due_ns - now_ns, 0) / 1e9, 0.05)):
                    self._safely(key.data, events)
                now_ns = clock.monotonic_ns()
                self._acknowledge()
                self.operators.answer(self.desk.due(self._word, now_ns))
                if not self._scribe.has_room:  # what waits to be read would wake us again and again
                    clock.sleep_until(now_ns + BREATH_NS)
                self._pulse.beat(now_ns)
                if now_ns >= news_ns:
                    news_ns = now_ns + NEWS_NS
                    self._tell(now_ns)
        finally:
            self.close()

    def _safely(self, ready: Callable[[int, int, int], None], events: int) -> None:
        try:
            ready(events, self.clock.monotonic_ns(), self.clock.realtime_ns())
        except Exception:  # the edge of the loop: whatever one connection brings, the others are served
            self.failures += 1
            LOG.exception("a connection brought something that the server failed on; it goes on")

    def status(self) -> dict[str, Any]:
        """For operators."""
        now_ns, monotonic_ns = self.clock.realtime_ns(), self.clock.monotonic_ns()
        self._word.hear(monotonic_ns)
        report, age_ns = self.report, self._tick_age_ns(monotonic_ns)
        connected = self._intake.is_connected and age_ns is not None and age_ns < FRESH_NS
        controller = self.newest.status(now_ns, not connected)
        word = self._word.told(monotonic_ns, now_ns)
        return {
            "time_ns": now_ns,
            "controller_connected": connected,
            "tick_age_ms": None if age_ns is None else age_ns / 1e6,
            **controller,
            "watchdog": controller["watchdog"] if word is None else word,
            "log": {
                "file": report.file,
                "parts": len(report.paths),
                "lag_s": (now_ns - report.tick_ns) / NS if report.file and report.tick_ns else None,
                "waiting_bytes": self._scribe.waiting,
                "gaps": report.gaps,
                "unlogged_ticks": report.unlogged,
                "refused": report.refused,
                "disk_free_percent": report.disk_free_percent,
                "hangs": self._hangs(),
            },
            "response": None if self._found is None else self._found._asdict(),
            "clock_ms": None if self._lag_ns is None else self._lag_ns / 1e6,
            "server": {
                "clients": len(self.operators.clients),
                "turned_away": self.operators.turned_away,
                "orders_relayed": self.desk.relayed,
                "orders_pending": len(self.desk.pending),
                "malformed": self._intake.malformed + self._word.malformed,
                "failures": self.failures,
                "undecodable": self.newest.undecodable,
            },
        }

    def close(self) -> None:
        self._notifier.tell(STOPPING)
        self._pulse.beat(self.clock.monotonic_ns(), LoopState.ENDING)
        if not self._scribe.close():
            LOG.error("the disk does not take the log; %d bytes are not written", self._scribe.waiting)
        self._acknowledge()
        self.operators.close()
        self.desk.close()
        self._intake.close()
        self._watchdog.close()
        self._control.close()
        self._selector.close()
        paths.release(self._replies)
        paths.release(self._word.sock)

    def _opened(self, head: Head, is_new: bool) -> None:
        if is_new or head != self.newest.head:
            self.newest = Newest(head, self._line)
            self._lag_ns = None
            self.response = LineResponse()

    def _look(self, tick: Bundle, utc_ns: int) -> None:
        news = self.newest.take(tick)
        self._lag_ns, self._looked_ns = utc_ns - tick.tick_ns, self.clock.monotonic_ns()
        if news.driven_v is not None:
            self.response.command(tick.tick_ns, news.driven_v * MW_PER_V)
        if news.line is not None:
            self.response.line(*news.line)
        self.operators.answer(self.desk.heard(news))

    def _tick_age_ns(self, monotonic_ns: int) -> int | None:
        """How old the newest tick is: one that was kept for a server that was away was old when it came."""
        return None if self._lag_ns is None else monotonic_ns - self._looked_ns + max(self._lag_ns, 0)

    def _reply(self, _events: int, _now_ns: int, _utc_ns: int) -> None:
        try:
            datagram = self._replies.recv(DATAGRAM_BYTES)
        except OSError:
            return
        self.operators.answer(self.desk.reply(datagram))

    def _acknowledge(self) -> None:
        if not self._reports:
            return
        before, self.report = self.report, self._reports.pop()
        report = self.report
        if report.paths[:1] != before.paths[:1] and report.file:
            self._begun(report.file)
        self._intake.acknowledge(report)

    def _hangs(self) -> bool:
        return self._scribe.hangs(SILENT_S)

    def _tell(self, now_ns: int) -> None:
        """News for the controller, none where the log hangs; and a status for who watches."""
        self._found = found = self.response.estimate()
        hangs = self._hangs()
        if not hangs:
            gain, lag_ms = (None, None) if found is None else (found.gain, found.lag_ms)
            self._control.send(encode(ServerWord(self.report.disk_free_percent, gain, lag_ms)))
        trouble = "; the log hangs" if hangs else ""  # a new process would hang too, and serve nobody meanwhile
        self._notifier.tell(ALIVE, status=f"{self.newest.ticks} ticks, {self.report.unlogged} missing{trouble}")
        self.operators.watched(to_json(self.status()) if self.operators.is_watched else b"", now_ns)
