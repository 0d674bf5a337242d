"""StreamReader, ``pmu read``: live streams into a sink, flushed as they come."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message, Tally
from pmutools.formats import Sink
from pmutools.formats.source import Gatherer
from pmutools.tools.live import LiveSource

FLUSH_NS = 1_000_000_000
"""What a killed reader can lose at most, where the format can be cut at all."""


@dataclass
class Reading:
    """What was read so far."""

    tally: Tally
    frames: int = 0
    streams: set[tuple[object, int]] = field(default_factory=set)
    skipped: Counter[str] = field(default_factory=Counter)
    """Bytes that are in no frame, by reason."""
    own_drops: int = 0

    def to_json(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "streams": len(self.streams),
            "bytes": self.tally.fed,
            "skipped": dict(self.skipped),
            "own_drops": self.own_drops,
        }


def read(source: LiveSource, sink: Sink, progress: Callable[[Reading], None] | None = None) -> Reading:
    """Read ``source`` to its end into ``sink``; ``progress`` is called about once a second.

    What has come is kept on an error too, which then passes on.
    """
    reading = Reading(source.tally)
    gatherer = Gatherer()
    due_ns = source.clock.monotonic_ns() + FLUSH_NS
    try:
        for found in source.polls():
            for item in found:
                _take(item, sink, gatherer, reading)
            if source.clock.monotonic_ns() >= due_ns:
                due_ns = source.clock.monotonic_ns() + FLUSH_NS
                _flush(sink, gatherer)
                reading.own_drops = source.own_drops
                if progress is not None:
                    progress(reading)
    finally:
        _flush(sink, gatherer)
        reading.own_drops = source.own_drops
    return reading


def _take(item: Message | Loss, sink: Sink, gatherer: Gatherer, reading: Reading) -> None:
    if isinstance(item, Loss):
        reading.skipped[str(item.skipped.reason)] += item.skipped.nbytes
        return
    data = item.frame.type is FrameType.DATA
    if data:
        reading.frames += 1
        reading.streams.add((item.flow, item.frame.idcode))
    if sink.wants == "messages":
        sink.write(item)
    elif data and (block := gatherer.add(item)) is not None:
        sink.write(block)


def _flush(sink: Sink, gatherer: Gatherer) -> None:
    for block in gatherer.flush():
        sink.write(block)
    sink.flush()
