"""From bundles to the session log: which session, what is missing, and how far it is safe. One thread's business."""

from __future__ import annotations

import logging
import shutil
import uuid
from pathlib import Path
from typing import NamedTuple

from dcon.link.assembly import Assembly, Gap, Pieces, Place
from dcon.link.bundle import Bundle, Kind
from dcon.server import state as states
from dcon.server.state import State
from dcon.session.head import Head, head_of
from dcon.session.parts import free_path
from dcon.session.rolling import RollingWriter
from pmutools.errors import SourceError
from pmutools.schema.log_writer import seal

LOG = logging.getLogger(__name__)
EARLIER = 256
"""Sessions that lack ticks and are remembered; the oldest of more are counted as one."""


class Report(NamedTuple):
    """How the log is."""

    paths: tuple[str, ...] = ()
    """Of the session's parts; the last may be under way."""
    session: int | None = None
    have: int = -1
    """Last sequence that is safe: the process may be killed."""
    tick_ns: int = 0
    """Last tick that is."""
    gaps: int = 0
    """Times that something was missing."""
    unlogged: int = 0
    """Ticks that are missing in the session."""
    lacking: tuple[tuple[int, int], ...] = ()
    """Numbers of sessions that lack ticks, and how many: of earlier ones in this folder, and this."""
    refused: bool = False
    """The system lets nothing be written at present."""
    disk_free_percent: float | None = None

    @property
    def file(self) -> str:
        """The part under way, or the last."""
        return self.paths[-1] if self.paths else ""


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
        self._old = states.load(folder)
        self._earlier = dict(self._old.earlier) if self._old is not None else {}
        self._assembly = Assembly()
        self._key = ""
        self._unlogged_before = 0
        self._writer: RollingWriter | None = None
        self._whole = Place()
        """How far all that came is in the log, or counted."""
        self._tick_ns = self._safe_ns = 0
        self._configs: dict[str, tuple[bytes, int]] = {}
        self._said = Report()

    @property
    def resumes(self) -> Place:
        """What need not be sent again."""
        return self._assembly.place if self._writer is not None or self._old is None else self._old.place

    def take(self, bundle: Bundle) -> None:
        """Record one bundle; one that was there before, or belongs to no session that is known, is left out."""
        assembly = self._assembly
        if bundle.is_numbered and bundle.tick_ns > 0 and assembly.wants(bundle):
            self._tick_ns = bundle.tick_ns
        for item in assembly.take(bundle):
            if isinstance(item, Pieces):
                self._head(item)
            elif self._writer is not None:
                self._record(item, self._writer)
        if not assembly.is_amid:
            self._whole = assembly.place

    def flush(self) -> Report:
        """Make safe what was taken, as far as the system lets us, and say how far that is."""
        writer = self._writer
        if writer is not None:
            writer.flush(self._tick_ns)
            if states.save(self.folder, self._state(writer)):
                self._said = self._said._replace(session=self._whole.session, have=self._whole.have)
                self._safe_ns = self._tick_ns
            self._said = self._said._replace(
                paths=tuple(map(str, writer.parts)),
                tick_ns=self._safe_ns,
                unlogged=self._unlogged(writer),
                lacking=self._lacking(writer),
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
        session, have, ticks = self._whole
        lost = self._unlogged(writer), writer.missing, writer.reason
        earlier = tuple(self._earlier.items())
        return State(
            session or 0, self._key, str(writer.path), have, parts, writer.size, configs, ticks, *lost, earlier
        )

    def _lacking(self, writer: RollingWriter) -> tuple[tuple[int, int], ...]:
        now = (self._whole.session or 0, self._unlogged(writer))
        return (*self._earlier.items(), now) if now[1] else tuple(self._earlier.items())

    def _unlogged(self, writer: RollingWriter) -> int:
        """Ticks that are missing in the session, those of earlier lives of this process too."""
        return self._unlogged_before + writer.unlogged_ticks

    def _head(self, pieces: Pieces) -> None:
        if self._writer is not None and pieces.session == self._assembly.place.session:
            return
        head = head_of(pieces.bundles)
        if head is None:
            return
        if self._writer is not None:
            self._writer.close()
            self._lacks(self._whole.session, self._unlogged(self._writer))
        old, self._old = self._old, None
        if old is not None and old.session != pieces.session:
            self._lacks(old.session, old.unlogged)
        if old is not None and old.session == pieces.session and self._seal(old):
            LOG.info("the session goes on in a new part after %s", old.parts[-1] if old.parts else self.path)
            self._open(head, old)
        else:
            self._open(head, self._fresh(pieces.session))
        self.flush()

    def _lacks(self, session: int | None, ticks: int) -> None:
        """A session is over that lacks so many ticks."""
        if session is None or not ticks:
            return
        self._earlier[session] = ticks
        while len(self._earlier) > EARLIER:
            oldest, next_oldest, *_ = self._earlier
            self._earlier[next_oldest] += self._earlier.pop(oldest)

    def _open(self, head: Head, state: State) -> None:
        """Write the log of a session, from its beginning or from where ``state`` says it is."""
        self._key, self._unlogged_before = state.key, state.unlogged - state.untold
        self._configs = {name: (bytes.fromhex(frame), at) for name, frame, at in state.configs}
        self._whole = state.place
        self._assembly.begin(state.place)
        max_mb, max_minutes = self._limits
        parts = list(map(Path, state.parts))
        self._writer = RollingWriter(
            *(state.path, head), max_mb=max_mb, max_minutes=max_minutes, session_id=state.key, parts=parts, patient=True
        )
        for name, (frame, at) in self._configs.items():
            self._writer.config(name, frame, at)
        if state.untold:
            self._writer.lost(state.untold, state.reason, 0)

    def _fresh(self, session: int) -> State:
        """A session of which nothing is there."""
        key = uuid.uuid4().hex
        return State(session, key, str(self._free(key)), -1)

    def _free(self, key: str) -> Path:
        try:
            return free_path(self.path)
        except SourceError as error:  # it may be there later: the writer tries again and again
            LOG.error("%s", error)
            return Path(self.path).with_stem(f"{Path(self.path).stem}-{key[:8]}")

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

    def _record(self, item: Bundle | Gap, writer: RollingWriter) -> None:
        if isinstance(item, Gap):
            self.gaps += 1
            if item.ticks:
                writer.lost(item.ticks, item.reason, self._tick_ns)
        elif item.kind is Kind.CONFIG:
            self._config(item, writer)
        elif item.kind is Kind.END:
            writer.close()
        else:
            writer.write(item.entries, item.tick_ns)

    def _config(self, bundle: Bundle, writer: RollingWriter) -> None:
        for entry in bundle.entries:
            if bundle.is_numbered or self._configs.get(entry.name, (b"",))[0] != entry.data:
                self._configs[entry.name] = (entry.data, entry.log_time_ns)
                writer.config(entry.name, entry.data, entry.log_time_ns)


def free_percent(folder: Path) -> float | None:
    """Of the disk; None where the system does not say."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return None
    return 100 * usage.free / usage.total if usage.total else None
