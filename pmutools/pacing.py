"""When each frame is due, and how late it really left.

Media time (ns) is the source's own time axis; the playback clock maps it to deadlines on the monotonic clock::

    target(t) = anchor_ns + (t - media_ns) / rate

Every deadline is computed from the one anchor, never from the deadline before it, so errors do not add up. A seek, a
change of rate, a pause and the wrap of an A-B loop each make a new anchor. All of it is exact integer arithmetic on
arguments; the only clock is the caller's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import loglinear


@dataclass(frozen=True, slots=True)
class Playback:
    """The playback clock: a value.

    ``anchor_ns`` and ``media_ns`` are one instant on both axes, ``rate`` is media seconds per second (> 0),
    ``running`` is false while paused. A seek, a pause, another rate: :func:`dataclasses.replace`.
    """

    anchor_ns: int
    media_ns: int
    rate: Fraction = Fraction(1)
    running: bool = True

    def __post_init__(self) -> None:
        if self.rate <= 0:
            raise ValueError(f"playback rate {self.rate} is not above 0")

    def target_ns(self, media_ns: int) -> int:
        """When a frame at ``media_ns`` is due (were it not paused), rounded down."""
        return self.anchor_ns + (media_ns - self.media_ns) * self.rate.denominator // self.rate.numerator

    def targets_ns(self, media_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """:meth:`target_ns` of media times (N,) within some hours of each other, the first one the earliest."""
        up, down, low_ns = self.rate.denominator, self.rate.numerator, int(media_ns[0])
        whole, rest = divmod((low_ns - self.media_ns) * up, down)
        targets: npt.NDArray[np.int64] = self.anchor_ns + whole + (rest + (media_ns - low_ns) * up) // down
        return targets

    def media_from(self, target_ns: int) -> int:
        """The first media time that is due at ``target_ns`` or later."""
        return self.media_ns - (self.anchor_ns - target_ns) * self.rate.numerator // self.rate.denominator


class LatenessSummary(NamedTuple):
    """Pacing error: actual minus scheduled time in ns. Percentiles are upper bin edges, within 3.2 %; max is exact."""

    frames: int
    misses: int
    p50_ns: int
    p99_ns: int
    max_ns: int


_FRACTION_BITS = 5
_BINS = 1024
"""Up to 63 ns one bin a nanosecond, then 32 bins an octave: the last bin begins at 67.6 s, and holds what is beyond."""


def _bins(values_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The bins of values (N,)."""
    return np.minimum(loglinear.bins(np.maximum(values_ns, 0), _FRACTION_BITS), _BINS - 1)


class Lateness:
    """Histograms of lateness, one a stream in 4 KiB each, whatever the count.

    What is late by more than its stream's ``miss_ns`` (S,) counts as a miss: customarily half the reporting interval.
    """

    def __init__(self, miss_ns: Sequence[int]) -> None:
        streams = len(miss_ns)
        self._miss_ns = np.array(miss_ns, np.int64)
        self._bins = np.zeros((streams, _BINS), np.uint32)
        self._misses = np.zeros(streams, np.int64)
        self._max_ns = np.zeros(streams, np.int64)

    def add(self, streams: npt.NDArray[np.integer[Any]], late_ns: npt.NDArray[np.int64]) -> None:
        """Count frames (N,) of ``streams`` that left ``late_ns`` after their time; what left early counts as 0."""
        # a one of the same type takes the fast way, thirty times faster than any other
        np.add.at(self._bins.reshape(-1), streams * np.int64(_BINS) + _bins(late_ns), np.uint32(1))
        missed = late_ns > self._miss_ns[streams]
        np.add.at(self._misses, streams[missed], 1)
        most = late_ns > self._max_ns[streams]  # few are: a maximum is slow to take
        np.maximum.at(self._max_ns, streams[most], late_ns[most])

    def summary(self, stream: int | None = None) -> LatenessSummary:
        """Of one stream, or of all together."""
        chosen = slice(None) if stream is None else slice(stream, stream + 1)
        bins = self._bins[chosen].sum(axis=0, dtype=np.int64)
        most = int(self._max_ns[chosen].max(initial=0))
        frames, misses = int(bins.sum()), int(self._misses[chosen].sum())
        return LatenessSummary(frames, misses, _percentile(bins, 50, most), _percentile(bins, 99, most), most)


def _percentile(bins: npt.NDArray[np.int64], percent: float, most_ns: int) -> int:
    """The smallest bin edge that at least ``percent`` of the values do not exceed; 0 of nothing."""
    seen = np.cumsum(bins)
    if not seen[-1]:
        return 0
    index = int(np.searchsorted(seen, max(percent / 100 * int(seen[-1]), 1)))
    return min(loglinear.high(index, _FRACTION_BITS), most_ns) if index < _BINS - 1 else most_ns
