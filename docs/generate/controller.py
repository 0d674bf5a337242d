"""States, checks, settings and the filter of the controller."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields
from enum import StrEnum
from types import ModuleType
from typing import Any

from dcon.core import instance
from dcon.core.checks import Check, bound
from dcon.core.params import Line, Params
from dcon.core.probe import Probing
from dcon.core.rows import CORE
from dcon.core.system import DRIVING, MODE_IS_FREE, ORDERS, PERMISSIVES, TRANSITIONS, Trigger
from dcon.core.thresholds import Thresholds
from dcon.core.values import SystemState
from dcon.drivers import line_status
from dcon.link import command
from dcon.link.counts import COUNTS
from dcon.places import IioKeys, OutputRegisters, StatusRegisters
from dcon.sections import LineInput, Log, Output, Platform, Server
from dcon.settings import ELSEWHERE
from generate.markdown import attribute_docs, code, fenced, mermaid, prose, table
from pmutools.grid.plant import PLANTS
from pmutools.grid.scenarios import SCENARIOS
from pmutools.sites import Site

Transitions = Mapping[tuple[Any, Any], StrEnum]
MANY = 4
"""A trigger that leads to one state from at least so many others is said in words, not drawn."""


def _common(of: Transitions) -> dict[tuple[Any, StrEnum], set[StrEnum]]:
    sources = defaultdict[tuple[Any, StrEnum], set[StrEnum]](set)
    for (state, trigger), after in of.items():
        sources[trigger, after].add(state)
    return {key: states for key, states in sources.items() if len(states) >= MANY}


def diagram(of: Transitions, *starts: str) -> str:
    """A table of transitions as a state diagram; ``starts`` are states, or ``STATE: when`` of several."""
    common, labels = _common(of), defaultdict[tuple[str, str], list[str]](list)
    for (state, trigger), after in of.items():
        if (trigger, after) not in common:
            labels[state.name, after.name].append(str(trigger))
    lines = ["stateDiagram-v2", *(f"    [*] --> {start}" for start in starts)]
    lines += [f"    {a} --> {b}: {', '.join(texts)}" for (a, b), texts in labels.items()]
    everything = {state for state, _ in of}
    words = []
    for (trigger, after), states in common.items():
        besides = sorted(state.name for state in everything - states)
        words.append(f"`{trigger}` leads to {after.name} from every state but {' and '.join(besides)}.")
    return mermaid(lines) + "\n\n" + " ".join(words)


def transition_table(of: Transitions) -> str:
    """The same as a matrix: a row a state, a column a trigger, the next state in the cell."""
    states, moves = dict.fromkeys(state for state, _ in of), list(dict.fromkeys(trigger for _, trigger in of))
    rows = ((code(s), *(getattr(of.get((s, trigger)), "name", "") for trigger in moves)) for s in states)
    return table(("state", *map(code, moves)), rows)


WORDS = {
    Trigger.START: "Begin: verify the PMUs' data.",
    Trigger.OFF: "Stop computing.",
    Trigger.ARM: "First step: relays closed, 0 V.",
    Trigger.ACTIVATE: "Second step: follow the active instance.",
    Trigger.TRIP: "A check with the action trip: 0 MW at once, latched.",
    Trigger.ESTOP: "0 MW at once, latched.",
    Trigger.RESET: "Leave a latched state; nothing is armed by it.",
}
"""Triggers whose names say enough in code."""


def triggers() -> str:
    """What moves the system."""
    says = attribute_docs(Trigger)
    rows = []
    for trigger in Trigger:
        kind = "order" if trigger in ORDERS else "from within"
        rows.append((code(trigger), kind, says.get(trigger.name) or WORDS[trigger]))
    return table(("trigger", "comes", "meaning"), rows)


def system_rules() -> str:
    """What holds in which state."""

    def names(states: Iterable[SystemState]) -> str:
        return ", ".join(state.name for state in SystemState if state in states)

    return (
        f"- The command differs from 0 MW in {names(DRIVING)} only.\n"
        f"- `open_loop` and `closed_loop` can be ordered in {names(MODE_IS_FREE)} only: no way from open to closed loop"
        " leads past the two steps of arming.\n"
        f"- Orders: {', '.join(code(order) for order in ORDERS)} (`gain` takes a value in MW/mHz)."
    )


def permissives() -> str:
    """What must hold to arm."""
    return table(("permissive", "refused with"), ((code(row.name), row.text) for row in PERMISSIVES))


DEFAULTS = Params.paired(("N",), ("S",))
LIMITS = {item.name: item for item in fields(Thresholds)}
UNITS = {"_s": "s", "_frames": "frames", "_ticks": "ticks"}


def condition(row: Check[Any]) -> str:
    """When a check is up, in words, with the defaults and their keys."""
    if row.value is None:
        return ""

    def shown(given: Any) -> tuple[str, str]:
        key = given if isinstance(given, str) else ""
        unit = LIMITS[key].metadata["unit"] if key else row.unit
        return f"{bound(DEFAULTS, given):g} {unit}".strip(), code(key) if key else ""

    (high, high_key), (low, low_key) = shown(row.high), shown(row.low)
    what = (row.value.__doc__ or "").split("\n")[0].removesuffix(".").replace("``", "`")
    has_high, has_low = bound(DEFAULTS, row.high) < math.inf, bound(DEFAULTS, row.low) > -math.inf
    limits = f"outside {low} to {high}" if has_high and has_low else f"> {high}" if has_high else f"< {low}"
    if row.name == "not_finite":
        limits = ""
    keys = ", ".join(key for key in (low_key, high_key) if key)
    text = f"{what} {limits}".strip() + (f" ({keys})" if keys else "")
    if row.hold:
        unit = next(unit for suffix, unit in UNITS.items() if row.hold.endswith(suffix))
        text += f" for {LIMITS[row.hold].default:g} {unit} ({code(row.hold)})"
    return prose(text)


def checks() -> str:
    """Every check, in the order of its bit in ``flags``."""
    rows = (
        (bit, code(row.name), row.scope, condition(row), f"**{row.action}**", row.text)
        for bit, row in enumerate(CORE.rows)
    )
    return table(("bit", "check", "scope", "up while", "action", "what the operator reads"), rows)


def _number(value: object) -> str:
    return (
        str(value).lower()
        if isinstance(value, bool)
        else f"{value:g}"
        if isinstance(value, int | float)
        else str(value)
    )


def _range(item: Field[Any]) -> str:
    low, high = item.metadata.get("low"), item.metadata.get("high")
    if low is None or high is None:
        return ""
    return f"≥ {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def _words(item: Field[Any]) -> str:
    return " ".join(item.metadata["choices"]) if "choices" in item.metadata else _range(item)


def numbers(cls: type, leave_out: Iterable[str] = ()) -> str:
    """Settings whose unit, bounds and source are in the field's metadata."""
    says = attribute_docs(cls)
    rows = []
    for item in fields(cls):
        if item.name not in leave_out:
            unit, source = item.metadata.get("unit", ""), item.metadata.get("source", "")
            rows.append((code(item.name), _number(item.default), unit, _words(item), says.get(item.name, ""), source))
    return table(("key", "default", "unit", "range", "meaning", "source"), rows)


