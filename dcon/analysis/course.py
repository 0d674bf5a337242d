"""The course of a session: states, modes and instances one after another, gaps, flags, orders, switches."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dcon.analysis.disturbances import Floats
from dcon.columns.tables import INSTANCE_STATES, MODES, STATES, UNKNOWN, SessionColumns
from dcon.session.rolling import LOG_SUBJECT
from pmutools.timebase import NS

Ints = npt.NDArray[np.int64]


class Stretch(NamedTuple):
    """A time during which something stays as it is: from its first tick to the one after its last."""

    name: str
    begin_ns: int
    end_ns: int


class Gap(NamedTuple):
    """Ticks that are not in the log between ``begin_ns`` and ``end_ns``."""

    begin_ns: int
    end_ns: int
    ticks: int
    why: str


class Raised(NamedTuple):
    """A check and the subject that it was up for, as the flag register has it at the end of the session."""

    name: str
    subject: str
    times: int
    first_ns: int
    last_ns: int
    up: bool
    latched: bool
    acknowledged: str
    value: float | None
    limit: float | None


class Switch(NamedTuple):
    """A change of the active instance; names are empty for none."""

    tick_ns: int
    from_instance: str
    to_instance: str
    why: str
    """What happened in that tick to either instance or its PMUs."""
    step_mw: float
    """Change of the command in that tick: bumpless, if small."""


class InstanceUse(NamedTuple):
    """How an instance fared. Shares are of the session's ticks."""

    name: str
    active: float
    ready: float
    held: float
    disabled: float
    disabled_times: int
    reasons: dict[str, int]
    """Checks that disabled it, by how often."""


def runs(codes: npt.NDArray[Any]) -> list[tuple[int, int]]:
    """(first, end) of each run of equal ``codes`` (T,)."""
    if not len(codes):
        return []
    edges = [0, *(np.flatnonzero(np.diff(codes.astype(np.int64))) + 1).tolist(), len(codes)]
    return list(itertools.pairwise(edges))


def stretches(session: SessionColumns, codes: npt.NDArray[Any], names: Sequence[str], rate_hz: float) -> list[Stretch]:
    """``codes`` (T,), places in ``names``, as stretches; a gap of the log does not end one."""
    ticks = session.tick.tick_ns
    return [
        Stretch(_named(names, int(codes[first])), int(ticks[first]), _end_ns(ticks, end, rate_hz))
        for first, end in runs(codes)
    ]


def states(session: SessionColumns, rate_hz: float) -> list[Stretch]:
    return stretches(session, session.tick.state, STATES, rate_hz)


def modes(session: SessionColumns, rate_hz: float) -> list[Stretch]:
    return stretches(session, session.tick.mode, MODES, rate_hz)


def actives(session: SessionColumns, rate_hz: float) -> list[Stretch]:
    """The active instance; "" for none."""
    return stretches(session, session.tick.active, session.instances, rate_hz)


def flag_stretches(session: SessionColumns, rate_hz: float) -> dict[str, list[Stretch]]:
    """When each flag that was ever up was up."""
    ever = np.bitwise_or.reduce(session.tick.flags) if len(session.tick.flags) else np.uint64(0)
    found: dict[str, list[Stretch]] = {}
    for bit in range(64):
        if not int(ever) >> bit & 1:
            continue
        name = session.flags[bit] if bit < len(session.flags) else str(bit)
        up = (session.tick.flags >> np.uint64(bit)) & np.uint64(1)
        found[name] = [each for each in stretches(session, up, ("", name), rate_hz) if each.name]
    return found


def gaps(session: SessionColumns, rate_hz: float) -> list[Gap]:
    """Ticks that are missing, whether the log lost them or they never ran."""
    ticks = session.tick.tick_ns
    period = NS / rate_hz
    lost = set(session.gaps)
    why = {event.tick_ns: event.detail for event in session.events if event.subject == LOG_SUBJECT}
    found = []
    for row in np.flatnonzero((np.diff(ticks) > 1.5 * period) | (np.diff(ticks) <= 0)).tolist():
        before, after = int(ticks[row]), int(ticks[row + 1])
        missing = max(0, round((after - before) / period) - 1)
        reason = "the clock was set back" if after <= before else "lost by the log" if row + 1 in lost else "not run"
        found.append(Gap(before, after, missing, why.get(after, reason)))
    return found


def register(session: SessionColumns) -> list[Raised]:
    """The last entry of each check and subject; from events, where the log has no register."""
    last = {(row.flag.name, row.flag.subject): row.flag for row in session.flag_changes}
    return [
        Raised(
            flag.name,
            flag.subject,
            flag.times,
            flag.first_ns,
            flag.last_ns,
            flag.up,
            flag.latched,
            flag.acknowledged,
            _known(flag.value),
            _known(flag.limit),
        )
        for flag in sorted(last.values(), key=lambda flag: (flag.first_ns, flag.name, flag.subject))
    ]


def switches(session: SessionColumns) -> list[Switch]:
    """Every change of the active instance, with what happened in that tick."""
    tick, names = session.tick, session.instances
    happened: dict[int, list[tuple[str, str]]] = defaultdict(list)
    for event in session.events:
        happened[event.tick_ns].append((event.name, event.subject))
    found = []
    for row in (np.flatnonzero(np.diff(tick.active)) + 1).tolist():
        before, after = _named(names, int(tick.active[row - 1])), _named(names, int(tick.active[row]))
        at = int(tick.tick_ns[row])
        concerned = {before, after, "system", *before.split("-"), *after.split("-")} - {""}
        why = [
            f"{name} {subject}" if subject != "system" else name
            for name, subject in happened[at]
            if subject in concerned and name not in ("selected", "instance_disabled")
        ]
        step = float(tick.command_mw[row] - tick.command_mw[row - 1])
        found.append(Switch(at, before, after, ", ".join(dict.fromkeys(why)), step))
    return found


def instances(session: SessionColumns) -> list[InstanceUse]:
    total = max(len(session.tick.tick_ns), 1)
    codes = {name: place for place, name in enumerate(INSTANCE_STATES)}
    reasons: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for event in session.events:
        if event.name == "instance_disabled":
            reasons[event.subject][event.detail or "unknown"] += 1
    found = []
    for place, name in enumerate(session.instances):
        column = session.instance.state[:, place] if place < session.instance.state.shape[1] else np.empty(0, np.uint8)
        shares = {state: float((column == code).sum()) / total for state, code in codes.items()}
        found.append(
            InstanceUse(
                name,
                float((session.tick.active == place).sum()) / total,
                shares["READY"],
                shares["HELD"],
                shares["DISABLED"],
                sum(reasons[name].values()),
                dict(reasons[name]),
            )
        )
    return found


def _named(names: Sequence[str], code: int) -> str:
    if code in (-1, UNKNOWN):
        return "" if code == -1 else "unknown"
    return names[code] if code < len(names) else str(code)


def _end_ns(ticks: Ints, end: int, rate_hz: float) -> int:
    return int(ticks[end]) if end < len(ticks) else int(ticks[end - 1]) + round(NS / rate_hz)


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def largest(values: Floats) -> float:
    """Largest magnitude; 0 where nothing is known."""
    known = np.abs(values[np.isfinite(values)])
    return float(known.max()) if known.size else 0.0
