"""What is to be recorded, as one value; and the recorder that does it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import W_OK, access
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.errors import PmuError, SettingsError, SourceError
from pmutools.flow import Flow
from pmutools.formats import JOURNAL, Sink, open_sink
from pmutools.formats.columns import Phasors
from pmutools.formats.fields import Fields
from pmutools.formats.naming import Namer, safe, stream_name
from pmutools.net.sockets import allow_all_files
from pmutools.tools.live import LiveSource
from pmutools.tools.reader.conditions import Condition
from pmutools.tools.reader.log import Log, Recorder
from pmutools.tools.reader.ring import WINDOW, Ring, Window
from pmutools.tools.reader.rolling import Rolling
from pmutools.tools.reader.split import Split
from pmutools.tools.reader.watch import Watch


@dataclass(frozen=True)
class Recording:
    """How streams are recorded: the options of ``pmu read``."""

    out: str
    """A path whose suffix tells the format; ``-`` is standard output."""
    form: str | None = None
    """The format of standard output; None: CSV."""
    phasors: Phasors = "polar"
    long: bool = False
    fields: Fields | None = None
    per_stream: bool = False
    split: Split | None = None
    keep: int | None = None
    triggers: tuple[Condition, ...] = ()
    window: Window = WINDOW

    @property
    def to_stdout(self) -> bool:
        return self.out == "-"


@contextmanager
def open_recorder(recording: Recording, source: LiveSource, tell: Callable[[str], None]) -> Iterator[Recorder]:
    """The recorder of ``recording``, closed when left; ``tell`` is given lines about triggers.

    Raises
    ------
    SettingsError
        Options that do not go together, or not with the format.
    SourceError
        The place cannot be written: told before anything is received, with a ring too.
    """
    recorder = _recorder(recording, source, tell)
    try:
        yield recorder
    finally:
        recorder.close()


def _recorder(recording: Recording, source: LiveSource, tell: Callable[[str], None]) -> Recorder:
    def begin(path: Path) -> Sink:
        return open_sink(
            path,
            form=recording.form,
            phasors=recording.phasors,
            long=recording.long,
            fields=recording.fields,
            per_stream=recording.per_stream,
            name=names_of(source),
            journal=True,
        )

    path, keep = Path(recording.out), recording.keep
    if recording.to_stdout and (recording.split is not None or recording.triggers):
        raise SettingsError("several files cannot go to standard output; name a file")
    if recording.split is not None and recording.triggers:
        raise SettingsError("--split cuts one recording, --trigger makes one an event: choose one")
    if keep is not None and recording.split is None and not recording.triggers:
        raise SettingsError("--keep counts files of --split or --trigger; add one of them")
    allow_all_files()
    if not recording.to_stdout and (left := keep_journal(path)) is not None:
        tell(f"{path} was not finished by the run before: its frames are kept in {left}; pmu convert makes them a file")
    if recording.triggers:
        _try(path, begin)
        watch = Watch(recording.triggers)
        return Ring(path, begin, watch, source.clock, window=recording.window, keep=keep, tell=tell)
    if recording.split is not None:
        return Rolling(path, begin, recording.split, source.clock.realtime_ns, keep=keep)
    return Log(begin(path))


def names_of(source: LiveSource) -> Namer:
    """Names of files: those of the sites that are in a stream, else station and IDCODE."""

    def name(flow: Flow, config: StreamConfig) -> str:
        return safe(source.name(flow, config)) if source.sites_of(flow, config.idcode) else stream_name(flow, config)

    return name


def keep_journal(path: Path) -> Path | None:
    """Give the journal that a killed run has left another name, before a new one takes its place; None without one.

    Raises SourceError where the system refuses.
    """
    journal = path.with_name(path.name + JOURNAL)
    if not journal.is_file():
        return None
    number = 1
    while (kept := path.with_name(f"{path.stem}.left-{number}{path.suffix}{JOURNAL}")).exists():
        number += 1
    try:
        journal.rename(kept)
    except OSError as error:
        raise SourceError(f"{journal} holds frames of a killed run and cannot be renamed: {error.strerror}") from None
    return kept


def _try(path: Path, begin: Callable[[Path], Sink]) -> None:
    """Raise what beginning a recording beside ``path`` would raise, without leaving anything."""
    trial = path.with_name(f".{path.name}")
    if path.parent.is_dir() and not access(path.parent, W_OK):
        raise SourceError(f"cannot write {path}: {path.parent} is not writable; check its rights")
    try:
        sink = begin(trial)
    except PmuError as error:
        raise type(error)(str(error).replace(str(trial), str(path))) from None
    sink.close()
    for left in sink.paths:
        left.unlink(missing_ok=True)
