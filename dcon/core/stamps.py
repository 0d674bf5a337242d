"""What stamps are worth: whether two are as far apart as their reporting rate says, and how wrong a clock may be."""

from __future__ import annotations

import math
from functools import lru_cache

from dcon.core.params import NS
from pmutools.c37118.constants import stat_pmu_tq, stat_unlocked_time, time_quality_error_ns

_MSG_TQ_ERROR_NS = tuple(math.inf if (ns := time_quality_error_ns(code)) is None else ns for code in range(16))
_PMU_TQ_ERROR_NS = (0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, math.inf)
"""Table 7: worst-case error of PMU_TQ; 0 is a device of 2005 that does not say."""


def clock_error_us(stat: int, time_quality: int) -> float:
    """Worst-case clock error by PMU_TQ and MSG_TQ; infinite where STAT says unlocked for 10 s or more."""
    if stat_unlocked_time(stat) != 0:
        return math.inf
    return max(_MSG_TQ_ERROR_NS[time_quality & 0xF], _PMU_TQ_ERROR_NS[stat_pmu_tq(stat)]) / 1e3


@lru_cache(maxsize=64)
def tolerance_ns(time_base: int) -> int:
    """How far a stamp may be off: 10 µs, or one tick of a FRACSEC that is coarser."""
    return max(10_000, -(-NS // time_base))


def is_apart(before_ns: int, after_ns: int, periods: int, rate_hz: int, time_base: int) -> bool:
    """Whether ``after_ns`` is ``periods`` frame periods past ``before_ns``, within the tolerance."""
    off = (after_ns - before_ns) * rate_hz - periods * NS
    return abs(off) <= tolerance_ns(time_base) * rate_hz
