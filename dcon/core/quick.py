"""The uneventful case of a frame, and of all instances, in one go: no check is up, nothing is new but the numbers.

What is written out here says of itself where it does not apply (None); then the tables decide. Its limits lie a hair
inside theirs, so that it passes nothing that a row would not: tests hold the two ways to one result, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from dcon.core.differentiator import Filter
from dcon.core.params import NS, Pair, Params
from dcon.core.stamps import clock_error_us, tolerance_ns
from dcon.core.state import Freq, Instance, Pmu
from dcon.core.thresholds import RING_SIZE
from dcon.core.values import InstanceState, Sample

_HAIR = 1e-9
"""Relative."""
_NS_HAIR = 1000.0
_STAT_BAD: Final = 0xE430
"""Data error, not synchronised, configuration change, unlocked for 10 s or more."""
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time
_READY, _HELD = InstanceState.READY, InstanceState.HELD
_PI, _TURN, _KEPT = math.pi, 2 * math.pi, RING_SIZE - 1


class Limits(NamedTuple):
    """The thresholds, in the units of frames and of instances."""

    law: tuple[float, float, float, float, float, int]
    """a1, a2, b, gain of the low-pass, nominal frequency (Hz), frames/s."""
    arrival: tuple[tuple[bool, ...], float, float, float]
    """Whether a clock is good, by PMU_TQ and MSG_TQ; least and longest latency, longest gap, ns."""
    voltage: tuple[float, float, float, float]
    """Least, most and step, pu; (|V2| / |V1|)²."""
    turning: tuple[float, float, float, float]
    """Change of the angle increment (rad), |f|, its change in a frame, and f against FREQ, Hz."""
    alignment_age_ns: float
    median_mhz: float


def limits_of(params: Params) -> Limits:
    """What is passed at ``params``."""
    limits, c, inside = params.thresholds, params.coefficients, 1 - _HAIR
    clocks = tuple(clock_error_us(code >> 4 << 6, code & 15) <= limits.max_clock_error_us for code in range(128))
    latest_ms = min(limits.latency_warn_ms, limits.latency_max_ms)
    return Limits(
        (c.a1, c.a2, c.b, c.low_pass, params.nominal_hz, params.rate_hz),
        (clocks, limits.latency_min_ms * 1e6 + _NS_HAIR, latest_ms * 1e6 - _NS_HAIR, params.gap_ns - _NS_HAIR),
        (
            limits.voltage_min_pu * (1 + _HAIR),
            limits.voltage_max_pu * inside,
            limits.voltage_step_pu * inside,
            (limits.unbalance_max_percent / 100) ** 2 * inside,
        ),
        (
            math.radians(limits.angle_step_deg) * inside,
            limits.frequency_max_hz * inside,
            limits.rocof_max_hz_s / params.rate_hz * inside,
            limits.freq_max_mhz / 1e3 * inside,
        ),
        limits.alignment_age_ms * 1e6 - _NS_HAIR,
        limits.median_max_mhz * inside,
    )


def next_frame(limits: Limits, base_v: float, last: Pmu, sample: Sample, now_ns: int) -> Pmu | None:
    """``last`` with the only frame of a tick, where it follows the run and every row of PMUs is down."""
    a1, a2, b, low_pass, nominal_hz, rate_hz = limits.law
    clock_is_good, latency_min_ns, latency_max_ns, gap_ns = limits.arrival
    v_min, v_max, v_step, unbalance_2 = limits.voltage
    angle_step, f_max, rocof, freq_max = limits.turning
    time_ns, arrival_ns, v1, frequency_hz, stat, time_quality, time_base, v2 = sample
    slot_before, time_before, _, _, v1_before, magnitude_before, filtered, ring, _, _, freq, _, _ = last
    theta_before, increment_before, f1, f2, frames = filtered
    if frames < 3 or slot_before is None:
        return None
    slot = (time_ns * rate_hz + NS // 2) // NS
    off = (time_ns - time_before) * rate_hz - NS
    if slot != slot_before + 1 or abs(off) > tolerance_ns(time_base) * rate_hz:
        return None
    if stat & _STAT_BAD or not clock_is_good[stat >> 2 & 0x70 | time_quality & 0xF]:
        return None
    if not latency_min_ns <= arrival_ns - time_ns <= latency_max_ns:
        return None
    arrival_ns = min(arrival_ns, now_ns)
    if now_ns - arrival_ns > gap_ns:
        return None

    real, imag = v1.real, v1.imag
    magnitude = math.hypot(real, imag)
    if not 0.0 < magnitude < math.inf:
        return None
    if base_v and not (
        v_min * base_v <= magnitude <= v_max * base_v and abs(magnitude - magnitude_before) <= v_step * base_v
    ):
        return None
    if v2 == v2 and not v2.real * v2.real + v2.imag * v2.imag <= unbalance_2 * magnitude * magnitude:
        return None
    theta = math.atan2(imag, real)
    increment = theta - theta_before
    if increment > _PI:
        increment -= _TURN
    elif increment <= -_PI:
        increment += _TURN
    f = b * (increment + increment_before) + a1 * f1 - a2 * f2
    x = frequency_hz - nominal_hz
    if v1 == v1_before and x != 0.0:
        return None
    x1, x2, y1, y2 = freq
    y = low_pass * (x + 2 * x1 + x2) + a1 * y1 - a2 * y2
    if not (
        abs(increment - increment_before) <= angle_step
        and abs(f) <= f_max
        and abs(f - f1) <= rocof
        and abs(f - y) <= freq_max
    ):
        return None
    turned = _new(Filter, (theta, increment, f, f1, 3))
    smooth = _new(Freq, (x, x1, y, y1))
    ring = (f, *ring[:_KEPT])
    return _new(Pmu, (slot, time_ns, arrival_ns, time_base, v1, magnitude, turned, ring, 0, 0, smooth, (), ()))


def next_instances(
    limits: Limits, pairs: Sequence[Pair], last: Sequence[Instance], pmus: Sequence[Pmu], disabling: int, now_ns: int
) -> tuple[Instance, ...] | None:
    """Every instance after a tick, where all PMUs stand at one new stamp and all instances are READY and agree."""
    slot, time_ns = pmus[0].slot, pmus[0].time_ns
    if slot is None or now_ns - time_ns > limits.alignment_age_ns:
        return None
    newest = []
    for pmu in pmus:
        if pmu.slot != slot or pmu.time_ns != time_ns or not pmu.ring or pmu.raised & disabling:
            return None
        newest.append(pmu.ring[0])
    after = []
    least, most = math.inf, -math.inf
    for (north, south), (state, verified, slot_before, _, reason, raised, _, _) in zip(pairs, last, strict=True):
        if raised or (state is not _READY and state is not _HELD) or slot_before is None or slot <= slot_before:
            return None
        delta_f_mhz = (newest[north] - newest[south]) * 1e3
        if delta_f_mhz < least:
            least = delta_f_mhz
        if delta_f_mhz > most:
            most = delta_f_mhz
        after.append(_new(Instance, (_READY, verified + slot - slot_before, slot, delta_f_mhz, reason, 0, (), ())))
    return tuple(after) if most - least <= limits.median_mhz else None
