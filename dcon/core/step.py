"""One tick of the controller: a pure function of parameters, memory, inputs and time.

Order within a tick (section IV a-e): frames of each PMU through checks and differentiator; alignment and difference
of each instance; which instance is active; orders and checks move the system's state; gain, transfer and limit make
the command; all of it becomes the record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from dcon import limiter
from dcon.core import instance as instances_of
from dcon.core import pmu as pmus_of
from dcon.core.checks import Supervisor, SystemView
from dcon.core.law import Transfer, approach, command_mw, saturate
from dcon.core.params import Params
from dcon.core.rows import CORE
from dcon.core.state import Instance, Pmu, State
from dcon.core.system import (
    DRIVING,
    MODE_IS_FREE,
    TRANSITIONS,
    ArmView,
    Trigger,
    mode_of,
    refusal,
    trigger_of,
)
from dcon.core.values import Event, Inputs, InstanceRecord, InstanceState, Mode, Order, Record, SystemState

_SYSTEM = "system"
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time: there are many instances
_DISABLED = InstanceState.DISABLED  # looking a member up costs as much as comparing it


def step(
    params: Params, state: State, inputs: Inputs, now_ns: int, supervisor: Supervisor = CORE
) -> tuple[State, Record]:
    """The memory and the record after a tick at ``now_ns`` (POSIX UTC) with ``inputs``.

    Never raises: input that the controller cannot digest is the event ``internal_error``, FAULT, and 0 MW.
    The same arguments give the same result, to the last bit.
    """
    try:
        return _step(params, state, inputs, now_ns, supervisor)
    except Exception as error:
        return _failed(params, state, now_ns, supervisor, error)


def _step(params: Params, state: State, inputs: Inputs, now_ns: int, supervisor: Supervisor) -> tuple[State, Record]:
    pmus = tuple(
        pmus_of.update(params, supervisor, site, last, samples, now_ns)
        for site, last, samples in zip(params.pmus, state.pmus, inputs.samples, strict=True)
    )
    instances = tuple(
        instances_of.update(params, supervisor, pair, last, pmus, now_ns)
        for pair, last in zip(params.instances, state.instances, strict=True)
    )
    events = _flag_events(params, supervisor, state, pmus, instances)
    ready = sum(instance.is_ready for instance in instances)
    active = instances_of.choose(params, instances, state.active, keep=state.system in DRIVING)
    if active != state.active and active is not None:
        events.append(Event("selected", params.instance_names[active]))
    gain = approach(state.gain_mw_per_mhz, state.target_gain_mw_per_mhz, params.gain_ramp_per_s / params.tick_hz)
    own_mw = _own_mw(params, instances, gain)

    followed = None if active is None else instances[active]
    view = ArmView(ready, 0.0 if active is None else own_mw[active])
    orders = _Orders(state.system, state.mode, state.target_gain_mw_per_mhz)
    for order in sorted(inputs.orders, key=_is_stop):  # a stop has the last word in its tick
        orders = _obey(params, orders, order, view, events)
    raised = 0
    for bit, test in supervisor.system_tests:
        if test(params, SystemView(orders.system, ready, followed)):
            raised |= bit
    system = _supervise(supervisor, orders.system, raised, ready, events)

    target_mw = own_mw[active] if system is SystemState.ACTIVE and active is not None else 0.0
    source = active if system is SystemState.ACTIVE else None
    last_source = state.active if state.system is SystemState.ACTIVE else None
    if system not in DRIVING:
        transfer = Transfer()
    elif source != last_source:
        transfer = Transfer(state.command_mw - target_mw, params.transfer_ticks, params.transfer_ticks)
    else:
        transfer = state.transfer.tick()
    wanted_mw = saturate(target_mw + transfer.residual_mw, params.limit_mw)
    if system in DRIVING:
        limited = limiter.limit(wanted_mw, state.command_mw, 1.0 / params.tick_hz, params.limit_mw)
    else:
        limited = limiter.Limited(0.0, "")
    if limited.reason == "invalid":
        raised |= supervisor.bits["command_invalid"]
        system = _move(system, Trigger.TRIP, "command_invalid", events)
    elif limited.reason == "slew":
        raised |= supervisor.bits["slew_limited"]
    if system is SystemState.RAMPDOWN and transfer.left_ticks == 0 and limited.mw == 0.0:
        system = _move(system, Trigger.RAMPED, "", events)
    events.extend(Event(name, _SYSTEM) for name in supervisor.named(raised & ~state.raised))

    after = State(
        pmus=pmus,
        instances=instances,
        system=system,
        mode=orders.mode,
        active=active,
        gain_mw_per_mhz=gain,
        target_gain_mw_per_mhz=orders.target_gain_mw_per_mhz,
        command_mw=limited.mw,
        transfer=transfer,
        raised=raised,
    )
    return after, _record(params, after, own_mw, events, now_ns)


def _own_mw(params: Params, instances: Sequence[Instance], gain: float) -> list[float]:
    """What each instance alone would command."""
    deadband_mhz, limit_mw = params.deadband_mhz, params.limit_mw
    return [
        0.0 if instance.state is _DISABLED else command_mw(instance.delta_f_mhz, gain, deadband_mhz, limit_mw)
        for instance in instances
    ]


def _is_stop(order: Order) -> bool:
    return order.name == Trigger.ESTOP


class _Orders(NamedTuple):
    """What orders may change."""

    system: SystemState
    mode: Mode
    target_gain_mw_per_mhz: float


def _obey(params: Params, now: _Orders, order: Order, view: ArmView, events: list[Event]) -> _Orders:
    """``now`` after one order; an event says what became of it."""
    name, value = order
    if (trigger := trigger_of(name)) is not None:
        # A second stop changes nothing and is no mistake.
        why = "" if trigger is Trigger.ESTOP else refusal(params, now.system, trigger, view)
        if not why:
            return now._replace(system=_move(now.system, trigger, "order", events))
    elif (mode := mode_of(name)) is not None:
        why = "" if now.system in MODE_IS_FREE or mode is now.mode else f"not in {now.system}: disarm first"
        if not why:
            events.append(Event(str(mode), _SYSTEM, "order"))
            return now._replace(mode=mode)
    elif name == "gain":
        why = "" if 0 <= value <= params.gain_max_mw_per_mhz else f"must be 0 to {params.gain_max_mw_per_mhz:g} MW/mHz"
        if not why:
            events.append(Event(name, _SYSTEM, f"{value:g}"))
            return now._replace(target_gain_mw_per_mhz=float(value))
    else:
        why = "no such order"
    events.append(Event("refused", str(name), why))
    return now


def _supervise(
    supervisor: Supervisor, system: SystemState, raised: int, ready: int, events: list[Event]
) -> SystemState:
    """The system's state after what is not an order; a stop that was ordered stands."""
    if ready:
        system = _move(system, Trigger.READY, "", events)
    if raised & supervisor.disarming:
        system = _move(system, Trigger.DISARM, " ".join(supervisor.named(raised & supervisor.disarming)), events)
    if raised & supervisor.tripping:
        system = _move(system, Trigger.TRIP, " ".join(supervisor.named(raised & supervisor.tripping)), events)
    return system


