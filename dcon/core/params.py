"""Every number of the controller, with its unit, bounds, default and source.

``Params`` is what ``[controller]`` of the initialisation file fills, ``Thresholds`` is ``[supervisor]``; the bounds
and sources are in each field's ``metadata`` (keys ``unit``, ``low``, ``high``, ``source``), where ``dcon check``
finds them. Sources: "section ..." is the paper (Pierre et al.); "choice" is ours, where no source fixes a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

from dcon.core.differentiator import Coefficients, coefficients
from dcon.limiter import LIMIT_MW
from pmutools.errors import SettingsError

NS = 1_000_000_000
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


@dataclass(frozen=True)
class Thresholds:
    """Limits of the checks in :mod:`dcon.core.rows`, one key each."""

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
    angle_step_deg: float = setting(5.0, "deg", "choice", 0, 180)
    """Angle increment minus the one before it: disable above."""
    frequency_max_hz: float = setting(1.0, "Hz", "choice", 0, 10)
    """Deviation from nominal: disable above."""
    rocof_max_hz_s: float = setting(5.0, "Hz/s", "choice", 0, 100)
    """Change of the computed frequency: disable above."""
    alignment_age_ms: float = setting(200.0, "ms", "choice")
    """Age of the newest common stamp of a pair: disable the instance above."""
    alignment_skew_frames: float = setting(8, "frames", "choice: Figs. 13-15 run at 6", 0, RING_SIZE - 1)
    """Newest stamps of a pair apart: disable the instance above."""
    delta_f_max_mhz: float = setting(200.0, "mHz", "choice: a larger difference is an island, not a mode")
    """|Δf| of the active instance: disarm above."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class PmuParams:
    """One PMU of the controller."""

    name: str
    nominal_kv: float | None = None
    """Line-to-line; None leaves its voltage unjudged."""
    base_v: float = field(init=False)
    """Nominal phase voltage, V; 0 where unknown."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_v", (self.nominal_kv or 0.0) * 1e3 / math.sqrt(3))


class Pair(NamedTuple):
    """A control instance: indices of its north and its south PMU in ``Params.pmus``."""

    north: int
    south: int


@dataclass(frozen=True)
class Params:
    """Everything fixed for a session. Raises SettingsError, in one line, for what cannot be."""

    pmus: tuple[PmuParams, ...]
    instances: tuple[Pair, ...]
    """Control instances, best first."""
    gain_mw_per_mhz: float = setting(9.0, "MW/mHz", "section VI: 9 to 15 feasible, 9 and 12 tested")
    """Gain at the start; bounded by ``gain_max_mw_per_mhz``."""
    gain_max_mw_per_mhz: float = setting(15.0, "MW/mHz", "section VI", 0, 100)
    """Largest gain an order may set; only simulations raise it."""
    gain_ramp_per_s: float = setting(3.0, "MW/mHz/s", "choice", 0.01, 100)
    """How fast the gain moves to an ordered value."""
    deadband_mhz: float = setting(0.25, "mHz", "section VI, the 2017 test", 0, 100)
    """Taken off |Δf|."""
    limit_mw: float = setting(LIMIT_MW, "MW", "section I", 0, LIMIT_MW)
    """Largest command, either sign."""
    rate_hz: int = setting(60, "frames/s", "section III", 6, 240)
    """Reporting rate of every PMU."""
    tick_hz: int = setting(60, "1/s", "section IV", 6, 1000)
    """Rate of the control loop."""
    nominal_hz: float = setting(60.0, "Hz", "the Western Interconnection", 50, 60)
    """Nominal frequency."""
    align: bool = True
    """Subtract frequencies of identical stamps (section V.C); False only to show why (Figs. 13-15)."""
    interpolate_single_loss: bool = False
    """Bridge exactly one lost frame by its midpoint (section V.B, Algorithm 1) and stay READY."""
    init_s: float = setting(20.0, "s", "section IV: approximately 20 s", 0, 3600)
    """Valid data, from both PMUs, before an instance is READY after any disable."""
    return_s: float = setting(60.0, "s", "choice", 0, 86400)
    """An instance of higher priority takes over in ACTIVE only when READY for so long."""
    transfer_s: float = setting(1.0, "s", "choice: 125 MW away in 1 s", 0.2, 60)
    """Length of every bumpless transfer."""
    min_ready: int = setting(2, "instances", "choice", 1)
    """READY instances needed to arm (all of them, if there are fewer)."""
    arm_limit_mw: float = setting(LIMIT_MW / 2, "MW", "choice", 0, LIMIT_MW)
    """The active instance's own command must be smaller than this to arm and to activate."""
    thresholds: Thresholds = field(default_factory=Thresholds)

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.gain_mw_per_mhz > self.gain_max_mw_per_mhz:
            raise SettingsError(
                f"gain_mw_per_mhz = {self.gain_mw_per_mhz:g}: must be 0 to {self.gain_max_mw_per_mhz:g} MW/mHz"
            )
        names = [pmu.name for pmu in self.pmus]
        if len(set(names)) < len(names):
            raise SettingsError(f"two PMUs of one name: {', '.join(names)}")
        if not self.instances:
            raise SettingsError("no control instance: give at least one PMU in the north and one in the south")
        if len(set(self.instances)) < len(self.instances):
            raise SettingsError(f"a control instance is listed twice: {', '.join(self.instance_names)}")
        for pair in self.instances:
            if not all(0 <= index < len(names) for index in pair) or pair.north == pair.south:
                raise SettingsError(f"control instance {tuple(pair)}: no such pair of PMUs")

    @classmethod
    def paired(
        cls, north: tuple[str, ...], south: tuple[str, ...], *, nominal_kv: float | None = None, **settings: Any
    ) -> Params:
        """Every north PMU with every south one, priority in the order given; ``settings`` are fields of Params."""
        pmus = tuple(PmuParams(name, nominal_kv) for name in (*north, *south))
        pairs = tuple(Pair(n, len(north) + s) for n in range(len(north)) for s in range(len(south)))
        return cls(pmus=pmus, instances=pairs, **settings)

    @cached_property
    def instance_names(self) -> tuple[str, ...]:
        """``N1-S1`` and so on, in order of priority."""
        return tuple(f"{self.pmus[pair.north].name}-{self.pmus[pair.south].name}" for pair in self.instances)

    @cached_property
    def coefficients(self) -> Coefficients:
        """The differentiator at ``rate_hz``."""
        return coefficients(self.rate_hz)

    @cached_property
    def rate(self) -> Fraction:
        return Fraction(self.rate_hz)

    @cached_property
    def gap_ns(self) -> float:
        """Longest silence of a PMU: ``gap_ms`` or three frame periods."""
        return max(self.thresholds.gap_ms * 1e6, 3 * NS / self.rate_hz)

    @cached_property
    def init_frames(self) -> int:
        return round(self.init_s * self.rate_hz)

    @cached_property
    def return_frames(self) -> int:
        return self.init_frames + round(self.return_s * self.rate_hz)

    @cached_property
    def transfer_ticks(self) -> int:
        return max(1, round(self.transfer_s * self.tick_hz))
