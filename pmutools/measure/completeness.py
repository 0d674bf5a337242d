"""How many frames are there if a concentrator waits so long: completeness against wait.

``completeness(W)`` is the share of expected frames that came by W after their stamp (*absolute* wait, from UTC; of one
stream, its distribution of delays with the lost ones never reaching 1). Over all streams it is the share of stamps
whose frames were all there by then; *relative*, by W after the first of that stamp had come. The stragglers are those
that were last: what each costs, or would spare.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME
from pmutools.measure.columns import Ints
from pmutools.measure.counts import Counts
from pmutools.measure.histogram import NS_PER_MS, Histogram, ms

BUDGET_BYTES = 32 << 20
"""What the arrivals that are compared may take; how many stamps that is depends on the number of streams."""
_LONGEST = 1 << 15
_AT_ONCE = 1 << 19
"""Arrivals that are judged together."""
_LATEST = np.iinfo(np.int64).max
_SHARES: tuple[float, ...] = (*np.linspace(0.0, 1.0, 41).tolist(), 0.99, 0.995, 0.999, 0.9999)


def curve(delays: Histogram, expected: int, waits_ms: Sequence[float] = ()) -> list[list[float]]:
    """``[[wait ms, share of expected]]`` at these waits, or at those where the curve rises."""
    if not delays.count or not expected:
        return []
    if waits_ms:
        at_ns = np.array(waits_ms) * NS_PER_MS
    else:
        found = delays.quantiles_ns(_SHARES)
        at_ns = np.unique([float(value) for value in found if value is not None])
    shares = delays.at_most_array(at_ns) / expected
    return [[wait / NS_PER_MS, min(1.0, share)] for wait, share in zip(at_ns.tolist(), shares.tolist(), strict=True)]


@dataclass
class Straggler(Counts):
    """One stream's part in complete stamps that it had a frame for."""

    stamps: int = 0
    expected: int = 0
    missing: int = 0
    last: int = 0
    """It came last (alone) and all others were there."""
    cost_ns: int = 0
    """... by how much, after the last but one, summed up."""
    lag: Histogram = field(default_factory=Histogram)
    """Its arrival after the first of the stamp."""


@dataclass
class AlignmentCounts(Counts):
    """Stamps over all streams of one rate."""

    stamps: int = 0
    """Reporting instants for which some stream's frame was due."""
    complete: int = 0
    absolute: Histogram = field(default_factory=Histogram)
    """From the stamp to the last arrival, of complete stamps."""
    relative: Histogram = field(default_factory=Histogram)
    """From the first to the last arrival, of complete stamps."""
    outside: int = 0
    """Frames so far behind other streams' that their stamp was settled."""


class Row(NamedTuple):
    """A stream's line in the table of stragglers."""

    name: str
    last_share: float | None
    cost_ms: float | None
    """Mean time that all waited for it when it was last."""
    missing: int
    lag_p50_ms: float | None
    lag_p99_ms: float | None


