"""``dcon analyze``."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click

from dcon.cli.spare import spare_in
from pmutools.cli.shell import Exit, Talk, common


@click.command(name="analyze", short_help="What recorded sessions tell: a report, figures, and JSON.")
@click.argument("sessions", metavar="SESSION...", nargs=-1, required=True)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", required=True)
@common
def command(sessions: tuple[str, ...], out: Path, as_json: bool, quiet: bool, verbose: int) -> int:
    """Analyse session logs: states, flags, ringdowns and their damping, delays, timing, data quality.

    Writes report.html (one file, works offline), figures/ (PNG and SVG) and analysis.json to DIR. The first part of a
    session brings those that follow it; several sessions are put into the order of their times.

    Exit code 3 says that something of the logs is missing or could not be read; the report says what.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: for matrices this small threads only cost
    from dcon.analysis.report import JSON, PAGE, main_findings, write_analysis
    from pmutools.report.page import FIGURES

    talk = Talk(quiet, verbose)
    spare_in(out, (PAGE, JSON, FIGURES), sessions)
    outcome = write_analysis(sessions, out, lambda name: talk.progress(f"reading {name}"))
    talk.progress("")
    if as_json:
        click.echo(json.dumps(outcome.to_json(), allow_nan=False))
    elif not quiet:
        for sentence in main_findings(outcome):
            click.echo(sentence)
    for files, found in outcome.newer:
        talk.say(f"warning: {files[0]} {found}")
    for session in outcome.sessions:
        for line in session.columns.missing:
            talk.say(f"{session.files[0]}: {line}")
    for _, why in outcome.unread:
        talk.say(f"not read: {why}")
    talk.say(f"report: {out / PAGE}, {out / JSON}")
    return Exit.INCOMPLETE if outcome.lost else Exit.DONE
