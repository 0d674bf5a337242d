"""The reader's loop: rounds are counted, shown to who wants to see them, recorded and flushed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from pmutools.c37118.demux import Loss, Message
from pmutools.errors import SourceError
from pmutools.formats import Sink
from pmutools.formats.source import Block
from pmutools.timebase import NS, format_utc
from pmutools.tools.live import LiveSource
from pmutools.tools.reader.log import Log, Recorder
from pmutools.tools.reader.reading import Reading

FLUSH_NS = NS
"""What a killed reader can lose at most: what came since."""
Observer = Callable[[Sequence[Block | Message | Loss]], None]


def read(
    source: LiveSource,
    into: Sink | Recorder,
    progress: Callable[[Reading], None] | None = None,
    *,
    observe: Observer | None = None,
    round_ns: int = FLUSH_NS,
    flush_ns: int = FLUSH_NS,
) -> Reading:
    """Read ``source`` to its end into ``into``, which is left open.

    ``observe`` is given every round before it is recorded, ``progress`` is called after each flush. Rounds and flushes
    are about ``round_ns`` and ``flush_ns`` apart (0: after each round).

    Raises
    ------
    SourceError
        The system refuses to write. What was flushed is kept, the message says how much that is; ``into`` is closed.
    """
    reading = Reading(source.tally)
    recorder: Recorder = into if hasattr(into, "take") else Log(into)  # type: ignore[assignment]
    clock = source.clock
    due_ns = clock.monotonic_ns() + flush_ns
    for found in source.rounds(round_ns):
        reading.count(found)
        reading.own_drops = source.own_drops
        if observe is not None:
            observe(found)
        with _told(recorder, reading):
            recorder.take(found)
        now_ns = clock.monotonic_ns()
        if now_ns + round_ns // 2 >= due_ns:  # the nearest round, not the next one
            due_ns = now_ns + flush_ns
            _flush(recorder, reading)
            if progress is not None:
                progress(reading)
    _flush(recorder, reading)
    return reading


def _flush(recorder: Recorder, reading: Reading) -> None:
    with _told(recorder, reading):
        recorder.flush()
    reading.flushed()


@contextmanager
def _told(recorder: Recorder, reading: Reading) -> Iterator[None]:
    """Where writing fails: keep what can be kept, and say what is lost."""
    try:
        yield
    except SourceError as error:
        with suppress(SourceError):
            recorder.close()
        raise SourceError(f"{error}; {_fate(reading)}") from None


def _fate(reading: Reading) -> str:
    """What is kept, and what is lost, when nothing more can be written."""
    lost = f"{reading.frames - reading.kept} frames that came after it are lost"
    if reading.kept_to_ns is None:
        return f"nothing was kept: {reading.frames} frames are lost"
    return f"{reading.kept} frames are kept, up to {format_utc(reading.kept_to_ns)}; {lost}"
