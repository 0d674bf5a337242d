"""``pmu convert``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Exit, Talk, common
from pmutools.cli.sources import DURATION, END, IDCODES, START, Watched, spare

if TYPE_CHECKING:
    from pmutools.parsers import Place


@click.command(name="convert", short_help="Recordings to another format.")
@click.argument("inputs", nargs=-1, required=True, metavar="IN...")
@click.argument("output", metavar="OUT")
@START
@END
@IDCODES
@click.option("--phasors", type=click.Choice(("polar", "rect")), default="polar", show_default=True)
@click.option("--long", "long_form", is_flag=True, help="Tables in long form: one row a value, one file.")
@DURATION
@common
def command(
    inputs: tuple[str, ...],
    output: str,
    start: Place | None,
    end: Place | None,
    idcodes: tuple[int, ...],
    phasors: str,
    long_form: bool,
    duration_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Convert recordings; formats are chosen by suffix. Several inputs are merged on time.

    Frames go to frames byte for byte; tables hold SI units and keep the configuration where the format can.
    """
    from pmutools.formats import open_sink
    from pmutools.tools.convert import convert
    from pmutools.tools.recordings import open_recordings
    from pmutools.tools.window import Window

    talk = Talk(quiet, verbose)
    spare(output, inputs)
    window = Window(start, end, duration_ns, idcodes)
    source = open_recordings(inputs)
    with open_sink(output, phasors="rect" if phasors == "rect" else "polar", long=long_form) as sink:
        result = convert(Watched(source, talk), sink, window)
    paths = [str(path) for path in sink.paths]
    told = json.dumps(result.to_json() | {"paths": paths})
    if as_json and output != "-":
        click.echo(told)
    if not result.frames:
        talk.complain(f"pmu convert: no data frames in {', '.join(inputs)} within what was asked for")
        return Exit.FAILED
    talk.say(f"{result.frames} data frames of {result.streams} streams -> {', '.join(paths)}")
    for name, count in result.losses.items():
        talk.say(f"  {name}: {count}")
    if as_json and output == "-":  # standard output has the data
        click.echo(told, err=True)
    return Exit.INCOMPLETE if result.losses else Exit.DONE
