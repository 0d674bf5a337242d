"""The checks of frames, PMUs and instances: rows of :class:`~dcon.core.checks.Supervisor`, and ``CORE`` itself.

Each function gives the number that its row judges, in the row's unit, NaN where it cannot be known (which raises the
check) and None where there is nothing to judge. A frame that fails its CHK, size or IDCODE never gets here: it is
missing, and shows as a wrong stamp step or as a gap.
"""

from __future__ import annotations

import math

from dcon.core.checks import (
    Action,
    Check,
    FrameValue,
    PairValue,
    PairView,
    PmuValue,
    Scope,
    Supervisor,
)
from dcon.core.params import NS, Params, PmuParams
from dcon.core.stamps import clock_error_us, tolerance_ns
from dcon.core.state import Pmu
from dcon.core.system_rows import FEEDBACK_ROWS, SURROUNDINGS_ROWS, SYSTEM_ROWS
from dcon.core.values import Sample
from pmutools.c37118.constants import STAT_DATA_ERROR_MASK, Stat

_NOT_SYNCHRONISED = int(Stat.NOT_SYNCHRONISED)
_CONFIG_CHANGE = int(Stat.CONFIG_CHANGE)


def not_finite(_params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> float:
    """NaN where |V1| is not finite, else 0."""
    return 0.0 if new.magnitude_v < math.inf else math.nan


def stat_error(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> float:
    """STAT bits 15 and 14."""
    return sample.stat & STAT_DATA_ERROR_MASK


def not_synchronised(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> float:
    """STAT bit 13."""
    return sample.stat & _NOT_SYNCHRONISED


def config_change(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> float:
    """STAT bit 10."""
    return sample.stat & _CONFIG_CHANGE


def time_quality(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> float:
    """Clock error by MSG_TQ and PMU_TQ; infinite where STAT says unlocked for 10 s or more."""
    return clock_error_us(sample.stat, sample.time_quality)


def latency(_params: Params, _pmu: PmuParams, _last: Pmu, _new: Pmu, sample: Sample) -> float:
    """Stamp to arrival."""
    return (sample.arrival_ns - sample.time_ns) / 1e6


def voltage(_params: Params, pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> float | None:
    """|V1| over nominal."""
    return new.magnitude_v / pmu.base_v if pmu.base_v > 0 else None


def voltage_step(_params: Params, pmu: PmuParams, last: Pmu, new: Pmu, _sample: Sample) -> float | None:
    """Change of |V1| in a frame, over nominal."""
    if pmu.base_v == 0 or new.filter.frames < 2:
        return None
    return abs(new.magnitude_v - last.magnitude_v) / pmu.base_v


def unbalance(_params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, sample: Sample) -> float | None:
    """|V2| over |V1|."""
    v2 = sample.v2
    if v2 != v2:  # the three phases are not given
        return None
    return 100 * math.hypot(v2.real, v2.imag) / new.magnitude_v if new.magnitude_v > 0 else math.nan


def angle_step(_params: Params, _pmu: PmuParams, last: Pmu, new: Pmu, _sample: Sample) -> float | None:
    """Angle increment against the one before."""
    if new.filter.frames < 3:
        return None
    return abs(math.degrees(new.filter.increment_rad - last.filter.increment_rad))


def frequency(_params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> float | None:
    """Computed frequency against nominal."""
    return abs(new.filter.f_hz) if new.filter.frames == 3 else None


def rocof(params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> float | None:
    """Change of the computed frequency."""
    if new.filter.frames < 3:
        return None
    return abs(new.filter.f_hz - new.filter.f_before_hz) * params.rate_hz


def freq_difference(_params: Params, _pmu: PmuParams, _last: Pmu, new: Pmu, _sample: Sample) -> float | None:
    """Computed frequency against FREQ through the same low-pass."""
    if new.filter.frames < 3 or math.isnan(new.freq.y1):
        return None
    return abs(new.filter.f_hz - new.freq.y1) * 1e3


def frozen(params: Params, _pmu: PmuParams, last: Pmu, new: Pmu, sample: Sample) -> float | None:
    """FREQ against nominal, in a frame whose V1 is that of the frame before; infinite where FREQ is absent.

    A phasor at rest is right where the grid is at nominal and FREQ says so, as a plant without noise does before
    anything happens. Off nominal by ``frozen_mhz`` it turns by more than any wire format rounds to.
    """
    if new.v1 != last.v1:
        return None
    if math.isnan(sample.frequency_hz):
        return math.inf
    return abs(sample.frequency_hz - params.nominal_hz) * 1e3


def no_data(_params: Params, pmu: Pmu, _now_ns: int) -> float:
    """1 before the first frame."""
    return float(pmu.arrival_ns is None)


def arrival_gap(params: Params, pmu: Pmu, now_ns: int) -> float | None:
    """Time since the last arrival."""
    if pmu.arrival_ns is None:
        return None
    # A clock that is set back must not hide a silence: count the ticks as well.
    return max((now_ns - pmu.arrival_ns) / 1e6, (pmu.idle_ticks - 1) * 1e3 / params.tick_hz)


def _longest_gap_ms(params: Params) -> float:
    return params.gap_ns / 1e6


def alignment_age(_params: Params, view: PairView) -> float:
    """Age of the newest common stamp."""
    return (view.now_ns - min(view.north.time_ns, view.south.time_ns)) / 1e6


def alignment_skew(_params: Params, view: PairView) -> float | None:
    """Newest stamps apart."""
    north, south = view.north.slot, view.south.slot
    return None if north is None or south is None else abs(north - south)


def stamps_differ(params: Params, view: PairView) -> float | None:
    """Stamps apart, beyond 10 us or a tick of TIME_BASE."""
    north, south = view.north, view.south
    if north.slot is None or south.slot is None:
        return None
    apart = abs((north.time_ns - south.time_ns) * params.rate_hz - (north.slot - south.slot) * NS)
    return max(0.0, apart / params.rate_hz - tolerance_ns(min(north.time_base, south.time_base))) / 1e3


def off_median(_params: Params, view: PairView) -> float | None:
    """Δf against the median over the READY instances."""
    return None if view.median_mhz is None else abs(view.delta_f_mhz - view.median_mhz)


_PMU_WARN = (Scope.PMU, Action.WARN)
_PMU_DISABLE = (Scope.PMU, Action.DISABLE)
_PAIR_DISABLE = (Scope.INSTANCE, Action.DISABLE)
_TRIP = (Scope.SYSTEM, Action.TRIP)
_ANY = -math.inf
"""No lower bound."""

ENGINE_ROWS: tuple[Check[None], ...] = (
    Check("stamp_step", *_PMU_DISABLE, None, "a frame was lost or came out of order"),
    Check("stale_frame", *_PMU_WARN, None, "a frame no newer than the last was ignored"),
    Check("interpolated", *_PMU_WARN, None, "one lost frame was bridged by its midpoint"),
    Check("unread_frame", *_PMU_WARN, None, "a frame could not be read, and counts as lost"),
    Check("slew_limited", Scope.SYSTEM, Action.WARN, None, "the slew backstop held the command"),
    Check("command_invalid", *_TRIP, None, "the computed command is no number"),
    Check("internal_error", *_TRIP, None, "the controller failed on this tick's input"),
)
"""Raised by the engine as it goes."""

FRAME_ROWS: tuple[Check[FrameValue], ...] = (
    Check("not_finite", *_PMU_DISABLE, not_finite, "V1 is absent"),
    Check("stat_error", *_PMU_DISABLE, stat_error, "STAT: data error, test mode or filler"),
    Check("not_synchronised", *_PMU_DISABLE, not_synchronised, "STAT: PMU lost its time source"),
    Check("config_change", *_PMU_DISABLE, config_change, "STAT: the configuration is to change"),
    Check("time_quality", *_PMU_DISABLE, time_quality, "the PMU's clock is too uncertain", "max_clock_error_us"),
    Check("latency_high", *_PMU_WARN, latency, "frames arrive late", "latency_warn_ms"),
    Check("latency", *_PMU_DISABLE, latency, "frames arrive too late or too early", "latency_max_ms", "latency_min_ms"),
    Check("voltage", *_PMU_DISABLE, voltage, "|V1| out of bounds", "voltage_max_pu", "voltage_min_pu"),
    Check("voltage_step", *_PMU_DISABLE, voltage_step, "|V1| jumped", "voltage_step_pu"),
    Check("unbalance", *_PMU_DISABLE, unbalance, "the phases differ", "unbalance_max_percent", _ANY, "unbalance_s"),
    Check("angle_step", *_PMU_DISABLE, angle_step, "the angle jumped", "angle_step_deg"),
    Check("frequency", *_PMU_DISABLE, frequency, "frequency out of bounds", "frequency_max_hz"),
    Check("rocof", *_PMU_DISABLE, rocof, "frequency changes too fast", "rocof_max_hz_s"),
    Check("freq_differs", *_PMU_WARN, freq_difference, "FREQ says otherwise", "freq_max_mhz", _ANY, "freq_warn_s"),
    Check(
        "freq_wrong", *_PMU_DISABLE, freq_difference, "FREQ differs for long", "freq_max_mhz", _ANY, "freq_disable_s"
    ),
    Check("frozen", *_PMU_DISABLE, frozen, "the phasor repeats itself", "frozen_mhz", _ANY, "frozen_frames"),
)

PMU_ROWS: tuple[Check[PmuValue], ...] = (
    Check("no_data", *_PMU_WARN, no_data, "nothing has arrived yet"),
    Check("arrival_gap", *_PMU_DISABLE, arrival_gap, "frames stopped arriving", _longest_gap_ms, unit="ms"),
)

INSTANCE_ROWS: tuple[Check[PairValue], ...] = (
    Check("alignment_age", *_PAIR_DISABLE, alignment_age, "the newest common stamp is too old", "alignment_age_ms"),
    Check("alignment_skew", *_PAIR_DISABLE, alignment_skew, "one PMU runs too far behind", "alignment_skew_frames"),
    Check("stamps_differ", *_PAIR_DISABLE, stamps_differ, "the two PMUs do not measure at one time", unit="us"),
    Check("off_median", *_PAIR_DISABLE, off_median, "the others see otherwise", "median_max_mhz", _ANY, "median_s"),
)

CORE = Supervisor(
    engine=ENGINE_ROWS,
    frame=FRAME_ROWS,
    pmu=PMU_ROWS,
    instance=INSTANCE_ROWS,
    system=SYSTEM_ROWS,
    feedback=FEEDBACK_ROWS,
    surroundings=SURROUNDINGS_ROWS,
    known=(FRAME_ROWS, PMU_ROWS, INSTANCE_ROWS),
)
"""What ``step`` uses unless told otherwise."""
