"""What the watchdog decides: pure, without clock or socket. The same arguments give the same result.

The relays are two in series, each by a computation of its own, and both must be closed for a command to pass. Power
for them is held only while a step says so: whatever stops the steps lets them open.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Final, NamedTuple

from dcon.watchdog.codec import CLOSED, RELAYS
from dcon.watchdog.limits import FULL_SCALE_V, MW_PER_V, PERIOD_MS, Limits, Rules
from dcon.watchdog.memory import MS, Item, Memory, State, absorbed, forwarded
from dcon.watchdog.rules import Action, Finding, causes_of, judge


class Trigger(StrEnum):
    """What moves the state; of several in one step the first of this list counts."""

    LATCH = "latch"
    """A rule with the action ``latch`` is up."""
    TRIP = "trip"
    """A rule with the action ``trip`` is up."""
    RESET = "reset"
    """An operator's word, while no rule is up that would trip."""
    OPEN = "open"
    """The command does not ask for closed relays any more."""
    CLOSE = "close"
    """It asks, near 0 V, has been seen not to ask, and no rule is up but warnings."""


TRANSITIONS: Final[dict[tuple[State, Trigger], State]] = {
    (State.OPEN, Trigger.CLOSE): State.CLOSED,
    (State.CLOSED, Trigger.OPEN): State.OPEN,
    (State.CLOSED, Trigger.TRIP): State.TRIPPED,
    (State.CLOSED, Trigger.LATCH): State.TRIPPED,
    (State.OPEN, Trigger.LATCH): State.TRIPPED,
    (State.TRIPPED, Trigger.RESET): State.OPEN,
}
"""(state, trigger) -> state; what is not listed changes nothing."""


class Forward(NamedTuple):
    """A command that leaves."""

    sequence: int
    time_ns: int | None
    """UTC of the tick; None is now."""
    volts: float
    mw: float
    flags: int


class Event(NamedTuple):
    """A line of the watchdog's log."""

    name: str
    """``trip``, ``close``, ``open``, ``reset``, ``estop``, ``estop_release``, ``refused`` (a reset, or a request to
    close), ``warning`` or ``warning_over``."""
    who: str = ""
    found: tuple[Finding, ...] = ()


class Decision(NamedTuple):
    """What follows from a step."""

    state: State
    relay_a: bool
    """Closed."""
    relay_b: bool
    estop: int
    """Released: bits 0 software, 1 line a, 2 line b; a line that is not fitted is."""
    healthy: bool
    """The relays would close if they were asked to, or may stay closed."""
    causes: int
    """Up, or latched by a trip."""
    forward: Forward | None
    tell: bool
    """A status is due."""
    events: tuple[Event, ...]


def safe_volts(volts: float) -> float:
    """The limiter: finite, within ±10 V; 0 V for what is no number."""
    if not math.isfinite(volts):
        return 0.0
    return max(-FULL_SCALE_V, min(FULL_SCALE_V, volts))


def asks(memory: Memory) -> bool:
    """The newest command asks for closed relays."""
    return memory.command is not None and memory.command.relays


def may_close(limits: Limits, memory: Memory, blocked: int) -> bool:
    """All that it takes to close, but for the state."""
    return not blocked and memory.low_seen and asks(memory) and memory.worst.volts <= limits.close_max_v


def second_relay(limits: Limits, memory: Memory, found: tuple[Finding, ...]) -> bool:
    """Whether relay b is closed: decided from what was found, without the table that relay a follows."""
    blocked = causes_of(found, Action.BLOCK)
    if not asks(memory) or memory.latched or causes_of(found, Action.TRIP, Action.LATCH):
        return False
    return memory.relay_b or may_close(limits, memory, blocked)


def trigger_of(limits: Limits, memory: Memory, found: tuple[Finding, ...]) -> Trigger | None:
    """What a step's findings amount to."""
    if causes_of(found, Action.LATCH):
        return Trigger.LATCH
    if causes_of(found, Action.TRIP):
        return Trigger.TRIP
    if memory.state is State.TRIPPED and any(word.verb == "reset" for word in memory.words):
        return Trigger.RESET
    if not asks(memory):
        return Trigger.OPEN
    blocked = causes_of(found, Action.BLOCK)
    return Trigger.CLOSE if may_close(limits, memory, blocked) else None


def estop_bits(memory: Memory) -> int:
    """Released: bits 0 software, 1 line a, 2 line b."""
    lines = (False, False) if memory.inputs is None else memory.inputs[:2]
    a, b = (released is None or bool(released) for released in lines)
    return (not memory.estop) | a << 1 | b << 2


