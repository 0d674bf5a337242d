"""Availability by UTC hour: the table that a completeness report is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from pmutools import timebase
from pmutools.measure.columns import Ints
from pmutools.measure.counts import Counts

_HOUR_S = 3600


def _lower(mine: int | None, other: int | None) -> int | None:
    return min((slot for slot in (mine, other) if slot is not None), default=None)


def _higher(mine: int | None, other: int | None) -> int | None:
    return max((slot for slot in (mine, other) if slot is not None), default=None)


@dataclass
class HourCounts(Counts):
    """Unique frames by the hour of their stamps, counted since 1970; some 100 bytes an hour."""

    received: dict[int, int] = field(default_factory=dict)
    lowest: int | None = field(default=None, metadata={"merge": _lower})
    highest: int | None = field(default=None, metadata={"merge": _higher})
    """Slots."""

    def add(self, slot: Ints, rate: Fraction) -> None:
        """Count frames (N,), N >= 1, by their slots at ``rate`` > 0."""
        low, high = int(slot.min()), int(slot.max())
        self.lowest, self.highest = _lower(self.lowest, low), _higher(self.highest, high)
        per_hour = _HOUR_S * rate
        if low // per_hour == high // per_hour:
            found = {int(low // per_hour): len(slot)}
        else:
            hours = slot * per_hour.denominator // per_hour.numerator
            found = dict(zip(*(column.tolist() for column in np.unique(hours, return_counts=True)), strict=True))
        for hour, count in found.items():
            self.received[hour] = self.received.get(hour, 0) + count

    def to_json(self, rate: Fraction) -> list[dict[str, Any]]:
        """Received and expected frames of each hour from the first to the last that any was received in."""
        if self.lowest is None or self.highest is None or not rate:
            return []
        rows = []
        for hour in sorted(self.received):
            first = max(-(-hour * _HOUR_S * rate // 1), self.lowest)
            last = min(-(-(hour + 1) * _HOUR_S * rate // 1) - 1, self.highest)
            expected, received = int(last - first + 1), self.received[hour]
            rows.append(
                {
                    "utc": timebase.format_utc(hour * _HOUR_S * timebase.NS)[:13] + "Z",
                    "expected": expected,
                    "received": received,
                    "share": min(1.0, received / expected) if expected > 0 else None,
                }
            )
        return rows
