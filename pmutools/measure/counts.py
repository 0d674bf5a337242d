"""Counts that add up: of one stream's intervals, of many streams, of two runs.

What a meter has counted is a dataclass of :class:`Counts`; two of them merge field by field, so that the whole is the
sum of its parts, and costs the same memory however long it took.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pmutools import loglinear

C = TypeVar("C", bound="Counts")
LARGEST = {"merge": max}
"""Metadata of a field that holds the largest of what was seen."""


class Counts:
    """Base of dataclasses of numbers, dictionaries of numbers, and of what merges itself."""

    def merge(self, other: Counts) -> None:
        """Add what ``other`` counted; it keeps its own."""
        for item in fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            mine, others = getattr(self, item.name), getattr(other, item.name)
            if "merge" in item.metadata:
                setattr(self, item.name, item.metadata["merge"](mine, others))
            elif isinstance(mine, dict):
                for key, count in others.items():
                    mine[key] = mine.get(key, 0) + count
            elif hasattr(mine, "merge"):
                mine.merge(others)
            else:
                setattr(self, item.name, mine + others)

    def plus(self: C, other: C) -> C:
        """Both together, as another."""
        both = deepcopy(self)
        both.merge(other)
        return both


class Tally:
    """How often each whole number >= 0 came: exact up to 255, to 0.8 % beyond; mean and largest are exact."""

    _BITS = 7

    def __init__(self, values: Iterable[int] = ()) -> None:
        self.count, self.total, self.largest = 0, 0, 0
        self._bins: dict[int, int] = {}
        numbers = np.fromiter(values, np.int64)
        self.add(numbers)

    def add(self, values: npt.NDArray[np.int64]) -> None:
        """Count numbers (N,)."""
        if not values.size:
            return
        self.count += values.size
        self.total += int(values.sum())
        self.largest = max(self.largest, int(values.max()))
        if int(values.min()) == (value := int(values.max())):  # the usual case
            index = loglinear.bin_of(value, self._BITS)
            self._bins[index] = self._bins.get(index, 0) + values.size
            return
        for index, count in zip(*np.unique(loglinear.bins(values, self._BITS), return_counts=True), strict=True):
            self._bins[int(index)] = self._bins.get(int(index), 0) + int(count)

    def add_one(self, value: int, times: int = 1) -> None:
        """Count one number, some times."""
        if times <= 0:
            return
        self.count += times
        self.total += value * times
        self.largest = max(self.largest, value)
        index = loglinear.bin_of(value, self._BITS)
        self._bins[index] = self._bins.get(index, 0) + times

    def merge(self, other: Tally) -> None:
        self.count += other.count
        self.total += other.total
        self.largest = max(self.largest, other.largest)
        for index, count in other._bins.items():
            self._bins[index] = self._bins.get(index, 0) + count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tally) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def mean(self) -> float | None:
        return self.total / self.count if self.count else None

    def at_most(self, value: int) -> int:
        """How many numbers are ``value`` or less."""
        return sum(count for index, count in self._bins.items() if loglinear.low(index, self._BITS) <= value)

    def quantile(self, share: float) -> int | None:
        """The smallest number that at least ``share`` of all do not exceed; None of nothing."""
        wanted = max(1, math.ceil(share * self.count - 1e-9))
        seen = 0
        for index in sorted(self._bins):
            seen += self._bins[index]
            if seen >= wanted:
                return min(loglinear.high(index, self._BITS), self.largest)
        return None

    def items(self) -> list[tuple[int, int]]:
        """(number, count), smallest first."""
        return [(loglinear.low(index, self._BITS), count) for index, count in sorted(self._bins.items())]

    def to_json(self) -> Mapping[str, Any]:
        return {
            "count": self.count,
            "mean": self.mean,
            "p50": self.quantile(0.5),
            "max": self.largest if self.count else None,
            "histogram": [list(item) for item in self.items()],
        }
