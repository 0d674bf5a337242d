"""What opens the relays: a table of rules. Each judges one number, and is up above its limit.

A number that is not known is infinite; None is "not judged": the rule is down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import StrEnum
from typing import Final, NamedTuple

from dcon.watchdog.codec import FAILED, LOOPS, RUNNING
from dcon.watchdog.limits import WINDOW_MS, Rules
from dcon.watchdog.memory import MS, Memory, Offences, State

CAUSES: Final = (
    *LOOPS,
    "command_silent",
    "malformed",
    "range",
    "mismatch",
    "sequence",
    "stamp",
    "unasked",
    "readback_silent",
    "readback",
    "estop_software",
    "estop_a",
    "estop_b",
    "estop_discrepancy",
    "relay_open",
    "relay_welded",
    "drive",
    "late",
    "latch_unreadable",
)
"""Bits of ``causes`` in a status, lowest first. All rules of one loop share the loop's bit; the last is of no rule, but
of a latch that was found at the start and could not be read."""


class Action(StrEnum):
    """What a rule does while it is up."""

    WARN = "warn"
    """It is told, and nothing else."""
    BLOCK = "block"
    """The relays do not close."""
    TRIP = "trip"
    """Closed relays open, latched; open ones do not close."""
    LATCH = "latch"
    """Trips in every state: a reset is needed even where the relays were open."""


def silent_ms(rules: Rules, memory: Memory, at: int, now_ns: int) -> float | None:
    """Time since the last beat."""
    loop = memory.loops[at]
    if loop is None:
        return math.inf if LOOPS[at] in rules.beats else None
    return (now_ns - loop.heard_ns) / MS


def stuck_ms(_rules: Rules, memory: Memory, at: int, _now_ns: int) -> float | None:
    """Time in which beats came and the counter stood."""
    loop = memory.loops[at]
    return None if loop is None else (loop.heard_ns - loop.advanced_ns) / MS


def racing_hz(_rules: Rules, memory: Memory, at: int, _now_ns: int) -> float | None:
    """Advance of the counter in a second; one that goes back has gone nearly all the way round."""
    loop = memory.loops[at]
    if loop is None:
        return None
    return max(loop.per_s, loop.moved / WINDOW_MS * 1000)


def failed(_rules: Rules, memory: Memory, at: int, _now_ns: int) -> float | None:
    """The loop says that it has failed."""
    loop = memory.loops[at]
    return None if loop is None else float(loop.state == FAILED)


def not_running(_rules: Rules, memory: Memory, at: int, _now_ns: int) -> float | None:
    """The loop says that it is starting, or ending."""
    loop = memory.loops[at]
    return None if loop is None else float(loop.state != RUNNING)


def command_silent_ms(_rules: Rules, memory: Memory, _at: int, now_ns: int) -> float | None:
    """Time since the last command."""
    return math.inf if memory.command is None else (now_ns - memory.command_ns) / MS


def _recent(offences: Offences, now_ns: int) -> float:
    return float(offences.times if now_ns - offences.last_ns <= WINDOW_MS * MS else 0)


def malformed(_rules: Rules, memory: Memory, _at: int, now_ns: int) -> float | None:
    """Datagrams of a wrong size, magic, CRC or value, with less than a second from one to the next."""
    return _recent(memory.malformed, now_ns)


def out_of_order(_rules: Rules, memory: Memory, _at: int, now_ns: int) -> float | None:
    """Commands whose sequence repeats or goes back, with less than a second from one to the next."""
    return _recent(memory.disorder, now_ns)


def range_v(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """The command's volts, either way."""
    return memory.worst.volts


