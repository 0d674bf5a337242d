"""The least delay over time: what is left of a delay when no queue is in the way.

The floor of a frame is the least delay of the last :data:`MEMORY` buckets and of its own up to it: delays above the
floor (PDV, RFC 5481) are free of any constant offset between the clocks. The floor's course tells their skew from a
step in latency.
"""

from __future__ import annotations

import copy
import math
from array import array
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pmutools.measure.columns import Ints
from pmutools.timebase import NS

BUCKET_NS = 10 * NS
MEMORY = 6
POINTS = 512
"""So many points of the course are kept; beyond, each two that are neighbours become one."""
_ENOUGH = 6
_NEVER = np.iinfo(np.int64).max


class Skew(NamedTuple):
    """A line through the floor. ``ppm`` > 0: the sender's clock loses against the receiver's."""

    ppm: float
    span_s: float
    residual_ns: float
    """Standard deviation of the floor about the line."""


class Step(NamedTuple):
    """A lasting change of the floor, by ``change_ns``, at ``at_ns`` (time of arrival)."""

    change_ns: int
    at_ns: int
    noise_ns: float
    """Standard deviation of the floor about its two levels."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorCourse:
    """The least delay (P,) of each stretch of time that begins at (P,)."""

    start_ns: Ints
    least_ns: Ints

    def skew(self) -> Skew | None:
        """The line of least squares; None for fewer than :data:`_ENOUGH` points.

        The first stretch and the last are left out: they begin and end in the middle, and the least of a few frames
        is more than that of many.
        """
        if len(self.start_ns) < _ENOUGH:
            return None
        start_ns, least_ns = self.start_ns[1:-1], self.least_ns[1:-1]
        seconds = (start_ns - start_ns[0]) / NS
        off = (least_ns - least_ns[0]).astype(np.float64)
        seconds_off = seconds - seconds.mean()
        slope = float(seconds_off @ (off - off.mean()) / (seconds_off @ seconds_off))
        residual = off - off.mean() - slope * seconds_off
        return Skew(slope / 1000, float(seconds[-1]), float(residual.std()))

    def drift(self) -> Skew | None:
        """The skew where a line is what the floor is like: None where a step explains it better, or where the slope's
        standard error is above 1 ppm and a fifth of it.
        """
        skew, step = self.skew(), self.step()
        if skew is None or not skew.span_s:
            return None
        if step is not None and abs(step.change_ns) >= 6 * step.noise_ns and 2 * step.noise_ns <= skew.residual_ns:
            return None
        error_ppm = skew.residual_ns / 1000 / skew.span_s * math.sqrt(12 / (len(self.start_ns) - 2))
        return None if error_ppm > max(1.0, abs(skew.ppm) / 5) else skew

    def step(self) -> Step | None:
        """The split into two levels that leaves the least spread, each of three points or more."""
        count = len(self.least_ns)
        if count < _ENOUGH:
            return None
        off = (self.least_ns - self.least_ns[0]).astype(np.float64)
        total, squares = np.cumsum(off), np.cumsum(off * off)
        n = np.arange(3, count - 2)
        left, right = total[n - 1], total[-1] - total[n - 1]
        spread = squares[-1] - left**2 / n - right**2 / (count - n)
        best = int(np.argmin(spread))
        size = int(n[best])
        change = right[best] / (count - size) - left[best] / size
        noise = math.sqrt(max(0.0, float(spread[best])) / count)
        return Step(round(float(change)), int(self.start_ns[size]), noise)


class FloorMeter:
    """Floors of frames in order of arrival, and the floor's course."""

    def __init__(self) -> None:
        self._bucket: int | None = None
        self._least = _NEVER
        self._last: list[tuple[int, int]] = []
        """(bucket, least) of the last :data:`MEMORY` buckets before this one."""
        self._course = _Course()

    def restart(self) -> None:
        """The delays that come next have nothing to do with those before; the course goes on."""
        self._finish()
        self._bucket, self._least, self._last = None, _NEVER, []

    def add(self, arrival_ns: Ints, delay_ns: Ints) -> Ints:
        """The floor (N,) of each frame (N,)."""
        floor = np.empty_like(delay_ns)
        buckets = arrival_ns // BUCKET_NS
        cuts = [0, *(np.flatnonzero(np.diff(buckets)) + 1).tolist(), len(buckets)]
        for first, end in pairwise(cuts):
            if first == end:
                continue
            bucket = int(buckets[first])
            if bucket != self._bucket:
                self._finish()
                self._last = [entry for entry in self._last if 0 < bucket - entry[0] <= MEMORY]
                self._bucket, self._least = bucket, _NEVER
            before = min((least for _, least in self._last), default=_NEVER)
            here = floor[first:end]
            np.minimum.accumulate(delay_ns[first:end], out=here)
            np.minimum(here, min(before, self._least), out=here)
            self._least = min(self._least, int(delay_ns[first:end].min()))
        return floor

    def _finish(self) -> None:
        if self._bucket is None or self._least == _NEVER:
            return
        self._last.append((self._bucket, self._least))
        self._course.add(self._bucket, self._least)

    def course(self) -> FloorCourse:
        """The floor so far."""
        course = copy.deepcopy(self._course)
        if self._bucket is not None and self._least != _NEVER:
            course.add(self._bucket, self._least)
        return FloorCourse(np.array(course.buckets, np.int64) * BUCKET_NS, np.array(course.least_ns, np.int64))


class _Course:
    """The least of each bucket, in 16 bytes a point: thousands of streams keep one for as long as they last."""

    def __init__(self) -> None:
        self.buckets, self.least_ns = array("q"), array("q")
        self._width = 1

    def add(self, bucket: int, least_ns: int) -> None:
        """The next bucket."""
        self._append(bucket, least_ns)
        while len(self.buckets) > POINTS:
            self._width *= 2
            points = list(zip(self.buckets, self.least_ns, strict=True))
            self.buckets, self.least_ns = array("q"), array("q")
            for point in points:
                self._append(*point)

    def _append(self, bucket: int, least_ns: int) -> None:
        start = bucket - bucket % self._width
        if self.buckets and self.buckets[-1] == start:
            self.least_ns[-1] = min(self.least_ns[-1], least_ns)
        else:
            self.buckets.append(start)
            self.least_ns.append(least_ns)
