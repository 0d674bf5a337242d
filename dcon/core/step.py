"""One tick of the controller: a pure function of parameters, memory, inputs and time.

Order within a tick (section IV a-e): frames of each PMU through checks and differentiator; alignment and difference
of each instance; which instance is active; checks and orders move the system's state; gain, transfer, probing signal
and limit make the command; all of it becomes the record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from dcon import limiter
from dcon.core import instance as instances_of
from dcon.core import pmu as pmus_of
from dcon.core.changes import changed_instances, changed_pmus, changes, compared
from dcon.core.checks import Supervisor, SystemView, judge, which
from dcon.core.command import NONE, Command, form
from dcon.core.differentiator import wrap
from dcon.core.feedback import QUIET, Feedback, watched
from dcon.core.law import Transfer, approach, command_mw
from dcon.core.orders import SYSTEM, Ordered, is_stop, moved, obey
from dcon.core.params import Params
from dcon.core.probe import IDLE
from dcon.core.register import Register, latched, risen, still_up, with_changes
from dcon.core.rows import CORE
from dcon.core.state import Instance, Pmu, State
from dcon.core.system import DRIVING, ArmView, Trigger
from dcon.core.values import NOTHING, Event, Flag, Inputs, InstanceRecord, InstanceState, Record, SystemState

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
    tables = supervisor.tables(params)
    told = inputs.surroundings
    unread = told.unread or (0,) * len(params.pmus)
    pmus = tuple(
        [
            pmus_of.update(params, supervisor, tables, site, last, samples, now_ns, lost)
            for site, last, samples, lost in zip(params.pmus, state.pmus, inputs.samples, unread, strict=True)
        ]
    )
    instances, quiet = instances_of.update(params, supervisor, tables, state.instances, pmus, now_ns)
    ready = len(instances) if quiet else sum([instance.is_ready for instance in instances])
    active = instances_of.choose(params, instances, state.active, keep=state.system in DRIVING)
    gain = approach(state.gain_mw_per_mhz, state.target_gain_mw_per_mhz, params.gain_ramp_per_s / params.tick_hz)
    own_mw = _own_mw(params, instances, gain)

    angle_deg = None if active is None else _angle_deg(params, pmus, active)
    overruns = (state.overruns << 1 | bool(told.overrun)) & ((1 << params.tick_hz) - 1)
    view = SystemView(
        state.system,
        ready,
        None if active is None else instances[active],
        angle_deg,
        _slipped(state, active, angle_deg),
        overruns,
        state.feedback,
        state.driven_mw,
        told,
        now_ns,
    )
    rows = tables.system[which(state.system is SystemState.ACTIVE, told != NOTHING or params.requires)]
    raised, held, evidence = judge(rows, state.held, (params, view))

    events: list[Event] = []
    flags = changed_pmus(params, supervisor, tables, state, pmus, now_ns, events)
    if not quiet:
        flags = changed_instances(params, supervisor, tables, state, instances, flags, now_ns, events)
    if active != state.active and active is not None:
        events.append(Event("selected", params.instance_names[active]))
    of_commands = state.raised & supervisor.of_commands
    flags = compared(supervisor, tables, flags, SYSTEM, state.raised ^ of_commands, raised, evidence, now_ns)
    ordered = Ordered(state.system, state.mode, state.target_gain_mw_per_mhz, state.probe, flags)
    if inputs.orders:
        arm = ArmView(
            ready,
            0.0 if active is None else own_mw[active],
            told,
            now_ns,
            state.driven_mw,
            tuple(latched(flags)),
            tuple(supervisor.named(raised & (supervisor.tripping | supervisor.stopping))),
            tuple(still_up(flags)),
        )
        for order in sorted(inputs.orders, key=is_stop):
            ordered = obey(params, ordered, order, arm, events)
    system, flags = _supervise(supervisor, ordered.system, ordered.flags, raised, ready, events)

    command = form(
        params, state, system, ordered.mode, active, 0.0 if active is None else own_mw[active], ordered.probe
    )
    extra = 0
    if not command.valid:
        extra |= supervisor.bits["command_invalid"]
    elif command.slewed:
        extra |= supervisor.bits["slew_limited"]
    flags = compared(supervisor, tables, flags, SYSTEM, of_commands, extra, (), now_ns)
    raised |= extra
    if not command.valid:
        system, flags = _supervise(supervisor, system, flags, extra, 0, events)
        command = NONE
    if system is SystemState.RAMPDOWN and command.is_over:
        system = moved(system, Trigger.RAMPED, "", events)
    if ordered.probe.is_on and not command.probe.is_on:
        events.append(Event("probe_end", SYSTEM))
    if new := raised & ~state.raised:
        events.extend(Event(name, SYSTEM) for name in supervisor.named(new))

    after = State(
        pmus,
        instances,
        system,
        ordered.mode,
        active,
        gain,
        ordered.target_gain_mw_per_mhz,
        command.command_mw,
        command.transfer,
        raised,
        held,
        command.driven_mw,
        command.probe,
        _watched(params, state, command, instances, active, gain) if system is SystemState.ACTIVE else QUIET,
        angle_deg,
        overruns,
        flags,
    )
    return after, _record(params, after, command, own_mw, events, changes(state.flags, flags), now_ns)


def _own_mw(params: Params, instances: Sequence[Instance], gain: float) -> list[float]:
    """What each instance alone would command."""
    deadband_mhz, limit_mw = params.deadband_mhz, params.limit_mw
    return [
        0.0 if instance.state is _DISABLED else command_mw(instance.delta_f_mhz, gain, deadband_mhz, limit_mw)
        for instance in instances
    ]


def _watched(
    params: Params, state: State, command: Command, instances: Sequence[Instance], active: int | None, gain: float
) -> Feedback:
    delta_f_mhz = 0.0 if active is None else instances[active].delta_f_mhz
    asked_mw = command_mw(delta_f_mhz, gain, params.deadband_mhz, math.inf)
    return watched(params, state.feedback, command.command_mw, asked_mw)


def _angle_deg(params: Params, pmus: Sequence[Pmu], active: int) -> float:
    """North minus south by the newest frame of each; their stamps may be ``alignment_skew_frames`` apart."""
    north, south = params.instances[active]
    return math.degrees(wrap(pmus[north].filter.theta_rad - pmus[south].filter.theta_rad))


def _slipped(state: State, active: int | None, angle_deg: float | None) -> bool:
    if angle_deg is None or state.angle_deg is None or active != state.active:
        return False
    return abs(angle_deg - state.angle_deg) > 180


def _supervise(
    supervisor: Supervisor, system: SystemState, flags: Register, raised: int, ready: int, events: list[Event]
) -> tuple[SystemState, Register]:
    """State and register after what is not an order; a stop that was ordered stands. What acts is latched."""
    if ready:
        system = moved(system, Trigger.READY, "", events)
    for trigger, mask in (
        (Trigger.DISARM, supervisor.disarming),
        (Trigger.TRIP, supervisor.tripping),
        (Trigger.ESTOP, supervisor.stopping),
    ):
        if not raised & mask:
            continue
        names = supervisor.named(raised & mask)
        after = moved(system, trigger, " ".join(names), events)
        if after is not system:
            acted = [flag for name in names if (flag := flags.get((name, SYSTEM))) is not None]
            flags = with_changes(flags, [flag._replace(latched=True) for flag in acted])
            system = after
    return system, flags


def _record(
    params: Params,
    state: State,
    command: Command,
    own_mw: Sequence[float],
    events: Sequence[Event],
    flag_changes: tuple[Flag, ...],
    now_ns: int,
) -> Record:
    flags = state.raised
    for pmu in state.pmus:
        flags |= pmu.raised
    for instance in state.instances:
        flags |= instance.raised
    active, nominal_hz = state.active, params.nominal_hz
    return Record(
        tick_ns=now_ns,
        state=state.system,
        mode=state.mode,
        active=active,
        gain_mw_per_mhz=state.gain_mw_per_mhz,
        delta_f_mhz=math.nan if active is None else state.instances[active].delta_f_mhz,
        command_mw=state.command_mw,
        output_v=limiter.volts(state.driven_mw),
        probe_mw=command.probe_mw,
        flags=flags,
        f_hz=tuple([nominal_hz + pmu.ring[0] if pmu.ring else math.nan for pmu in state.pmus]),
        age_ms=tuple([math.nan if pmu.arrival_ns is None else (now_ns - pmu.time_ns) / 1e6 for pmu in state.pmus]),
        instances=tuple(
            [
                _new(InstanceRecord, (at, index == active, delta_f_mhz, mw, reason))
                for index, ((at, _, _, delta_f_mhz, reason, _, _, _), mw) in enumerate(
                    zip(state.instances, own_mw, strict=True)
                )
            ]
        ),
        events=tuple(events),
        flag_changes=flag_changes,
    )


def _failed(
    params: Params, state: State, now_ns: int, supervisor: Supervisor, error: Exception
) -> tuple[State, Record]:
    """0 MW and FAULT; the memory is that of the last good tick, and the frames of this one count as lost."""
    events = [Event("internal_error", SYSTEM, f"{type(error).__name__}: {error}")]
    bit = supervisor.bits["internal_error"]
    flags = state.flags
    if not state.raised & bit:
        flags = with_changes(flags, [risen(flags, "internal_error", SYSTEM, now_ns)])
    system, flags = _supervise(supervisor, state.system, flags, bit, 0, events)
    after = state._replace(
        system=system,
        command_mw=0.0,
        driven_mw=0.0,
        probe=IDLE,
        transfer=Transfer(),
        feedback=QUIET,
        raised=state.raised | bit,
        flags=flags,
    )
    shown = after._replace(pmus=(Pmu(),) * len(after.pmus))  # the input that failed may be anything, now_ns too
    own_mw = (0.0,) * len(after.instances)
    return after, _record(params, shown, NONE, own_mw, events, changes(state.flags, flags), now_ns)
