"""Quantiles of any number of durations in little memory: a signed log-linear histogram.

Values are int64 nanoseconds, negative ones too: a delay below zero is a clock's error and must not be lost. Bins are
1 µs wide to ±2.048 ms, then 1024 an octave, so that a quantile is wrong by at most 0.5 µs or 0.05 % of itself,
whichever is more (:func:`error_ns`). Count, mean, standard deviation, least and largest are exact.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools import loglinear

BITS = 10
RESOLUTION_NS = 1000
NS_PER_MS = 1e6
PERCENTILES = {
    "p1": 0.01,
    "p5": 0.05,
    "p25": 0.25,
    "p50": 0.5,
    "p75": 0.75,
    "p90": 0.9,
    "p95": 0.95,
    "p99": 0.99,
    "p99_9": 0.999,
}
"""Those that every distribution is told by, by the key they have in ``summary.json``."""
_PAGE_BITS = 8
_PAGE = 1 << _PAGE_BITS
_TYPES = {np.dtype(kind): int(np.iinfo(kind).max) for kind in (np.uint8, np.uint16, np.uint32, np.int64)}
"""What a page may be of, from narrow to wide, and how much each counts: the tail's many pages hold little."""
_DENSE = 1 << 14
"""A batch that spans more bins is sorted rather than counted in an array."""
_FEW = 48
"""Fewer bins of a page than so many are kept one by one, 12 bytes each."""
_LOOKED_FROM = 128
"""So many bins kept one by one are looked through for pages that have become worth it."""

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """The bins that hold anything, in order: from ``low_ns`` up to below ``high_ns``, each (B,)."""

    low_ns: Ints
    high_ns: Ints
    count: Ints

    def __iter__(self) -> Iterator[tuple[int, int, int]]:
        """(low, high, count) of each."""
        return zip(self.low_ns.tolist(), self.high_ns.tolist(), self.count.tolist(), strict=True)


def error_ns(value_ns: float) -> float:
    """By how much a quantile that is told as ``value_ns`` may be wrong."""
    return max(RESOLUTION_NS / 2, abs(value_ns) / (2 << BITS))