def _move(system: SystemState, trigger: Trigger, why: str, events: list[Event]) -> SystemState:
    after = TRANSITIONS.get((system, trigger))
    if after is None:
        return system
    events.append(Event(after.lower(), _SYSTEM, why))
    return after


_INSTANCE_EVENTS = {
    InstanceState.DISABLED: "instance_disabled",
    InstanceState.INITIALISING: "instance_initialising",
    InstanceState.READY: "instance_ready",
}


def _flag_events(
    params: Params, supervisor: Supervisor, last: State, pmus: Sequence[Pmu], instances: Sequence[Instance]
) -> list[Event]:
    """Checks that rose and instances that changed state, in this tick."""
    events: list[Event] = []
    for site, before, pmu in zip(params.pmus, last.pmus, pmus, strict=True):
        if new := pmu.raised & ~before.raised:
            events.extend(Event(name, site.name) for name in supervisor.named(new))
    for index, (old, instance) in enumerate(zip(last.instances, instances, strict=True)):
        name = params.instance_names[index]
        if new := instance.raised & ~old.raised:
            events.extend(Event(check, name) for check in supervisor.named(new))
        if instance.state is not old.state and not (instance.is_ready and old.is_ready):
            events.append(Event(_INSTANCE_EVENTS[instance.state], name, instance.reason))
    return events


def _record(params: Params, state: State, own_mw: Sequence[float], events: Sequence[Event], now_ns: int) -> Record:
    flags = state.raised
    for pmu in state.pmus:
        flags |= pmu.raised
    for instance in state.instances:
        flags |= instance.raised
    driven = state.mode is Mode.CLOSED_LOOP and state.system in DRIVING
    active = state.active
    return Record(
        tick_ns=now_ns,
        state=state.system,
        mode=state.mode,
        active=active,
        gain_mw_per_mhz=state.gain_mw_per_mhz,
        delta_f_mhz=math.nan if active is None else state.instances[active].delta_f_mhz,
        command_mw=state.command_mw,
        output_v=limiter.volts(state.command_mw) if driven else 0.0,
        probe_mw=0.0,
        flags=flags,
        f_hz=tuple(params.nominal_hz + pmu.ring[0] if pmu.ring else math.nan for pmu in state.pmus),
        age_ms=tuple(math.nan if pmu.arrival_ns is None else (now_ns - pmu.time_ns) / 1e6 for pmu in state.pmus),
        instances=tuple(
            _new(InstanceRecord, (instance.state, index == active, instance.delta_f_mhz, mw, instance.reason))
            for index, (instance, mw) in enumerate(zip(state.instances, own_mw, strict=True))
        ),
        events=tuple(events),
    )


def _failed(
    params: Params, state: State, now_ns: int, supervisor: Supervisor, error: Exception
) -> tuple[State, Record]:
    """0 MW and FAULT; the memory is that of the last good tick, and the frames of this one count as lost."""
    events = [Event("internal_error", _SYSTEM, f"{type(error).__name__}: {error}")]
    after = state._replace(
        system=_move(state.system, Trigger.TRIP, "internal_error", events),
        command_mw=0.0,
        transfer=Transfer(),
        raised=state.raised | supervisor.bits["internal_error"],
    )
    shown = after._replace(pmus=(Pmu(),) * len(after.pmus))  # the input that failed may be anything, now_ns too
    return after, _record(params, shown, (0.0,) * len(after.instances), events, now_ns)
