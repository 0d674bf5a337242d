"""``pmu synth``."""

from __future__ import annotations

import click

from pmutools import parsers
from pmutools.cli.shell import Parsed, Talk, common
from pmutools.cli.sources import Watched
from pmutools.errors import SettingsError


@click.command(name="synth", short_help="A recording made by a simulated grid and its PMUs.")
@click.argument("output", metavar="OUT")
@click.option("--scenario", "scenario_name", default="cjb", show_default=True, metavar="NAME", help="What happens.")
@click.option("--plant", default="modal", show_default=True, metavar="NAME", help="The grid it happens to.")
@click.option("--pmus", type=click.IntRange(1, 200), default=8, show_default=True, help="Half north, half south.")
@click.option("--rate", type=click.IntRange(1, 240), default=60, show_default=True, metavar="FPS")
@click.option(
    "--duration", type=Parsed(parsers.number(0.001, 86400)), metavar="S", help="Default: the scenario's, at most a day."
)
@click.option("--seed", type=Parsed(parsers.integer(0, 2**64 - 1)), default="1", show_default=True, metavar="N")
@click.option(
    "--pdc", type=click.IntRange(1, 65534), metavar="IDCODE", help="All PMUs in one stream of a concentrator."
)
@common
def command(
    output: str,
    scenario_name: str,
    plant: str,
    pmus: int,
    rate: int,
    duration: float | None,
    seed: int,
    pdc: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> None:
    """Simulate a grid, and record what its PMUs would have sent. The same arguments make the same bytes."""
    import json
    from pathlib import Path

    from pmutools.formats import open_sink
    from pmutools.formats.source import MessageSource
    from pmutools.tools.convert import convert
    from pmutools.tools.synth import Recipe, synthesise
    from pmutools.tools.window import Window

    talk = Talk(quiet, verbose)
    if pdc is not None and pmus > 100:
        raise SettingsError("--pdc: at most 100 PMUs in one stream")
    messages = synthesise(Recipe(scenario_name, plant, pmus, rate, duration, seed, pdc))
    with open_sink(output) as sink:
        source = MessageSource(Path(scenario_name), "synth", messages)
        result = convert(Watched(source, talk), sink, Window())
    paths = [str(path) for path in sink.paths]
    if as_json:
        click.echo(json.dumps(result.to_json() | {"paths": paths}))
    talk.say(f"{result.frames} data frames of {result.streams} streams -> {', '.join(paths)}")
