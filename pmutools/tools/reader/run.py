"""The reader's loop: rounds are counted, shown to who wants to see them, recorded and flushed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from pmutools.c37118.demux import Loss, Message
from pmutools.errors import SourceError
from pmutools.formats import Sink
from pmutools.formats.source import Block
from pmutools.timebase import NS, format_utc
from pmutools.tools.continuity import Continuity
from pmutools.tools.live import LiveSource
from pmutools.tools.reader.log import Log, Recorder
from pmutools.tools.reader.reading import Reading
from pmutools.tools.reader.steps import Direct, Threaded

FLUSH_NS = NS
"""What a killed reader can lose at most: what came since."""
LOSS_BYTES = 600
"""What a loss takes beside its bytes, about."""
Observer = Callable[[Sequence[Block | Message | Loss]], None]


def read(
    source: LiveSource,
    into: Sink | Recorder,
    progress: Callable[[Reading], None] | None = None,
    *,
    observe: Observer | None = None,
    round_ns: int = FLUSH_NS,
    flush_ns: int = FLUSH_NS,
    threaded: bool = False,
) -> Reading:
    """Read ``source`` to its end into ``into``, which is left open.

    ``observe`` is given every round before it is recorded, ``progress`` is called after each flush. Rounds and flushes
    are about ``round_ns`` and ``flush_ns`` apart (0: after each round). ``threaded``: ``into`` is written in a thread
    of its own, and ``progress`` does not wait for it.

    Raises
    ------
    SourceError
        The system refuses to write. What was flushed is kept, the message says how much that is; ``into`` is closed.
    """
    reading = Reading(source.tally, source.name)
    recorder: Recorder = into if hasattr(into, "take") else Log(into)  # type: ignore[assignment]
    clock = source.clock
    due_ns = clock.monotonic_ns() + flush_ns
    continuity = Continuity()
    with _told(recorder, reading), Threaded() if threaded else Direct() as steps:
        for came in source.rounds(round_ns):
            found = continuity.settle(came)
            reading.count(found)
            reading.own_drops = source.own_drops
            if observe is not None:
                observe(came)
            steps.do(partial(_record, recorder.take, found), weight(found))
            now_ns = clock.monotonic_ns()
            if now_ns + round_ns // 2 >= due_ns:  # the nearest round, not the next one
                due_ns = now_ns + flush_ns
                steps.do(_flush(recorder, reading))
                if progress is not None:
                    progress(reading)
        steps.do(_flush(recorder, reading))
    return reading


class _Refused(Exception):
    """The recording cannot be written, for the reason in ``__cause__``."""


def _record(step: Callable[..., None], *given: object) -> None:
    try:
        step(*given)
    except SourceError as error:
        raise _Refused from error


def _flush(recorder: Recorder, reading: Reading) -> Callable[[], None]:
    """A flush, after which all that has been counted by now is safe."""
    frames, latest_ns = reading.frames, reading.latest_ns

    def step() -> None:
        _record(recorder.flush)
        reading.kept, reading.kept_to_ns = frames, latest_ns

    return step


@contextmanager
def _told(recorder: Recorder, reading: Reading) -> Iterator[None]:
    """Where writing fails: keep what can be kept, and say what is lost."""
    try:
        yield
    except _Refused as refused:
        with suppress(SourceError):
            recorder.close()
        raise SourceError(f"{refused.__cause__}; {_fate(reading)}") from None


def weight(found: Sequence[Block | Message | Loss]) -> int:
    """Bytes that a round takes in memory, about: its columns are some times its frames."""
    blocks = sum(6 * len(item.batch) * item.batch.config.frame_size for item in found if isinstance(item, Block))
    return blocks + sum(LOSS_BYTES + item.skipped.nbytes for item in found if isinstance(item, Loss))


def _fate(reading: Reading) -> str:
    """What is kept, and what is lost, when nothing more can be written."""
    lost = f"{reading.frames - reading.kept} frames that came after it are lost"
    if reading.kept_to_ns is None:
        return f"nothing was kept: {reading.frames} frames are lost"
    return f"{reading.kept} frames are kept, up to {format_utc(reading.kept_to_ns)}; {lost}"
