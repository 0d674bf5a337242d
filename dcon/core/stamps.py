"""Whether two stamps are as far apart as their reporting rate says."""

from __future__ import annotations

from functools import lru_cache

from dcon.core.params import NS


@lru_cache(maxsize=64)
def tolerance_ns(time_base: int) -> int:
    """How far a stamp may be off: 10 µs, or one tick of a FRACSEC that is coarser."""
    return max(10_000, -(-NS // time_base))


def is_apart(before_ns: int, after_ns: int, periods: int, rate_hz: int, time_base: int) -> bool:
    """Whether ``after_ns`` is ``periods`` frame periods past ``before_ns``, within the tolerance."""
    off = (after_ns - before_ns) * rate_hz - periods * NS
    return abs(off) <= tolerance_ns(time_base) * rate_hz
