"""Band-pass filters at the rate of the ticks, by which the supervisor judges the command.

Butterworth sections, designed by the prewarped bilinear transform in scalar ``math``: the last bit of what they give
is the same on every processor of a platform.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from dcon.core.thresholds import Thresholds

HIGHEST = 0.4
"""No edge may be above this share of the tick rate: near half of it, the transform bends a filter out of shape."""
_Q2 = math.sqrt(0.5)
_Q4 = (0.5411961001461969, 1.3065629648763766)
"""Quality of the section(s) of a Butterworth filter of second and of fourth order."""


class Section(NamedTuple):
    """H(z) = (b0 + b1 z⁻¹ + b2 z⁻²) / (1 + a1 z⁻¹ + a2 z⁻²)."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


Band = tuple[Section, ...]
"""Sections in cascade."""
Memory = tuple[float, ...]
"""Two numbers a section."""


def low_pass(edge_hz: float, rate_hz: float, q: float = _Q2) -> Section:
    """Of second order."""
    k = math.tan(math.pi * edge_hz / rate_hz)
    d = 1 + k / q + k * k
    b = k * k / d
    return Section(b, 2 * b, b, 2 * (k * k - 1) / d, (1 - k / q + k * k) / d)


def high_pass(edge_hz: float, rate_hz: float, q: float = _Q2) -> Section:
    """Of second order."""
    k = math.tan(math.pi * edge_hz / rate_hz)
    d = 1 + k / q + k * k
    return Section(1 / d, -2 / d, 1 / d, 2 * (k * k - 1) / d, (1 - k / q + k * k) / d)


class Bands(NamedTuple):
    """What the command is looked at through."""

    ringing: Band
    """Fourth order below, second above."""
    swing: Band
    forget: float
    """Weight of a tick in the mean square of the ringing."""


def bands_of(limits: Thresholds, tick_hz: int) -> Bands:
    """The filters for ``limits`` at ``tick_hz``."""
    steep = [high_pass(limits.ringing_low_hz, tick_hz, q) for q in _Q4]
    ringing = (*steep, low_pass(limits.ringing_high_hz, tick_hz))
    swing = (high_pass(limits.growth_low_hz, tick_hz), low_pass(limits.growth_high_hz, tick_hz))
    return Bands(ringing, swing, 1 - math.exp(-1 / (limits.ringing_rms_s * tick_hz)))


def passed(band: Band, memory: Memory, value: float) -> tuple[float, Memory]:
    """The band's output for one more ``value``, and its memory after it; ``()`` is the memory before the first."""
    after: list[float] = []
    for at, (b0, b1, b2, a1, a2) in enumerate(band):
        s1, s2 = memory[2 * at : 2 * at + 2] if memory else (0.0, 0.0)
        out = b0 * value + s1
        after += (b1 * value - a1 * out + s2, b2 * value - a2 * out)
        value = out
    return value, tuple(after)
