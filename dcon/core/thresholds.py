"""Limits of the checks, one key of ``[supervisor]`` each, with unit, bounds, default and source.

Bounds and sources are in each field's ``metadata`` (keys ``unit``, ``low``, ``high``, ``source``), where ``dcon check``
finds them. Sources: "section ..." is the paper (Pierre et al.); "choice" is ours, where no source fixes a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Final

from dcon.core.clash import Clash, check_order
from pmutools.errors import SettingsError

RING_SIZE = 32
"""Frames of each PMU kept for alignment: four times the largest skew accepted."""


def setting(default: float, unit: str, source: str, low: float = 0.0, high: float = math.inf) -> Any:
    """A field in ``unit`` whose value must be a number within ``low``..``high``."""
    return field(default=default, metadata={"unit": unit, "source": source, "low": low, "high": high})


def check_bounds(values: object) -> None:
    """Raise SettingsError for the first field of a dataclass that is outside its metadata's bounds."""
    for item in fields(values):  # type: ignore[arg-type]
        low, high = item.metadata.get("low"), item.metadata.get("high")
        if low is None or high is None:
            continue
        value = getattr(values, item.name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise SettingsError(f"{item.name} = {value!r}: must be {low:g} to {high:g} {item.metadata['unit']}")


ASCENDING: Final = (
    ("latency_min_ms", "latency_warn_ms"),
    ("latency_warn_ms", "latency_max_ms"),
    ("latency_warn_ms", "alignment_age_ms"),
    ("voltage_min_pu", "voltage_max_pu"),
    ("freq_warn_s", "freq_disable_s"),
    ("ringing_low_hz", "ringing_high_hz"),
    ("growth_low_hz", "growth_high_hz"),
    ("response_gain_min", "response_gain_max"),
)
"""Pairs of which the first must be below the second: warnings come before what they warn of, bands have a width, and
frames that are not even late are not too old to be aligned."""
INTER_AREA_HZ: Final = 1.0
"""Inter-area modes, which the command is to follow, are below; what rings is above."""


@dataclass(frozen=True)
class Thresholds:
    """What the rows of :mod:`dcon.core.rows` and :mod:`dcon.core.system_rows` compare with, and for how long.

    ``_s``, ``_frames`` and ``_ticks`` of a check's second key say how long its condition must hold.
    """

    gap_ms: float = setting(50.0, "ms", "section IV b", 1)
    """No frame of a PMU for longer than this, or three frame periods if that is more, disables its instances."""
    max_clock_error_us: float = setting(100.0, "us", "choice: 2.2° at 60 Hz")
    """Worst-case clock error that a PMU may report in MSG_TQ or PMU_TQ."""
    latency_warn_ms: float = setting(90.0, "ms", "choice: Table I sums to 88 before the tick")
    """Stamp to arrival: warn above."""
    latency_max_ms: float = setting(200.0, "ms", "choice")
    """Stamp to arrival: disable above."""
    latency_min_ms: float = setting(-5.0, "ms", "choice: a negative delay is a clock error", -1e3, 0)
    """Stamp to arrival: disable below."""
    voltage_min_pu: float = setting(0.80, "pu", "choice", 0, 2)
    """|V1| below this share of nominal disables (PMUs with a known nominal voltage only)."""
    voltage_max_pu: float = setting(1.20, "pu", "choice", 0, 2)
    """|V1| above disables."""
    voltage_step_pu: float = setting(0.10, "pu", "choice", 0, 2)
    """Change of |V1| from one frame to the next: disable above."""
    unbalance_max_percent: float = setting(5.0, "%", "choice", 0, 100)
    """|V2| / |V1|, where three phases are given: disable above."""
    unbalance_s: float = setting(1.0, "s", "choice", 0, 60)
    """For so long."""
    angle_step_deg: float = setting(5.0, "deg", "choice", 0, 180)
    """Angle increment minus the one before it: disable above."""
    frequency_max_hz: float = setting(1.0, "Hz", "choice", 0, 10)
    """Deviation from nominal: disable above."""
    rocof_max_hz_s: float = setting(5.0, "Hz/s", "choice", 0, 100)
    """Change of the computed frequency: disable above."""
    freq_max_mhz: float = setting(20.0, "mHz", "choice", 0, 1000)
    """Computed frequency against the PMU's own FREQ through the same low-pass: warn, then disable above."""
    freq_warn_s: float = setting(0.5, "s", "choice", 0, 60)
    """For so long: warn."""
    freq_disable_s: float = setting(2.0, "s", "choice", 0, 60)
    """For so long: disable."""
    frozen_mhz: float = setting(
        2.0, "mHz", "choice: turns 0.2 mrad a frame, twice the step of an integer angle", 0, 1000
    )
    """A phasor that stands still although FREQ is off nominal by more than this is frozen."""
    frozen_frames: int = setting(5, "frames", "choice", 1, 1000)
    """For so many frames: disable."""
    alignment_age_ms: float = setting(200.0, "ms", "choice")
    """Age of the newest common stamp of a pair: disable the instance above."""
    alignment_skew_frames: float = setting(8, "frames", "choice: Figs. 13-15 run at 6", 0, RING_SIZE - 1)
    """Newest stamps of a pair apart: disable the instance above."""
    median_max_mhz: float = setting(3.0, "mHz", "choice", 0, 1000)
    """Δf of an instance against the median of the READY ones, if there are three: disable the instance above."""
    median_s: float = setting(0.5, "s", "choice", 0, 60)
    """For so long."""
    delta_f_max_mhz: float = setting(200.0, "mHz", "choice: a larger difference is an island, not a mode")
    """|Δf| of the active instance: disarm above."""
    angle_max_deg: float = setting(120.0, "deg", "choice", 0, 180)
    """Angle between the active instance's two PMUs: disarm above."""
    saturation_max_percent: float = setting(50.0, "%", "choice", 0, 100)
    """Share of time that the feedback command spends at its limit: disarm above."""
    saturation_s: float = setting(10.0, "s", "choice", 0.1, 60)
    """Time that the share is taken over."""
    ringing_max_mw: float = setting(10.0, "MW", "choice", 0, 125)
    """RMS of the feedback command between ``ringing_low_hz`` and ``ringing_high_hz``: disarm above."""
    ringing_s: float = setting(2.0, "s", "choice", 0, 60)
    """For so long."""
    ringing_rms_s: float = setting(0.5, "s", "choice", 0.05, 10)
    """Time constant of that mean square."""
    ringing_low_hz: float = setting(1.5, "Hz", "choice: above every inter-area mode", 0.1, 20)
    """Lower edge of the band of ringing."""
    ringing_high_hz: float = setting(8.0, "Hz", "choice: the line may ring near 5 Hz", 0.2, 60)
    """Upper edge; at most 0.4 of the ticks' rate."""
    growth_max: float = setting(1.5, "", "choice", 1, 100)
    """Growth of the swing of the feedback command over three cycles, each growing by its share: disarm above."""
    growth_min_mw: float = setting(30.0, "MW", "choice", 0, 125)
    """A smaller swing is not judged."""
    growth_low_hz: float = setting(0.1, "Hz", "choice", 0.01, 1)
    """Lower edge of the band of swings."""
    growth_high_hz: float = setting(1.5, "Hz", "choice", 0.2, 10)
    """Upper edge; at most 0.4 of the ticks' rate."""
    bias_max_mw: float = setting(25.0, "MW", "choice", 0, 125)
    """Mean of the feedback command: warn above."""
    bias_s: float = setting(30.0, "s", "choice", 1, 600)
    """Time that the mean is taken over, in whole seconds."""
    overruns_max: float = setting(2, "ticks", "choice", 0, 60)
    """Ticks of the last second that were not done in time: trip above."""
    readback_max_percent: float = setting(2.0, "%", "choice: of 10 V", 0, 100)
    """Output read back against output ordered, in percent of 10 V: trip above."""
    readback_ticks: int = setting(3, "ticks", "choice", 1, 60)
    """For so many ticks."""
    gps_holdover_s: float = setting(5.0, "s", "choice", 0, 3600)
    """Time since the controller's clock last had its GPS lock: disarm above."""
    relays_open_s: float = setting(0.5, "s", "choice: they close within a tick of arming", 0.1, 10)
    """Relays open for so long, in ARMED or ACTIVE: disarm."""
    response_gain_min: float = setting(0.7, "", "choice", 0, 1)
    """Response of the line to the command, as estimated: warn, then disarm below."""
    response_gain_max: float = setting(1.3, "", "choice", 1, 10)
    """Above."""
    response_lag_max_ms: float = setting(60.0, "ms", "choice: 11 ms are normal", 0, 1000)
    """Lag of the line behind the command, as estimated: warn, then disarm above."""
    response_s: float = setting(10.0, "s", "choice", 0, 600)
    """A response out of bounds for so long: disarm."""
    server_age_s: float = setting(2.0, "s", "choice", 0, 600)
    """Time since the server was last heard: warn above."""
    disk_min_percent: float = setting(10.0, "%", "choice", 0, 100)
    """Free share of the disk that is logged to: warn below."""

    def __post_init__(self) -> None:
        check_bounds(self)
        check_order(self, ASCENDING)
        if not self.voltage_min_pu < 1:
            raise Clash(f"{self.voltage_min_pu:g}: must be below 1, or nominal voltage disables", "voltage_min_pu")
        if not self.voltage_max_pu > 1:
            raise Clash(f"{self.voltage_max_pu:g}: must be above 1, or nominal voltage disables", "voltage_max_pu")
        if not self.saturation_max_percent < 100:
            raise Clash("100: must be below 100, no share is above it", "saturation_max_percent")
        if not self.ringing_low_hz > INTER_AREA_HZ:
            problem = f"{self.ringing_low_hz:g}: must be above {INTER_AREA_HZ:g} Hz, the band of what is to be damped"
            raise Clash(problem, "ringing_low_hz")