KEY_WORDS = {"path": "Where the session log goes; `--log` goes over it."}
"""Keys whose names say enough in code."""


def keys(cls: type) -> str:
    """Settings of a section that is read as text."""
    says = KEY_WORDS | attribute_docs(cls)
    rows = []
    for item in fields(cls):
        if "parse" in item.metadata:
            default = "required" if item.default is MISSING else _default(item.default)
            rows.append((code(item.name), default, says[item.name]))
    return table(("key", "default", "meaning"), rows)


def _default(value: object) -> str:
    if value is None:
        return ""
    return code(",".join(map(str, value)) if isinstance(value, tuple) else _number(value))


def datagram(module: ModuleType) -> str:
    """A driver's datagram, from its module's text."""
    _, layout, rest = (module.__doc__ or "").split("\n\n", 2)
    fields_ = "\n".join(part.strip() for part in layout.split("|"))
    return f"{fenced(fields_)}\n\n{module.SIZE} bytes, big-endian. {prose(rest)}"


def scenarios() -> str:
    """Scenarios by name."""
    rows = ((code(s.name), s.text, f"{s.duration_s:g} s", s.condition) for s in SCENARIOS.values())
    return table(("scenario", "what happens", "length", "condition of the plant"), rows)


def plants() -> str:
    """Plants by name."""
    return table(("plant", "what it is"), ((code(name), kind.text) for name, kind in PLANTS.items()))


GENERATORS = {
    "system-diagram": lambda: diagram(TRANSITIONS, "INIT"),
    "system-transitions": lambda: transition_table(TRANSITIONS),
    "system-triggers": triggers,
    "system-rules": system_rules,
    "instance-diagram": lambda: diagram(instance.TRANSITIONS, "DISABLED"),
    "permissives": permissives,
    "checks": checks,
    "settings-controller": lambda: numbers(Params, ELSEWHERE),
    "settings-supervisor": lambda: numbers(Thresholds),
    "settings-probing": lambda: numbers(Probing, ("samples",)),
    "settings-pdci": lambda: f"{keys(LineInput)}\n\n{numbers(Line)}",
    "settings-server": lambda: keys(Server),
    "settings-pmu": lambda: keys(Site),
    "settings-output": lambda: keys(Output),
    "settings-platform": lambda: keys(Platform),
    "settings-log": lambda: keys(Log),
    "counts": lambda: table(("count", "of what"), ((code(name), text) for name, text in COUNTS.items())),
    "command-datagram": lambda: datagram(command),
    "status-datagram": lambda: datagram(line_status),
    "iio-keys": lambda: keys(IioKeys),
    "modbus-output-keys": lambda: keys(OutputRegisters),
    "modbus-status-keys": lambda: keys(StatusRegisters),
    "scenarios": scenarios,
    "plants": plants,
}