def mismatch_mw(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """What the command's MW and 12.5 MW/V times its volts differ by."""
    return memory.worst.mismatch_mw


def stamp_ms(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """What the command's time and the watchdog's clock differ by."""
    return memory.worst.stamp_ms


def unasked_v(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """The command's volts while it does not ask for closed relays."""
    return memory.worst.unasked_v


def readback_silent_ms(rules: Rules, memory: Memory, _at: int, now_ns: int) -> float | None:
    """Time since the last readback."""
    if memory.readback_ns is None:
        return math.inf if rules.readback_required else None
    return (now_ns - memory.readback_ns) / MS


def readbacks_off(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """Readbacks in a row that are not what was forwarded."""
    return float(memory.readbacks_off)


def estop_pressed(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """An operator's word."""
    return float(memory.estop)


def line_pressed(_rules: Rules, memory: Memory, at: int, _now_ns: int) -> float | None:
    """The line's file does not say 1."""
    if memory.inputs is None:
        return 1.0
    released = (memory.inputs.estop_a, memory.inputs.estop_b)[at]
    return None if released is None else float(not released)


def discrepancy_ms(_rules: Rules, memory: Memory, _at: int, now_ns: int) -> float | None:
    """Time for which one line is pressed and the other is not."""
    return 0.0 if memory.differ_ns is None else (now_ns - memory.differ_ns) / MS


def open_ms(_rules: Rules, memory: Memory, at: int, now_ns: int) -> float | None:
    """Time for which the contact is not closed though that was ordered."""
    since_ns = memory.wrong_ns[at]
    return 0.0 if since_ns is None or memory.state is not State.CLOSED else (now_ns - since_ns) / MS


def welded_ms(_rules: Rules, memory: Memory, at: int, now_ns: int) -> float | None:
    """Time for which the contact is not open though that was ordered."""
    since_ns = memory.wrong_ns[at]
    return 0.0 if since_ns is None or memory.state is State.CLOSED else (now_ns - since_ns) / MS


def drive_failed(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """A file that drives a relay cannot be written."""
    return float(memory.drive_failed)


def late_ms(_rules: Rules, memory: Memory, _at: int, _now_ns: int) -> float | None:
    """How late the watchdog's own round came."""
    return memory.late_ms


class Rule(NamedTuple):
    """One row."""

    name: str
    cause: str
    """Its bit: one of :data:`CAUSES`."""
    action: Action
    value: Callable[[Rules, Memory, int, int], float | None]
    limit: str = ""
    """Its limit by name; "" is 0."""
    unit: str = ""
    text: str = ""
    """For the operator."""
    at: int = 0
    """Which of several loops, lines or contacts."""
    reached: bool = False
    """Up at its limit, not only above it."""


class _Timing(NamedTuple):
    timeout: str
    rate: str
    silent: Action = Action.TRIP


_FRONT = _Timing("fast_timeout_ms", "front_rate_max_hz")
_SLOW = _Timing("slow_timeout_ms", "slow_rate_max_hz")
_TIMING: Final = {
    "control": _Timing("fast_timeout_ms", "control_rate_max_hz"),
    "udp": _FRONT,
    "parse": _FRONT,
    "server": _Timing("server_timeout_ms", "slow_rate_max_hz", Action.WARN),
}


def rules_of(at: int) -> tuple[Rule, ...]:
    """The rules of one loop's beats."""
    name = LOOPS[at]
    timing = _TIMING.get(name, _SLOW)
    act, block = timing.silent, min(timing.silent, Action.BLOCK, key=list(Action).index)
    return (
        Rule(f"{name}_silent", name, act, silent_ms, timing.timeout, "ms", f"the {name} loop does not beat", at),
        Rule(
            f"{name}_stuck", name, act, stuck_ms, timing.timeout, "ms", f"the {name} loop beats, and stands still", at
        ),
        Rule(f"{name}_racing", name, act, racing_hz, timing.rate, "1/s", f"the {name} loop counts too fast", at),
        Rule(f"{name}_failed", name, act, failed, "", "", f"the {name} loop has failed", at),
        Rule(f"{name}_not_running", name, block, not_running, "", "", f"the {name} loop is not running", at),
    )


_TRIP, _LATCH = Action.TRIP, Action.LATCH
OTHERS: Final = (
    Rule("command_silent", "command_silent", _TRIP, command_silent_ms, "command_timeout_ms", "ms", "no command comes"),
    Rule("malformed", "malformed", _TRIP, malformed, "malformed_max", "", "a datagram is malformed"),
    Rule("range", "range", _TRIP, range_v, "range_max_v", "V", "the command is out of range"),
    Rule("mismatch", "mismatch", _TRIP, mismatch_mw, "mismatch_max_mw", "MW", "the command's MW and volts disagree"),
    Rule("sequence", "sequence", _TRIP, out_of_order, "", "", "a command repeats, or goes back"),
    Rule("stamp", "stamp", _TRIP, stamp_ms, "stamp_max_ms", "ms", "the command is not of now"),
    Rule("unasked", "unasked", _TRIP, unasked_v, "unasked_max_v", "V", "volts, though no relays are asked for"),
    Rule(
        "readback_silent",
        "readback_silent",
        _TRIP,
        readback_silent_ms,
        "readback_timeout_ms",
        "ms",
        "no readback comes",
    ),
    Rule(
        "readback",
        "readback",
        _TRIP,
        readbacks_off,
        "readback_count",
        "",
        "the output is not as forwarded",
        reached=True,
    ),
    Rule("estop_software", "estop_software", _LATCH, estop_pressed, text="emergency stop by an operator's word"),
    Rule("estop_a", "estop_a", _LATCH, line_pressed, text="emergency stop, line a", at=0),
    Rule("estop_b", "estop_b", _LATCH, line_pressed, text="emergency stop, line b", at=1),
    Rule(
        *("estop_discrepancy", "estop_discrepancy", _LATCH, discrepancy_ms, "estop_discrepancy_ms", "ms"),
        "the lines of the emergency stop differ",
    ),
    Rule("relay_a_open", "relay_open", _TRIP, open_ms, "contact_timeout_ms", "ms", "relay a has not closed", 0),
    Rule("relay_b_open", "relay_open", _TRIP, open_ms, "contact_timeout_ms", "ms", "relay b has not closed", 1),
    Rule("relay_a_welded", "relay_welded", _LATCH, welded_ms, "contact_timeout_ms", "ms", "relay a has not opened", 0),
    Rule("relay_b_welded", "relay_welded", _LATCH, welded_ms, "contact_timeout_ms", "ms", "relay b has not opened", 1),
    Rule("drive", "drive", _TRIP, drive_failed, text="a relay cannot be driven"),
    Rule("late", "late", _TRIP, late_ms, "late_max_ms", "ms", "the watchdog itself was late"),
)
RULES: Final = (*(rule for at in range(len(LOOPS)) for rule in rules_of(at)), *OTHERS)
BIT: Final = {cause: 1 << bit for bit, cause in enumerate(CAUSES)}


class Finding(NamedTuple):
    """A rule that is up."""

    rule: Rule
    value: float
    limit: float


def limit_of(rules: Rules, rule: Rule) -> float:
    """The limit of a rule."""
    return float(getattr(rules.limits, rule.limit)) if rule.limit else 0.0


def judge(rules: Rules, memory: Memory, now_ns: int) -> tuple[Finding, ...]:
    """The rules that are up, in the order of the table. A value that is no number is up."""
    found = []
    for rule in RULES:
        value = rule.value(rules, memory, rule.at, now_ns)
        if value is None:
            continue
        limit = limit_of(rules, rule)
        if not (value < limit if rule.reached else value <= limit):
            found.append(Finding(rule, value, limit))
    return tuple(found)


def causes_of(found: tuple[Finding, ...], *actions: Action) -> int:
    """Bits of what was found, of rules with one of ``actions``."""
    bits = 0
    for finding in found:
        if finding.rule.action in actions:
            bits |= BIT[finding.rule.cause]
    return bits


def names_of(causes: int) -> tuple[str, ...]:
    """Names of the bits of a status."""
    return tuple(name for name, bit in BIT.items() if causes & bit)
