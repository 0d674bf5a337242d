"""From bundles to the session log: which session, what is missing, and how far it is safe. One thread's business."""

from __future__ import annotations

import logging
import shutil
import uuid
from pathlib import Path
from typing import NamedTuple

from dcon.link.bundle import Bundle, Entry, Kind
from dcon.server import state as states
from dcon.server.state import State
from dcon.session.head import head_of
from dcon.session.parts import free_path
from dcon.session.rolling import RollingWriter
from pmutools.errors import SourceError
from pmutools.schema.log_writer import seal
from pmutools.schema.messages import MESSAGES

LOG = logging.getLogger(__name__)
AWAY = "the server was away for longer than is kept, or they came too fast"
UNREADABLE = "what came from the controller could not be read"
MOST_PIECES = 512
"""Of a head: more than any initialisation file and probing signal have."""


class Report(NamedTuple):
    """How the log is."""

    file: str = ""
    """Of the part under way, or the last."""
    parts: int = 0
    session: int | None = None
    have: int = -1
    """Last sequence that is safe: the process may be killed."""
    tick_ns: int = 0
    """Last tick that is."""
    gaps: int = 0
    """Times that something was missing."""
    unlogged: int = 0
    """Ticks that are missing in the session."""
    refused: bool = False
    """The system lets nothing be written at present."""
    disk_free_percent: float | None = None


