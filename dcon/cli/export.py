"""``dcon export``."""

from __future__ import annotations

import json

import click

from dcon.cli.spare import spare
from dcon.export.tables import TABLES
from pmutools.cli.shell import Exit, Talk, common


@click.command(name="export", short_help="A session log as a table.")
@click.argument("sessions", metavar="SESSION...", nargs=-1, required=True)
@click.argument("output", metavar="OUT")
@click.option("--table", type=click.Choice(list(TABLES)), default="tick", show_default=True)
@common
def command(sessions: tuple[str, ...], output: str, table: str, as_json: bool, quiet: bool, verbose: int) -> int:
    """Write one table of a session log to OUT: .csv, .parquet, .arrow or .jsonl.

    `event` has what was ordered and what happened, `setting` the orders with who gave them and why.

    The first part of a session brings those that follow it; or name the parts.

    Exit code 3 says that part of the log is missing or could not be read.
    """
    from dcon.export.export import export

    talk = Talk(quiet, verbose)
    spare(output, sessions)
    summary = export(sessions, output, table)
    if as_json:
        said = {"rows": summary.rows, "gaps": summary.gaps, "damage": summary.damage.lines()}
        click.echo(json.dumps(said | {"newer": summary.newer.to_json(), "missing": summary.missing}))
    talk.say(f"{summary.rows} rows -> {output}")
    if summary.newer:
        talk.say(f"warning: {sessions[0]} {summary.newer}")
    for line in (*summary.missing, *summary.damage.lines()):
        talk.say(f"{sessions[0]}: {line}")
    return Exit.INCOMPLETE if summary.gaps or summary.damage or summary.missing else Exit.DONE
