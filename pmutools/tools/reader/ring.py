"""A ring buffer: what came lately is kept in memory, and recorded around each trigger, before it and after it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import attrgetter
from pathlib import Path

from pmutools.clock import Clock
from pmutools.formats import suffix_of
from pmutools.timebase import NS
from pmutools.tools.reader.history import History
from pmutools.tools.reader.log import Log
from pmutools.tools.reader.reading import Round
from pmutools.tools.reader.rolling import Begin, Files
from pmutools.tools.reader.watch import Fired, Watch

HISTORY_BYTES = 512 << 20
"""What the history takes at most, by its own account; where a span has more, it is shortened, and that is told."""
BUDGET_NS = 100_000_000
"""How long the history is written at a time, so that a long one does not keep what is coming waiting."""
EVENT_NS = 600 * NS
"""A recording ends after this, though its condition still holds; only a new trigger begins another."""


@dataclass(frozen=True)
class Window:
    """What is recorded of an event: at least this, and up to a round more."""

    before_ns: int = 60 * NS
    after_ns: int = 10 * NS


WINDOW = Window()


@dataclass
class _Event:
    """A recording being written: the next round to write, and until when rounds belong to it."""

    log: Log
    cursor: int
    began_ns: int
    until_ns: int


class Ring:
    """Records rounds around triggers, each event into a recording of its own, named by the time of its first trigger.

    A trigger during an event extends it, and so does a condition that still holds, up to :data:`EVENT_NS`. ``tell`` is
    given a line for each trigger and each event; ``keep`` recordings of this run are kept.
    """

    def __init__(
        self,
        path: Path,
        begin: Begin,
        watch: Watch,
        clock: Clock,
        *,
        window: Window = Window(),  # it is frozen
        keep: int | None = None,
        tell: Callable[[str], None] = lambda line: None,
        history_bytes: int = HISTORY_BYTES,
    ) -> None:
        self._path, self._begin, self._watch, self._clock = path, begin, watch, clock
        self._window, self._keep, self._tell, self._history_bytes = window, keep, tell, history_bytes
        self._history = History()
        self._files = Files(path.parent)
        self._event: _Event | None = None
        self._asked = deque[Fired]()
        self._shortened = False
        self.events = 0
        """Recordings begun."""

    @property
    def paths(self) -> list[Path]:
        event = self._event  # which the thread that records may end meanwhile
        return self._files.paths + (event.log.paths if event is not None else [])

    @property
    def undecoded(self) -> int:
        event = self._event
        return self._files.undecoded + (event.log.undecoded if event is not None else 0)

    @property
    def idle(self) -> tuple[str, ...]:
        """Conditions that no station or channel has fitted so far."""
        return self._watch.idle

    def fire(self, kind: str) -> bool:
        """Someone asks for a recording by ``signal`` or ``key``; it begins with the next round. False: not wanted.

        May be called from another thread, or from a signal handler.
        """
        fired = self._watch.manual(kind, self._clock.realtime_ns())
        if fired is not None:
            self._asked.append(fired)
        return fired is not None

    def take(self, found: Round) -> None:
        now_ns = self._clock.monotonic_ns()
        items = list(found)
        self._history.add(items, now_ns)
        fired = self._watch.look(items, now_ns, self._clock.realtime_ns())
        while self._asked:
            fired.append(self._asked.popleft())
        for each in sorted(fired, key=attrgetter("time_ns")):
            self._trigger(each, now_ns)
        event = self._event
        if event is not None and self._watch.holding:
            event.until_ns = max(event.until_ns, min(now_ns + self._window.after_ns, event.began_ns + EVENT_NS))
        self._write(now_ns + BUDGET_NS)
        self._forget(now_ns)

    def flush(self) -> None:
        if self._event is not None:
            self._event.log.flush()

    def close(self) -> None:
        """End the event that is being recorded, with all that has come."""
        if self._event is not None:
            self._write(None)
        if self._event is not None:
            self._end(self._event)

    def _trigger(self, fired: Fired, now_ns: int) -> None:
        until_ns = now_ns + self._window.after_ns
        if self._event is not None:
            self._tell(f"trigger {fired}")
            self._event.until_ns = max(self._event.until_ns, until_ns)
            return
        if self._keep is not None:
            self._files.trim(self._keep - 1)
        path = _named(self._path, fired.time_ns)
        self._tell(f"trigger {fired} -> {path}")
        self.events += 1
        self._event = _Event(Log(self._begin(path)), self._history.first, now_ns, until_ns)

    def _write(self, deadline_ns: int | None) -> None:
        """Bring the recording up to date, as far as there is time; end it where its last round is written."""
        event = self._event
        while event is not None and event.cursor < self._history.end:
            if self._history.at_ns(event.cursor) > event.until_ns:
                self._end(event)
                return
            event.log.take(self._history.round(event.cursor))
            event.cursor += 1
            if deadline_ns is not None and self._clock.monotonic_ns() >= deadline_ns:
                return

    def _end(self, event: _Event) -> None:
        self._event = None
        event.log.close()
        self._files.add(event.log)
        self._tell(f"recorded {', '.join(map(str, event.log.paths[:4])) or 'nothing'}")

    def _forget(self, now_ns: int) -> None:
        """Drop what is too old; and what is too much, though it should be kept or is still to be written."""
        history, event = self._history, self._event
        while history.end > history.first:
            too_much = history.nbytes > self._history_bytes
            written = event is None or history.first < event.cursor
            old = history.at_ns(history.first) < now_ns - self._window.before_ns
            if not (old and written) and not too_much:
                return
            if too_much and not old and not self._shortened:
                self._shortened = True
                self._tell(
                    f"the history is full ({self._history_bytes >> 20} MiB): it reaches back "
                    f"{(now_ns - history.at_ns(history.first)) / NS:.1f} s, not {self._window.before_ns / NS:g} s"
                )
            history.drop()
            if event is not None and event.cursor < history.first:
                event.cursor = history.first
                self._tell("a part of the event is lost: it came faster than it could be written")


def _named(path: Path, time_ns: int) -> Path:
    """``OUT-20160908T170511.017Z.csv``; with ``-2`` ... before the suffix where that is there already."""
    suffix = suffix_of(path)
    moment = datetime.fromtimestamp(time_ns // NS, UTC)
    stem = f"{path.name[: len(path.name) - len(suffix)]}-{moment:%Y%m%dT%H%M%S}.{time_ns % NS // 1_000_000:03d}Z"
    fresh, count = path.with_name(stem + suffix), 1
    while fresh.exists() or fresh.with_name(fresh.name[: len(fresh.name) - len(suffix)]).exists():
        count += 1
        fresh = path.with_name(f"{stem}-{count}{suffix}")
    return fresh