class Recorder:
    """Writes what comes, in the order in which it comes. It raises nothing: what cannot be written is counted."""

    def __init__(
        self, path: str, folder: Path, *, max_mb: float = float("inf"), max_minutes: float = float("inf")
    ) -> None:
        """``path`` of the log, ``folder`` for what must be known when the process is started again."""
        self.path = path
        self.folder = folder
        self._limits = max_mb, max_minutes
        self.gaps = 0
        self.malformed = 0
        """Bundles that made no sense."""
        self._old = states.load(folder)
        self._session: int | None = None
        self._key = ""
        self._writer: RollingWriter | None = None
        self._received = self._whole = -1
        """Last sequence that came; last that ended what it was of."""
        self._tick_ns = self._safe_ns = 0
        self._pieces: list[Bundle] = []
        self._more: list[Entry] = []
        self._configs: dict[str, tuple[bytes, int]] = {}
        self._said = Report()

    @property
    def resumes(self) -> tuple[int | None, int]:
        """Session, and last sequence of it, that need not be sent again."""
        if self._session is not None:
            return self._session, self._received
        return (None, -1) if self._old is None else (self._old.session, self._old.have)

    def take(self, bundle: Bundle) -> None:
        """Record one bundle; one that was there before, or belongs to no session that is known, is left out."""
        if bundle.kind is Kind.HEAD:
            self._head(bundle)
        elif bundle.session == self._session and self._writer is not None:
            if bundle.is_numbered:
                self._numbered(bundle, self._writer)
            elif bundle.kind is Kind.CONFIG:
                self._config(bundle, self._writer, news=False)

    def flush(self) -> Report:
        """Make safe what was taken, as far as the system lets us, and say how far that is."""
        writer = self._writer
        if writer is not None and self._session is not None:
            writer.flush(self._tick_ns)
            if states.save(self.folder, self._state(writer)):
                self._said = self._said._replace(session=self._session, have=self._whole)
                self._safe_ns = self._tick_ns
            self._said = self._said._replace(
                file=str(writer.parts[-1]) if writer.parts else "",
                parts=len(writer.parts),
                tick_ns=self._safe_ns,
                unlogged=writer.unlogged_ticks,
                refused=writer.is_refused,
            )
        self._said = self._said._replace(gaps=self.gaps, disk_free_percent=free_percent(Path(self.path).parent))
        return self._said

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self.flush()

    def _state(self, writer: RollingWriter) -> State:
        configs = tuple((name, frame.hex(), at) for name, (frame, at) in self._configs.items())
        parts = tuple(map(str, writer.parts))
        return State(self._session or 0, self._key, str(writer.path), self._whole, parts, writer.size, configs)

    def _head(self, piece: Bundle) -> None:
        if piece.session == self._session or len(piece.entries) != 1:
            return
        at = piece.entries[0].log_time_ns
        if at == 0 or (self._pieces and self._pieces[0].session != piece.session):
            self._pieces = []
        if at != len(self._pieces) or at >= MOST_PIECES:
            self.malformed += 1
            return
        self._pieces.append(piece)
        head = head_of(self._pieces)
        if head is None:
            return
        self._pieces, self._more = [], []
        if self._writer is not None:
            self._writer.close()
        self._session = piece.session
        old, self._old = self._old, None
        parts: list[Path] = []
        if old is not None and old.session == piece.session and self._seal(old):
            LOG.info("the session goes on in a new part after %s", old.parts[-1] if old.parts else self.path)
            parts = list(map(Path, old.parts))
            self._key, self._received = old.key, old.have
            self._configs = {name: (bytes.fromhex(frame), at) for name, frame, at in old.configs}
            path = Path(old.path)
        else:
            self._key, self._received, self._configs = uuid.uuid4().hex, -1, {}
            path = self._free()
        self._whole = self._received
        max_mb, max_minutes = self._limits
        self._writer = RollingWriter(
            *(path, head), max_mb=max_mb, max_minutes=max_minutes, session_id=self._key, parts=parts, patient=True
        )
        for name, (frame, at) in self._configs.items():
            self._writer.config(name, frame, at)
        self.flush()

    def _free(self) -> Path:
        try:
            return free_path(self.path)
        except SourceError as error:  # it may be there later: the writer tries again and again
            LOG.error("%s", error)
            return Path(self.path).with_stem(f"{Path(self.path).stem}-{self._key[:8]}")

    @staticmethod
    def _seal(old: State) -> bool:
        """End the part that was under way where the state says; false where it is not there any more."""
        if old.size is None or not old.parts:
            return True
        try:
            seal(old.parts[-1], old.size)
        except (OSError, ValueError) as error:
            LOG.error("%s cannot be continued: %s; a new log is begun", old.parts[-1], error)
            return False
        return True

    def _numbered(self, bundle: Bundle, writer: RollingWriter) -> None:
        if bundle.sequence <= self._received:
            return
        missing = bundle.sequence - self._received - 1
        self._received = bundle.sequence
        self._tick_ns = bundle.tick_ns or self._tick_ns
        if missing:
            self._lost(writer, missing, AWAY)
        if bundle.kind is Kind.CONFIG:
            self._config(bundle, writer, news=True)
        elif bundle.kind is Kind.END:
            writer.close()
        elif bundle.tick_ns <= 0 or not all(map(_is_known, bundle.entries)):
            self.malformed += 1
            self._lost(writer, 1, UNREADABLE)
        elif bundle.kind is Kind.MORE:
            self._more += bundle.entries
        else:
            writer.write([*self._more, *bundle.entries], bundle.tick_ns)
            self._more = []
        if not self._more:
            self._whole = bundle.sequence

    def _config(self, bundle: Bundle, writer: RollingWriter, *, news: bool) -> None:
        for entry in bundle.entries:
            if news or self._configs.get(entry.name, (b"",))[0] != entry.data:
                self._configs[entry.name] = (entry.data, entry.log_time_ns)
                writer.config(entry.name, entry.data, entry.log_time_ns)

    def _lost(self, writer: RollingWriter, ticks: int, reason: str) -> None:
        self.gaps += 1
        self._more = []
        writer.lost(ticks, reason, self._tick_ns)


def _is_known(entry: Entry) -> bool:
    if entry.message == "PmuFrame":
        return bool(entry.name)
    return entry.message in MESSAGES and not entry.name


def free_percent(folder: Path) -> float | None:
    """Of the disk; None where the system does not say."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return None
    return 100 * usage.free / usage.total if usage.total else None
