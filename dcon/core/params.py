"""Every number of the controller, with its unit, bounds, default and source.

``Params`` is what ``[controller]`` of the initialisation file fills; :class:`~dcon.core.thresholds.Thresholds` is
``[supervisor]``, where the form of a setting is explained, :class:`~dcon.core.probe.Probing` is ``[probing]``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

from dcon.core.bands import HIGHEST, Bands, bands_of
from dcon.core.clash import Clash, check_order
from dcon.core.differentiator import Coefficients, coefficients
from dcon.core.probe import SWEPT, Probing, Waveform, waveform
from dcon.core.thresholds import Thresholds, check_bounds, setting
from dcon.limiter import LIMIT_MW
from pmutools.errors import SettingsError

NS = 1_000_000_000
RATES = (30, 50, 60, 100, 120)
"""Frames per second that the differentiator is designed for, and judged at."""


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


@dataclass(frozen=True)
class Line:
    """The DC line that the command is added to: ``[pdci]``."""

    rating_ns_mw: float = setting(3220.0, "MW", "path rating, north to south", 0, 1e5)
    """Largest power north to south."""
    rating_sn_mw: float = setting(3100.0, "MW", "path rating, south to north", 0, 1e5)
    """Largest power south to north."""
    minimum_mw: float = setting(310.0, "MW", "choice: 10 % of the rating", 0, 1e5)
    """Smallest power that the line carries, in either direction."""
    status_age_s: float = setting(2.0, "s", "choice: four of the 0.5 s at which a device is asked", 0, 3600)
    """A status older than this is not known."""

    def __post_init__(self) -> None:
        check_bounds(self)
        check_order(self, [("minimum_mw", key) for key in ("rating_ns_mw", "rating_sn_mw") if getattr(self, key) > 0])


class Required(NamedTuple):
    """Sources of :class:`~dcon.core.values.Surroundings` that must be there: without them no arming, a loss acts."""

    gps: bool = False
    watchdog: bool = False
    server: bool = False
    line: bool = False


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
    """Largest gain an order may set; only simulations and replays take more than 15."""
    gain_ramp_per_s: float = setting(3.0, "MW/mHz/s", "choice", 0.01, 100)
    """How fast the gain moves to an ordered value."""
    deadband_mhz: float = setting(0.25, "mHz", "section VI, the 2017 test", 0, 100)
    """Taken off |Δf|."""
    limit_mw: float = setting(LIMIT_MW, "MW", "section I", 0, LIMIT_MW)
    """Largest command, either sign."""
    rate_hz: int = setting(60, "frames/s", "section III", RATES[0], RATES[-1])
    """Reporting rate of every PMU: one of :data:`RATES`."""
    tick_hz: int = setting(60, "1/s", "section IV", 6, 1000)
    """Rate of the control loop."""
    nominal_hz: float = setting(60.0, "Hz", "the Western Interconnection", 50, 60)
    """Nominal frequency."""
    align: bool = field(default=True, metadata={"source": "section V.C"})
    """Subtract frequencies of identical stamps (section V.C); False only to show why (Figs. 13-15)."""
    interpolate_single_loss: bool = field(default=False, metadata={"source": "section V.B: a dropout disables"})
    """Bridge exactly one lost frame by its midpoint (section V.B, Algorithm 1) and stay READY."""
    init_s: float = setting(20.0, "s", "section IV: approximately 20 s", 0.1, 3600)
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
    line: Line = field(default_factory=Line)
    required: Required = field(default_factory=Required)
    probing: Probing = field(default_factory=Probing)

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.gain_mw_per_mhz > self.gain_max_mw_per_mhz:
            raise SettingsError(
                f"gain_mw_per_mhz = {self.gain_mw_per_mhz:g}: must be 0 to {self.gain_max_mw_per_mhz:g} MW/mHz"
            )
        check_together(self)
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
    def requires(self) -> bool:
        """Whether any source of the surroundings must be there."""
        return self.required != Required()

    @cached_property
    def bands(self) -> Bands:
        """Filters that watch the command."""
        return bands_of(self.thresholds, self.tick_hz)

    @cached_property
    def waveform(self) -> Waveform:
        """The probing signal; worked out when it is first asked for."""
        return waveform(self.probing, self.tick_hz)

    @cached_property
    def transfer_ticks(self) -> int:
        return max(1, round(self.transfer_s * self.tick_hz))


def check_together(params: Params) -> None:
    """Raise Clash for settings of different sections that exclude each other."""
    limits, line, probing, tick_hz = params.thresholds, params.line, params.probing, params.tick_hz
    if params.rate_hz not in RATES:
        raise SettingsError(f"rate_hz = {params.rate_hz}: must be one of {', '.join(map(str, RATES))} frames/s")
    if params.nominal_hz not in (50, 60):
        raise Clash(f"{params.nominal_hz:g}: C37.118 has 50 and 60 Hz only", "controller.nominal_hz")
    for key in ("ringing_high_hz", "growth_high_hz"):
        if (edge_hz := getattr(limits, key)) > HIGHEST * tick_hz:
            most = f"at most {HIGHEST * tick_hz:g} Hz, {HIGHEST:g} of tick_hz = {tick_hz}"
            raise Clash(f"{edge_hz:g}: {most}", f"supervisor.{key}", "controller.tick_hz")
    fastest = {"square": "frequency_hz", **dict.fromkeys(SWEPT, "high_hz")}.get(probing.kind)
    if fastest is not None and (hz := getattr(probing, fastest)) >= tick_hz / 2:
        raise Clash(f"{hz:g}: must be below half of {tick_hz} ticks/s", f"probing.{fastest}", "controller.tick_hz")
    if fastest is not None and probing.amplitude_mw > params.limit_mw:
        problem = f"{probing.amplitude_mw:g}: above limit_mw = {params.limit_mw:g}, the signal would be clipped"
        raise Clash(problem, "probing.amplitude_mw", "controller.limit_mw")
    if not limits.overruns_max < tick_hz:
        problem = f"{limits.overruns_max:g}: must be below tick_hz = {tick_hz}, the ticks of a second"
        raise Clash(problem, "supervisor.overruns_max", "controller.tick_hz")
    if not limits.alignment_age_ms > 1e3 / params.rate_hz:
        problem = f"{limits.alignment_age_ms:g}: must be above the {1e3 / params.rate_hz:.1f} ms from frame to frame"
        raise Clash(problem, "supervisor.alignment_age_ms")
    if not params.deadband_mhz < limits.delta_f_max_mhz:
        problem = f"{params.deadband_mhz:g}: must be below delta_f_max_mhz = {limits.delta_f_max_mhz:g}"
        raise Clash(problem, "controller.deadband_mhz", "supervisor.delta_f_max_mhz")
    room_mw = max(line.rating_ns_mw, line.rating_sn_mw) - line.minimum_mw
    if room_mw < 2 * params.limit_mw:
        problem = f"{line.minimum_mw:g}: leaves {room_mw:g} MW below the rating, but ±limit_mw needs"
        keys = ("pdci.minimum_mw", "pdci.rating_ns_mw", "pdci.rating_sn_mw", "controller.limit_mw")
        raise Clash(f"{problem} {2 * params.limit_mw:g}", *keys)
