"""Completeness against wait, of one stream and over all, and who was last."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from support.measured import MS, START_NS, measured, stamps

from pmutools.measure.completeness import Alignment, curve
from pmutools.measure.histogram import Histogram
from pmutools.timebase import slots_array

RATE = Fraction(60)


def arrivals(delays_ms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    times = stamps(range(len(delays_ms)))
    return slots_array(times, RATE), times + (delays_ms * MS).astype(np.int64)


def test_curve_of_one_stream_never_reaches_the_lost() -> None:
    delays = Histogram((np.linspace(10, 30, 900) * MS).astype(np.int64))
    told = curve(delays, 1000)
    assert told[0][0] == pytest.approx(10, rel=1e-3)
    assert told[-1] == [pytest.approx(30, rel=1e-3), 0.9]
    assert all(a[0] < b[0] and a[1] <= b[1] for a, b in pairwise(told))
    assert curve(delays, 1000, (20.0, 100.0)) == [[20.0, pytest.approx(0.45, abs=0.002)], [100.0, 0.9]]
    assert curve(Histogram(), 10) == []


@pytest.mark.parametrize("size", [7, 1000, 3000])
def test_stragglers(size: int) -> None:
    """C is 5 ms behind the others, and misses every 100th; B comes when A does."""
    alignment = Alignment(("A", "B", "C"), RATE)
    count = 3000
    for at in range(0, count, size):
        for stream, delay in enumerate((20.0, 20.0, 25.0)):
            slot, arrival = arrivals(np.full(count, delay))
            chosen = np.arange(at, min(at + size, count))
            if stream == 2:
                chosen = chosen[chosen % 100 != 99]
            alignment.add(stream, slot[chosen], arrival[chosen])
    alignment.close(200 * MS)
    counts = alignment.counts
    assert (counts.stamps, counts.complete, counts.outside) == (2999, 2970, 0)  # C never reached the last
    assert counts.absolute.quantile_ns(0.5) == pytest.approx(25 * MS, rel=1e-3)
    assert counts.relative.min_ns == counts.relative.max_ns == 5 * MS
    first, *others = alignment.table()
    assert (first.name, first.last_share, first.missing) == ("C", 1.0, 29)
    assert first.cost_ms == pytest.approx(5.0)
    assert [row.last_share for row in others] == [0.0, 0.0]
    told = alignment.to_json()
    assert told["completeness_vs_wait"][-1][1] == pytest.approx(2970 / 2999)


def test_memory_is_bounded_and_what_falls_out_is_counted() -> None:
    alignment = Alignment(("A", "B"), RATE, budget_bytes=1024)
    assert alignment.stamps == 64
    slot, arrival = arrivals(np.full(1000, 20.0))
    alignment.add(0, slot, arrival)
    alignment.add(1, slot, arrival)
    alignment.close(200 * MS)
    assert alignment._arrivals.nbytes == 1024
    assert alignment.counts.outside > 900
    assert alignment.counts.stamps == 1000


def test_a_stream_that_joins_late_is_not_missed_before() -> None:
    alignment = Alignment(("A", "B"), RATE)
    slot, arrival = arrivals(np.full(1000, 20.0))
    alignment.add(0, slot, arrival)
    alignment.add(1, slot[500:], arrival[500:])
    alignment.close(200 * MS)
    assert (alignment.counts.complete, alignment.counts.stamps) == (1000, 1000)
    assert alignment.stragglers[1].missing == 0


@pytest.mark.parametrize("budget_bytes", [32 << 20, 4096])
def test_streams_join_and_leave_while_it_runs(budget_bytes: int) -> None:
    """One more every 50 stamps, 5 ms later than all before; the first leaves."""
    alignment = Alignment((), RATE, budget_bytes)
    slot, arrival = arrivals(np.full(500, 20.0))
    for at in range(500):
        if at % 50 == 0:
            assert alignment.join(f"S{at // 50}") == at // 50
        if at == 450:
            alignment.leave(0)
        for stream in range(int(at >= 450), at // 50 + 1):
            alignment.add(stream, slot[at : at + 1], arrival[at : at + 1] + stream * 5 * MS)
    alignment.close(0)
    counts = alignment.counts
    assert alignment._arrivals.nbytes <= max(budget_bytes, 64 * 8 * 16)
    assert counts.outside == 0
    assert counts.complete == counts.stamps >= 450  # in the first 50 there was but the stream that left
    assert counts.absolute.max_ns == 65 * MS and alignment.stragglers[0].expected <= 450
    assert sum(straggler.missing for straggler in alignment.stragglers) == 0


def test_a_silence_of_all_and_a_set_clock_cost_nothing() -> None:
    alignment = Alignment(("A",), RATE)
    slot, arrival = arrivals(np.full(100, 20.0))
    alignment.add(0, slot, arrival)
    alignment.add(0, slot + 10**9, arrival)
    alignment.close(200 * MS)
    assert alignment.counts.stamps == 200


def test_it_takes_what_the_meter_tells() -> None:
    from support.measured import batch, config

    from pmutools.measure.stream import Identity, StreamMeter

    alignment = Alignment(("A",), RATE)
    meter = StreamMeter(Identity("A", 1), config())
    frames = batch(stamps([0, 1, 1, 2, 3]), 20.0)
    for seen in (*meter.add(frames), *meter.drain()):
        alignment.add(0, *seen.unique())
    alignment.close(200 * MS)
    assert alignment.counts.complete == 4
    assert measured(frames).counts.slots.received == 4
    assert frames.time_ns[0] == START_NS


def test_nobody_is_last_in_a_tie() -> None:
    alignment = Alignment(("A", "B"), RATE)
    for stream in (0, 1):
        alignment.add(stream, *arrivals(np.full(100, 20.0)))
    alignment.close(200 * MS)
    assert [row.last_share for row in alignment.table()] == [0.0, 0.0]
    assert alignment.counts.relative.max_ns == 0
