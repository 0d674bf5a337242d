"""``pmu info``: what a recording holds, stream by stream, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import STAT_DATA_ERROR_MASK, FrameType, Stat
from pmutools.c37118.demux import Loss, Message
from pmutools.flow import Flow
from pmutools.formats.describe import describe_station
from pmutools.formats.source import Block, Source
from pmutools.measure.columns import frames_of, gist_of
from pmutools.measure.slotmeter import SlotMeter
from pmutools.measure.slots import HORIZON_S, SlotCounts

HORIZON_NS = round(HORIZON_S * timebase.NS)


@dataclass
class StreamInventory:
    """Counts of one stream's data frames; times in ns, absent until a frame came."""

    flow: Flow
    idcode: int
    config: StreamConfig
    config_changes: int = 0
    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0
    first_arrival_ns: int | None = None
    last_arrival_ns: int | None = None
    backwards: int = 0
    """Stamps that go back by more than :data:`HORIZON_NS` from one frame to the next."""
    data_error: int = 0
    not_synchronised: int = 0
    invalid: int = 0
    time_quality: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._meter = SlotMeter(self.config.rate, HORIZON_NS)

    @property
    def slots(self) -> SlotCounts:
        """Slots by what became of them; of nothing where the configuration names no rate."""
        return self._meter.counts

    @property
    def gaps(self) -> int:
        """Runs of slots that no frame came for."""
        return self._meter.losses.counts.periods.count

    @property
    def reordered(self) -> int:
        """Frames that came after one of a later slot; copies are left out."""
        return self._meter.order.counts.reordered

    def add(self, batch: Batch) -> None:
        """Count a batch that follows all before it."""
        if batch.config != self.config:
            before, self.config, self.config_changes = self.config, batch.config, self.config_changes + 1
            if before.rate != self.config.rate:
                self.close()
                self._meter.restart(self.config.rate)
        if not self.frames:
            self.first_ns = self.last_ns = int(batch.time_ns[0])
        self.frames += len(batch)
        self.backwards += int(np.count_nonzero(np.diff(batch.time_ns, prepend=self.last_ns) < -HORIZON_NS))
        self.last_ns = int(batch.time_ns[-1])
        seen = batch.arrival_ns[batch.arrival_ns != NO_TIME]
        if len(seen):
            self.first_arrival_ns = int(seen[0]) if self.first_arrival_ns is None else self.first_arrival_ns
            self.last_arrival_ns = int(seen[-1])
        self.data_error += int(np.count_nonzero((batch.stat & STAT_DATA_ERROR_MASK).any(axis=1)))
        self.not_synchronised += int(np.count_nonzero((batch.stat & Stat.NOT_SYNCHRONISED).any(axis=1)))
        self.invalid += int(np.count_nonzero(~batch.valid.all(axis=1)))
        for code, count in zip(*np.unique(batch.time_quality & 0xF, return_counts=True), strict=True):
            self.time_quality[int(code)] = self.time_quality.get(int(code), 0) + int(count)
        if rate := self.config.rate:
            for _ in self._meter.feed(frames_of(gist_of(batch), rate)):
                pass

    def close(self) -> None:
        """Count what was kept until it was clear what to make of it."""
        for _ in self._meter.flush():
            pass
        self._meter.close()

    @property
    def measured_hz(self) -> float | None:
        """Frames per second over the span of the stamps; None for fewer than two frames."""
        span = self.last_ns - self.first_ns
        return (self.frames - 1) * timebase.NS / span if self.frames > 1 and span > 0 else None

    def to_json(self) -> dict[str, Any]:
        rate = self.config.rate
        return {
            "idcode": self.idcode,
            "transport": self.flow.transport,
            "source": self.flow.source,
            "destination": self.flow.destination,
            "connection": self.flow.connection,
            "config": self.config.kind.name.lower(),
            "rate_hz": float(rate),
            "measured_hz": self.measured_hz,
            "time_base": self.config.time_base,
            "frame_size": self.config.frame_size,
            "frames": self.frames,
            "first": timebase.format_utc(self.first_ns) if self.frames else None,
            "last": timebase.format_utc(self.last_ns) if self.frames else None,
            "first_ns": self.first_ns if self.frames else None,
            "last_ns": self.last_ns if self.frames else None,
            "span_s": (self.last_ns - self.first_ns) / timebase.NS,
            "first_arrival_ns": self.first_arrival_ns,
            "last_arrival_ns": self.last_arrival_ns,
            "gaps": self.gaps,
            "missing": self.slots.lost,
            "duplicates": self.slots.duplicated,
            "conflicting": self.slots.conflicting,
            "reordered": self.reordered,
            "stale": self.slots.stale,
            "backwards": self.backwards,
            "off_grid": self.slots.off_grid,
            "config_changes": self.config_changes,
            "data_error": self.data_error,
            "not_synchronised": self.not_synchronised,
            "invalid": self.invalid,
            "time_quality": {f"{code:X}": count for code, count in sorted(self.time_quality.items())},
            "stations": [describe_station(station) for station in self.config.stations],
        }


@dataclass
class Inventory:
    """All streams of a recording, and where its bytes went."""

    path: str
    kind: str
    streams: list[StreamInventory]
    frames: dict[FrameType, int]
    bytes_in: int
    skipped: dict[str, int]
    ignored_bytes: int
    ignored_flows: int
    defects: dict[str, int]

    @property
    def damaged(self) -> bool:
        """Whether input bytes were lost or undecodable."""
        return bool(self.skipped) or bool(self.defects)

    def to_json(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "kind": self.kind,
            "frames": {kind.name.lower(): count for kind, count in sorted(self.frames.items())},
            "bytes": self.bytes_in,
            "skipped": self.skipped,
            "ignored_bytes": self.ignored_bytes,
            "ignored_flows": self.ignored_flows,
            "defects": self.defects,
            "streams": [stream.to_json() for stream in self.streams],
        }


def take_inventory(source: Source, name: str = "") -> Inventory:
    """Read a source to its end and count what is in it; ``name`` is what the user calls it, by default its path."""
    streams: dict[tuple[Flow, int], StreamInventory] = {}
    for item in source.blocks():
        if isinstance(item, Loss):
            continue
        if isinstance(item, Message):
            if item.config is not None and item.frame.type.rules_data:
                key = (item.flow, item.config.idcode)
                streams.setdefault(key, StreamInventory(item.flow, item.config.idcode, item.config))
            continue
        block: Block = item
        config = block.batch.config
        key = (block.flow, config.idcode)
        streams.setdefault(key, StreamInventory(block.flow, config.idcode, config)).add(block.batch)
    for stream in streams.values():
        stream.close()
    tally = source.tally
    return Inventory(
        name or str(source.path),
        source.kind,
        list(streams.values()),
        dict(tally.frames),
        tally.fed,
        {str(reason): count for reason, count in tally.skipped.items()},
        tally.ignored,
        tally.ignored_flows,
        source.defects(),
    )