def moved(memory: Memory, state: State, found: tuple[Finding, ...]) -> Memory:
    """The memory after the step's transition."""
    tripping, blocking = causes_of(found, Action.TRIP, Action.LATCH), causes_of(found, Action.BLOCK)
    low_seen = memory.low_seen and not (asks(memory) and tripping | blocking)  # a request that is refused is spent
    if state is not State.TRIPPED:
        latched = 0
        low_seen = low_seen and memory.state is not State.TRIPPED  # a reset asks for a new request
    else:
        latched = memory.latched | tripping
    return memory._replace(state=state, latched=latched, low_seen=low_seen)


def events_of(before: Memory, memory: Memory, after: Memory, found: tuple[Finding, ...], warned: int) -> list[Event]:
    """What a step has to tell: the memory ``before``, with its news, and ``after`` it."""
    events = []
    stops = tuple(finding for finding in found if finding.rule.action is not Action.WARN)
    for word in memory.words:
        if word.verb != "reset":
            events.append(Event(word.verb, word.who))
        elif before.state is State.TRIPPED and after.state is State.OPEN:
            events.append(Event("reset", word.who))
        else:
            events.append(Event("refused", word.who, stops))
    if after.state is not before.state and after.state is State.TRIPPED:
        events.append(Event("trip", found=stops))
    elif after.state is State.CLOSED and before.state is State.OPEN:
        events.append(Event("close"))
    elif after.state is State.OPEN and before.state is State.CLOSED:
        events.append(Event("open"))
    elif after.state is State.OPEN and memory.low_seen and not after.low_seen and before.state is State.OPEN:
        events.append(Event("refused", found=stops))
    if (rising := warned & ~before.warned) or before.warned & ~warned:
        warnings = tuple(finding for finding in found if finding.rule.action is Action.WARN)
        events.append(Event("warning" if rising else "warning_over", found=warnings))
    return events


def forward_of(memory: Memory, closed: bool, was_closed: bool, now_ns: int) -> tuple[Memory, Forward | None]:
    """Closed, each new command; open, 0 V at once and then each period."""
    command = memory.command
    if closed and command is not None:
        if memory.command_ns != now_ns:
            return memory, None
        volts, time_ns, flags = safe_volts(command.volts), command.time_ns, RELAYS | CLOSED
    else:
        if not was_closed and memory.sent_ns is not None and now_ns - memory.sent_ns < PERIOD_MS * MS:
            return memory, None
        volts, time_ns, flags = 0.0, None, 0
    forward = Forward(memory.sequence, time_ns, volts, volts * MW_PER_V, flags)
    return forwarded(memory, volts, now_ns), forward


def told(memory: Memory, shown: tuple[int, ...], now_ns: int) -> tuple[Memory, bool]:
    """Whether a status is due: it changed, or a period has gone by."""
    due = shown != memory.shown or memory.told_ns is None or now_ns - memory.told_ns >= PERIOD_MS * MS
    return (memory._replace(shown=shown, told_ns=now_ns) if due else memory), due


def step(rules: Rules, memory: Memory, news: Sequence[Item], now_ns: int) -> tuple[Memory, Decision]:
    """One round: the news of it, in order of arrival, at ``now_ns`` of CLOCK_MONOTONIC."""
    before, memory = memory, absorbed(rules, memory, news, now_ns)
    found = judge(rules, memory, now_ns)
    trigger = trigger_of(rules.limits, memory, found)
    state = memory.state if trigger is None else TRANSITIONS.get((memory.state, trigger), memory.state)
    after = moved(memory, state, found)

    relay_a, relay_b = after.state is State.CLOSED, second_relay(rules.limits, after, found)
    warned, blocking = causes_of(found, Action.WARN), causes_of(found, Action.BLOCK, Action.TRIP, Action.LATCH)
    healthy = not (blocking or after.latched or after.state is State.TRIPPED)
    causes = blocking | warned | after.latched
    events = events_of(before, memory, after, found, warned)
    after, forward = forward_of(after, relay_a and relay_b, before.state is State.CLOSED, now_ns)
    shown = (relay_a, relay_b, estop_bits(after), after.state, healthy, causes)
    after, tell = told(after._replace(relay_b=relay_b, warned=warned), shown, now_ns)
    return after, Decision(after.state, relay_a, relay_b, shown[2], healthy, causes, forward, tell, tuple(events))
