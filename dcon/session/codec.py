"""Values of a tick <-> the messages of a session log (:mod:`pmutools.schema.messages`), exact to the last bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dcon.core.values import (
    NOTHING,
    Event,
    Flag,
    InstanceRecord,
    InstanceState,
    Mode,
    Order,
    Pdci,
    Record,
    Sample,
    Surroundings,
    SystemState,
)
from pmutools.schema.descriptors import message_class
from pmutools.schema.pmu_log import PmuFrame

NO_INSTANCE = -1

_SYSTEM_STATES = {str(state): state for state in SystemState}
_MODES = {str(mode): mode for mode in Mode}
_INSTANCE_STATES = {str(state): state for state in InstanceState}


class Timing(NamedTuple):
    """How a tick ran: microseconds from its start to its command, and from its nominal time to its start, which is when
    the loop woke up."""

    compute_us: float
    late_us: float


class Watchdog(NamedTuple):
    """State of the watchdog at ``time_ns``; ``heartbeats`` are (component, age in ms)."""

    time_ns: int
    relays_closed: bool
    estop: bool = False
    latched: bool = False
    reason: str = ""
    """Causes that are up, or latched, with blanks between them."""
    heartbeats: tuple[tuple[str, float], ...] = ()
    silent: bool = False
    """It has said nothing for too long: this is its last word."""


def encode_tick(record: Record, instances: Sequence[str]) -> bytes:
    """``/dcon/tick``; ``instances`` are the names that ``record.active`` counts in."""
    active = record.active
    message = message_class("Tick")(
        tick_ns=record.tick_ns,
        state=record.state,
        mode=record.mode,
        active=NO_INSTANCE if active is None else active,
        active_instance="" if active is None else instances[active],
        gain_mw_per_mhz=record.gain_mw_per_mhz,
        delta_f_mhz=record.delta_f_mhz,
        command_mw=record.command_mw,
        output_v=record.output_v,
        probe_mw=record.probe_mw,
        flags=record.flags,
        f_hz=record.f_hz,
        age_ms=record.age_ms,
    )
    return bytes(message.SerializeToString())


def encode_instances(record: Record) -> bytes:
    """``/dcon/instance``: all instances of one tick."""
    state, active, delta_f_mhz, command_mw, reason = (
        zip(*record.instances, strict=True) if record.instances else ((),) * 5
    )
    message = message_class("Instance")(
        tick_ns=record.tick_ns,
        state=state,
        active=active,
        delta_f_mhz=delta_f_mhz,
        command_mw=command_mw,
        reason=reason,
    )
    return bytes(message.SerializeToString())


def decode_record(tick: Any, instance: Any, events: Sequence[Any], flags: Sequence[Any] = ()) -> Record:
    """The record of one tick from its decoded messages; raises ValueError for a state that this version lacks."""
    try:
        return Record(
            tick.tick_ns,
            _SYSTEM_STATES[tick.state],
            _MODES[tick.mode],
            None if tick.active == NO_INSTANCE else tick.active,
            tick.gain_mw_per_mhz,
            tick.delta_f_mhz,
            tick.command_mw,
            tick.output_v,
            tick.probe_mw,
            tick.flags,
            tuple(tick.f_hz),
            tuple(tick.age_ms),
            decode_instances(instance),
            tuple([Event(event.name, event.subject, event.detail) for event in events]),
            tuple(map(decode_flag, flags)),
        )
    except KeyError as error:
        raise ValueError(f"tick {tick.tick_ns}: unknown state {error}") from None


def decode_instances(instance: Any) -> tuple[InstanceRecord, ...]:
    """Raises KeyError for an unknown state, ValueError where the message's lists differ in length."""
    columns = (instance.active, instance.delta_f_mhz, instance.command_mw, instance.reason)
    states = [_INSTANCE_STATES[state] for state in instance.state]
    return tuple(map(InstanceRecord._make, zip(states, *columns, strict=True)))


def encode_event(tick_ns: int, event: Event) -> bytes:
    message = message_class("Event")(tick_ns=tick_ns, name=event.name, subject=event.subject, detail=event.detail)
    return bytes(message.SerializeToString())


def encode_order(tick_ns: int, order: Order) -> bytes:
    return bytes(message_class("Setting")(tick_ns=tick_ns, **order._asdict()).SerializeToString())


def decode_order(message: Any) -> Order:
    return Order(message.name, message.value, message.text, message.who, message.why)


def encode_flag(tick_ns: int, flag: Flag) -> bytes:
    return bytes(message_class("Flag")(tick_ns=tick_ns, **flag._asdict()).SerializeToString())


def decode_flag(message: Any) -> Flag:
    return Flag._make(getattr(message, name) for name in Flag._fields)


def encode_surroundings(tick_ns: int, told: Surroundings) -> bytes:
    given = {name: value for name, value in told._asdict().items() if value is not None}
    unread, pdci = given.pop("unread"), given.pop("pdci", None)
    message = message_class("Surroundings")(tick_ns=tick_ns, told=list(given), unread=unread, **given)
    if pdci is not None:
        message.told.append("pdci")
        for name, value in pdci._asdict().items():
            setattr(message, f"pdci_{name}", value)
    return bytes(message.SerializeToString())


def decode_surroundings(message: Any | None) -> Surroundings:
    """The inverse; no message is NOTHING. What this version does not know is left out."""
    if message is None:
        return NOTHING
    told: dict[str, Any] = {name: getattr(message, name) for name in message.told if name in _TOLD}
    if "pdci" in message.told:
        told["pdci"] = Pdci._make(getattr(message, f"pdci_{name}") for name in Pdci._fields)
    return Surroundings(**told, unread=tuple(message.unread))


_TOLD = frozenset(Surroundings._fields) - {"pdci", "unread"}


def encode_timing(tick_ns: int, timing: Timing) -> bytes:
    message = message_class("Timing")(tick_ns=tick_ns, compute_us=timing.compute_us, late_us=timing.late_us)
    return bytes(message.SerializeToString())


def encode_counts(tick_ns: int, counts: Mapping[str, int]) -> bytes:
    """By name; those that are 0 are left out."""
    known = {name: value for name, value in counts.items() if value}
    message = message_class("Counts")(tick_ns=tick_ns, name=list(known), value=list(known.values()))
    return bytes(message.SerializeToString())


def encode_pdci(tick_ns: int, pdci: Pdci) -> bytes:
    return bytes(message_class("Pdci")(tick_ns=tick_ns, **pdci._asdict()).SerializeToString())


def decode_pdci(message: Any) -> Pdci:
    return Pdci._make(getattr(message, name) for name in Pdci._fields)


def encode_watchdog(watchdog: Watchdog) -> bytes:
    message = message_class("Watchdog")(
        time_ns=watchdog.time_ns,
        relays_closed=watchdog.relays_closed,
        estop=watchdog.estop,
        latched=watchdog.latched,
        reason=watchdog.reason,
        heartbeat=[name for name, _ in watchdog.heartbeats],
        heartbeat_age_ms=[age for _, age in watchdog.heartbeats],
        silent=watchdog.silent,
    )
    return bytes(message.SerializeToString())


def sample_of(frame: PmuFrame) -> Sample:
    """The controller's view of a logged frame."""
    arrival_ns = frame.time_ns if frame.arrival_ns is None else frame.arrival_ns
    return Sample(
        frame.time_ns, arrival_ns, frame.v1, frame.frequency_hz, frame.stat, frame.time_quality, frame.time_base
    )
