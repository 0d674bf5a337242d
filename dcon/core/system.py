"""States of the whole controller, the orders that move it, and what it takes to arm."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Final, NamedTuple

from dcon.core.params import Params
from dcon.core.values import Mode, SystemState


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
MODE_IS_FREE: Final = frozenset((_S.OFF, _S.INIT, _S.STANDBY, _S.FAULT, _S.ESTOP))
"""States in which the mode may change: no path from open to closed loop that skips the two steps of arming."""

ORDERS: Final = (
    *(Trigger.START, Trigger.OFF, Trigger.ARM, Trigger.ACTIVATE, Trigger.DISARM, Trigger.RESET, Trigger.ESTOP),
    *(Mode.OPEN_LOOP, Mode.CLOSED_LOOP),
    "gain",
)
"""Names that :class:`~dcon.core.values.Order` may have; ``gain`` takes a value in MW/mHz."""

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


class Permissive(NamedTuple):
    """One condition of arming."""

    name: str
    test: Callable[[Params, ArmView], bool]
    """True allows."""
    text: str
    """For the operator, where it does not."""


PERMISSIVES: Final = (
    Permissive(
        "ready_instances",
        lambda params, view: view.ready >= min(params.min_ready, len(params.instances)),
        "too few control instances are READY",
    ),
    Permissive(
        "command_small",
        lambda params, view: abs(view.command_mw) <= params.arm_limit_mw,
        "the command is not small: wait for the swing to end",
    ),
)
"""All must hold to arm, and again to activate."""


def refusal(params: Params, state: SystemState, trigger: Trigger, view: ArmView) -> str:
    """Why an order is refused; "" if it is not."""
    if (state, trigger) not in TRANSITIONS:
        return f"not in {state}"
    if trigger in (Trigger.ARM, Trigger.ACTIVATE):
        return "; ".join(row.text for row in PERMISSIVES if not row.test(params, view))
    return ""