class Alignment:
    """Compares arrivals of streams that report at the same instants.

    Streams may be added in any order and at their own pace, as long as they stay within 3/4 of ``stamps`` instants of
    each other. A stamp is judged once the newest is about that far ahead, or at the end, by the streams that had begun.
    Memory: ``budget_bytes``, however many streams join.
    """

    def __init__(self, names: Sequence[str], rate: Fraction, budget_bytes: int = BUDGET_BYTES) -> None:
        self.names, self.rate = list(names), rate
        self.counts = AlignmentCounts()
        self.stragglers = [Straggler() for _ in names]
        self._budget_bytes = budget_bytes
        count = max(1, len(names))
        self.stamps = self._size(count)
        self._arrivals = np.full((self.stamps, count), _LATEST)
        self._joined = np.full(count, _LATEST)
        """The first slot of each stream; before it nothing is expected."""
        self._heads = np.full(count, NO_TIME)
        self._running = list(range(len(names)))
        self._settled: int | None = None
        self._head = 0

    def _size(self, streams: int) -> int:
        size = min(_LONGEST, max(64, self._budget_bytes // (8 * streams)))
        return 1 << (size.bit_length() - 1)

    def join(self, name: str) -> int:
        """Another stream; its place."""
        place = len(self.names)
        if place >= self._arrivals.shape[1]:
            self._widen(2 * place)
        self.names.append(name)
        self.stragglers.append(Straggler())
        self._running.append(place)
        return place

    def leave(self, stream: int) -> None:
        """Nothing more is expected of a stream; stamps that are not judged yet do without it."""
        self._running.remove(stream)

    def _widen(self, streams: int) -> None:
        """Room for so many; the ring becomes shorter where memory would not do."""
        size, before = self._size(streams), self._arrivals.shape[1]
        if self._settled is not None:
            self._settle(self._head - size)
        arrivals = np.full((size, streams), _LATEST)
        if self._settled is not None:
            kept = np.arange(self._settled + 1, self._head + 1)
            arrivals[kept & (size - 1), :before] = self._arrivals[kept & (self.stamps - 1)]
        self.stamps, self._arrivals = size, arrivals
        more = streams - before
        self._joined = np.concatenate((self._joined, np.full(more, _LATEST)))
        self._heads = np.concatenate((self._heads, np.full(more, NO_TIME)))

    def add(self, stream: int, slot: Ints, arrival_ns: Ints) -> None:
        """Unique frames (N,) of a stream, by its place in ``names``, in order of arrival."""
        if (unknown := arrival_ns == NO_TIME).any():
            slot, arrival_ns = slot[~unknown], arrival_ns[~unknown]
        if not len(slot):
            return
        if self._settled is None:
            self._settled, self._head = int(slot.min()) - 1, int(slot.min()) - 1
        half = self.stamps // 2
        rows = 0
        while rows < len(slot):  # a piece at a time, no further than half the ring beyond the newest
            beyond = slot[rows:] > self._head + half
            count = int(np.argmax(beyond)) if beyond.any() else len(beyond)
            if not count:
                self._advance(int(slot[rows]))
                continue
            self._add(stream, slot[rows : rows + count], arrival_ns[rows : rows + count])
            rows += count

    def _add(self, stream: int, slot: Ints, arrival_ns: Ints) -> None:
        newest = int(slot.max())
        if newest > self._head:
            self._advance(newest)
        assert self._settled is not None
        low = int(slot.min())
        if low <= self._settled:
            inside = slot > self._settled
            self.counts.outside += int(np.count_nonzero(~inside))
            slot, arrival_ns = slot[inside], arrival_ns[inside]
            if not len(slot):
                return
            low = int(slot.min())
        at = slot & (self.stamps - 1)
        self._arrivals[at, stream] = np.minimum(self._arrivals[at, stream], arrival_ns)
        self._joined[stream] = min(int(self._joined[stream]), low)
        self._heads[stream] = max(int(self._heads[stream]), newest)

    def _advance(self, newest: int) -> None:
        """Make room up to ``newest``: judge what falls out of the ring."""
        assert self._settled is not None
        if newest - self._head > self.stamps:  # a silence of all, or a clock that was set: nothing is expected in it
            self._settle(self._head)
            self._settled = newest - 1
        elif newest - self.stamps > self._settled:
            upto = newest - 3 * self.stamps // 4  # many at once: a stamp at a time would cost as much
            self._settle(min(self._head, upto))
            self._settled = max(self._settled, upto)
        self._head = newest

    def _settle(self, upto: int) -> None:
        assert self._settled is not None
        first = self._settled + 1
        while first <= upto:
            start = first & (self.stamps - 1)
            count = min(upto - first + 1, self.stamps - start, max(64, _AT_ONCE // len(self._joined)))
            block = self._arrivals[start : start + count]
            self._judge(first, block)
            block[...] = _LATEST
            first += count
        self._settled = max(self._settled, upto)

    def _judge(self, first: int, block: Ints) -> None:
        """Stamps from slot ``first`` on, arrivals (K, streams): piece by piece in which the same streams are due."""
        joined = [(int(self._joined[stream]), stream) for stream in self._running]
        end = first + len(block)
        cuts = sorted({first, end, *(slot for slot, _ in joined if first < slot < end)})
        for low, high in pairwise(cuts):
            due = [stream for slot, stream in joined if slot <= low]
            if due:
                self._judge_piece(low, block[low - first : high - first, due], due)

    def _judge_piece(self, first: int, block: Ints, due: Sequence[int]) -> None:
        """Stamps whose frames of the streams ``due`` (S) are expected, arrivals (K, S)."""
        number, came = len(due), block != _LATEST
        complete = came.all(1)
        self.counts.stamps += len(block)
        for stream, here in zip(due, came.sum(0).tolist(), strict=True):
            straggler = self.stragglers[stream]
            straggler.expected += len(block)
            straggler.stamps += here
            straggler.missing += len(block) - here
        rows = np.flatnonzero(complete)
        if not rows.size:
            return
        self.counts.complete += len(rows)
        full = block[rows]
        earliest, latest, last = full.min(1), full.max(1), full.argmax(1)
        self.counts.absolute.add(latest - timebase.slot_times_array(rows + first, self.rate))
        self.counts.relative.add(latest - earliest)
        second = np.partition(full, number - 2, axis=1)[:, number - 2] if number > 1 else latest
        cost = latest - second
        alone = cost > 0
        times = np.bincount(last[alone], minlength=number).tolist()
        costs = np.bincount(last[alone], cost[alone], minlength=number).tolist()
        lags = full - earliest[:, None]
        for column, stream in enumerate(due):
            straggler = self.stragglers[stream]
            straggler.last += times[column]
            straggler.cost_ns += round(costs[column])
            straggler.lag.add(lags[:, column])

    def close(self, wait_ns: int) -> None:
        """The end: judge what is left, up to the newest stamp that the slowest stream that still runs has reached."""
        if self._settled is None:
            return
        slack = int(wait_ns * self.rate / timebase.NS) + 1
        heads = self._heads[self._running]
        heads = heads[heads >= self._head - slack]
        self._settle(int(heads.min()) if heads.size else self._head)

    def table(self) -> list[Row]:
        """The streams, most often last first."""
        rows = []
        for name, straggler in zip(self.names, self.stragglers, strict=True):
            low, high = straggler.lag.quantiles_ns((0.5, 0.99))
            share = straggler.last / self.counts.complete if self.counts.complete else None
            cost = ms(straggler.cost_ns / straggler.last) if straggler.last else None
            rows.append(Row(name, share, cost, straggler.missing, ms(low), ms(high)))
        return sorted(rows, key=lambda row: -(row.last_share or 0.0))

    def to_json(self) -> Mapping[str, Any]:
        """Both curves, and the stragglers."""
        counts = self.counts
        return {
            "rate_hz": float(self.rate),
            "stamps": counts.stamps,
            "complete": counts.complete,
            "outside": counts.outside,
            "completeness_vs_wait": curve(counts.absolute, counts.stamps),
            "completeness_vs_relative_wait": curve(counts.relative, counts.stamps),
            "absolute_ms": counts.absolute.summary_ms(),
            "relative_ms": counts.relative.summary_ms(),
            "stragglers": [row._asdict() for row in self.table()],
        }
