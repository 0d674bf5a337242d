"""``pmu info``."""

from __future__ import annotations

import sys

import click

from pmutools.cli.shell import Exit, Talk, common
from pmutools.cli.sources import DURATION, TARGET, Watched, is_live, open_target
from pmutools.timebase import NS

LIVE_NS = 5 * NS
"""How long a live stream is looked at."""


@click.command(name="info", short_help="What a recording or a live stream holds, and what is wrong with it.")
@click.argument("target", type=TARGET)
@DURATION
@common
def command(target: str, duration_ns: int | None, as_json: bool, quiet: bool, verbose: int) -> int:
    """Streams, stations, channels, rate, span, gaps and defects of a FILE or live URL.

    A URL is read for --duration seconds (5 by default) or until Ctrl-C; what happens to its connection is told on
    stderr. Exit code 3 says that some bytes were lost or undecodable.
    """
    import json

    from pmutools.tools.inventory import take_inventory

    talk = Talk(quiet, verbose)
    if duration_ns is None and is_live(target):
        duration_ns = LIVE_NS
    with open_target(target, duration_ns, talk, verbose) as opened:
        inventory = take_inventory(Watched(opened.source, talk, target), target)
    if not inventory.frames and not inventory.skipped:
        talk.complain(f"pmu info: {target}: {opened.why()}")
        return Exit.INTERRUPTED if opened.stopped() else Exit.FAILED
    if as_json:
        json.dump(inventory.to_json(), sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        from pmutools.cli.info_text import show

        show(inventory)
    if opened.stopped():
        return Exit.INTERRUPTED
    return Exit.INCOMPLETE if inventory.damaged else Exit.DONE
