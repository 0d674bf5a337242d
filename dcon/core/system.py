"""States of the whole controller, the orders that move it, and what it takes to arm."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Final, NamedTuple

from dcon.core.line import line_status, margin_mw
from dcon.core.params import Params
from dcon.core.values import NOTHING, Mode, Surroundings, SystemState


class Trigger(StrEnum):
    """What moves the system: an operator's order of that name, or ``ready``, ``ramped``, ``trip`` from within."""

    START = "start"
    OFF = "off"
    READY = "ready"
    """First instance READY."""
    ARM = "arm"
    ACTIVATE = "activate"
    DISARM = "disarm"
    """By order, or by a check."""
    RAMPED = "ramped"
    """The command has come down to 0."""
    TRIP = "trip"
    ESTOP = "estop"
    RESET = "reset"


_S = SystemState
TRANSITIONS: Final[dict[tuple[SystemState, Trigger], SystemState]] = {
    (_S.OFF, Trigger.START): _S.INIT,
    (_S.INIT, Trigger.READY): _S.STANDBY,
    (_S.INIT, Trigger.OFF): _S.OFF,
    (_S.STANDBY, Trigger.OFF): _S.OFF,
    (_S.STANDBY, Trigger.ARM): _S.ARMED,
    (_S.ARMED, Trigger.ACTIVATE): _S.ACTIVE,
    (_S.ARMED, Trigger.DISARM): _S.STANDBY,
    (_S.ACTIVE, Trigger.DISARM): _S.RAMPDOWN,
    (_S.RAMPDOWN, Trigger.RAMPED): _S.STANDBY,
    (_S.FAULT, Trigger.RESET): _S.INIT,
    (_S.ESTOP, Trigger.RESET): _S.INIT,
    **{(state, Trigger.TRIP): _S.FAULT for state in _S if state not in (_S.FAULT, _S.ESTOP)},
    **{(state, Trigger.ESTOP): _S.ESTOP for state in _S if state is not _S.ESTOP},
}
"""(state, trigger) -> state; an order that is not listed is refused."""

DRIVING: Final = frozenset((_S.ACTIVE, _S.RAMPDOWN))
"""States with a command; in all others it is 0 MW."""
ENGAGED: Final = DRIVING | {_S.ARMED}
"""States in which closed relays are asked for."""
MODE_IS_FREE: Final = frozenset((_S.OFF, _S.INIT, _S.STANDBY, _S.FAULT, _S.ESTOP))
"""States in which the mode may change: no path from open to closed loop that skips the two steps of arming."""

ORDERS: Final = (
    *(Trigger.START, Trigger.OFF, Trigger.ARM, Trigger.ACTIVATE, Trigger.DISARM, Trigger.RESET, Trigger.ESTOP),
    *(Mode.OPEN_LOOP, Mode.CLOSED_LOOP),
    *("gain", "probe_start", "probe_stop", "ack", "release"),
)
"""Names that an operator's :class:`~dcon.core.values.Order` may have; ``gain`` takes a value in MW/mHz, ``ack`` names a
flag, ``release`` is of the watchdog's emergency stop."""
LINK_REFUSED: Final = "link_refused"
"""Name of an order that is none: something came over the operators' link and was refused, ``text`` says why."""

_TRIGGER_ORDERS: Final = {str(name): name for name in ORDERS if isinstance(name, Trigger)}
_MODE_ORDERS: Final = {str(mode): mode for mode in Mode}


def trigger_of(order: str) -> Trigger | None:
    """The trigger that an order is; None for one that is none."""
    return _TRIGGER_ORDERS.get(order)


def mode_of(order: str) -> Mode | None:
    """The mode that an order asks for; None for one that asks for none."""
    return _MODE_ORDERS.get(order)


class ArmView(NamedTuple):
    """What decides on arming."""

    ready: int
    command_mw: float
    """The active instance's own."""
    surroundings: Surroundings = NOTHING
    now_ns: int = 0
    driven_mw: float = 0.0
    latched: tuple[str, ...] = ()
    """Checks that disarmed or tripped, and wait for an acknowledgement."""
    causes: tuple[str, ...] = ()
    """Checks that are up and would trip at once again."""
    still_up: tuple[str, ...] = ()
    """Checks that disarmed or tripped, are acknowledged, and have not fallen yet."""


class Permissive(NamedTuple):
    """One condition of arming."""

    name: str
    test: Callable[[Params, ArmView], bool]
    """True allows."""
    text: str
    """For the operator, where it does not."""


def _enough_ready(params: Params, view: ArmView) -> bool:
    return view.ready >= min(params.min_ready, len(params.instances))


def _command_small(params: Params, view: ArmView) -> bool:
    return abs(view.command_mw) <= params.arm_limit_mw


def _gps_locked(params: Params, view: ArmView) -> bool:
    age_s = view.surroundings.gps_age_s
    return not params.required.gps if age_s is None else age_s == 0


def _watchdog_healthy(params: Params, view: ArmView) -> bool:
    healthy = view.surroundings.watchdog_healthy
    return not params.required.watchdog if healthy is None else healthy


def _estop_released(params: Params, view: ArmView) -> bool:
    released = view.surroundings.estop_released
    return not params.required.watchdog if released is None else released


def _server_there(params: Params, view: ArmView) -> bool:
    age_s = view.surroundings.server_age_s
    return not params.required.server if age_s is None else age_s <= params.thresholds.server_age_s


def _line_takes_it(params: Params, view: ArmView) -> bool:
    status = line_status(params, view.surroundings, view.now_ns)
    return not params.required.line if status is None else status.in_service and status.dcon_enabled


def _line_has_room(params: Params, view: ArmView) -> bool:
    status = line_status(params, view.surroundings, view.now_ns)
    return not params.required.line if status is None else margin_mw(params, status, view.driven_mw) >= 0


def _all_acknowledged(_params: Params, view: ArmView) -> bool:
    return not view.latched


def _all_fallen(_params: Params, view: ArmView) -> bool:
    return not view.still_up


PERMISSIVES: Final = (
    Permissive("ready_instances", _enough_ready, "too few control instances are READY"),
    Permissive("command_small", _command_small, "the command is not small: wait for the swing to end"),
    Permissive("gps_locked", _gps_locked, "the controller's clock has no GPS lock"),
    Permissive("watchdog_healthy", _watchdog_healthy, "the watchdog is not healthy"),
    Permissive("estop_released", _estop_released, "the emergency stop is pressed"),
    Permissive("server_there", _server_there, "the server is silent"),
    Permissive(
        "line_takes_it",
        _line_takes_it,
        "the line is out of service, does not accept the command, or its status is not known",
    ),
    Permissive("line_has_room", _line_has_room, "the line's schedule leaves no room for the command"),
    Permissive("acknowledged", _all_acknowledged, "what disarmed or tripped last is not acknowledged"),
    Permissive("fallen", _all_fallen, "what disarmed or tripped last is acknowledged, but still up"),
)
"""All must hold to arm, and again to activate. What is not fitted allows, unless a setting requires it."""


def refusal(params: Params, state: SystemState, trigger: Trigger, view: ArmView) -> str:
    """Why an order is refused; "" if it is not."""
    if (state, trigger) not in TRANSITIONS:
        return f"not possible in {state}"
    if trigger is Trigger.RESET and view.causes:
        return f"still up: {' '.join(view.causes)}"
    if trigger in (Trigger.ARM, Trigger.ACTIVATE):
        return "; ".join(row.text for row in PERMISSIVES if not row.test(params, view))
    return ""
