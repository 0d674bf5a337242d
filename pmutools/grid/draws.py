"""Random numbers by counter: each is a pure function of a seed and of what it is for.

So two PMUs, or two runs that sample in another order, never share or shift each other's noise. The generator is
the finaliser of SplitMix64 (Steele, Lea and Flood 2014) chained over the key; normals by Box and Muller.
"""

from __future__ import annotations

import math

_MASK = (1 << 64) - 1
_GOLDEN = 0x9E37_79B9_7F4A_7C15


def bits(*key: int) -> int:
    """64 random bits of ``key``."""
    state = 0
    for part in key:
        state = (state + _GOLDEN + part) & _MASK
        state = ((state ^ state >> 30) * 0xBF58_476D_1CE4_E5B9) & _MASK
        state = ((state ^ state >> 27) * 0x94D0_49BB_1331_11EB) & _MASK
        state ^= state >> 31
    return state


def uniform(*key: int) -> float:
    """A number in (0, 1), 53 bits."""
    return ((bits(*key) >> 11) + 0.5) * 2.0**-53


def normal(*key: int) -> float:
    """A standard normal number."""
    return math.sqrt(-2.0 * math.log(uniform(*key, 0))) * math.cos(2.0 * math.pi * uniform(*key, 1))
