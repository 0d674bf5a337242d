"""A reader without a network: rounds made of thin air, in virtual time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from support.playing import START_NS, recording, stream
from support.recordings import blocks_of, data_of

from pmutools.c37118 import Message
from pmutools.c37118.batch import Batch, decode_batch, encode_batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Loss, Tally
from pmutools.clock import VirtualClock
from pmutools.flow import Flow
from pmutools.formats import open_source
from pmutools.formats.source import Block
from pmutools.timebase import NS

Item = Block | Message | Loss
ROUND_NS = NS // 4


def flow_of(idcode: int) -> Flow:
    return Flow("udp", f"192.0.2.{idcode % 250}:4713", "192.0.2.1:4713")


def block(
    config: StreamConfig,
    frames: int = 12,
    *,
    first: int = 0,
    flow: Flow | None = None,
    latency_ns: int = 40_000_000,
    **columns: Any,
) -> Block:
    """Consecutive frames of a :func:`stream`, from slot ``first`` after START_NS on; ``columns`` replace those of the
    batch, as far as the FORMAT can carry them."""
    messages = recording(config, frames, first_slot=first, latency_ns=latency_ns)
    raw = b"".join(data_of(messages))
    arrivals = [message.frame.arrival_ns for message in messages[1:]]
    batch = decode_batch(raw, config, np.array(arrivals, np.int64), 1)
    if columns:
        changed = replace(
            batch, **{name: np.asarray(value, getattr(batch, name).dtype) for name, value in columns.items()}
        )
        batch = decode_batch(encode_batch(changed)[0].tobytes(), config, changed.arrival_ns, changed.stamp_source)
    return Block(flow or flow_of(config.idcode), batch)


def rounds_of(config: StreamConfig, count: int, frames: int = 12) -> list[list[Item]]:
    """Rounds of one stream, without gaps."""
    return [[block(config, frames, first=number * frames)] for number in range(count)]


@dataclass
class Rounds:
    """Stands for a :class:`~pmutools.tools.live.LiveSource`; each round takes ``round_ns`` of virtual time."""

    given: Sequence[Sequence[Item]]
    clock: VirtualClock = field(default_factory=lambda: VirtualClock(START_NS))
    round_ns: int = ROUND_NS
    own_drops: int = 0
    tally: Tally = field(default_factory=Tally)

    def name(self, flow: Flow, config: StreamConfig) -> str:
        return config.name

    def rounds(self, round_ns: int = 0) -> Iterator[list[Item]]:
        for found in self.given:
            self.clock.advance(self.round_ns)
            yield list(found)


def stamps_in(path: Path) -> list[int]:
    """Stamps of all frames of a recording, in its order, as slots of 1/50 s after START_NS."""
    batches = [each.batch for each in blocks_of(open_source(path))]
    return [round((ns - START_NS) * 50 / NS) for batch in batches for ns in batch.time_ns.tolist()]


def values(batch: Batch) -> list[float]:
    return batch.frequency[:, 0].tolist()


__all__ = ["START_NS", "Item", "Rounds", "block", "flow_of", "recording", "rounds_of", "stamps_in", "stream", "values"]
