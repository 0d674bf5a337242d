"""A session log that goes on: a new part by time and size, and through a full disk.

Nothing here stops the controller. Where the system refuses to write, the part ends with its last whole chunk; ticks are
counted instead of logged, and every ten seconds a new part is tried. Its metadata and its first event say how many
ticks are missing.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from dcon.core.values import Event
from dcon.link.bundle import Entry
from dcon.session import codec
from dcon.session.checkpoint import EVERY_S
from dcon.session.head import Head
from dcon.session.parts import SESSION, part_path
from dcon.session.writer import SessionWriter
from pmutools.errors import SourceError
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
RETRY_NS = 10 * NS
"""Of ticks: how long to wait before trying a new part after a refusal."""
PATIENCE_NS = 2 * EVERY_S * NS
"""Of ticks: how long a part that is to end waits for the next checkpoint, where it has had one."""
LOG_SUBJECT = "log"
"""Subject of events that the log adds to a tick: no business of the controller, nor of a replay."""


class RollingWriter:
    """Writes a session log in parts (:mod:`dcon.session.parts`); a context manager, used as a :class:`SessionWriter`.

    Only making one raises SourceError, where the first part cannot be written at all, and not with ``patient``.

    Parameters
    ----------
    path
        Of the first part.
    head
        As for :class:`SessionWriter`; it goes into every part, with the newest configurations.
    max_mb, max_minutes
        A part that has so many bytes (in millions, compressed) or spans so much of the ticks' time is ended, before
        the next tick that is logged with a checkpoint: the next part can be replayed alone. Infinity for no limit.
    session_id
        What the parts have in common; unless given, one that no other session has.
    parts
        Those of the session that there are already.
    patient
        The first part is begun by the first tick, and tried again where it cannot be written, as any other.
    """

    session = 0
    """No server has it in its charge."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        head: Head,
        *,
        max_mb: float = float("inf"),
        max_minutes: float = float("inf"),
        session_id: str | None = None,
        parts: Sequence[Path] = (),
        patient: bool = False,
    ) -> None:
        self.path = Path(path)
        self.parts = list(parts)
        """Of the session so far."""
        self.unlogged_ticks = 0
        """In the whole session."""
        self._max_bytes = max_mb * 1e6
        self._max_ns = max_minutes * 60 * NS
        self._head = replace(head, metadata={**head.metadata, SESSION: session_id or uuid.uuid4().hex})
        self._configs: dict[str, tuple[bytes, int]] = {}
        self._log: SessionWriter | None = None
        self._begun_ns = 0
        """First tick of the part."""
        self._checkpoint_ns: int | None = None
        """Last tick with one, of the part."""
        self._is_full = False
        """The part ends as soon as the next may begin."""
        self._is_made = False
        """The part was not there before: it is ours to take away."""
        self._written = self._open_ticks = 0
        """Ticks of the part; those of them that are not flushed yet."""
        self._tried_ns: int | None = None
        """When the system last refused to write; None once ticks are stored again."""
        self.reason = ""
        """Why ticks were not logged last."""
        self.missing = 0
        """Ticks that are not logged since the last that is: the log does not say so yet."""
        if not patient:
            self._open()

    def write(self, entries: Sequence[Entry], tick_ns: int) -> None:
        """Log the entries of the tick at ``tick_ns``, or count it."""
        is_checkpoint = any(entry.message == "Checkpoint" for entry in entries)
        if self._log is not None and self._is_full and (is_checkpoint or self._has_waited(tick_ns)):
            self._end_part(self._log, tick_ns)
        log = self._log or self._next_part(tick_ns)
        if log is None:
            self._count(1)
            return
        if self.missing and not self._written:
            gap = Event("log_gap", LOG_SUBJECT, f"{self.missing} ticks were not logged: {self.reason}")
            entries = (*entries, Entry("Event", "", codec.encode_event(tick_ns, gap), tick_ns, tick_ns))
        size = log.size
        try:
            log.write(entries, tick_ns)
        except SourceError as error:
            self._refused(error, tick_ns, self._open_ticks + 1)
            return
        if log.size != size:
            self._flushed()
        if not self._written:
            self._begun_ns = tick_ns
        if is_checkpoint:
            self._checkpoint_ns = tick_ns
        self._written += 1
        self._open_ticks += 1
        self._is_full = log.size >= self._max_bytes or abs(tick_ns - self._begun_ns) >= self._max_ns
        if self._is_full and self._checkpoint_ns is None:
            self._end_part(log, tick_ns)  # there is none to wait for

    def config(self, name: str, frame: bytes, time_ns: int) -> None:
        """Attach a configuration frame that came at ``time_ns``; parts to come begin with it."""
        self._configs[name] = (frame, time_ns)
        if self._log is not None:
            try:
                self._log.config(name, frame, time_ns)
                self._flushed()
            except SourceError as error:
                self._refused(error, time_ns, self._open_ticks)

    def lost(self, ticks: int, reason: str, now_ns: int) -> None:
        """``ticks`` will not come: what is logged next begins a part that says so."""
        if self._log is not None:
            self._end_part(self._log, now_ns)
        self.reason = reason
        self._count(ticks)

    def flush(self, now_ns: int) -> None:
        """A process killed after this loses nothing that was logged before it."""
        if self._log is not None:
            try:
                self._log.flush()
                self._flushed()
            except SourceError as error:
                self._refused(error, now_ns, self._open_ticks)

    @property
    def size(self) -> int | None:
        """Bytes of the part under way that are written; None where there is none."""
        return None if self._log is None else self._log.size

    @property
    def is_refused(self) -> bool:
        """The system lets us write nothing at present."""
        return self._tried_ns is not None

    def close(self) -> None:
        if self._log is not None:
            self._end_part(self._log, self._begun_ns)

    def __enter__(self) -> RollingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _has_waited(self, tick_ns: int) -> bool:
        """No checkpoint has come for a part to end with."""
        return self._checkpoint_ns is None or abs(tick_ns - self._checkpoint_ns) >= PATIENCE_NS

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
        head = {"part": str(number), "unlogged_ticks": str(self.missing)}
        if self.parts:
            head |= {"continues": self.parts[-1].name, "first": self.parts[0].name}
        self.parts.append(part_path(self.path, number))
        self._is_made = not os.path.lexists(self.parts[-1])
        self._written = self._open_ticks = 0
        self._checkpoint_ns, self._is_full = None, False
        metadata = {**self._head.metadata, **head}
        self._log = SessionWriter(self.parts[-1], replace(self._head, metadata=metadata))
        for name, (frame, time_ns) in self._configs.items():
            self._log.config(name, frame, time_ns)

    def _flushed(self) -> None:
        """The open chunk has been written."""
        if not self._open_ticks:
            return
        if self._tried_ns is not None:
            LOG.warning("%s: logging again; %d ticks are missing", self.parts[-1], self.missing)
        self._tried_ns = None
        self.missing = self._open_ticks = 0

    def _refused(self, error: SourceError, now_ns: int, ticks: int) -> None:
        """The system takes no more: go on without, and try again later. ``ticks`` are lost with the open chunk."""
        if self._tried_ns is None:
            LOG.error("%s; control goes on, and ticks that are not logged are counted", error)
        self.reason = str(error).rpartition(": ")[2]
        self._count(ticks)
        self._tried_ns = now_ns
        self._log = None
        if self._written == self._open_ticks:  # a part that holds nothing gives its room and its number back
            path = self.parts.pop()
            with contextlib.suppress(OSError):
                if self._is_made and stat.S_ISREG(path.lstat().st_mode):
                    path.unlink()

    def _count(self, ticks: int) -> None:
        self.missing += ticks
        self.unlogged_ticks += ticks
