"""``dcon keys``."""

from __future__ import annotations

import click

from pmutools.cli.shell import Talk, common


@click.command(name="keys", short_help="Make a key for a new operator.")
@click.argument("name")
@click.option("--file", "path", required=True, metavar="FILE", help="Where it is added; made, mode 0600, if new.")
@click.option("--may", metavar="ORDER,...", help="What the operator may order; default: all.")
@common
def command(name: str, path: str, may: str | None, as_json: bool, quiet: bool, verbose: int) -> None:
    """Add the operator NAME with a random key to a FILE of keys.

    The server and the platform read it as [server] keys; the operator needs the section of that name alone, in a file
    that nobody else can read, for dcon ctl --key.
    """
    from dcon.link.keys import add_key
    from pmutools.errors import SettingsError
    from pmutools.parsers import words

    try:
        allowed = () if may is None else words(may)
    except ValueError as error:
        raise SettingsError(f"--may: {error}") from None
    if may is not None and not allowed:
        raise SettingsError("--may: names no order; leave it out for all of them")
    add_key(path, name, allowed)
    Talk(quiet, verbose).say(f"operator {name} added to {path}")
