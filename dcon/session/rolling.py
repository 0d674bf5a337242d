"""A session log that goes on: a new part by time and size, and through a full disk.

Nothing here stops the controller. Where the system refuses to write, the part ends with its last whole chunk; ticks are
counted instead of logged, and every ten seconds a new part is tried. Its metadata and its first event say how many
ticks are missing.
"""

from __future__ import annotations

import contextlib
import logging
import os
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType

from dcon.core.values import NOTHING, Event, Order, Pdci, Record, Surroundings
from dcon.session.codec import Timing, Watchdog
from dcon.session.log import SessionWriter
from dcon.session.parts import SESSION, part_path
from pmutools.errors import SourceError
from pmutools.schema.pmu_log import Loggable
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
RETRY_NS = 10 * NS
"""Of ticks: how long to wait before trying a new part after a refusal."""
LOG_SUBJECT = "log"
"""Subject of events that the log adds to a tick: no business of the controller, nor of a replay."""


class RollingWriter:
    """Writes a session log in parts (:mod:`dcon.session.parts`); a context manager, used as a :class:`SessionWriter`.

    Only making one raises SourceError, where the first part cannot be written at all.

    Parameters
    ----------
    path
        Of the first part.
    max_mb, max_minutes
        A part that has so many bytes (in millions, compressed) or spans so much of the ticks' time is ended, between
        two ticks; infinity for no limit.
    session_id
        What the parts have in common; unless given, one that no other session has.
    ini_text, configs, metadata, pmus, instances, flags, probe_file
        As for :class:`SessionWriter`; they go into every part, with the newest configurations.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        ini_text: str,
        configs: Mapping[str, bytes],
        metadata: Mapping[str, str],
        pmus: Sequence[str],
        instances: Sequence[str],
        flags: Sequence[str] = (),
        probe_file: bytes = b"",
        max_mb: float = float("inf"),
        max_minutes: float = float("inf"),
        session_id: str | None = None,
    ) -> None:
        self.path = Path(path)
        self.parts: list[Path] = []
        """Of the session so far."""
        self.unlogged_ticks = 0
        """In the whole session."""
        self._max_bytes = max_mb * 1e6
        self._max_ns = max_minutes * 60 * NS
        self._ini_text = ini_text
        self._probe_file = probe_file
        self._configs = {name: (frame, 0) for name, frame in configs.items()}
        self._metadata = {**metadata, SESSION: session_id or uuid.uuid4().hex}
        self._names = {"pmus": tuple(pmus), "instances": tuple(instances), "flags": tuple(flags)}
        self._log: SessionWriter | None = None
        self._begun_ns = 0
        """First tick of the part."""
        self._written = self._open_ticks = 0
        """Ticks of the part; those of them that are not flushed yet."""
        self._tried_ns: int | None = None
        """When the system last refused to write; None once ticks are stored again."""
        self._reason = ""
        self._missing = 0
        """Ticks that are not logged since the last that is."""
        self._open()

    def tick(
        self,
        record: Record,
        frames: Iterable[Loggable] = (),
        orders: Iterable[Order] = (),
        *,
        timing: Timing | None = None,
        pdci: Pdci | None = None,
        surroundings: Surroundings = NOTHING,
    ) -> None:
        """Log one tick, as :meth:`SessionWriter.tick` does; or count it."""
        now_ns = record.tick_ns
        log = self._log or self._next_part(now_ns)
        if log is None:
            self._missing += 1
            self.unlogged_ticks += 1
            return
        if self._missing and not self._written:
            gap = Event("log_gap", LOG_SUBJECT, f"{self._missing} ticks were not logged: {self._reason}")
            record = record._replace(events=(*record.events, gap))
        size = log.size
        try:
            log.tick(record, frames, orders, timing=timing, pdci=pdci, surroundings=surroundings)
        except SourceError as error:
            self._refused(error, now_ns, self._open_ticks + 1)
            return
        if log.size != size:
            self._flushed()
        if not self._written:
            self._begun_ns = now_ns
        self._written += 1
        self._open_ticks += 1
        if log.size >= self._max_bytes or abs(now_ns - self._begun_ns) >= self._max_ns:
            self._end_part(log, now_ns)  # the next is begun with the next tick: one piece of work at a time

    def config(self, name: str, frame: bytes, time_ns: int) -> None:
        """Attach a configuration frame that came at ``time_ns``; parts to come begin with it."""
        self._configs[name] = (frame, time_ns)
        if self._log is not None:
            try:
                self._log.config(name, frame, time_ns)
                self._flushed()
            except SourceError as error:
                self._refused(error, time_ns, self._open_ticks)

    def watchdog(self, watchdog: Watchdog) -> None:
        """Log the watchdog's state; where nothing can be logged, it is not."""
        log = self._log or self._next_part(watchdog.time_ns)
        if log is not None:
            try:
                log.watchdog(watchdog)
            except SourceError as error:
                self._refused(error, watchdog.time_ns, self._open_ticks)

    def close(self) -> None:
        if self._log is not None:
            self._end_part(self._log, self._begun_ns)

    def __enter__(self) -> RollingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _end_part(self, log: SessionWriter, now_ns: int) -> None:
        """Close the part, index and all; where there is no room for its index, it stays whole without."""
        try:
            log.flush()
            self._flushed()
            log.close()
            self._log = None
        except SourceError as error:
            self._refused(error, now_ns, self._open_ticks)

    def _next_part(self, now_ns: int) -> SessionWriter | None:
        """The next part, where it is time to try and the system lets us."""
        if self._tried_ns is not None and abs(now_ns - self._tried_ns) < RETRY_NS:
            return None
        try:
            self._open()
        except SourceError as error:
            self._refused(error, now_ns, 0)
            return None
        return self._log

    def _open(self) -> None:
        number = len(self.parts) + 1
        head = {"part": str(number), "unlogged_ticks": str(self._missing)}
        if self.parts:
            head |= {"continues": self.parts[-1].name, "first": self.parts[0].name}
        self.parts.append(part_path(self.path, number))
        self._written = self._open_ticks = 0
        self._log = SessionWriter(
            self.parts[-1],
            ini_text=self._ini_text,
            configs={},
            metadata=self._metadata | head,
            probe_file=self._probe_file,
            **self._names,
        )
        for name, (frame, time_ns) in self._configs.items():
            self._log.config(name, frame, time_ns)

    def _flushed(self) -> None:
        """The open chunk has been written."""
        if not self._open_ticks:
            return
        if self._tried_ns is not None:
            LOG.warning("%s: logging again; %d ticks are missing", self.parts[-1], self._missing)
        self._tried_ns = None
        self._missing = self._open_ticks = 0

    def _refused(self, error: SourceError, now_ns: int, ticks: int) -> None:
        """The system takes no more: go on without, and try again later. ``ticks`` are lost with the open chunk."""
        if self._tried_ns is None:
            LOG.error("%s; control goes on, and ticks that are not logged are counted", error)
        self._reason = str(error).rpartition(": ")[2]
        self._missing += ticks
        self.unlogged_ticks += ticks
        self._tried_ns = now_ns
        self._log = None
        if self._written == self._open_ticks:  # a part that holds nothing gives its room and its number back
            with contextlib.suppress(OSError):
                self.parts.pop().unlink()
