"""What the characterizer costs with a thousand streams, and whether its memory is flat.

The table's row is the engine by itself: blocks of a quarter of a second of each stream, through meters, courses,
alignment and samples on disk. ``python -m bench.characterizing 600`` is the whole, live: a player in a process of its
own sends, ``pmu characterize`` measures, and all that was sent must be accounted for.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench.host import Look, growth_mib, rss_kib
from bench.layouts import RATE, B
from bench.pacing import PORT
from bench.table import Budget, Row

from pmutools.c37118.batch import Batch
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.samples import Samples

PER_BLOCK = RATE // 4
STREAMS = 1000
_PMU = (sys.executable, "-c", "from pmutools.cli import main; main()")
GROWTH_MIB = 16.0
"""Memory may grow by no more in the second half."""
END_S = 10.0
"""What is written in the end may take so long."""


@dataclass(frozen=True)
class Sizes:
    streams: int
    seconds: int


FULL = Sizes(streams=STREAMS, seconds=20)
QUICK = Sizes(streams=10, seconds=1)


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's row."""
    with tempfile.TemporaryDirectory() as folder:
        engine, samples = Engine(), Samples(Path(folder))
        engine.sinks.append(samples.add)
        taken_ns = frames = 0
        for number, blocks in enumerate(arriving(sizes)):
            began_ns = time.thread_time_ns()
            engine.take(blocks)
            if number % 4 == 3:
                engine.drain()
                samples.flush()
            taken_ns += time.thread_time_ns() - began_ns
            frames += len(blocks) * PER_BLOCK
        engine.close()
        samples.close()
        assert sum(gauge.meter.result().counts.slots.received for gauge in engine.gauges[:10]) == min(
            10, sizes.streams
        ) * (sizes.seconds * RATE)
        assert samples.rows == frames
    us = taken_ns / frames / 1000
    what = f"{sizes.streams:,} streams of {RATE}/s measured, aligned and written, a frame"
    cores = f"{us * sizes.streams * RATE / 1e6:.2f} of a core for all of them"
    yield Row("measure", what, cores, "the budget", us, " us", Budget("at most", 6.0))


def arriving(sizes: Sizes) -> Iterator[list[Block]]:
    """A quarter of a second of every stream, 44 ms late and up to some ms more."""
    template = B.frames(PER_BLOCK).batches[0]
    configs = [replace(B.config, idcode=number + 1) for number in range(sizes.streams)]
    flows = [Flow("udp", f"192.0.2.1:{10_000 + number}", "192.0.2.2:4713") for number in range(sizes.streams)]
    random, rate = np.random.default_rng(1), B.config.rate
    for number in range(sizes.seconds * 4):
        slots = np.arange(number * PER_BLOCK, (number + 1) * PER_BLOCK)
        times = 1_700_000_000 * 10**9 + slots * rate.denominator * 10**9 // rate.numerator
        late = 44_000_000 + random.exponential(2e6, (sizes.streams, PER_BLOCK)).astype(np.int64)
        yield [
            Block(flow, _batch(template, times, times + delays, config))
            for flow, config, delays in zip(flows, configs, late, strict=True)
        ]


def _batch(template: Batch, time_ns: np.ndarray, arrival_ns: np.ndarray, config: object) -> Batch:  # type: ignore[type-arg]
    return replace(template[:PER_BLOCK], time_ns=time_ns, arrival_ns=arrival_ns, config=config)  # type: ignore[arg-type]


# --- long runs ------------------------------------------------------------------------------------------------------


def soak(seconds: int, pmus: int = STREAMS) -> int:
    """``make soak``: so many PMUs measured for so long; memory, completeness and the end. 1 if one is not right."""
    capture = Path(__file__).resolve().parents[2] / "captures" / "cjb-8pmu.pcap"
    url = f"udp://127.0.0.1:{PORT}"
    play = [*_PMU, "play", str(capture), "--to", url, "--emulate", str(pmus), "--loop", "0", "--duration", str(seconds)]
    memory: list[Look] = []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        measure = [*_PMU, "characterize", url, "--out", str(out), "--no-samples", "--no-report", "--quiet"]
        with (
            subprocess.Popen(measure) as measuring,
            subprocess.Popen([*play, "--quiet", "--json"], stdout=subprocess.PIPE) as playing,
        ):
            began = time.monotonic()
            while playing.poll() is None and time.monotonic() - began < seconds + 60:
                time.sleep(min(10.0, max(1.0, seconds / 20)))
                memory.append((measuring.pid, rss_kib(measuring.pid)))
                print(f"{time.monotonic() - began:6.0f} s  {memory[-1][1] / 1024:7.1f} MiB", flush=True)
                if playing.stdout is not None and time.monotonic() - began > seconds:
                    break
            assert playing.stdout is not None
            streams = json.loads(playing.stdout.read())["streams"]
            time.sleep(1)
            measuring.send_signal(signal.SIGINT)
            ending = time.monotonic()
            measuring.wait(120)
            took_s = time.monotonic() - ending
        told = json.loads((out / "summary.json").read_text())["all"]
    sent = sum(stream["fates"].get("sent", 0) for stream in streams)
    received, drops = told["received"] + told["duplicated"] + told["stale"], told["own_drops"]
    # streams that take their seats, and rings that fill, are over after half the time; a backlog passes
    growth = growth_mib(memory)
    # the socket also drops some of the configurations that are sent each minute: the sum may exceed what was sent
    print(f"{sent} frames of {pmus} PMUs sent, {received} received, {drops} dropped by this machine's socket")
    print(f"memory grew by {growth:.1f} MiB in the second half; the end took {took_s:.1f} s")
    return int(not (received + drops >= sent * 0.9999 and growth < GROWTH_MIB and took_s < END_S))


if __name__ == "__main__":
    sys.exit(soak(*map(int, sys.argv[1:])) if sys.argv[1:] else soak(600))
