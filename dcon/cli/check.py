"""``dcon check``."""

from __future__ import annotations

import json
from dataclasses import fields

import click

from pmutools.cli.shell import common


@click.command(name="check", short_help="Dry check of an initialisation file; prints every effective setting.")
@click.option("--ini", required=True, metavar="FILE")
@common
def command(ini: str, as_json: bool, quiet: bool, verbose: int) -> None:
    """Read an initialisation file as the controller would, and print what is in force, with units and sources."""
    from dcon.settings import effective, load
    from pmutools.sites import Site

    settings = load(ini)
    sites = [
        {item.name: _plain(getattr(site, item.name)) for item in fields(Site) if getattr(site, item.name) is not None}
        for site in settings.sites
    ]
    rows = effective(settings)
    if as_json:
        keys = ("section", "key", "value", "source")
        click.echo(json.dumps({"pmus": sites, "settings": [dict(zip(keys, row, strict=True)) for row in rows]}))
        return
    for site in sites:
        name = site.pop("name")
        click.echo(f"[pmu {name}]  " + "  ".join(f"{key} = {value}" for key, value in site.items()))
    for section, key, value, source in rows:
        click.echo(f"[{section}] {key} = {value}" + (f"   ({source})" if source else ""))


def _plain(value: object) -> object:
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return value if isinstance(value, int | float) else str(value)
