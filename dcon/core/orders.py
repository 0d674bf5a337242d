"""What an operator's order does, and why it may be refused."""

from __future__ import annotations

from typing import NamedTuple

from dcon.core import register
from dcon.core.params import Params
from dcon.core.probe import Probe, started
from dcon.core.register import Register
from dcon.core.system import LINK_REFUSED, MODE_IS_FREE, TRANSITIONS, ArmView, Trigger, mode_of, refusal, trigger_of
from dcon.core.values import Event, Mode, Order, SystemState

SYSTEM = "system"
"""Subject of what concerns the whole controller."""
LINK = "link"
"""Subject of what the operators' link refuses."""


class Ordered(NamedTuple):
    """What orders may change."""

    system: SystemState
    mode: Mode
    target_gain_mw_per_mhz: float
    probe: Probe
    flags: Register


def moved(system: SystemState, trigger: Trigger, why: str, events: list[Event]) -> SystemState:
    """The state after ``trigger``, as an event where it is another."""
    after = TRANSITIONS.get((system, trigger))
    if after is None:
        return system
    events.append(Event(after.lower(), SYSTEM, why))
    return after


def is_stop(order: Order) -> bool:
    """Whether it is the emergency stop, which has the last word in its tick."""
    return order.name == Trigger.ESTOP


def obey(params: Params, now: Ordered, order: Order, view: ArmView, events: list[Event]) -> Ordered:
    """``now`` after one order; an event says what became of it."""
    name, value, _, who, _ = order
    if (trigger := trigger_of(name)) is not None:
        # A second stop changes nothing and is no mistake.
        why = "" if trigger is Trigger.ESTOP else refusal(params, now.system, trigger, view)
        if not why:
            return now._replace(system=moved(now.system, trigger, _by("order", who), events))
    elif (mode := mode_of(name)) is not None:
        why = "" if now.system in MODE_IS_FREE or mode is now.mode else f"not possible in {now.system}: disarm first"
        if not why:
            events.append(Event(str(mode), SYSTEM, _by("order", who)))
            return now._replace(mode=mode)
    elif name == "gain":
        why = "" if 0 <= value <= params.gain_max_mw_per_mhz else f"must be 0 to {params.gain_max_mw_per_mhz:g} MW/mHz"
        if not why:
            events.append(Event(name, SYSTEM, _by(f"{value:g}", who)))
            return now._replace(target_gain_mw_per_mhz=float(value))
    elif name in _OTHERS:
        after = _OTHERS[name](params, now, order, events)
        if isinstance(after, Ordered):
            return after
        why = after
    else:
        why = "no such order"
    events.append(Event("refused", str(name), f"{why}; {_by('order', who)}" if who else why))
    return now


def _by(what: str, who: str) -> str:
    return f"{what} by {who}" if who else what


def _probe_start(params: Params, now: Ordered, order: Order, events: list[Event]) -> Ordered | str:
    if params.probing.kind == "none":
        return "no signal: set kind in [probing]"
    if now.system is not SystemState.ACTIVE:
        return f"not possible in {now.system}"
    if now.probe.is_on:
        return "a signal is under way"
    events.append(Event(order.name, SYSTEM, _by(params.probing.kind, order.who)))
    return now._replace(probe=started(params.waveform))


def _probe_stop(_params: Params, now: Ordered, order: Order, events: list[Event]) -> Ordered | str:
    if not now.probe.is_on:
        return "no signal is under way"
    events.append(Event(order.name, SYSTEM, _by("order", order.who)))
    return now._replace(probe=now.probe._replace(stopping=True))


def _acknowledge(_params: Params, now: Ordered, order: Order, events: list[Event]) -> Ordered | str:
    found = register.open_flags(now.flags, order.text)
    if not found:
        return f"nothing to acknowledge{f': {order.text}' if order.text else ''}"
    who = order.who or "operator"
    events.extend(Event(order.name, flag.subject, f"{flag.name} by {who}") for flag in found)
    return now._replace(flags=register.with_changes(now.flags, [register.acknowledged(flag, who) for flag in found]))


def _release(_params: Params, now: Ordered, order: Order, events: list[Event]) -> Ordered:
    """It is the watchdog's to release its stop: here it is only told."""
    events.append(Event(order.name, SYSTEM, _by("order", order.who)))
    return now


def _link_refused(_params: Params, now: Ordered, order: Order, events: list[Event]) -> Ordered:
    """What came over the operators' link and was no order: an input, so that it is in the log, and replays."""
    who = order.who or "nobody known"
    events.append(Event("refused", LINK, f"{order.text}; said to be by {who}"))
    return now


_OTHERS = {
    "probe_start": _probe_start,
    "probe_stop": _probe_stop,
    "ack": _acknowledge,
    "release": _release,
    LINK_REFUSED: _link_refused,
}
