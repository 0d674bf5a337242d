"""When each frame is due, and how late it really left.

Media time (ns) is the source's own time axis; the playback clock maps it to deadlines on the monotonic clock::

    media(m) = media_ns + rate * (m - anchor_ns)        target(t) = anchor_ns + (t - media_ns) / rate

Every deadline is computed from the one anchor, never from the deadline before it, so errors do not add up. A seek, a
change of rate, a pause, a loop's wrap and a new file each make a new anchor. All of it is exact integer arithmetic on
arguments; the only clock is the caller's.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class Playback:
    """The playback clock: a value; each operation gives the next one.

    ``anchor_ns`` (monotonic) and ``media_ns`` are one instant on both axes, ``rate`` is media seconds per second
    (> 0), ``running`` is false while paused.
    """

    anchor_ns: int
    media_ns: int
    rate: Fraction = Fraction(1)
    running: bool = True

    def __post_init__(self) -> None:
        if self.rate <= 0:
            raise ValueError(f"playback rate {self.rate} is not above 0")

    def media_at(self, now_ns: int) -> int:
        """Media time at a monotonic time, rounded down."""
        if not self.running:
            return self.media_ns
        return self.media_ns + (now_ns - self.anchor_ns) * self.rate.numerator // self.rate.denominator

    def target_ns(self, media_ns: int, delay_ns: int = 0) -> int | None:
        """Monotonic deadline of a frame at ``media_ns``, or None while paused.

        ``delay_ns`` is wall time on top (network delay), so it is not scaled by the rate.
        """
        if not self.running:
            return None
        rate = self.rate
        return self.anchor_ns + (media_ns - self.media_ns) * rate.denominator // rate.numerator + delay_ns

    def pause(self, now_ns: int) -> Playback:
        return replace(self, anchor_ns=now_ns, media_ns=self.media_at(now_ns), running=False)

    def resume(self, now_ns: int) -> Playback:
        """Go on from the same media time; no effect while running."""
        return self if self.running else replace(self, anchor_ns=now_ns, running=True)

    def with_rate(self, now_ns: int, rate: Fraction) -> Playback:
        return replace(self, anchor_ns=now_ns, media_ns=self.media_at(now_ns), rate=rate)

    def seek(self, now_ns: int, media_ns: int) -> Playback:
        """Go to ``media_ns``: also for a loop's wrap, a skipped gap and the next file."""
        return replace(self, anchor_ns=now_ns, media_ns=media_ns)

    def shift(self, by_ns: int) -> Playback:
        """All deadlines later by ``by_ns`` of wall time (earlier if negative): to follow a stepped UTC clock."""
        return replace(self, anchor_ns=self.anchor_ns + by_ns)


class LatenessSummary(NamedTuple):
    """Pacing error: actual minus scheduled time in ns. Percentiles are upper bin edges, within 3.2 %; max is exact."""

    frames: int
    misses: int
    p50_ns: int
    p99_ns: int
    max_ns: int


_FRACTION_BITS = 5
_LINEAR = 1 << _FRACTION_BITS + 1
_BINS = 1024
"""Up to 63 ns one bin a nanosecond, then 32 bins an octave: the last bin begins at 67.6 s, and holds what is beyond."""


def _bin(value_ns: int) -> int:
    if value_ns < _LINEAR:
        return max(value_ns, 0)
    shift = value_ns.bit_length() - _FRACTION_BITS - 1
    return min((shift << _FRACTION_BITS) + (value_ns >> shift), _BINS - 1)


def _bin_edge(index: int) -> int:
    """The largest value of a bin."""
    if index < _LINEAR:
        return index
    shift = (index >> _FRACTION_BITS) - 1
    return ((index - (shift << _FRACTION_BITS)) + 1 << shift) - 1


class Lateness:
    """Histogram of lateness in 8 KiB, whatever the count; histograms of the same ``miss_ns`` can be merged.

    What is late by more than ``miss_ns`` counts as a miss: customarily half the reporting interval. What left early
    (sent with a batch) counts as not late.
    """

    __slots__ = ("_bins", "count", "max_ns", "miss_ns", "misses")

    def __init__(self, miss_ns: int) -> None:
        self.miss_ns = miss_ns
        self.count = 0
        self.misses = 0
        self.max_ns = 0
        self._bins = array("Q", bytes(8 * _BINS))

    def add(self, late_ns: int) -> None:
        self.count += 1
        self._bins[_bin(late_ns)] += 1
        if late_ns > self.max_ns:
            self.max_ns = late_ns
        if late_ns > self.miss_ns:
            self.misses += 1

    def merge(self, other: Lateness) -> None:
        """Add what ``other`` counted."""
        if other.miss_ns != self.miss_ns:
            raise ValueError(f"misses beyond {other.miss_ns} ns do not add to misses beyond {self.miss_ns} ns")
        self.count += other.count
        self.misses += other.misses
        self.max_ns = max(self.max_ns, other.max_ns)
        for index, count in enumerate(other._bins):
            self._bins[index] += count

    def percentile_ns(self, percent: float) -> int:
        """The smallest bin edge that at least ``percent`` of the values do not exceed; 0 of nothing."""
        needed = percent / 100 * self.count
        seen = 0
        for index, count in enumerate(self._bins):
            seen += count
            if count and seen >= needed:
                return min(_bin_edge(index), self.max_ns) if index < _BINS - 1 else self.max_ns
        return 0

    def summary(self) -> LatenessSummary:
        return LatenessSummary(self.count, self.misses, self.percentile_ns(50), self.percentile_ns(99), self.max_ns)
