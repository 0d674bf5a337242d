"""``dcon platform``."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from types import FrameType
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Exit, Parsed, Talk, common
from pmutools.errors import SettingsError, SourceError
from pmutools.parsers import number

if TYPE_CHECKING:
    from dcon.platform.loop import Platform


@click.command(name="platform", short_help="The real-time controller: PMU streams in, command out, session log.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--log", metavar="FILE", help="Session log; default: [log] path.")
@click.option("--duration", type=Parsed(number(1e-3, 1e9)), metavar="S", help="Stop S seconds after --start.")
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
) -> int:
    """Run the controller: PMU streams in, 60 ticks a second, the command out over UDP, everything logged.

    Ctrl-C ramps the command down, which takes a second, and ends; a second Ctrl-C ends at once.

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
    platform = Platform(settings)
    with _stopped_by_signals(platform):
        summary = platform.run(path, orders=timed, start_ns=start_ns, duration_s=duration)
    if as_json:
        click.echo(json.dumps(asdict(summary)))
    talk.say(f"{summary.ticks} ticks, {summary.frames} frames, ended {summary.final_state}; session log {path}")
    if len(summary.log_parts) > 1:
        talk.say(f"in {len(summary.log_parts)} parts, the last {summary.log_parts[-1]}")
    if summary.unlogged_ticks:
        talk.complain(f"{summary.unlogged_ticks} ticks were not logged")
    if platform.stopping:
        return Exit.INTERRUPTED
    if not summary.frames:
        where = ", ".join(str(site.url) for site in settings.sites)
        raise SourceError(f"no frame came from any PMU ({where}); are they on, and the ports and IDCODEs right?")
    return Exit.INCOMPLETE if summary.unlogged_ticks else Exit.DONE


@contextmanager
def _stopped_by_signals(platform: Platform) -> Iterator[None]:
    def stop(signum: int, frame: FrameType | None) -> None:
        if platform.stopping:
            raise KeyboardInterrupt
        platform.stop()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
