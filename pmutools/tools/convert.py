"""``pmu convert``: a source, through a window, into a sink."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss
from pmutools.formats import Sink
from pmutools.formats.source import Block, Source
from pmutools.tools.recordings import losses
from pmutools.tools.window import Window


@dataclass
class Conversion:
    """What went through: data frames, streams, and losses by name (bytes for skips, counts for container defects)."""

    frames: int = 0
    streams: int = 0
    losses: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {"frames": self.frames, "streams": self.streams, "losses": self.losses}


def convert(source: Source, sink: Sink, window: Window) -> Conversion:
    """Read ``source`` to its end into ``sink``; a sink of tables gets blocks, one of bytes every message."""
    result = Conversion()
    streams: set[tuple[object, int]] = set()
    for item in window.blocks(source.blocks()) if sink.wants == "blocks" else window.items(source.items()):
        if isinstance(item, Loss):
            continue
        if isinstance(item, Block):
            result.frames += len(item.batch)
            streams.add((item.flow, item.batch.config.idcode))
        elif item.frame.type is FrameType.DATA:
            result.frames += 1
            streams.add((item.flow, item.frame.idcode))
        sink.write(item)
    result.streams = len(streams)
    result.losses = losses(source)
    return result
