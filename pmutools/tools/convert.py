"""``pmu convert``: sources, merged on time, through a window into a sink."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from pmutools import timebase
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.prefix import decode_prefix
from pmutools.formats import Sink
from pmutools.formats.source import Block, Source
from pmutools.tools.window import Window


@dataclass
class Conversion:
    """What went through: data frames, streams, and losses by name (bytes for skips, counts for container defects)."""

    frames: int = 0
    streams: int = 0
    losses: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {"frames": self.frames, "streams": self.streams, "losses": self.losses}


def convert(sources: Sequence[Source], sink: Sink, window: Window) -> Conversion:
    """Read ``sources`` to their ends into ``sink``; a sink of tables gets blocks, one of bytes every message."""
    result = Conversion()
    streams: set[tuple[object, int]] = set()
    items: Iterable[Block | Message | Loss]
    items = window.blocks(_merge_blocks(sources)) if sink.wants == "blocks" else window.items(_merge_items(sources))
    for item in items:
        if isinstance(item, Loss):
            continue
        if isinstance(item, Block):
            result.frames += len(item.batch)
            streams.add((item.flow, item.batch.config.idcode))
            sink.write(item)
        elif sink.wants == "messages":
            if item.frame.type is FrameType.DATA:
                result.frames += 1
                streams.add((item.flow, item.frame.idcode))
            sink.write(item)
    result.streams = len(streams)
    for source in sources:
        for reason, nbytes in source.tally.skipped.items():
            name = f"{source.path}: bytes skipped, {reason}"
            result.losses[name] = result.losses.get(name, 0) + nbytes
        for defect, count in source.defects().items():
            result.losses[f"{source.path}: {defect}"] = count
    return result


def merged(paths: Sequence[str]) -> Iterator[Message | Loss]:
    """Every frame of several recordings, merged on time."""
    from pmutools.formats import open_source

    return _merge_items([open_source(path) for path in paths])


def _merge_items(sources: Sequence[Source]) -> Iterator[Message | Loss]:
    if len(sources) == 1:
        return sources[0].items()
    keyed = [_keyed_items(source, number) for number, source in enumerate(sources)]
    return (item for *_, item in heapq.merge(*keyed, key=lambda entry: entry[:3]))


def _keyed_items(source: Source, number: int) -> Iterator[tuple[int, int, int, Message | Loss]]:
    """Items with the stamp of the last data frame before them, which keeps a source's own order."""
    time_ns = -(1 << 62)
    for index, item in enumerate(source.items()):
        if isinstance(item, Message) and item.frame.type is FrameType.DATA and item.config is not None:
            prefix = decode_prefix(item.frame.data)
            time_ns = max(time_ns, timebase.to_ns(prefix.soc, prefix.fracsec, item.config.time_base))
        yield time_ns, number, index, item


def _merge_blocks(sources: Sequence[Source]) -> Iterator[Block | Message | Loss]:
    """Tables are one stream each, so merging block by block keeps every table in order."""
    for source in sources:
        yield from source.blocks()
