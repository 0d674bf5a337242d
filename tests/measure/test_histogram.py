"""The signed log-linear histogram: what it tells of quantiles is as near as it says."""

from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools import loglinear
from pmutools.measure.counts import Tally
from pmutools.measure.histogram import PERCENTILES, Histogram, error_ns

values = st.lists(st.integers(-(10**16), 10**16) | st.integers(-10_000_000, 10_000_000), min_size=1, max_size=200)
bits = st.integers(3, 12)


@given(st.integers(0, 2**53 - 1), bits)
def test_a_number_lies_in_its_bin(value: int, bits: int) -> None:
    index = int(loglinear.bins(np.array([value]), bits)[0])
    assert index == loglinear.bin_of(value, bits)
    assert loglinear.low(index, bits) <= value <= loglinear.high(index, bits)
    assert loglinear.high(index, bits) - loglinear.low(index, bits) <= max(0, value >> bits)


@given(values)
def test_quantiles_are_as_near_as_stated(found: list[int]) -> None:
    histogram = Histogram(found)
    ranked = sorted(found)
    for share in (0.0, 1.0, *PERCENTILES.values()):
        exact = ranked[max(0, math.ceil(share * len(ranked) - 1e-9) - 1)]
        told = histogram.quantile_ns(share)
        assert told is not None
        assert abs(told - exact) <= error_ns(exact) + 1


@given(values, st.integers(0, 200))
def test_lost_frames_rank_last(found: list[int], lost: int) -> None:
    told = Histogram(found).quantile_ns(0.9, lost)
    rank = math.ceil(0.9 * (len(found) + lost) - 1e-9)
    assert (told == math.inf) == (rank > len(found))
    assert Histogram().quantile_ns(0.5) is None
    assert Histogram().quantile_ns(0.5, lost=3) == math.inf


@given(values, values)
def test_merged_is_counted_together(a: list[int], b: list[int]) -> None:
    one, other, both = Histogram(a), Histogram(b), Histogram(a + b)
    one.merge(other)
    assert one == both
    size = max(map(abs, a + b))
    assert one.mean_ns == pytest.approx(both.mean_ns, abs=1e-3 + 1e-12 * size)
    assert one.sd_ns == pytest.approx(both.sd_ns, abs=1e-3 + 1e-7 * size)
    assert other == Histogram(b)


@given(values, st.integers(1, 50))
def test_chunked_is_the_whole(found: list[int], size: int) -> None:
    chunked = Histogram()
    for at in range(0, len(found), size):
        chunked.add(np.array(found[at : at + size]))
    assert chunked == Histogram(found)


def test_moments_and_ends_are_exact() -> None:
    found = np.random.default_rng(1).normal(44e6, 1.3e6, 10_000).astype(np.int64)
    histogram = Histogram(found)
    assert histogram.mean_ns == pytest.approx(found.mean(), rel=1e-12)
    assert histogram.sd_ns == pytest.approx(found.std(), rel=1e-12)
    assert (histogram.min_ns, histogram.max_ns) == (found.min(), found.max())
    assert sum(n for *_, n in histogram.bins()) == 10_000
    told = histogram.summary_ms(lost=2000)
    assert told["p99_expected"] is None
    assert told["p50_expected"] > told["p50"]  # type: ignore[operator]


@given(values, st.integers(-(10**8), 10**8))
def test_at_most_counts_whole_bins(found: list[int], limit: int) -> None:
    histogram = Histogram(found)
    near = sum(abs(value - limit) <= 2 * error_ns(limit) + 1000 for value in found)
    assert abs(histogram.at_most(limit) - sum(value <= limit for value in found)) <= near
    assert histogram.at_most(max(found)) == len(found)
    assert histogram.at_most(min(found) - 1) == 0


def test_memory_does_not_grow_with_wild_values() -> None:
    histogram = Histogram([44_000_000, 63 * 86_400 * 10**9, -5 * 86_400 * 10**9, 0])
    assert not histogram._pages
    assert [n for *_, n in histogram.bins()] == [1, 1, 1, 1]


