"""``pmu dump``."""

from __future__ import annotations

import sys
from typing import IO

import click

from pmutools.cli.shell import Exit, Talk, common, visible
from pmutools.cli.sources import DURATION, TARGET, is_live, open_target

TYPES = ("data", "cfg1", "cfg2", "cfg3", "header", "command", "skipped")


@click.command(name="dump", short_help="Every frame, one a line.")
@click.argument("target", type=TARGET)
@click.option("--type", "types", type=click.Choice(TYPES), multiple=True, help="Only frames of this type; repeatable.")
@DURATION
@common
def command(
    target: str, types: tuple[str, ...], duration_ns: int | None, as_json: bool, quiet: bool, verbose: int
) -> int:
    """Every frame of a FILE or live URL, one a line.

    A URL is read until Ctrl-C or --duration; what happens to its connection is told on stderr.
    Exit code 3 says that some bytes could not be read as frames; they are listed as `skipped`.
    """
    import json

    from pmutools.c37118.demux import Loss
    from pmutools.cli.dump_text import one_line
    from pmutools.formats.describe import describe

    talk, live = Talk(quiet, verbose), is_live(target)
    skipped = frames = 0
    out: IO[str] = sys.stdout
    with open_target(target, duration_ns, talk, verbose) as opened:
        for item in opened.source.items():
            if isinstance(item, Loss):
                skipped += item.skipped.nbytes
            else:
                frames += 1
            described = describe(item)
            if not types or described["type"] in types:
                line = json.dumps(described, separators=(",", ":")) if as_json else visible(one_line(described))
                out.write(f"{line}\n")
                if live:
                    out.flush()
        defects = opened.source.defects()
    for name, count in defects.items():
        talk.say(f"{target}: {name}: {count}")
    if opened.stopped():
        return Exit.INTERRUPTED
    if not frames and not skipped:
        talk.complain(f"pmu dump: {target}: {opened.why()}")
        return Exit.FAILED
    return Exit.INCOMPLETE if skipped or defects else Exit.DONE
