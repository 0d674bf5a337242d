"""What the characterizer's meters cost, by themselves: no decoding, no sockets."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from bench.layouts import C
from bench.table import Budget, Row

from pmutools.c37118.batch import Batch, decode_batch
from pmutools.measure.completeness import Alignment
from pmutools.measure.stream import Identity, StreamMeter

BLOCK = 8192
LIVE = 60


@dataclass(frozen=True)
class Sizes:
    blocks: int


FULL = Sizes(blocks=60)
QUICK = Sizes(blocks=2)


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows."""
    blocks = arriving(sizes.blocks)
    yield _row(f"a batch of {BLOCK} frames through all meters, and aligned with another stream", blocks, 8.0)
    seconds = [block[at : at + LIVE] for block in blocks for at in range(0, BLOCK - LIVE, LIVE)]
    yield _row(f"a second's {LIVE} frames, as they come from 1,000 streams in one core's second", seconds, 1.0)


def arriving(count: int) -> list[Batch]:
    """Batches of one stream, 1 % lost, 44 ms late and up to some ms more."""
    first = C.frames(BLOCK).batches
    wire = np.concatenate([batch.wire for batch in first if batch.wire is not None])
    template = decode_batch(wire, C.config, check=False)
    rate, found, random = C.config.rate, [], np.random.default_rng(1)
    for number in range(count):
        slots = np.arange(number * BLOCK, (number + 1) * BLOCK)
        slots = slots[random.random(BLOCK) > 0.01]
        time_ns = 1_700_000_000 * 10**9 + slots * rate.denominator * 10**9 // rate.numerator
        arrival_ns = time_ns + 44_000_000 + random.exponential(2e6, len(slots)).astype(np.int64)
        found.append(replace(template[: len(slots)], time_ns=time_ns, arrival_ns=arrival_ns))
    return found


def _row(what: str, batches: list[Batch], at_most_ms: float) -> Row:
    meter = StreamMeter(Identity("bench", batches[0].config.idcode), batches[0].config)
    alignment = Alignment(("one", "other"), Fraction(batches[0].config.rate))
    times_ms = []
    for batch in batches:
        began_ns = time.thread_time_ns()
        for seen in meter.add(batch):
            alignment.add(0, *seen.unique())
        times_ms.append((time.thread_time_ns() - began_ns) / 1e6)
    mean = statistics.fmean(times_ms)
    assert meter.result().counts.slots.frames == sum(map(len, batches))
    ours = f"p50 {statistics.median(times_ms):.2f} ms, mean {mean:.2f} ms"
    return Row("measure", what, ours, "the budget", mean, " ms", Budget("at most", at_most_ms))
