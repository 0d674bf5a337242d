"""``dcon check``."""

from __future__ import annotations

import json
from dataclasses import fields

import click

from pmutools.cli.shell import Talk, common


@click.command(name="check", short_help="Dry check of an initialisation file; prints every effective setting.")
@click.option("--ini", required=True, metavar="FILE")
@common
def command(ini: str, as_json: bool, quiet: bool, verbose: int) -> None:
    """Read an initialisation file as the controller would, and print what is in force.

    Each setting with its unit, where its value comes from, and the default where that is another. A warning names each
    check that cannot fire at the present limit of the command, and each safeguard that one failure defeats.
    """
    from dcon.effective import effective, warnings_of
    from dcon.settings import load
    from pmutools.sites import Site

    settings = load(ini)
    rows, warnings = effective(settings), warnings_of(settings)
    if as_json:
        sites = [
            {key.name: _plain(value) for key in fields(Site) if (value := getattr(site, key.name)) is not None}
            for site in settings.sites
        ]
        click.echo(json.dumps({"pmus": sites, "settings": [row._asdict() for row in rows], "warnings": warnings}))
    else:
        for row in rows:
            click.echo(row)
    talk = Talk(quiet, verbose)
    for warning in warnings:
        talk.say(f"warning: {warning}")


def _plain(value: object) -> object:
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return value if isinstance(value, int | float) else str(value)
