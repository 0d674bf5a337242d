"""Streams for the live displays, round by round, without sockets and clocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from support.measured import MS, batch, config, stamps

from pmutools.c37118.config import StreamConfig
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.tools.watch import Watch

ROUND_NS = 250 * MS
PER_ROUND = 15
NAMES = ("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")


def stream(number: int, rate: int = 60) -> tuple[Flow, StreamConfig]:
    """A stream's flow and configuration."""
    name = NAMES[number] if number < len(NAMES) else f"PMU-{number:04d}"
    plain = config(rate, 101 + number)
    flow = Flow("udp", f"10.0.{number >> 8}.{number & 255}:5000", "10.1.0.1:4713")
    return flow, replace(plain, stations=(replace(plain.stations[0], name=name),))


def block(
    number: int,
    slots: Iterable[int],
    delay_ms: npt.ArrayLike = 20.0,
    *,
    rate: int = 60,
    stat: int = 0,
    hz: float = 60.0,
) -> Block:
    """Data frames of a stream."""
    flow, of = stream(number, rate)
    made = batch(stamps(slots, rate), delay_ms, of=of, stat=stat)
    made.frequency[:] = hz
    return Block(flow, made)


def watched(streams: int = 8, rounds: int = 60) -> Watch:
    """Streams of 60 frames/s: N2 loses frames, N4 is not synchronised, S1 had a late second, S3 has fallen silent."""
    watch, random = Watch(), np.random.default_rng(1)
    for number in range(rounds):
        blocks = []
        for row in range(streams):
            if row == 6 and number > max(rounds - 20, 2):
                continue
            slots = np.arange(PER_ROUND * number, PER_ROUND * (number + 1))
            if row == 1:
                slots = slots[random.random(PER_ROUND) > 0.05]
            late = 250 * (row == 4 and number == rounds - 3)
            delays = 20 + random.exponential(2, len(slots)) + late
            swing = 0.02 * np.sin(2 * np.pi * 0.4 * number / 4 + row)
            blocks.append(block(row, slots, delays, stat=0x2000 * (row == 3), hz=60 + swing))
        watch.add(blocks, ROUND_NS * (number + 1))
    return watch
