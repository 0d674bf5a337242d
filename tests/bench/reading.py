"""What recording costs, from the blocks of live rounds to files that are closed: no sockets, no decoding."""

from __future__ import annotations

import gc
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench.layouts import A, C, Layout
from bench.stopwatch import cpu_s
from bench.table import Budget, Row

from pmutools.c37118.batch import Batch, decode_batch, encode_batch
from pmutools.c37118.config import StreamConfig
from pmutools.flow import Flow
from pmutools.formats import open_sink
from pmutools.formats.source import Block
from pmutools.net.sockets import allow_all_files
from pmutools.tools.reader.log import Log

RATE = 60
TIMES_US = 3.0
"""What a frame may cost in Parquet: with receiving and decoding as much again, 100,000 frames/s are two thirds of a
core."""


@dataclass(frozen=True)
class Sizes:
    streams: int
    """Side by side."""
    seconds: int
    """Rounds of a second, written over and over."""
    times: int


FULL = Sizes(streams=1000, seconds=2, times=4)
QUICK = Sizes(streams=3, seconds=2, times=1)


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows: of one-phasor streams, as many as ``sizes`` says; and of one concentrator."""
    many = rounds(A, sizes.streams, sizes.seconds)
    few = rounds(C, 1, sizes.seconds * 20)
    what = f"{sizes.streams} streams of {RATE}/s, one phasor each"
    yield _row(f"{what}: Parquet in long form, journal beside it", many, "x.parquet", True, sizes.times, TIMES_US)
    yield _row(f"{what}: a Parquet table each, journal beside them", many, "x.parquet", False, sizes.times, None)
    yield _row(f"{what}: Arrow in long form", many, "x.arrow", True, sizes.times, None)
    yield _row(f"{what}: raw frames", many[:1], "x.c37118", False, 1, None)
    what = "a concentrator's stream of 8 PMUs"
    for name in ("x.parquet", "x.arrow", "x.csv", "x.mcap", "x.pcapng", "x.jsonl"):
        yield _row(f"{what}: {name[2:]}", few, name, False, 1, None)


def rounds(layout: Layout, streams: int, seconds: int) -> list[list[Block]]:
    """What comes within each second: a block a stream, each with an IDCODE and an address of its own."""
    made = [replace(layout.config, idcode=1 + number) for number in range(streams)]
    flows = [Flow("udp", f"192.0.2.{k % 250}:{4713 + k // 250}", "192.0.2.1:4713") for k in range(streams)]
    template = decode_batch(layout.frames(RATE * seconds).data, layout.config, check=False)
    parts = [template[second * RATE : (second + 1) * RATE] for second in range(seconds)]
    return [[Block(flow, _arrived(part, each)) for flow, each in zip(flows, made, strict=True)] for part in parts]


def _arrived(part: Batch, config: StreamConfig) -> Batch:
    """The frames of ``part`` as those of another stream, some 44 ms late."""
    octets = encode_batch(replace(part, config=config))[0].tobytes()
    late_ns = np.random.default_rng(config.idcode).integers(0, 5_000_000, len(part)) + 44_000_000
    return decode_batch(octets, config, part.time_ns + late_ns, 1, check=False)


def _row(what: str, given: list[list[Block]], name: str, long: bool, times: int, at_most_us: float | None) -> Row:
    allow_all_files()
    frames = times * sum(len(block.batch) for found in given for block in found)
    folder = Path(tempfile.mkdtemp(prefix="reading"))
    try:
        gc.collect()
        began_s = cpu_s()
        log = Log(open_sink(folder / name, long=long, journal=True))
        for found in given * times:
            log.take(found)
            log.flush()
        log.close()
        took_us = (cpu_s() - began_s) * 1e6 / frames
        nbytes = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / frames
    finally:
        shutil.rmtree(folder)
    ours = f"{1e3 / took_us:.0f} k frames/s, {nbytes:.0f} bytes a frame"
    budget = None if at_most_us is None else Budget("at most", at_most_us)
    return Row("read", what, ours, "the budget" if budget else "", took_us, " us", budget)
