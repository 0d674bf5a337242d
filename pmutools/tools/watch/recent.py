"""The last seconds of all streams: counts by place in time, series for sparklines, the newest delays.

A *place* is a quarter of a second, or what passed between two rounds if that is longer. :data:`PLACES` are kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from pmutools import loglinear
from pmutools.timebase import NS
from pmutools.tools.watch.table import Column, Floats, Ints, Segments, Table

PLACE_NS = NS // 4
PLACES = 60
"""15 s: also the points of a sparkline."""
RECENT_NS = 10 * NS
DELAYS = 640
"""Delays kept a stream: 10 s at 64 frames/s, less at higher rates."""
BITS = 4
LONGEST_US = 1 << 26
BINS = loglinear.bin_of(LONGEST_US, BITS) + 1
"""Bins of delays since the start: up to 67 s, each to 6 % of itself."""
SHARES = (0.5, 0.99)
REFRESHED = 64
"""Streams whose percentiles are renewed at once, or a quarter of them all, if that is more."""
_MS = 1e6
_MIDDLES_MS = np.array([(loglinear.low(b, BITS) + loglinear.high(b, BITS)) / 2e3 for b in range(BINS)], np.float32)

Small = npt.NDArray[np.uint32]


class Recent(Table):
    """Counts a place (R, PLACES), and what is made of the delays."""

    COUNTS = ("frames", "good", "expected", "unique", "late", "duplicated")
    COLUMNS: ClassVar = {
        **{name: Column(np.uint32, 0, PLACES) for name in COUNTS},
        "frequency_hz": Column(np.float32, np.nan, PLACES),
        "most_ms": Column(np.float32, np.nan, PLACES),
        "frequency_sum": Column(np.float64),
        "frequency_count": Column(np.int64),
        "delays_ms": Column(np.float32, np.nan, DELAYS),
        "delays": Column(np.int64),
        "bins": Column(np.uint32, 0, BINS),
        "percentiles_ms": Column(np.float32, np.nan, 5),
        "max_ms": Column(np.float32, np.nan),
        "jitter_ms": Column(np.float64),
        "last_ms": Column(np.float64, np.nan),
    }
    frames: Small
    good: Small
    """Frames that can be used, by what they say of themselves."""
    expected: Small
    """Slots."""
    unique: Small
    late: Small
    """Unique frames that came after the wait."""
    duplicated: Small
    frequency_hz: Floats
    """Mean of the place."""
    most_ms: Floats
    """Largest delay of the place."""
    frequency_sum: npt.NDArray[np.float64]
    frequency_count: Ints
    delays_ms: Floats
    """(R, DELAYS) in a ring."""
    delays: Ints
    """How many there have been."""
    bins: Small
    percentiles_ms: Floats
    """(R, 5): p50, p99 and largest of the last 10 s, p50 and p99 since the start; renewed in turns."""
    max_ms: Floats
    """Since the start."""
    jitter_ms: npt.NDArray[np.float64]
    """RFC 3550's."""
    last_ms: npt.NDArray[np.float64]
    """The last delay."""

    def __init__(self) -> None:
        super().__init__()
        self.at = 0
        self.begun_ns: int | None = None
        self.ended_ns = np.zeros(PLACES, np.int64)
        self.used = 0
        self._turn = 0

    # --- time

    def pass_time(self, now_ns: int) -> bool:
        """What comes next came up to now; a new place begins, and that is true, where the last one is old enough."""
        new = self.begun_ns is None or now_ns - self.begun_ns >= PLACE_NS
        if self.begun_ns is None:
            self.begun_ns, self.ended_ns[:], self.used = now_ns, now_ns, 1
        elif new:
            self.at = (self.at + 1) % PLACES
            self.begun_ns, self.used = now_ns, min(self.used + 1, PLACES)
            for name in self.COUNTS:
                getattr(self, name)[:, self.at] = 0
            self.frequency_hz[:, self.at] = self.most_ms[:, self.at] = np.nan
            self.frequency_sum[:] = self.frequency_count[:] = 0
        self.ended_ns[self.at] = now_ns
        return new

    def order(self) -> npt.NDArray[np.intp]:
        """Places, the oldest first."""
        return (self.at + 1 - self.used + np.arange(self.used)) % PLACES

    def within(self, length_ns: int) -> npt.NDArray[np.intp]:
        """Places of the last ``length_ns``, the oldest first."""
        order = self.order()
        ended_ns = self.ended_ns[order]
        recent: npt.NDArray[np.intp] = order[ended_ns > ended_ns[-1] - length_ns]
        return recent

    def passed(self, length_ns: int) -> tuple[npt.NDArray[np.intp], int]:
        """The same, but for the very first, which began nobody knows when; and when the one before them ended."""
        places, order = self.within(length_ns), self.order()
        if len(places) == len(order):
            places = places[1:]
        return places, int(self.ended_ns[order[-1 - len(places)]])

    # --- frames

    def count(self, rows: npt.NDArray[np.intp], counts: Mapping[str, npt.NDArray[Any]]) -> None:
        """Counts (B,) of streams, by :attr:`COUNTS`, into this place."""
        for name, count in counts.items():
            getattr(self, name)[rows, self.at] += count.astype(np.uint32)

    def add_frequency(self, segments: Segments, frequency_hz: npt.NDArray[np.float64]) -> None:
        """Frequencies (N,), NaN where absent."""
        rows, there = segments.rows, ~np.isnan(frequency_hz)
        self.frequency_sum[rows] += np.add.reduceat(np.where(there, frequency_hz, 0.0), segments.starts)
        self.frequency_count[rows] += segments.sums(there)
        count = self.frequency_count[rows]
        mean = np.divide(self.frequency_sum[rows], count, out=np.full(len(rows), np.nan), where=count > 0)
        self.frequency_hz[rows, self.at] = mean

    def add_delays(self, segments: Segments, delay_ns: Ints) -> None:
        """Delays (N,) of unique frames, in order of arrival."""
        rows, row = segments.rows, segments.row
        delay_ms = delay_ns / _MS
        place = (self.delays[row] + segments.place) % DELAYS
        self.delays_ms.reshape(-1)[row * DELAYS + place] = delay_ms
        self.delays[rows] += segments.lengths
        found = loglinear.bins(np.clip(delay_ns // 1000, 0, LONGEST_US), BITS)
        np.add.at(self.bins.reshape(-1), row * BINS + found, np.uint32(1))
        most = np.maximum.reduceat(delay_ms, segments.starts)
        self.most_ms[rows, self.at] = np.fmax(self.most_ms[rows, self.at], most)
        self.max_ms[rows] = np.fmax(self.max_ms[rows], most)
        self._add_jitter(segments, delay_ms)

    def _add_jitter(self, segments: Segments, delay_ms: npt.NDArray[np.float64]) -> None:
        """J += (abs(D(i) - D(i-1)) - J)/16, of all frames of a segment at once."""
        rows = segments.rows
        before = np.empty_like(delay_ms)
        before[1:] = delay_ms[:-1]
        before[segments.starts] = self.last_ms[rows]
        change = np.abs(delay_ms - before)
        change[np.isnan(change)] = 0.0
        to_come = np.repeat(segments.lengths, segments.lengths) - 1 - segments.place
        weighted = np.add.reduceat(change * (15 / 16) ** to_come / 16, segments.starts)
        self.jitter_ms[rows] = self.jitter_ms[rows] * (15 / 16) ** segments.lengths + weighted
        self.last_ms[rows] = delay_ms[segments.ends]

    # --- percentiles

    def refresh_all(self, rows: int) -> None:
        """Renew the percentiles of all streams at once."""
        self._renew(np.arange(rows))

    def refresh(self, rows: int) -> None:
        """Renew those of some streams: once a place, so that each has its turn within four."""
        some = max(REFRESHED, -(-rows // 4))
        if self._turn >= rows:
            self._turn = 0
        self._renew(np.arange(self._turn, min(self._turn + some, rows)))
        self._turn += some

    def _renew(self, rows: npt.NDArray[np.intp]) -> None:
        if not len(rows):
            return
        places = self.within(RECENT_NS)
        recent = self.unique[rows][:, places].sum(1, dtype=np.int64)
        delays = self.delays[rows]
        count = np.minimum(np.minimum(recent, delays), DELAYS)
        age = (delays[:, None] - 1 - np.arange(DELAYS)) % DELAYS
        values = np.where(age < count[:, None], self.delays_ms[rows], np.float32(np.inf))
        values.sort(axis=1)
        for number, share in enumerate((*SHARES, 1.0)):
            self.percentiles_ms[rows, number] = _ranked(values, _rank(share, count))
        seen = np.cumsum(self.bins[rows], axis=1)
        for number, share in enumerate(SHARES, 3):
            found = (seen < _rank(share, delays)[:, None]).sum(1)
            told = _MIDDLES_MS[np.minimum(found, BINS - 1)]
            self.percentiles_ms[rows, number] = np.where(delays > 0, np.minimum(told, self.max_ms[rows]), np.nan)


def _rank(share: float, count: Ints) -> Ints:
    """The nearest rank, from 1."""
    rank: Ints = np.maximum(1, np.ceil(share * count - 1e-9)).astype(np.int64)
    return rank


def _ranked(values: Floats, rank: Ints) -> Floats:
    """The value of a rank in each sorted row; NaN where there is none."""
    found = np.take_along_axis(values, rank[:, None] - 1, axis=1)[:, 0]
    told: Floats = np.where(np.isinf(found), np.float32(np.nan), found)
    return told


def shares(part: Ints, whole: Ints) -> Floats:
    """part / whole, NaN where there is nothing to share."""
    found: Floats = np.divide(part, whole, out=np.full(len(whole), np.nan, np.float32), where=whole > 0)
    return found
