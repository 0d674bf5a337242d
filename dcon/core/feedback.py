"""What the supervisor remembers of the feedback command: saturation, ringing, growth, bias. Never of a probing signal.

Kept in ACTIVE, begun anew with each. All of it is scalar ``math`` on small tuples.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dcon.core.bands import Memory, passed
from dcon.core.params import Params

HALF_CYCLES: Final = 7
"""Peaks of half cycles kept: three cycles and the one before."""


class Feedback(NamedTuple):
    """Memory between ticks."""

    ticks: int = 0
    """Since ACTIVE was entered."""
    saturated: int = 0
    """Bit k: the command was at its limit k ticks ago."""
    ringing: Memory = ()
    ringing_mw2: float = 0.0
    """Mean square in the band of ringing."""
    swing: Memory = ()
    half_mw: float = 0.0
    """Largest value of the swing since it last crossed 0, with its sign."""
    peaks_mw: tuple[float, ...] = ()
    """Of past half cycles, newest first."""
    second_mw: float = 0.0
    """Sum of the second under way."""
    means_mw: tuple[float, ...] = ()
    """Of whole seconds, newest first."""


QUIET: Final = Feedback()


def watched(params: Params, last: Feedback, command_mw: float, asked_mw: float) -> Feedback:
    """The memory after a tick in ACTIVE with ``command_mw``.

    ``asked_mw`` is what the control law asked for before any limit: a swing that saturates has harmonics in the band
    of ringing, and does not ring.
    """
    limits, bands, tick_hz = params.thresholds, params.bands, params.tick_hz
    ticks = last.ticks + 1
    window = (1 << round(limits.saturation_s * tick_hz)) - 1
    at_limit = abs(command_mw) >= params.limit_mw > 0
    ring_mw, ringing = passed(bands.ringing, last.ringing, asked_mw)
    swing_mw, swing = passed(bands.swing, last.swing, command_mw)
    half_mw, peaks = last.half_mw, last.peaks_mw
    if swing_mw * half_mw < 0:
        peaks = (abs(half_mw), *peaks[: HALF_CYCLES - 1])
        half_mw = swing_mw
    elif abs(swing_mw) > abs(half_mw):
        half_mw = swing_mw
    second_mw, means = last.second_mw + command_mw, last.means_mw
    if ticks % tick_hz == 0:
        means = (second_mw / tick_hz, *means[: round(limits.bias_s) - 1])
        second_mw = 0.0
    return Feedback(
        ticks,
        (last.saturated << 1 | at_limit) & window,
        ringing,
        last.ringing_mw2 + bands.forget * (ring_mw * ring_mw - last.ringing_mw2),
        swing,
        half_mw,
        peaks,
        second_mw,
        means,
    )


def saturated_percent(params: Params, memory: Feedback) -> float:
    """Share of the last ``saturation_s`` that the command spent at its limit."""
    return 100 * memory.saturated.bit_count() / round(params.thresholds.saturation_s * params.tick_hz)


def ringing_mw(memory: Feedback) -> float:
    """RMS in the band of ringing."""
    return math.sqrt(memory.ringing_mw2)


def growth(params: Params, memory: Feedback) -> float | None:
    """How much a swing grew over three cycles, by the cycle that grew least; None where it is not large enough.

    A disturbance, or a test signal at resonance, grows fast at first and then less; a loop that is unstable does not.
    """
    peaks = memory.peaks_mw
    if len(peaks) < HALF_CYCLES or peaks[-1] < params.thresholds.growth_min_mw:
        return None
    return float(min(peaks[k] / peaks[k + 2] for k in range(HALF_CYCLES - 2)) ** 3)


def bias_mw(params: Params, memory: Feedback) -> float | None:
    """|mean| over the last ``bias_s``; None before so much time has passed."""
    seconds = round(params.thresholds.bias_s)
    return abs(math.fsum(memory.means_mw)) / seconds if len(memory.means_mw) == seconds else None
