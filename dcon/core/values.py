"""What goes into a tick and what comes out of it; shared by the live controller, simulation, log and replay."""

from __future__ import annotations

import cmath
import math
from enum import StrEnum
from typing import Final, NamedTuple


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
    v2: complex = complex(cmath.nan, cmath.nan)
    """Negative-sequence voltage, V RMS; NaN where the three phases are not given."""


def value_of(order: str, value: float) -> float | None:
    """The value of an order of that name; None where it takes none, and has none."""
    return value if order == "gain" or value else None


def words_of(order: str, value: float | None, *others: str) -> str:
    """An order as it is shown."""
    return " ".join(word for word in (order, "" if value is None else f"{value:g}", *others) if word)


class Order(NamedTuple):
    """An operator's order or a setting, taken by the next tick. Names: ``ORDERS`` in :mod:`dcon.core.system`."""

    name: str
    value: float = 0.0
    text: str = ""
    """What the order concerns: of ``ack`` the flag, as ``NAME`` or ``NAME SUBJECT``, empty for all."""
    who: str = ""
    """Who ordered it."""
    why: str = ""
    """In the operator's words."""

    @property
    def given(self) -> float | None:
        """``value``, where the order has one."""
        return value_of(self.name, self.value)

    def __str__(self) -> str:
        """What is ordered, in words: ``gain 12``, ``ack ringing``."""
        return words_of(self.name, self.given, self.text)


class Pdci(NamedTuple):
    """State of the DC line as last reported at ``time_ns``; power counts north to south."""

    time_ns: int
    power_mw: float
    in_service: bool = True
    dcon_enabled: bool = True
    scheduled_mw: float = math.nan
    """Without the modulation; NaN where the line does not say."""


class Surroundings(NamedTuple):
    """What a tick is told besides PMU frames: of the controller's own platform and of the line it acts on.

    None is "not fitted": the checks of it are off, unless a setting requires it.
    """

    gps_age_s: float | None = None
    """Since the controller's clock last had its GPS lock; 0 while it has."""
    watchdog_healthy: bool | None = None
    """The watchdog lives, and would keep its relays closed."""
    estop_released: bool | None = None
    pdci: Pdci | None = None
    readback_v: float | None = None
    """Output read back: of the last tick's."""
    overrun: bool | None = None
    """The last tick was not done before this one was due."""
    response_gain: float | None = None
    """Response of the line to the command, MW per MW, as estimated elsewhere."""
    response_lag_ms: float | None = None
    server_age_s: float | None = None
    """Since the server was last heard."""
    disk_free_percent: float | None = None
    """Of the disk that is logged to."""
    unread: tuple[int, ...] = ()
    """Frames of each PMU, in the order of ``Params.pmus``, that came and could not be read; () is none."""
    relays_closed: bool | None = None
    """By the watchdog's word: the command passes."""


NOTHING: Final = Surroundings()
"""Nothing is told: a simulation."""


class Inputs(NamedTuple):
    """All that one tick is given."""

    samples: tuple[tuple[Sample, ...], ...]
    """One tuple a PMU in the order of ``Params.pmus``, frames in order of arrival; may be empty."""
    orders: tuple[Order, ...] = ()
    surroundings: Surroundings = NOTHING


class Flag(NamedTuple):
    """A check that is, or has been, up for one ``subject``: a PMU, an instance or ``system``."""

    name: str
    subject: str
    up: bool
    first_ns: int
    """The tick in which it first rose."""
    last_ns: int
    """The tick in which it last rose, or fell."""
    times: int
    """How often it rose."""
    value: float
    """What was found when it last rose, in the check's unit; NaN where it is no number."""
    limit: float
    """The bound that ``value`` broke; NaN where there is none."""
    latched: bool
    """It disarmed or tripped the controller: no arming until it is down and acknowledged."""
    acknowledged: str = ""
    """By whom, since it last rose; "" is by nobody."""


class Event(NamedTuple):
    """Something that happened in a tick.

    ``name`` is a check's name (its flag rose), a system state's name in lower case (it was entered), a mode,
    ``selected`` (instance ``subject`` is now the active one), ``instance_disabled``, ``instance_initialising``,
    ``instance_ready``, ``gain``, ``ack`` (by whom: detail), ``probe_start``, ``probe_stop``, ``probe_end``, or
    ``refused`` (an order). ``subject`` is a PMU, an instance or ``system``.
    """

    name: str
    subject: str
    detail: str = ""


DETAIL = 400
"""Characters of what is said of a stream in the words of the stream: a status has the last 50 events."""


def brief(text: str) -> str:
    """At most :data:`DETAIL` characters of it."""
    return text if len(text) <= DETAIL else f"{text[: DETAIL - 1]}…"


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
    """Computed and limited, without the probing signal; always finite."""
    output_v: float
    """Volts to drive; 0 in open loop, unless a probing signal is driven there."""
    probe_mw: float
    """The probing signal's part of what is driven, or (in open loop, unless it is driven there) of what would be."""
    flags: int
    """Checks that are up (uint64); bit names: ``Supervisor.names``."""
    f_hz: tuple[float, ...]
    """Absolute frequency of each PMU by the differentiator, newest frame; NaN where unknown."""
    age_ms: tuple[float, ...]
    """Tick time minus stamp of each PMU's newest frame; NaN where there is none."""
    instances: tuple[InstanceRecord, ...]
    events: tuple[Event, ...]
    flag_changes: tuple[Flag, ...] = ()
    """Entries of the flag register that changed in this tick, as they are now."""
