"""``dcon platform``."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from pmutools.cli.shell import Talk, common
from pmutools.errors import SettingsError


@click.command(name="platform", short_help="The real-time controller: PMU streams in, command out, session log.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--log", metavar="FILE", help="Session log; default: [log] path.")
@click.option("--duration", type=click.FloatRange(0, min_open=True), metavar="S", help="Stop S seconds after --start.")
@click.option("--start", metavar="UTC", help="What --duration and --order count from; default: now.")
@click.option("--order", "orders", multiple=True, metavar="S:NAME[=VALUE]", help="An order for later; repeatable.")
@common
def command(
    ini: str,
    log: str | None,
    duration: float | None,
    start: str | None,
    orders: tuple[str, ...],
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> None:
    """Run the controller: PMU streams in, 60 ticks a second, the command out over UDP, everything logged.

    Research software. There is no watchdog and no operator link yet; orders are given beforehand with --order.
    """
    from dcon.platform.loop import Platform
    from dcon.platform.orders import parse_order
    from dcon.settings import load
    from pmutools.timebase import parse_utc

    talk = Talk(quiet, verbose)
    settings = load(ini)
    timed = [parse_order(order) for order in orders]
    try:
        start_ns = None if start is None else parse_utc(start)
    except ValueError as error:
        raise SettingsError(f"--start: {error}") from None
    path = log or settings.log.path
    summary = Platform(settings).run(path, orders=timed, start_ns=start_ns, duration_s=duration)
    if as_json:
        click.echo(json.dumps(asdict(summary)))
    talk.say(f"{summary.ticks} ticks, {summary.frames} frames, ended {summary.final_state}; session log {path}")
