"""Everything that ``dcon analyze`` finds in sessions, as plain data: ``analysis.json`` and the page are made of it."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import pmutools
from dcon.analysis import course, numbers
from dcon.analysis.disturbances import Floats, disturbances
from dcon.analysis.ringdowns import Comparison, Loop, Ringdown, compare, ringdowns
from dcon.columns.read import read_columns
from dcon.columns.tables import MODES, STATES, InstanceColumns, SessionColumns, TickColumns
from dcon.core.params import Params
from dcon.limiter import LIMIT_MW
from dcon.session.newer import Newer
from dcon.session.parts import Part, named_twice, part_of
from dcon.settings import parse
from pmutools.errors import SettingsError, SourceError
from pmutools.measure.budget import Row
from pmutools.timebase import NS

Tell = Callable[[str], None]
DRIVING = ("ACTIVE", "RAMPDOWN")
CLOSED = "closed_loop"
MOST_EVENTS = 2000
"""Events, switches and orders that JSON and page list; counts are of all."""


@dataclass(frozen=True)
class Analysis:
    """One session. ``columns`` is what the figures are drawn from, and is not in the JSON."""

    files: list[str]
    columns: SessionColumns = field(repr=False)
    rate_hz: float
    limit_mw: float
    begin_ns: int
    end_ns: int
    notes: list[str]
    """What could not be read, or was assumed."""
    damaged: bool
    states: list[course.Stretch]
    modes: list[course.Stretch]
    actives: list[course.Stretch]
    flags: dict[str, list[course.Stretch]]
    register: list[course.Raised]
    gaps: list[course.Gap]
    switches: list[course.Switch]
    instances: list[course.InstanceUse]
    noise_mhz: float
    ringdowns: list[Ringdown]
    comparison: list[Comparison]
    budget: tuple[Row, ...]
    timing: numbers.Timing
    commands: numbers.Commands
    pmus: list[numbers.PmuQuality]

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.begin_ns) / NS

    def to_json(self) -> dict[str, Any]:
        session = self.columns
        return {
            "files": self.files,
            "metadata": dict(session.metadata),
            "begin_ns": self.begin_ns,
            "end_ns": self.end_ns,
            "duration_s": self.duration_s,
            "rate_hz": self.rate_hz,
            "limit_mw": self.limit_mw,
            "notes": self.notes,
            "damage": session.damage.lines(),
            "incomplete_ticks": session.incomplete_ticks,
            "gaps": [gap._asdict() for gap in self.gaps],
            "states": [stretch._asdict() for stretch in self.states],
            "modes": [stretch._asdict() for stretch in self.modes],
            "active_instances": [stretch._asdict() for stretch in self.actives[:MOST_EVENTS]],
            "flags": {
                name: {"times": len(up), "up_s": sum(each.end_ns - each.begin_ns for each in up) / NS}
                for name, up in self.flags.items()
            },
            "register": [entry._asdict() for entry in self.register],
            "orders": [order._asdict() | {"value": _known(order.given)} for order in session.orders[:MOST_EVENTS]],
            "events": [event._asdict() for event in session.events[:MOST_EVENTS]],
            "events_total": len(session.events),
            "switches": [switch._asdict() for switch in self.switches[:MOST_EVENTS]],
            "switches_total": len(self.switches),
            "instances": [use._asdict() for use in self.instances],
            "noise_mhz": self.noise_mhz,
            "ringdowns": [ringdown.to_json() for ringdown in self.ringdowns],
            "comparison": [row.to_json() for row in self.comparison],
            "delay_budget": [row.to_json() for row in self.budget],
            "timing": self.timing._asdict() | _spreads(self.timing, "compute_us", "late_us"),
            "commands": self.commands._asdict(),
            "pmus": [pmu._asdict() | _spreads(pmu, "delay_ms", "age_ms") for pmu in self.pmus],
        }


def _spreads(row: Any, *names: str) -> dict[str, Any]:
    return {name: getattr(row, name)._asdict() for name in names}


def _known(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


@dataclass
class Outcome:
    """All sessions: those that could be read, and (file, why) of the rest."""

    sessions: list[Analysis] = field(default_factory=list)
    unread: list[tuple[str, str]] = field(default_factory=list)

    @property
    def between(self) -> list[course.Gap]:
        """The times between one session and the next; of none, where they overlap."""
        return [_between(a, b) for a, b in itertools.pairwise(self.sessions)]

    @property
    def comparison(self) -> list[Comparison]:
        """Open against closed loop over all sessions."""
        return compare([found for session in self.sessions for found in session.ringdowns])

    @property
    def newer(self) -> list[tuple[list[str], Newer]]:
        """(files, what they hold that this program does not know) of each session with such."""
        return [(session.files, found) for session in self.sessions if (found := session.columns.newer)]

    @property
    def lost(self) -> bool:
        """Whether something of the input could not be read."""
        return bool(self.unread) or any(session.damaged for session in self.sessions)

    def to_json(self) -> dict[str, Any]:
        return {
            "version": pmutools.__version__,
            "sessions": [session.to_json() for session in self.sessions],
            "between": [gap._asdict() for gap in self.between],
            "comparison": [row.to_json() for row in self.comparison],
            "unread": [{"file": name, "why": why} for name, why in self.unread],
            "newer": [{"files": files, **(found.to_json() or {})} for files, found in self.newer],
        }


def _between(a: Analysis, b: Analysis) -> course.Gap:
    if b.begin_ns < a.end_ns:
        return course.Gap(b.begin_ns, b.begin_ns, 0, "the sessions overlap")
    missing = max(0, round((b.begin_ns - a.end_ns) / NS * b.rate_hz))
    return course.Gap(a.end_ns, b.begin_ns, missing, "between sessions")


Look = Callable[[Analysis], None]


def analyze_all(paths: Sequence[str | os.PathLike[str]], tell: Tell | None = None, look: Look | None = None) -> Outcome:
    """Analyse sessions: parts of one session are put together, and sessions into the order of their times.

    ``look`` is shown each session while its columns are in memory; after that only events and orders are, so that
    memory is bounded by one session. Raises SourceError where nothing of any file could be read, or one is named twice.
    """
    outcome = Outcome()
    for group in _sessions(paths, outcome.unread):
        if tell is not None:
            tell(str(group[0]))
        try:
            session = analyze(group)
            if look is not None:
                look(session)
            outcome.sessions.append(replace(session, columns=_slim(session.columns)))
        except SourceError as error:
            outcome.unread.append((str(group[0]), str(error)))
    if not outcome.sessions:
        raise SourceError(outcome.unread[0][1] if outcome.unread else "no session log given")
    outcome.sessions.sort(key=lambda session: session.begin_ns)
    return outcome


def _slim(session: SessionColumns) -> SessionColumns:
    """The same without what grows with every tick."""
    tick, instance = session.tick, session.instance
    return replace(
        session,
        tick=TickColumns._make(column[:0] for column in tick),
        instance=InstanceColumns._make(column[:0] for column in instance),
        pmu={},
    )


def _sessions(
    paths: Sequence[str | os.PathLike[str]], unread: list[tuple[str, str]]
) -> Iterator[list[str | os.PathLike[str]]]:
    """The files of each session; those that are none go to ``unread``. Raises SourceError for a part named twice."""
    groups: dict[str, list[str | os.PathLike[str]]] = {}
    met: dict[tuple[str, int], Part] = {}
    for path in paths:
        try:
            part = part_of(path)
        except SourceError as error:
            unread.append((str(path), str(error)))
            continue
        session = part.session or os.path.realpath(path)
        if (before := met.setdefault((session, part.number), part)) is not part:
            raise named_twice(before, part)
        groups.setdefault(session, []).append(path)
    yield from groups.values()


def analyze(paths: Sequence[str | os.PathLike[str]]) -> Analysis:
    """Analyse one session from its file or parts. Raises SourceError where it cannot be read or holds no tick."""
    session = read_columns(paths)
    name = str(paths[0])
    if not len(session.tick.tick_ns):
        lines = "; ".join(session.damage.lines())
        raise SourceError(f"{name}: holds no tick" + (f" ({lines})" if lines else ""))
    params, notes = _params(session, name)
    ticks = session.tick.tick_ns
    rate_hz = float(params.tick_hz) if params is not None else _rate_of(session)
    limit_mw = params.limit_mw if params is not None else LIMIT_MW
    gaps = course.gaps(session, rate_hz)
    loop = loop_of(session, rate_hz, limit_mw)
    found = ringdowns(loop, session.gaps)
    notes += [f"{Path(name).name}: {line}" for line in (*session.missing, *session.damage.lines())]
    if session.incomplete_ticks:
        notes.append(f"{session.incomplete_ticks} ticks say nothing of their instances")
    return Analysis(
        files=list(map(str, paths)),
        columns=session,
        rate_hz=rate_hz,
        limit_mw=limit_mw,
        begin_ns=int(ticks.min()),
        end_ns=int(ticks.max()) + round(NS / rate_hz),
        notes=notes,
        damaged=bool(session.damage or session.incomplete_ticks or session.missing),
        states=course.states(session, rate_hz),
        modes=course.modes(session, rate_hz),
        actives=course.actives(session, rate_hz),
        flags=course.flag_stretches(session, rate_hz),
        register=course.register(session),
        gaps=gaps,
        switches=course.switches(session),
        instances=course.instances(session),
        noise_mhz=disturbances(loop.delta_f_mhz, rate_hz).noise_mhz,
        ringdowns=found,
        comparison=compare(found),
        budget=numbers.delay_budget(session),
        timing=numbers.timing(session, sum(gap.ticks for gap in gaps)),
        commands=numbers.commands(session, rate_hz, limit_mw),
        pmus=[numbers.pmu_quality(session, pmu, rate_hz) for pmu in session.pmus],
    )


def loop_of(session: SessionColumns, rate_hz: float, limit_mw: float) -> Loop:
    """What ringdowns are found in: Δf of the active instance, and without one the median of those that run."""
    tick = session.tick
    driving = np.isin(tick.state, [STATES.index(state) for state in DRIVING]) & (tick.mode == MODES.index(CLOSED))
    situation = np.where(driving, tick.state.astype(np.int64) + 1, 0)
    return Loop(
        tick.tick_ns,
        delta_f_of(session),
        tick.command_mw,
        tick.output_v,
        np.nan_to_num(tick.probe_mw),
        tick.gain_mw_per_mhz,
        situation,
        rate_hz,
        limit_mw,
    )


def delta_f_of(session: SessionColumns) -> Floats:
    """(T,) mHz; NaN where no instance knows it."""
    found = session.tick.delta_f_mhz
    unknown = np.flatnonzero(np.isnan(found))
    others = session.instance.delta_f_mhz[unknown]
    if not unknown.size or not others.shape[1]:
        return found
    found = found.copy()
    some = np.isfinite(others).any(axis=1)
    found[unknown[some]] = np.nanmedian(others[some], axis=1)
    return found


def _params(session: SessionColumns, name: str) -> tuple[Params | None, list[str]]:
    """The settings that were in force; None, with a note, where the log's own cannot be read."""
    if not session.ini_text:
        return None, [f"{Path(name).name}: no initialisation file; ±{LIMIT_MW:g} MW assumed for the limit"]
    try:
        return parse(session.ini_text, name).params, []
    except (SettingsError, SourceError) as error:
        return None, [f"{error}; ±{LIMIT_MW:g} MW assumed for the limit"]


def _rate_of(session: SessionColumns) -> float:
    steps = np.diff(session.tick.tick_ns)
    return float(round(NS / float(np.median(steps)))) if len(steps) and np.median(steps) > 0 else 60.0
