"""The server's process: bundles in, log out (in a thread of its own), operators served, checks made beside the loop."""

from __future__ import annotations

import json
import logging
import os
import selectors
import socket
from collections import deque
from collections.abc import Callable
from typing import Any

from dcon.limiter import MW_PER_V
from dcon.link import paths
from dcon.link.assembly import Assembly, Pieces, Place
from dcon.link.beats import LoopName, LoopState, encode_beat
from dcon.link.bundle import LARGEST, Bundle, Kind, decode
from dcon.link.keys import read_keys
from dcon.link.notify import ALIVE, READY, STOPPING, Notifier
from dcon.link.orders import Verifier
from dcon.link.paths import Sender
from dcon.server.around import LineSource
from dcon.server.desk import Desk
from dcon.server.newest import Newest, to_json
from dcon.server.operators import Operators
from dcon.server.recorder import Recorder, Report
from dcon.server.response import LineResponse, Response
from dcon.server.scribe import Scribe
from dcon.server.told import WatchdogWord
from dcon.session.head import Head, head_of
from dcon.settings import Settings
from pmutools.clock import Clock, SystemClock
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
BEAT_NS = NS // 10
NEWS_NS = NS // 2
BREATH_NS = NS // 100
SILENT_S = 2.0
"""A disk that holds the log up for longer makes the server silent to the controller: nothing is recorded."""
FRESH_NS = NS // 2
"""A controller whose newest tick is older is not connected, whatever its socket says."""
CONNECTIONS = 8
"""Of controllers, at once: one is enough, but a new one may come before an old one is known to be gone."""
BUNDLES_A_ROUND = 64
"""Read from one connection before others have their turn."""
READ_BYTES = LARGEST + 1


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
        self._line = LineSource(
            settings.line_input.url is not None or settings.params.required.line, settings.params.line.status_age_s
        )
        self.newest = Newest(Head(""), self._line)
        self.response = LineResponse()
        self.report = Report()
        self.failures = 0
        self.malformed = 0
        """Messages on the controller's socket that are no bundles, and heads that say nothing."""
        self._selector = selectors.DefaultSelector()
        self._listener = paths.listen(self.folder, paths.SERVER)
        self._replies = paths.bind_datagram(self.folder, paths.REPLIES)
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        patience_ns = round(settings.watchdog.status_timeout_ms * 1e6)
        self._word = WatchdogWord(paths.bind_datagram(self.folder, paths.STATUS), patience_ns)
        self._selector.register(self._replies, selectors.EVENT_READ, self._reply)
        self._selector.register(self._word.sock, selectors.EVENT_READ, lambda _, now_ns, __: self._word.hear(now_ns))
        self._watchdog = Sender(self.folder / paths.WATCHDOG)
        self._control = Sender(self.folder / paths.CONTROL)
        self.desk = Desk(self.folder, self.status, verifier)
        self.desk.reply_to = str(self.folder / paths.REPLIES)
        self.operators = Operators(settings.server.listen, self.desk, self._selector)
        self._connections: list[socket.socket] = []
        self._source: socket.socket | None = None
        """The connection whose session is being recorded."""
        self._lag_ns: int | None = None
        """Of the newest tick when it came."""
        self._looked_ns = 0
        """When that was, monotonic."""
        self._found: Response | None = None
        self._beats = 0
        self._reports: deque[Report] = deque(maxlen=1)
        self._acked: tuple[int | None, int] = (None, -1)
        log = settings.log
        recorder = Recorder(log.path, self.folder, max_mb=log.max_mb, max_minutes=log.max_minutes)
        self._assembly = Assembly(recorder.resumes)
        self._scribe = Scribe(recorder, self._reports.append)

    def run(self) -> None:
        """Serve until :attr:`stopping`; then write what has come, and end the log."""
        clock = self.clock
        beat_ns = news_ns = clock.monotonic_ns()
        self._notifier.tell(READY)
        try:
            while not self.stopping:
                now_ns = clock.monotonic_ns()
                for key, events in self._selector.select(min(max(beat_ns - now_ns, 0) / 1e9, 0.05)):
                    self._safely(key.data, events)
                now_ns = clock.monotonic_ns()
                self._acknowledge()
                self.operators.answer(self.desk.pending.expired(now_ns))
                if not self._scribe.has_room:  # what waits to be read would wake us again and again
                    clock.sleep_until(now_ns + BREATH_NS)
                if now_ns >= beat_ns:
                    beat_ns = now_ns + BEAT_NS
                    self._beat(LoopState.RUNNING)
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
        connected = self._source is not None and age_ns is not None and age_ns < FRESH_NS
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
                "malformed": self.malformed + self._assembly.malformed + self._word.malformed,
                "failures": self.failures,
                "undecodable": self.newest.undecodable,
            },
        }

    def close(self) -> None:
        self._notifier.tell(STOPPING)
        self._beat(LoopState.ENDING)
        if not self._scribe.close():
            LOG.error("the disk does not take the log; %d bytes are not written", self._scribe.waiting)
        self._acknowledge()
        self.operators.close()
        self.desk.close()
        for sock in self._connections:
            sock.close()
        self._watchdog.close()
        self._control.close()
        self._selector.close()
        paths.release(self._listener)
        paths.release(self._replies)
        paths.release(self._word.sock)

    def _accept(self, _events: int, _now_ns: int, _utc_ns: int) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        sock.setblocking(False)
        if len(self._connections) >= CONNECTIONS:
            self._end(next(each for each in self._connections if each is not self._source))
        self._connections.append(sock)

        def ready(_events: int, _now_ns: int, utc_ns: int) -> None:
            self._receive(sock, utc_ns)

        self._selector.register(sock, selectors.EVENT_READ, ready)
        place = self._assembly.place
        self._say(sock, {"session": place.session, "have": place.have})

    def _end(self, sock: socket.socket) -> None:
        if sock in self._connections:
            self._connections.remove(sock)
            self._selector.unregister(sock)
            sock.close()
        if sock is self._source:
            self._source = None

    def _say(self, sock: socket.socket, said: dict[str, Any]) -> None:
        try:
            sock.send(json.dumps(said).encode())
        except BlockingIOError:  # it does not read: the next word says it all again
            pass
        except OSError:
            self._end(sock)

    def _receive(self, sock: socket.socket, utc_ns: int) -> None:
        for _ in range(BUNDLES_A_ROUND):
            if not self._scribe.has_room or sock not in self._connections:
                return
            try:
                data = sock.recv(READ_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._end(sock)
                return
            bundle = decode(data)
            if bundle is None:
                self.malformed += 1
                self._end(sock)
                return
            self._take(sock, bundle, len(data), utc_ns)

    def _take(self, sock: socket.socket, bundle: Bundle, size: int, utc_ns: int) -> None:
        if not self._assembly.wants(bundle):
            return
        self._scribe.put(bundle, size)
        for item in self._assembly.take(bundle):
            if isinstance(item, Pieces):
                self._open(sock, item)
            elif isinstance(item, Bundle) and item.kind is Kind.TICK:
                self._look(item, utc_ns)

    def _open(self, sock: socket.socket, pieces: Pieces) -> None:
        """What the session is: of a session that is known too, for a server that was started again."""
        head = head_of(pieces.bundles)
        if head is None:
            self.malformed += 1
            return
        self._source = sock
        is_new = pieces.session != self._assembly.place.session
        if is_new:
            self._assembly.begin(Place(pieces.session))
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
            datagram = self._replies.recv(READ_BYTES)
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
        safe = (report.session, report.have)
        if safe != self._acked and report.session == self._assembly.place.session and self._source is not None:
            self._acked = safe
            self._say(self._source, {"ack": report.have})

    def _hangs(self) -> bool:
        return self._scribe.hangs(SILENT_S)

    def _beat(self, state: LoopState) -> None:
        self._beats += 1
        self._watchdog.send(encode_beat(LoopName.SERVER, self._beats, self.clock.monotonic_ns(), state))

    def _tell(self, now_ns: int) -> None:
        """News for the controller, none where the log hangs; and a status for who watches."""
        self._found = found = self.response.estimate()
        hangs = self._hangs()
        if not hangs:
            news = {
                "kind": "server",
                "disk_free_percent": self.report.disk_free_percent,
                "response_gain": None if found is None else found.gain,
                "response_lag_ms": None if found is None else found.lag_ms,
            }
            self._control.send(json.dumps(news).encode())
        trouble = "; the log hangs" if hangs else ""  # a new process would hang too, and serve nobody meanwhile
        self._notifier.tell(ALIVE, status=f"{self.newest.ticks} ticks, {self.report.unlogged} missing{trouble}")
        self.operators.watched(to_json(self.status()) if self.operators.is_watched else b"", now_ns)
