"""The control loop's wake-up error and computation, beside cyclictest, while all that a controller has runs beside it.

One ``dcon run`` with eight PMUs at 60 frames/s goes on all the time: log, server, watchdog, and 10,000 packets/s of a
stranger on one of its ports. Turns of some seconds are the loop's own, by its log (``/dcon/timing``), and cyclictest's,
at the loop's interval, policy and priority. It wakes up half a tick after the loop: neither waits for the other.
"""

from __future__ import annotations

import os
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bench.host import steal_s
from bench.table import Budget, Row
from support.running import Running, flood
from support.swing import Streams

from dcon.sections import Platform
from dcon.session.codec import Timing
from dcon.session.reader import SessionReader
from pmutools.grid.pmu_model import fleet
from pmutools.timebase import NS

FLEET = tuple(pmu.name for pmu in fleet())
INTERVAL_US = 16_667
LONGEST_US = 20_000
"""Of the histogram; more is the largest that was seen."""
START_S = 3.0
"""What cyclictest takes at most beside its turn."""


@dataclass(frozen=True)
class Sizes:
    seconds: int
    rounds: int


FULL = Sizes(seconds=20, rounds=3)
QUICK = Sizes(seconds=3, rounds=1)


class Histogram(NamedTuple):
    """Latencies that cyclictest has counted, by whole µs; ``overflows`` are beyond it, the largest at ``max_us``."""

    counts: Mapping[int, int]
    overflows: int
    max_us: int

    @property
    def total(self) -> int:
        return sum(self.counts.values()) + self.overflows

    def quantile_us(self, share: float) -> float:
        """The least latency that ``share`` of them do not exceed; of those beyond the histogram, the largest."""
        wanted, passed = share * self.total, 0
        for latency_us in sorted(self.counts):
            passed += self.counts[latency_us]
            if passed and passed >= wanted:
                return float(latency_us)
        return float(self.max_us)


def histogram(text: str) -> Histogram:
    """What ``cyclictest --quiet --histogram`` of one thread prints; raises ValueError where it counted nothing."""
    rows = re.findall(r"^(\d+)[ \t]+(\d+)[ \t]*$", text, re.MULTILINE)
    counts = Counter({int(latency_us): int(count) for latency_us, count in rows if int(count)})
    found = Histogram(counts, _named(text, "Histogram Overflows"), _named(text, "Max Latencies"))
    if not found.total:
        raise ValueError(f"cyclictest has counted nothing: {text.strip()[-200:]}")
    return found


def _named(text: str, name: str) -> int:
    match = re.search(rf"^# {name}: *(\d+)", text, re.MULTILINE)
    return int(match[1]) if match else 0


class Ours(NamedTuple):
    """A turn of the control loop."""

    ticks: int
    late_us: tuple[float, float]
    """p50, p99."""
    compute_us: tuple[float, float]


class Turn(NamedTuple):
    """When one was, POSIX UTC, and what the host took of the processors meanwhile."""

    from_ns: int
    to_ns: int
    steal_s: float


