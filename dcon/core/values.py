"""What goes into a tick and what comes out of it; shared by the live controller, simulation, log and replay."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class SystemState(StrEnum):
    """ARMED: relays closed, 0 V, waiting for the operator's second step. FAULT and ESTOP are latched."""

    OFF = "OFF"
    INIT = "INIT"
    STANDBY = "STANDBY"
    ARMED = "ARMED"
    ACTIVE = "ACTIVE"
    RAMPDOWN = "RAMPDOWN"
    FAULT = "FAULT"
    ESTOP = "ESTOP"


class Mode(StrEnum):
    """In ``open_loop`` the command is computed and logged, and the output stays at 0 V."""

    OPEN_LOOP = "open_loop"
    CLOSED_LOOP = "closed_loop"


class InstanceState(StrEnum):
    """HELD: READY, but no new pair of frames in this tick, so the last difference is repeated."""

    DISABLED = "DISABLED"
    INITIALISING = "INITIALISING"
    READY = "READY"
    HELD = "HELD"


class Sample(NamedTuple):
    """One PMU frame as the controller sees it."""

    time_ns: int
    """Time of the measurement, from the frame's stamp (POSIX UTC)."""
    arrival_ns: int
    v1: complex
    """Positive-sequence voltage, V RMS; NaN where absent."""
    frequency_hz: float
    """The PMU's own estimate (absolute); not used by the control law."""
    stat: int
    time_quality: int
    """The whole byte: leap flags and MSG_TQ."""
    time_base: int = 1_000_000
    """Ticks per second of the stream's FRACSEC: how finely ``time_ns`` could be stamped."""


class Order(NamedTuple):
    """An operator's order or a setting, taken by the next tick. Names: ``ORDERS`` in :mod:`dcon.core.system`."""

    name: str
    value: float = 0.0


class Inputs(NamedTuple):
    """All that one tick is given."""

    samples: tuple[tuple[Sample, ...], ...]
    """One tuple a PMU in the order of ``Params.pmus``, frames in order of arrival; may be empty."""
    orders: tuple[Order, ...] = ()


class Event(NamedTuple):
    """Something that happened in a tick.

    ``name`` is a check's name (its flag rose), a system state's name in lower case (it was entered), a mode,
    ``selected`` (instance ``subject`` is now the active one), ``instance_disabled``, ``instance_initialising``,
    ``instance_ready``, ``gain`` or ``refused`` (an order). ``subject`` is a PMU, an instance or ``system``.
    """

    name: str
    subject: str
    detail: str = ""


class InstanceRecord(NamedTuple):
    """One control instance at the end of a tick."""

    state: InstanceState
    active: bool
    delta_f_mhz: float
    """f_north - f_south; NaN where unknown."""
    command_mw: float
    """What this instance alone would command; 0 where unknown."""
    reason: str
    """Why it was last disabled; "" if it never was."""


class Record(NamedTuple):
    """What one tick decided, and from what."""

    tick_ns: int
    state: SystemState
    mode: Mode
    active: int | None
    """Index into ``Params.instances``."""
    gain_mw_per_mhz: float
    delta_f_mhz: float
    """Of the active instance; NaN without one."""
    command_mw: float
    """Computed and limited; always finite."""
    output_v: float
    """Volts to drive: 0 in open loop."""
    probe_mw: float
    flags: int
    """Checks that are up (uint64); bit names: ``Supervisor.names``."""
    f_hz: tuple[float, ...]
    """Absolute frequency of each PMU by the differentiator, newest frame; NaN where unknown."""
    age_ms: tuple[float, ...]
    """Tick time minus stamp of each PMU's newest frame; NaN where there is none."""
    instances: tuple[InstanceRecord, ...]
    events: tuple[Event, ...]
