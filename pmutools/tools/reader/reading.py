"""What a reader has read so far, stream by stream."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message, Tally
from pmutools.flow import Flow
from pmutools.formats.describe import flow_name
from pmutools.formats.source import Block
from pmutools.timebase import format_utc

Round = Iterable[Block | Message | Loss]


@dataclass
class StreamReading:
    """One stream: a flow (all connections of it) and an IDCODE. Times are stamps, the earliest and the latest."""

    name: str
    flow: str
    idcode: int
    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "flow": self.flow,
            "idcode": self.idcode,
            "frames": self.frames,
            "first_time_ns": self.first_ns,
            "last_time_ns": self.last_ns,
            "first_time": format_utc(self.first_ns),
            "last_time": format_utc(self.last_ns),
        }


@dataclass
class Reading:
    """What was read so far."""

    tally: Tally
    name: Callable[[Flow, StreamConfig], str]
    """What a stream is called."""
    frames: int = 0
    kept: int = 0
    """Of these, frames that are in the recording whatever happens now."""
    kept_to_ns: int | None = None
    """The latest stamp among these."""
    latest_ns: int | None = None
    streams: dict[tuple[Flow, int], StreamReading] = field(default_factory=dict)
    skipped: Counter[str] = field(default_factory=Counter)
    """Bytes that are in no frame, or that no configuration came for, by reason."""
    undecoded: int = 0
    """Data frames that no configuration came for."""
    skipped_by_flow: dict[str, Counter[str]] = field(default_factory=dict)
    own_drops: int = 0

    def count(self, found: Round) -> None:
        """Take a round into account."""
        for item in found:
            if isinstance(item, Block):
                self._count_block(item)
            elif isinstance(item, Loss):
                reason, nbytes = item.skipped.reason, item.skipped.nbytes
                self.skipped[str(reason)] += nbytes
                self.undecoded += item.undecoded is not None
                self.skipped_by_flow.setdefault(flow_name(item), Counter())[str(reason)] += nbytes
            elif item.frame.type is FrameType.DATA:  # pragma: no cover - rounds give data as blocks
                raise TypeError("data frames come in blocks")

    def to_json(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "streams": [stream.to_json() for stream in self.streams.values()],
            "bytes": self.tally.fed,
            "skipped": dict(self.skipped),
            "skipped_by_flow": {flow: dict(reasons) for flow, reasons in self.skipped_by_flow.items()},
            "undecoded_frames": self.undecoded,
            "own_drops": self.own_drops,
            "ignored_bytes": self.tally.ignored,
            "ignored_flows": self.tally.ignored_flows,
        }

    def _count_block(self, block: Block) -> None:
        flow, batch = block
        key = flow.ends, batch.config.idcode
        stream = self.streams.get(key)
        first_ns, last_ns = int(batch.time_ns.min()), int(batch.time_ns.max())
        if stream is None:
            name = self.name(flow, batch.config)
            place = f"{flow.transport} {flow.source}" + (f" > {flow.destination}" if flow.destination else "")
            stream = self.streams[key] = StreamReading(name, place, batch.config.idcode, 0, first_ns, last_ns)
        stream.frames += len(batch)
        stream.first_ns, stream.last_ns = min(stream.first_ns, first_ns), max(stream.last_ns, last_ns)
        self.frames += len(batch)
        self.latest_ns = last_ns if self.latest_ns is None else max(self.latest_ns, last_ns)
