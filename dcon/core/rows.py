"""The checks that the controller cannot do without: rows of :class:`~dcon.core.checks.Supervisor`.

Comparisons are written so that NaN raises the check. A frame that fails its CRC, size or IDCODE never gets here: it
is missing, and shows as a wrong stamp step or as a gap.
"""

from __future__ import annotations

import math

from dcon.core.checks import Action, Check, FrameTest, InstanceTest, PmuTest, Scope, Supervisor, SystemTest, SystemView
from dcon.core.params import NS, Params, PmuParams
from dcon.core.stamps import tolerance_ns
from dcon.core.state import Pmu
from dcon.core.values import Sample
from pmutools.c37118.constants import STAT_DATA_ERROR_MASK, Stat, stat_pmu_tq, stat_unlocked_time, time_quality_error_ns

_NOT_SYNCHRONISED = int(Stat.NOT_SYNCHRONISED)
_CONFIG_CHANGE = int(Stat.CONFIG_CHANGE)
_MSG_TQ_ERROR_NS = tuple(math.inf if (ns := time_quality_error_ns(code)) is None else ns for code in range(16))
_PMU_TQ_ERROR_NS = (0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, math.inf)
"""Table 7: worst-case error of PMU_TQ; 0 is a device of 2005 that does not say."""