def test_bins_far_from_most_are_kept_one_by_one_until_they_are_many() -> None:
    usual, stalls = np.arange(16_384_000, 20_480_000, 8000), np.arange(300_000_000, 500_000_000, 4_000_000)
    histogram = Histogram(usual)
    for stall in stalls.tolist():
        histogram.add(np.array([16_384_000, stall]))
    opened = len(histogram._pages)
    assert len(histogram._few) == len(stalls)
    assert histogram == Histogram([*usual.tolist(), *stalls.tolist(), *[16_384_000] * len(stalls)])
    for near in range(300_000_000, 400_000_000, 300_000):
        histogram.add(np.array([near]))
    assert len(histogram._pages) > opened
    assert histogram.count == len(usual) + 2 * len(stalls) + 334 == int(histogram.bins().count.sum())


@given(st.lists(st.integers(0, 10**6), max_size=100), st.lists(st.integers(0, 300), max_size=100))
def test_tallies(a: list[int], b: list[int]) -> None:
    tally = Tally(a)
    tally.merge(Tally(b))
    one_by_one = Tally()
    for value in a + b:
        one_by_one.add_one(value)
    assert tally == Tally(a + b) == one_by_one
    if small := [value for value in a + b if value <= 255]:
        assert sum(n for value, n in tally.items() if value <= 255) == len(small)
        assert tally.at_most(100) == sum(value <= 100 for value in small)
    if a + b:
        assert tally.mean == pytest.approx(np.mean(a + b))


def test_more_than_32_bits_can_count() -> None:
    histogram = Histogram([5_000_000] * 1000 + [7_000_000])
    for _ in range(24):
        histogram.merge(deepcopy(histogram))
    assert histogram.count == 1001 << 24
    assert [n for *_, n in histogram.bins()] == [1000 << 24, 1 << 24]
    histogram.add(np.array([5_000_000, 7_000_000]))
    small = Histogram([1])
    small.merge(histogram)
    assert small.count == (1001 << 24) + 3
    assert small.quantile_ns(0.5) == pytest.approx(5_000_000, abs=error_ns(5_000_000))


@given(st.lists(st.tuples(st.integers(0, 300), st.integers(1, 30_000)), min_size=1, max_size=12))
def test_pages_grow_wider_as_they_fill(batches: list[tuple[int, int]]) -> None:
    spread = np.arange(300) * 1000
    histogram, expected = Histogram(spread), np.ones(301, np.int64)
    expected[300] = 0
    for bin_us, times in batches:
        histogram.add(np.full(times, bin_us * 1000))
        expected[bin_us] += times
    assert [count for *_, count in histogram.bins()] == expected[expected > 0].tolist()
    twice = deepcopy(histogram)
    twice.merge(histogram)
    assert [count for *_, count in twice.bins()] == (2 * expected[expected > 0]).tolist()


def test_a_page_that_holds_little_is_small() -> None:
    kinds = []
    for times in (100, 10_000, 100_000):
        histogram = Histogram(np.arange(200) * 1000)
        histogram.add(np.full(times, 5000))
        kinds.append(histogram._pages[0].itemsize)
    assert kinds == [2, 2, 4]
    assert Histogram(np.arange(200) * 1000)._pages[0].itemsize == 1


def test_edges_of_many_bins_are_those_of_each() -> None:
    values = np.concatenate((np.arange(-3000, 3000) * 1000, np.logspace(6, 17, 500).astype(np.int64)))
    values = np.concatenate((values, -values))
    histogram = Histogram(values)
    for low, high, _ in histogram.bins():
        inside = np.sort(values[(values >= low) & (values <= high)])
        assert len(inside)
    assert sum(count for *_, count in histogram.bins()) == len(values)
    before = list(histogram.bins())
    histogram.add(np.array([10**9]))
    assert list(histogram.bins()) != before  # what was kept is not told again
