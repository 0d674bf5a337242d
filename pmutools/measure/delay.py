"""How late frames come, and how evenly.

Only the sum is in the stream: *stamp-to-arrival delay* D = R - S, arrival less stamp, holds the PMU's estimation
(half its window, filters, processing), the network, every concentrator's wait, and receiver's clock error less the
sender's. It is not the network's delay. D is kept where it is negative: that is a clock that is wrong, and news.

============== ============== ================================================================================
delay          RFC 7679       D of unique frames; undefined for a lost one, which ranks as infinite in percentiles
IPDV           RFC 3393, 5481 D of a slot less D of the slot before it, signed; undefined where either is lost
PDV            RFC 5481       D less its floor, the least D of the last minute: what a concentrator must wait for
jitter         RFC 3550       J += (\\|D(i) - D(i-1)\\| - J)/16 in order of arrival; remembers some 50 frames
p95 - p50      OWAMP          what ``owping`` calls jitter
correlation    von Neumann    of the delays of slots that follow each other: near 1 where they wait in a queue
inter-arrival                 R less the R before it: no clock but the receiver's own comes in
============== ============== ================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pmutools.c37118.batch import NO_TIME
from pmutools.measure.columns import Frames, Ints
from pmutools.measure.counts import Counts, Tally
from pmutools.measure.evenness import EvennessCounts, EvennessMeter
from pmutools.measure.floor import FloorMeter
from pmutools.measure.histogram import Histogram
from pmutools.timebase import NS

BURST_SHARE = 0.2
"""Frames closer together than this share of the period came as a burst."""
_MEMORY = 1024
_WEIGHTS = (15 / 16) ** np.arange(_MEMORY - 1, -1, -1.0) / 16
SECOND_WITHIN_NS = 50_000_000
RESOLUTIONS_NS = (1_000, 1_000_000, 10_000_000)
"""Arrival stamps are looked at for being whole multiples of these."""


@dataclass
class DelayCounts(Counts):
    """Delays of unique frames whose arrival is known."""

    locked: Histogram = field(default_factory=Histogram)
    """Of frames that say they are synchronised."""
    unlocked: Histogram = field(default_factory=Histogram)
    ipdv: Histogram = field(default_factory=Histogram)
    pdv: Histogram = field(default_factory=Histogram)
    interarrival: Histogram = field(default_factory=Histogram)
    late: int = 0
    """Came after the wait."""
    negative: int = 0
    bursts: int = 0
    """Came within :data:`BURST_SHARE` of a period of the frame before."""
    together: int = 0
    """Have the very arrival of the frame before."""
    second_steps: int = 0
    """Delays that changed by a second, within 50 ms, from a frame to the next."""
    slot_steps: Tally = field(default_factory=Tally)
    """By how many slots frames that came in order follow each other."""
    evenness: EvennessCounts = field(default_factory=EvennessCounts)
    multiples: dict[int, int] = field(default_factory=dict)
    """How many arrivals are whole multiples of each of :data:`RESOLUTIONS_NS`."""
    jitter_ns: float = field(default=0.0, metadata={"merge": lambda mine, later: later or mine})
    """RFC 3550's, at the last frame."""

    @property
    def delay(self) -> Histogram:
        """Of all. Not kept beside the two that it is made of: most streams have but one of them."""
        if not self.unlocked.count:
            return self.locked
        found = Histogram()
        found.merge(self.locked)
        found.merge(self.unlocked)
        return found

    @property
    def correlation(self) -> float | None:
        """Of the delays of slots that follow each other: 1 - E[IPDV²] / (2 Var[D]), von Neumann's ratio."""
        spread, step, mean = self.delay.sd_ns, self.ipdv.sd_ns, self.ipdv.mean_ns
        if not spread or step is None or mean is None or self.ipdv.count < 50:
            return None
        return max(-1.0, 1 - (step * step + mean * mean) / (2 * spread * spread))

    @property
    def owamp_jitter_ns(self) -> float | None:
        """P95 - P50."""
        middle, high = self.delay.quantiles_ns((0.5, 0.95))
        return None if middle is None or high is None else high - middle


class DelayMeter:
    """Delays, from unique frames in order of arrival. ``wait_ns`` is the concentrator's; ``period_ns`` 1/Fs."""

    def __init__(self, period_ns: float, wait_ns: int) -> None:
        self.floor, self._evenness = FloorMeter(), EvennessMeter()
        self.counts = DelayCounts()
        self.wait_ns = wait_ns
        self._period_ns = period_ns
        self._jitter_ns = 0.0
        self._last: tuple[int, int, int] | None = None

    @property
    def counts(self) -> DelayCounts:
        """May be exchanged: counting goes on in the new ones."""
        return self._counts

    @counts.setter
    def counts(self, counts: DelayCounts) -> None:
        self._counts, self._evenness.counts = counts, counts.evenness

    def restart(self, period_ns: float) -> None:
        """What comes next belongs to another epoch."""
        self._period_ns, self._last = period_ns, None
        self.floor.restart()
        self._evenness.restart()

    def close(self) -> None:
        """Count what is still gathered."""
        self._evenness.flush()

    def add(self, frames: Frames, ipdv_ns: Ints) -> None:
        """Unique frames, and the IPDV of pairs that they complete."""
        counts = self.counts
        counts.ipdv.add(ipdv_ns)
        if (unknown := frames.arrival_ns == NO_TIME).any():
            frames = frames[~unknown]
        if not len(frames):
            return
        arrival, delay = frames.arrival_ns, frames.delay_ns
        if frames.synchronised.all():
            counts.locked.add(delay)
        else:
            counts.locked.add(delay[frames.synchronised])
            counts.unlocked.add(delay[~frames.synchronised])
        counts.late += int(np.count_nonzero(delay > self.wait_ns))
        counts.negative += int(np.count_nonzero(delay < 0))
        counts.pdv.add(delay - self.floor.add(arrival, delay))
        whole = arrival
        for unit in RESOLUTIONS_NS:  # each a multiple of the one before
            whole = whole[whole % unit == 0]
            counts.multiples[unit] = counts.multiples.get(unit, 0) + len(whole)
        self._evenness.add(frames.slot, delay)
        self._between(frames)

    def _between(self, frames: Frames) -> None:
        """What is about a frame and the one that came before it."""
        counts = self.counts
        before = self._last
        self._last = int(frames.arrival_ns[-1]), int(frames.delay_ns[-1]), int(frames.slot[-1])
        columns = (frames.arrival_ns, frames.delay_ns, frames.slot)
        gaps, changes, steps = (
            np.diff(column) if before is None else np.diff(column, prepend=before[number])
            for number, column in enumerate(columns)
        )
        if not gaps.size:
            return
        counts.interarrival.add(gaps)
        counts.bursts += int(np.count_nonzero(gaps < BURST_SHARE * self._period_ns))
        counts.together += int(np.count_nonzero(gaps == 0))
        size = np.abs(changes)
        counts.second_steps += int(np.count_nonzero(np.abs(size - NS) < SECOND_WITHIN_NS))
        counts.slot_steps.add(steps if steps.min() > 0 else steps[steps > 0])
        recent = size[-_MEMORY:]
        self._jitter_ns = self._jitter_ns * (15 / 16) ** len(recent) + float(recent @ _WEIGHTS[-len(recent) :])
        counts.jitter_ns = self._jitter_ns