class Histogram:
    """How often each duration came. ``merge`` of two is the histogram of all their values, to the last count."""

    __slots__ = (
        "_few",
        "_few_counts",
        "_few_most",
        "_kept",
        "_m2",
        "_mean",
        "_pages",
        "_totals",
        "count",
        "max_ns",
        "min_ns",
    )

    def __init__(self, values_ns: npt.ArrayLike = ()) -> None:
        self.count = 0
        self.min_ns: int | None = None
        self.max_ns: int | None = None
        self._mean, self._m2 = 0.0, 0.0
        self._pages: dict[int, npt.NDArray[Any]] = {}
        self._totals: dict[int, int] = {}
        """How much a page has counted."""
        self._few, self._few_counts = array("i"), array("q")
        """Bins far from most, in order: a stall that delays a frame of each of many streams must not open pages."""
        self._few_most = _LOOKED_FROM
        self._kept: tuple[Ints, Ints, Ints] | None = None
        """What :meth:`_filled` found since the last value came, and the sums of its counts."""
        self.add(np.asarray(values_ns, np.int64))

    def add(self, values_ns: Ints) -> None:
        """Count values (N,)."""
        if not values_ns.size:
            return
        low, high = int(values_ns.min()), int(values_ns.max())
        middle = low + (high - low) // 2
        off = (values_ns - middle).astype(np.float64)
        mean = float(off.mean())
        off -= mean
        self._combine(values_ns.size, middle + mean, float(off @ off), low, high)
        indices = _indices(values_ns)
        first, last = _index(low), _index(high)
        if last - first < _DENSE:
            base = first & -_PAGE
            counts = np.bincount(indices - base, minlength=(last | _PAGE - 1) + 1 - base)
            pages = counts.reshape(-1, _PAGE)
            for at, total in enumerate(pages.sum(1).tolist()):
                number = (base >> _PAGE_BITS) + at
                if not total:
                    continue
                if number in self._pages:
                    page = self._page(number, total)
                    page += pages[at].astype(page.dtype)
                else:
                    bins = np.flatnonzero(pages[at])
                    self._count(number, bins, pages[at][bins])
            return
        found, counts = np.unique(indices, return_counts=True)
        self._count_all(found, counts)

    def _count_all(self, indices: Ints, counts: Ints) -> None:
        """Add to bins (B,), in order."""
        if not len(indices):
            return
        numbers = indices >> _PAGE_BITS
        for here in np.split(np.arange(len(indices)), np.flatnonzero(np.diff(numbers)) + 1):
            self._count(int(numbers[here[0]]), indices[here] & _PAGE - 1, counts[here])

    def _count(self, number: int, bins: Ints, counts: Ints) -> None:
        """Add to bins (B,) of a page, on the page or, where there is none and B is small, one by one."""
        if number not in self._pages and len(bins) < _FEW:
            first = number << _PAGE_BITS
            for at, count in zip(bins.tolist(), counts.tolist(), strict=True):
                self._count_one(first + at, count)
            if len(self._few) > self._few_most:
                self._open_pages()
            return
        page = self._page(number, int(counts.sum()))
        page[bins] += counts.astype(page.dtype)

    def _page(self, number: int, more: int) -> npt.NDArray[Any]:
        """The page to count ``more`` on: a new one has what was kept one by one of it."""
        page = self._pages.get(number)
        first = number << _PAGE_BITS
        if page is None:
            start, end = (bisect_left(self._few, edge) for edge in (first, first + _PAGE))
            indices, counts = self._few[start:end], self._few_counts[start:end]
            del self._few[start:end], self._few_counts[start:end]
            total = self._totals[number] = sum(counts) + more
            page = self._pages[number] = np.zeros(_PAGE, _wide_enough(total))
            page[np.array(indices, np.int64) - first] = counts
            return page
        total = self._totals[number] = self._totals[number] + more
        if total > _TYPES[page.dtype]:
            page = self._pages[number] = page.astype(_wide_enough(total))
        return page

    def _count_one(self, index: int, count: int) -> None:
        number = index >> _PAGE_BITS
        if number in self._pages:
            self._page(number, count)[index & _PAGE - 1] += count
            return
        place = bisect_left(self._few, index)
        if place < len(self._few) and self._few[place] == index:
            self._few_counts[place] += count
        else:
            self._few.insert(place, index)
            self._few_counts.insert(place, count)

    def _open_pages(self) -> None:
        """Open the pages of bins kept one by one that have become many."""
        indices, counts = self._kept_singly()
        numbers, sizes = np.unique(indices >> _PAGE_BITS, return_counts=True)
        many = np.isin(indices >> _PAGE_BITS, numbers[sizes >= _FEW])
        self._keep_singly(indices[~many], counts[~many])
        self._count_all(indices[many], counts[many])
        self._few_most = _LOOKED_FROM + 2 * len(self._few)

    def _kept_singly(self) -> tuple[Ints, Ints]:
        return np.array(self._few, np.int64), np.array(self._few_counts, np.int64)

    def _keep_singly(self, indices: Ints, counts: Ints) -> None:
        self._few = array("i", indices.astype(np.intc).tobytes())
        self._few_counts = array("q", counts.astype(np.int64).tobytes())

    def _combine(self, count: int, mean: float, m2: float, low: int, high: int) -> None:
        """Take in the moments of ``count`` more values (Chan, Golub and LeVeque 1979)."""
        total = self.count + count
        self._kept = None
        step = mean - self._mean if self.count else 0.0
        self._m2 += m2 + step * step * (self.count * count / total)
        self._mean = self._mean + step * (count / total) if self.count else mean
        self.min_ns = low if self.min_ns is None else min(self.min_ns, low)
        self.max_ns = high if self.max_ns is None else max(self.max_ns, high)
        self.count = total

    def merge(self, other: Histogram) -> None:
        """Add all that ``other`` counted."""
        if other.min_ns is None or other.max_ns is None:
            return
        first = not self.count
        self._combine(other.count, other._mean, other._m2, other.min_ns, other.max_ns)
        if first:
            self._pages = {number: page.copy() for number, page in other._pages.items()}
            self._totals = dict(other._totals)
            self._few, self._few_counts, self._few_most = other._few[:], other._few_counts[:], other._few_most
            return
        for number, page in other._pages.items():
            mine = self._page(number, other._totals[number])
            mine += page.astype(mine.dtype)
        indices, counts = other._kept_singly()
        on_page = np.isin(indices >> _PAGE_BITS, list(self._pages))
        self._count_all(indices[on_page], counts[on_page])
        mine, my_counts = self._kept_singly()
        few, places = np.unique(np.concatenate((mine, indices[~on_page])), return_inverse=True)
        sums = np.zeros(len(few), np.int64)
        np.add.at(sums, places, np.concatenate((my_counts, counts[~on_page])))
        self._keep_singly(few, sums)
        if len(self._few) > self._few_most:
            self._open_pages()

    def __eq__(self, other: object) -> bool:
        """Whether both counted the same in every bin; means may differ in their last bits."""
        if not isinstance(other, Histogram):
            return NotImplemented
        return (self.count, self.min_ns, self.max_ns) == (other.count, other.min_ns, other.max_ns) and all(
            np.array_equal(mine, others) for mine, others in zip(self._filled(), other._filled(), strict=True)
        )

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def mean_ns(self) -> float | None:
        return self._mean if self.count else None

    @property
    def sd_ns(self) -> float | None:
        """Standard deviation of the population."""
        return math.sqrt(self._m2 / self.count) if self.count else None

    def bins(self) -> Bins:
        """What is in the histogram."""
        indices, counts, _ = self._filled()
        size = np.abs(indices)
        near = loglinear.lows(size, BITS) * RESOLUTION_NS - RESOLUTION_NS // 2
        far = (loglinear.lows(size + 1, BITS) - 1) * RESOLUTION_NS + RESOLUTION_NS // 2
        below = indices < 0
        return Bins(np.where(below, -far, near), np.where(below, -near, far), counts)

    def _filled(self) -> tuple[Ints, Ints, Ints]:
        """Indices of the bins that hold anything, their counts, and the sums of these."""
        if self._kept is None:
            indices, counts = self._found()
            self._kept = indices, counts, np.cumsum(counts)
        return self._kept

    def _found(self) -> tuple[Ints, Ints]:
        few, few_counts = self._kept_singly()
        if not self._pages:
            return few, few_counts
        numbers = sorted(self._pages)
        counts = np.concatenate([self._pages[number] for number in numbers]).astype(np.int64)
        indices = (np.array(numbers)[:, None] * _PAGE + np.arange(_PAGE)).reshape(-1)
        filled = counts > 0
        indices, counts = indices[filled], counts[filled]
        places = np.searchsorted(indices, few)
        return np.insert(indices, places, few), np.insert(counts, places, few_counts)

    def quantile_ns(self, share: float, lost: int = 0) -> float | None:
        """The smallest value that at least ``share`` of all do not exceed (the nearest rank, as in RFC 2330).

        ``lost`` frames rank behind all others with an infinite delay, as RFC 7679 has it: then infinity is an answer.
        None of nothing.
        """
        return self.quantiles_ns((share,), lost)[0]

    def quantiles_ns(self, shares: tuple[float, ...], lost: int = 0) -> list[float | None]:
        """:meth:`quantile_ns` of several shares."""
        if not self.count + lost:
            return [None] * len(shares)
        indices, _, seen = self._filled()
        found: list[float | None] = []
        for share in shares:
            rank = max(1, math.ceil(share * (self.count + lost) - 1e-9))
            if rank > self.count:
                found.append(math.inf)
            elif rank == 1:
                found.append(self.min_ns)
            elif rank == self.count:
                found.append(self.max_ns)
            else:
                found.append(self._middle_ns(int(indices[np.searchsorted(seen, rank)])))
        return found

    def _middle_ns(self, index: int) -> float:
        assert self.min_ns is not None and self.max_ns is not None
        low, high = _edges(index)
        return min(max((low + high) // 2, self.min_ns), self.max_ns)

    def at_most(self, value_ns: float) -> float:
        """How many values do not exceed ``value_ns``; within its bin, in proportion."""
        return float(self.at_most_array(np.array([value_ns]))[0])

    def at_most_array(self, values_ns: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """:meth:`at_most` of values (V,)."""
        if self.min_ns is None or self.max_ns is None:
            return np.zeros(len(values_ns))
        bins = self.bins()
        low, high, count = bins.low_ns, bins.high_ns, bins.count
        edges = np.stack((np.maximum(low, self.min_ns), np.minimum(high, self.max_ns)), 1).reshape(-1)
        seen = np.stack((np.cumsum(count) - count, np.cumsum(count)), 1).reshape(-1)
        found = np.interp(values_ns, edges, seen, left=0.0)
        return np.where(values_ns >= self.max_ns, self.count, np.where(values_ns < self.min_ns, 0.0, found))

    def summary_ms(self, lost: int | None = None) -> dict[str, float | int | None]:
        """Count, mean, sd, least, percentiles and largest in ms, by the keys of ``summary.json``.

        With ``lost``, also percentiles among all that were expected, as ``p99_expected``; null where infinite.
        """
        found = dict(zip(PERCENTILES, self.quantiles_ns(tuple(PERCENTILES.values())), strict=True))
        told: dict[str, float | int | None] = {
            "mean": ms(self.mean_ns),
            "sd": ms(self.sd_ns),
            "min": ms(self.min_ns),
            **{key: ms(value) for key, value in found.items()},
            "max": ms(self.max_ns),
            "count": self.count,
        }
        if lost is not None:
            ranked = zip(PERCENTILES, self.quantiles_ns(tuple(PERCENTILES.values()), lost), strict=True)
            told |= {f"{key}_expected": ms(value) for key, value in ranked}
        return told

    def to_json(self) -> dict[str, Any]:
        """All of it: the bins as [low ms, high ms, count]."""
        return {"count": self.count, "bins": [[low / NS_PER_MS, high / NS_PER_MS, n] for low, high, n in self.bins()]}


def _wide_enough(total: int) -> np.dtype[Any]:
    return next(kind for kind, most in _TYPES.items() if total <= most)


def ms(value_ns: float | None) -> float | None:
    """Milliseconds of a number that JSON can hold: null where there is none, or no end."""
    return None if value_ns is None or not math.isfinite(value_ns) else value_ns / NS_PER_MS


def _indices(values_ns: Ints) -> Ints:
    """Signed bins: 0 is what rounds to 0 µs, and bins ±i are alike."""
    size = np.abs(values_ns)
    size += RESOLUTION_NS // 2
    size //= RESOLUTION_NS
    found = loglinear.bins(size, BITS)
    if values_ns.min() < 0:
        found = np.where(values_ns < 0, -found, found)
    return found


def _index(value_ns: int) -> int:
    """:func:`_indices` of one value."""
    index = loglinear.bin_of((abs(value_ns) + RESOLUTION_NS // 2) // RESOLUTION_NS, BITS)
    return index if value_ns >= 0 else -index


def _edges(index: int) -> tuple[int, int]:
    """Lower and upper edge of a bin in ns."""
    low, high = loglinear.low(abs(index), BITS), loglinear.high(abs(index), BITS)
    near, far = low * RESOLUTION_NS - RESOLUTION_NS // 2, high * RESOLUTION_NS + RESOLUTION_NS // 2
    return (near, far) if index >= 0 else (-far, -near)