def not_finite(_params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> bool:
    return not new.magnitude_v < math.inf


def stat_error(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> bool:
    return sample.stat & STAT_DATA_ERROR_MASK != 0


def not_synchronised(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> bool:
    return sample.stat & _NOT_SYNCHRONISED != 0


def config_change(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> bool:
    return sample.stat & _CONFIG_CHANGE != 0


def time_quality(params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> bool:
    if sample.stat == 0 and sample.time_quality & 0xF == 0:
        return False
    limit_ns = params.thresholds.max_clock_error_us * 1e3
    return (
        _MSG_TQ_ERROR_NS[sample.time_quality & 0xF] > limit_ns
        or _PMU_TQ_ERROR_NS[stat_pmu_tq(sample.stat)] > limit_ns
        or stat_unlocked_time(sample.stat) != 0
    )


def latency_high(params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> bool:
    return sample.arrival_ns - sample.time_ns > params.thresholds.latency_warn_ms * 1e6


def latency(params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> bool:
    limits = params.thresholds
    return not limits.latency_min_ms * 1e6 <= sample.arrival_ns - sample.time_ns <= limits.latency_max_ms * 1e6


def voltage(params: Params, pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> bool:
    base, limits = pmu.base_v, params.thresholds
    return base > 0 and not limits.voltage_min_pu * base <= new.magnitude_v <= limits.voltage_max_pu * base


def voltage_step(params: Params, pmu: PmuParams, last: Pmu, new: Pmu, _sample: Sample) -> bool:
    base = pmu.base_v
    if base == 0 or new.filter.frames < 2:
        return False
    return not abs(new.magnitude_v - last.magnitude_v) <= params.thresholds.voltage_step_pu * base


def angle_step(params: Params, _pmu: PmuParams, last: Pmu, new: Pmu, _sample: Sample) -> bool:
    if new.filter.frames < 3:
        return False
    surprise = new.filter.increment_rad - last.filter.increment_rad
    return not abs(surprise) <= math.radians(params.thresholds.angle_step_deg)


def frequency(params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> bool:
    return new.filter.frames == 3 and not abs(new.filter.f_hz) <= params.thresholds.frequency_max_hz


def rocof(params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> bool:
    if new.filter.frames < 3:
        return False
    return not abs(new.filter.f_hz - new.filter.f_before_hz) * params.rate_hz <= params.thresholds.rocof_max_hz_s


def no_data(_params: Params, pmu: Pmu, _now_ns: int) -> bool:
    return pmu.arrival_ns is None


def arrival_gap(params: Params, pmu: Pmu, now_ns: int) -> bool:
    if pmu.arrival_ns is None:
        return False
    # A clock that is set back must not hide a silence: count the ticks as well.
    return now_ns - pmu.arrival_ns > params.gap_ns or (pmu.idle_ticks - 1) * NS > params.gap_ns * params.tick_hz


def alignment_age(params: Params, north: Pmu, south: Pmu, now_ns: int) -> bool:
    return now_ns - min(north.time_ns, south.time_ns) > params.thresholds.alignment_age_ms * 1e6


def alignment_skew(params: Params, north: Pmu, south: Pmu, _now_ns: int) -> bool:
    if north.slot is None or south.slot is None:
        return False
    return abs(north.slot - south.slot) > params.thresholds.alignment_skew_frames


def stamps_differ(params: Params, north: Pmu, south: Pmu, _now_ns: int) -> bool:
    if north.slot is None or south.slot is None or (north.slot == south.slot and north.time_ns == south.time_ns):
        return False
    apart = (north.time_ns - south.time_ns) * params.rate_hz - (north.slot - south.slot) * NS
    return abs(apart) > tolerance_ns(min(north.time_base, south.time_base)) * params.rate_hz


def no_ready_instance(_params: Params, view: SystemView) -> bool:
    return view.ready == 0


def frequency_difference(params: Params, view: SystemView) -> bool:
    return view.active is not None and not abs(view.active.delta_f_mhz) <= params.thresholds.delta_f_max_mhz


_DISABLE_PMU = (Scope.PMU, Action.DISABLE)

CORE = Supervisor(
    engine=(
        Check("stamp_step", *_DISABLE_PMU, None, "a frame was lost or came out of order"),
        Check("stale_frame", Scope.PMU, Action.WARN, None, "a frame no newer than the last was ignored"),
        Check("interpolated", Scope.PMU, Action.WARN, None, "one lost frame was bridged by its midpoint"),
        Check("slew_limited", Scope.SYSTEM, Action.WARN, None, "the slew backstop held the command"),
        Check("command_invalid", Scope.SYSTEM, Action.TRIP, None, "the computed command is no number"),
        Check("internal_error", Scope.SYSTEM, Action.TRIP, None, "the controller failed on this tick's input"),
    ),
    frame=(
        Check[FrameTest]("not_finite", *_DISABLE_PMU, not_finite, "V1 is absent"),
        Check[FrameTest]("stat_error", *_DISABLE_PMU, stat_error, "STAT: data error, test mode or filler"),
        Check[FrameTest]("not_synchronised", *_DISABLE_PMU, not_synchronised, "STAT: PMU lost its time source"),
        Check[FrameTest]("config_change", *_DISABLE_PMU, config_change, "STAT: the configuration is to change"),
        Check[FrameTest]("time_quality", *_DISABLE_PMU, time_quality, "the PMU's clock is too uncertain"),
        Check[FrameTest]("latency_high", Scope.PMU, Action.WARN, latency_high, "frames arrive late"),
        Check[FrameTest]("latency", *_DISABLE_PMU, latency, "frames arrive too late, or before their time"),
        Check[FrameTest]("voltage", *_DISABLE_PMU, voltage, "|V1| out of bounds"),
        Check[FrameTest]("voltage_step", *_DISABLE_PMU, voltage_step, "|V1| jumped"),
        Check[FrameTest]("angle_step", *_DISABLE_PMU, angle_step, "the angle jumped"),
        Check[FrameTest]("frequency", *_DISABLE_PMU, frequency, "frequency out of bounds"),
        Check[FrameTest]("rocof", *_DISABLE_PMU, rocof, "frequency changes too fast"),
    ),
    pmu=(
        Check[PmuTest]("no_data", Scope.PMU, Action.WARN, no_data, "nothing has arrived yet"),
        Check[PmuTest]("arrival_gap", *_DISABLE_PMU, arrival_gap, "frames stopped arriving"),
    ),
    instance=(
        Check[InstanceTest](
            "alignment_age", Scope.INSTANCE, Action.DISABLE, alignment_age, "the newest common stamp is too old"
        ),
        Check[InstanceTest](
            "alignment_skew", Scope.INSTANCE, Action.DISABLE, alignment_skew, "one PMU runs too far behind the other"
        ),
        Check[InstanceTest](
            "stamps_differ", Scope.INSTANCE, Action.DISABLE, stamps_differ, "the two PMUs do not measure at one time"
        ),
    ),
    system=(
        Check[SystemTest](
            "no_ready_instance", Scope.SYSTEM, Action.DISARM, no_ready_instance, "no control instance is READY"
        ),
        Check[SystemTest](
            "frequency_difference", Scope.SYSTEM, Action.DISARM, frequency_difference, "Δf too large: island suspected"
        ),
    ),
)
"""What ``step`` uses unless told otherwise."""