class Found(NamedTuple):
    """What was measured, a value a round."""

    policy: str
    ours: list[Ours]
    theirs: list[Histogram]
    our_steal_s: float
    their_steal_s: float


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows; one that says so where there is no cyclictest."""
    found = measured(sizes)
    compute = [statistics.median(turn.compute_us[k] for turn in found.ours) / 1e3 for k in (0, 1)]
    beside = "log, server, watchdog and 10,000 packets/s beside it"
    steal = f"steal {found.our_steal_s:.2f} s"
    for k, (name, at_most) in enumerate((("p50", 1.0), ("p99", 1.5))):
        mine = statistics.median(turn.late_us[k] for turn in found.ours)
        ours, what = f"{mine:.1f} us, {steal}", f"control loop ({found.policy}), {beside}: wake-up error, {name}"
        if not found.theirs:
            yield Row("control", what, ours, "cyclictest: not installed", mine, " us")
            continue
        peers = [turn.quantile_us((0.5, 0.99)[k]) for turn in found.theirs]
        against = f"cyclictest: {statistics.median(peers):.0f} us, steal {found.their_steal_s:.2f} s"
        ratio = statistics.median(
            turn.late_us[k] / max(peer, 1.0) for turn, peer in zip(found.ours, peers, strict=True)
        )
        yield Row("control", what, ours, against, ratio, "x", Budget("at most", at_most))
    told = f"p50 {compute[0]:.2f} ms, p99 {compute[1]:.2f} ms, {steal}"
    what = f"the same: from wake-up to command, 8 PMUs, {sum(turn.ticks for turn in found.ours)} ticks"
    yield Row("control", what, told, "the paper: 1 to 2 ms", compute[1], " ms", Budget("at most", 1))


def measured(sizes: Sizes) -> Found:
    """All rounds in one ``dcon run``."""
    peer = shutil.which("cyclictest")
    mine, theirs, their_steal_s = list[Turn](), list[Histogram](), 0.0
    with tempfile.TemporaryDirectory(prefix="waking-") as folder:
        site = Running(Path(folder), names=FLEET)
        try:
            site.start()
            site.activate()
            control = site.pid("platform")
            policy, priority = os.sched_getscheduler(control), os.sched_getparam(control).sched_priority
            length_s = sizes.rounds * (2 * sizes.seconds + START_S)
            with flood(site.ports[0], stranger(), length_s):
                for _ in range(sizes.rounds):
                    mine.append(_watched(sizes.seconds))
                    if peer:
                        before_s = steal_s()
                        theirs.append(_cyclictest(peer, sizes.seconds, policy, priority))
                        their_steal_s += steal_s() - before_s
            site.end()
        finally:
            site.close()
        ours = [by_log(site.log, turn) for turn in mine]
    name = f"SCHED_FIFO {priority}" if policy == os.SCHED_FIFO else "default policy"
    return Found(name, ours, theirs, sum(turn.steal_s for turn in mine), their_steal_s)


def stranger() -> list[bytes]:
    """What the flood is made of: data frames with an IDCODE that the port is not for."""
    return [Streams((FLEET[-1],)).data(FLEET[-1], time.time_ns())]


def _watched(seconds: float) -> Turn:
    before_s, from_ns = steal_s(), time.time_ns()
    time.sleep(seconds)
    return Turn(from_ns, time.time_ns(), steal_s() - before_s)


def _cyclictest(program: str, seconds: int, policy: int, priority: int) -> Histogram:
    """Half a tick after the loop, whose ticks are ``phase_ms`` after each 1/60 s of UTC."""
    offset_us = round(Platform().phase_ms * 1000) + INTERVAL_US // 2
    same = ["--policy=fifo", f"--priority={priority}"] if policy == os.SCHED_FIFO else ["--policy=other"]
    how = ["--clock=1", f"--secaligned={offset_us}", f"--interval={INTERVAL_US}", "--threads=1", "--mlockall"]
    command = [program, "--quiet", f"--histogram={LONGEST_US}", f"--duration={seconds}", *how, *same]
    return histogram(subprocess.run(command, capture_output=True, text=True, check=True, timeout=seconds + 30).stdout)


def by_log(path: Path, turn: Turn) -> Ours:
    """What the session log says of a turn; raises ValueError where it says nothing."""
    timings = [
        tick.timing
        for tick in SessionReader(path).ticks()
        if turn.from_ns <= tick.record.tick_ns < turn.to_ns and tick.timing is not None
    ]
    due = (turn.to_ns - turn.from_ns) * 60 // NS
    if len(timings) < 0.9 * due:
        raise ValueError(f"{path}: {len(timings)} of {due} ticks; did the controller begin again?")
    return summed(timings)


def summed(timings: Sequence[Timing]) -> Ours:
    late, compute = (np.array([getattr(timing, name) for timing in timings]) for name in ("late_us", "compute_us"))
    (late50, late99), (compute50, compute99) = (np.percentile(values, (50, 99)) for values in (late, compute))
    return Ours(len(timings), (float(late50), float(late99)), (float(compute50), float(compute99)))
