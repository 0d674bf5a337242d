"""``dcon export``."""

from __future__ import annotations

import json

import click

from pmutools.cli.shell import Exit, Talk, common

TABLES = ("tick", "instance", "pmu", "event")


@click.command(name="export", short_help="A session log as a table.")
@click.argument("session", metavar="SESSION")
@click.argument("output", metavar="OUT")
@click.option("--table", type=click.Choice(TABLES), default="tick", show_default=True)
@common
def command(session: str, output: str, table: str, as_json: bool, quiet: bool, verbose: int) -> int:
    """Write one table of a session log to OUT: .csv, .parquet, .arrow or .jsonl.

    Exit code 3 says that part of the log could not be read.
    """
    from dcon.session.export import export

    talk = Talk(quiet, verbose)
    summary = export(session, output, table)
    if as_json:
        click.echo(json.dumps({"rows": summary.rows, "gaps": summary.gaps, "damage": summary.damage.lines()}))
    talk.say(f"{summary.rows} rows -> {output}")
    for line in summary.damage.lines():
        talk.say(f"{session}: {line}")
    return Exit.INCOMPLETE if summary.gaps or summary.damage else Exit.DONE
