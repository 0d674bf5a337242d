"""``pmu info``."""

from __future__ import annotations

import sys

import click

from pmutools.cli.shell import Exit, Talk, common
from pmutools.cli.sources import DURATION, TARGET, open_target


@click.command(name="info", short_help="What a recording or a live stream holds, and what is wrong with it.")
@click.argument("target", type=TARGET)
@DURATION
@common
def command(target: str, duration: float | None, as_json: bool, quiet: bool, verbose: int) -> int:
    """Streams, stations, channels, rate, span, gaps and defects of a FILE or live URL.

    A URL is read for --duration seconds (5 by default). Exit code 3 says that some bytes were lost or undecodable.
    """
    import json

    from pmutools.tools.inventory import take_inventory

    Talk(quiet, verbose)
    with open_target(target, duration if duration is not None or "://" not in target else 5.0) as source:
        inventory = take_inventory(source)
    if not inventory.frames:
        click.echo(f"pmu info: {target}: no C37.118 frames found in {inventory.bytes_in} bytes of payload", err=True)
        return Exit.FAILED
    if as_json:
        json.dump(inventory.to_json(), sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        from pmutools.cli.info_text import show

        show(inventory)
    return Exit.INCOMPLETE if inventory.damaged else Exit.DONE
