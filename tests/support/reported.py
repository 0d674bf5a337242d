"""Runs to report on, made from stamps and arrivals as a receiver would have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from support.measured import MS, START_NS, arranged, batch, config, stamps

from pmutools.c37118.batch import Batch
from pmutools.measure.clockquality import ClockLog, ClockQuality, KernelClock
from pmutools.measure.completeness import Alignment
from pmutools.measure.require import parse_requirements, verdicts
from pmutools.measure.run import Run
from pmutools.measure.stream import Identity, StreamMeter
from pmutools.measure.summary import summary
from pmutools.measure.timeline import Timeline
from pmutools.timebase import NS

GOOD_CLOCK = KernelClock(0, 0.0, 200, 100, 0x2001)


@dataclass(frozen=True)
class Made:
    """One stream: when it sends, how late each frame comes, and what is wrong with it."""

    name: str
    seconds: float = 60.0
    rate: int = 60
    delay_ms: float = 40.0
    spread_ms: float = 2.0
    loss: float = 0.0
    copies: float = 0.0
    late: float = 0.0
    """The share of the frames that come 30 ms later than that."""
    outage_s: tuple[float, float] | None = None
    behind_s: float = 0.0
    """Its clock is so far behind: so are its stamps."""
    unseen: bool = False
    """Nobody saw the frames come."""
    seed: int = 1
    options: Mapping[str, Any] = field(default_factory=dict)

    def batch(self, idcode: int) -> Batch:
        """Its frames, in the order they came."""
        draw = np.random.default_rng(self.seed)
        slot = np.arange(round(self.seconds * self.rate))
        kept = draw.random(len(slot)) >= self.loss
        if self.outage_s is not None:
            low, high = self.outage_s
            kept &= (slot < low * self.rate) | (slot >= high * self.rate)
        slot = slot[kept]
        delay = self.delay_ms + draw.gamma(2.0, self.spread_ms / 2, len(slot)) if self.spread_ms else self.delay_ms
        delay = np.broadcast_to(delay, len(slot))
        if self.late:
            delay = delay + 30.0 * (draw.random(len(slot)) < self.late)
        again = np.flatnonzero(draw.random(len(slot)) < self.copies)
        slot, delay = np.concatenate((slot, slot[again])), np.concatenate((delay, delay[again] + 1.0))
        of = config(self.rate, idcode)
        times, off_ns = stamps(slot.tolist(), self.rate), round(self.behind_s * NS)
        frames = batch(times - off_ns, None if self.unseen else delay + off_ns / MS, of=of, **self.options)
        return frames if self.unseen else arranged(frames)


def clock(quality: KernelClock | None = GOOD_CLOCK) -> ClockLog:
    """A log of one sample; None: nobody could be asked."""
    log = ClockLog()
    log.add(ClockQuality(quality))
    return log


def run_of(
    streams: Sequence[Made],
    *,
    clock_log: ClockLog | None = None,
    require: str = "",
    fits: bool = True,
    align: bool = True,
    source: str = "udp://0.0.0.0:4713",
    **more: Any,
) -> Run:
    """The finished run of these streams, by the meters."""
    found = [_measured(made, 101 + number) for number, made in enumerate(streams)]
    alignment = Alignment([made.name for made in streams], found[0][0].rate) if align and len(found) > 1 else None
    if alignment is not None:
        for number, (_, _, pieces) in enumerate(found):
            for slot, arrival in pieces:
                alignment.add(number, slot, arrival)
        alignment.close(200 * MS)
    results, courses = [result for result, _, _ in found], [course for _, course, _ in found]
    alignments = [] if alignment is None else [alignment]
    told = summary(results, clock_log or clock(), alignments, may_fit=lambda: fits)
    run = Run(told, results, courses, alignments, source=source, **more)
    return replace(run, verdicts=verdicts(parse_requirements(require), told)) if require else run


def _measured(made: Made, idcode: int) -> tuple[Any, Any, list[Any]]:
    frames = made.batch(idcode)
    meter, line, pieces = StreamMeter(Identity(made.name, idcode, "udp"), frames.config), Timeline(), []
    found = [seen for first in range(0, len(frames), 4096) for seen in meter.add(frames[first : first + 4096])]
    for seen in (*found, *meter.close()):
        line.add(seen)
        pieces.append(seen.unique())
    last = int(frames.arrival_ns.max()) if len(frames) and not made.unseen else None
    return meter.result(last), line.course(), pieces


def eight(**more: Any) -> Run:
    """Eight PMUs for a minute, one of them bad."""
    good = [Made(f"{side}{number}", delay_ms=38 + number, seed=number) for side in "NS" for number in range(1, 5)]
    good[3] = replace(good[3], delay_ms=60, spread_ms=14, loss=0.03, copies=0.01, seed=44)
    return run_of(good, begin_ns=START_NS, end_ns=START_NS + 60 * NS + 200 * MS, **more)
