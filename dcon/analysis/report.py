"""``analysis.json``, ``report.html`` and ``figures/`` of analysed sessions."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pmutools
from dcon.analysis import tables
from dcon.analysis.analysis import Analysis, Outcome, Tell, analyze_all
from dcon.analysis.figures import comparison_figure, session_figures
from pmutools.errors import SourceError
from pmutools.report import page
from pmutools.report.figures import Figure
from pmutools.report.text import count, listed, plural, span, utc

PAGE, JSON = "report.html", "analysis.json"


@dataclass(frozen=True)
class Section:
    """What one session's part of the page is made from."""

    anchor: str
    title: str
    session: Analysis
    facts: list[tuple[str, str]]
    figures: list[str]
    ringdown_figures: list[str]
    instance_figure: str
    after: list[str]
    tables: dict[str, page.Table]
    timing: list[tuple[str, str]]
    commands: list[tuple[str, str]]


def write_analysis(paths: Sequence[str | os.PathLike[str]], out: Path, tell: Tell | None = None) -> Outcome:
    """Analyse session logs, and write what was found to the folder ``out``.

    Raises SettingsError where the extra ``analysis`` is not installed, SourceError where nothing is read or written.
    """
    page.require_extra()
    from pmutools.report.matplotlib_figures import save

    drawn: list[tuple[Analysis, list[Figure]]] = []
    outcome = analyze_all(
        paths, tell, lambda session: drawn.append((session, session_figures(session, f"{len(drawn) + 1:02d}")))
    )
    figures_of = {id(session.ringdowns): figures for session, figures in drawn}
    drawn.clear()  # and the columns with it
    ordered = [(session, figures_of[id(session.ringdowns)]) for session in outcome.sessions]
    figures = [figure for _, found in ordered for figure in found]
    if outcome.comparison:
        figures.insert(0, comparison_figure(outcome.comparison))
    folder = out / page.FIGURES
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f"{folder}: cannot make this folder: {error.strerror or error}") from None
    page.write(out / JSON, json.dumps(outcome.to_json(), indent=1, allow_nan=False) + "\n")
    page.write(out / PAGE, page.render("analysis.html", figures, told(outcome, ordered), "dcon.analysis"))
    try:
        for figure in figures:
            save(figure, folder)
    except OSError as error:
        raise SourceError(f"{folder}: cannot write figures: {error.strerror or error}") from None
    return outcome


def told(outcome: Outcome, ordered: Sequence[tuple[Analysis, list[Figure]]]) -> dict[str, Any]:
    """All names that the template knows."""
    return {
        "outcome": outcome,
        "main": [*main_findings(outcome), *(f"{files[0]} {newer}." for files, newer in outcome.newer)],
        "unread": outcome.unread,
        "between": tables.gap_table(outcome.between, "between", "Between the sessions"),
        "comparison": tables.comparison_table(outcome.comparison, "open-closed"),
        "sections": [section(session, figures, at) for at, (session, figures) in enumerate(ordered, 1)],
        "provenance": [("Made by", f"pmutools {pmutools.__version__}")],
        "source": listed([_title(session) for session in outcome.sessions]),
    }


def section(session: Analysis, figures: Sequence[Figure], number: int) -> Section:
    stem = f"session-{number}"
    names = [figure.name for figure in figures]
    made = {
        "ringdowns": tables.ringdown_table(session, stem),
        "gaps": tables.gap_table(session.gaps, f"{stem}-gaps", "Gaps"),
        "register": tables.register_table(session, stem),
        "orders": tables.order_table(session, stem),
        "events": tables.event_table(session, stem),
        "switches": tables.switch_table(session, stem),
        "instances": tables.instance_table(session, stem),
        "pmus": tables.pmu_table(session, stem),
        "budget": tables.budget_table(session, stem),
    }
    return Section(
        stem,
        _title(session),
        session,
        _facts(session),
        [name for name in names if name.endswith(("-timeline", "-signals"))],
        [name for name in names if "-ringdown-" in name],
        next((name for name in names if name.endswith("-instances")), ""),
        [name for name in names if name.endswith(("-delays", "-timing"))],
        made,
        tables.timing_facts(session),
        tables.command_facts(session),
    )


def _title(session: Analysis) -> str:
    """Names of its files, with the folder: every session of a simulation is called the same."""
    return ", ".join("/".join(Path(name).parts[-2:]) for name in session.files)


def _facts(session: Analysis) -> list[tuple[str, str]]:
    known = session.columns.metadata
    return [
        ("Files", ", ".join(session.files)),
        ("When", f"{utc(session.begin_ns, 1)} to {utc(session.end_ns, 1)} ({span(session.end_ns - session.begin_ns)})"),
        (
            "Ticks",
            f"{count(session.timing.ticks)} at {session.rate_hz:g}/s, {count(session.timing.missing_ticks)} missing",
        ),
        ("PMUs", listed(session.columns.pmus, 12)),
        *((name.capitalize(), known[name]) for name in ("scenario", "plant", "seed", "version") if name in known),
        ("Last state", session.states[-1].name),
    ]


def main_findings(outcome: Outcome) -> list[str]:
    """In sentences."""
    found: list[str] = []
    for row in outcome.comparison:
        loop = f"With {row.gain_mw_per_mhz:g} MW/mHz" if row.closed else "In open loop"
        gained = "" if row.gained_percent is None else f", {row.gained_percent:+.2f} points against the open loop"
        found.append(
            f"{loop}: {row.frequency_hz:.4f} Hz, damping {row.damping_percent:z.2f} %{gained} "
            f"({plural(row.ringdowns, 'ringdown')})."
        )
    if not found:
        found.append("No ringdown was found that could be fitted.")
    for number, session in enumerate(outcome.sessions, 1):
        whose = f"Session {number}: " if len(outcome.sessions) > 1 else ""
        bad = [state.name for state in session.states if state.name in ("FAULT", "ESTOP")]
        if bad:
            found.append(f"{whose}the controller was in {listed(dict.fromkeys(bad))} {plural(len(bad), 'time')}.")
        if session.gaps:
            missing = sum(gap.ticks for gap in session.gaps)
            found.append(f"{whose}{plural(len(session.gaps), 'gap')} in the log, {plural(missing, 'tick')}.")
        latched = [f"{entry.name} {entry.subject}" for entry in session.register if entry.latched]
        if latched:
            found.append(f"{whose}latched at the end: {listed(latched)}.")
        lost = [pmu.name for pmu in session.pmus if pmu.lost]
        if lost:
            found.append(f"{whose}frames were lost of {listed(lost)}.")
        found += [f"{whose}{note}." for note in session.notes]
    return found
