"""``pmu clock``."""

from __future__ import annotations

import json
from ipaddress import ip_address

import click

from pmutools import parsers
from pmutools.cli.shell import Exit, Parsed, Talk, common

MS = 1_000_000


def _address(text: str) -> tuple[str, int]:
    """HOST:PORT by number: looking up a name may take longer than anyone waits."""
    host, _, port = text.rpartition(":")
    try:
        ip_address(host.strip("[]"))
    except ValueError:
        raise ValueError(f"{text!r} is not of the form ADDRESS:PORT, such as 127.0.0.1:2947") from None
    return host.strip("[]"), parsers.integer(1, 65535)(port)


@click.command(name="clock", short_help="How good this machine's clock is, by all who can tell.")
@click.option("--gpsd", type=Parsed(_address), metavar="ADDRESS:PORT", help="gpsd, if not at 127.0.0.1:2947.")
@click.option("--chronyd", type=Parsed(_address), metavar="ADDRESS:PORT", help="chronyd, if not where chronyc looks.")
@click.option("--ptp4l", metavar="SOCKET", help="ptp4l's socket, if not one of the usual.")
@click.option(
    "--require",
    "limit_ns",
    type=Parsed(parsers.duration_ns(MS, 0)),
    metavar="MS",
    help="Exit code 3 unless the clock is known to be within MS of UTC.",
)
@common
def command(
    gpsd: tuple[str, int] | None,
    chronyd: tuple[str, int] | None,
    ptp4l: str | None,
    limit_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Ask the kernel, chrony, ptp4l and gpsd how far this machine's clock may be from UTC, and say what to do about it.

    A delay is arrival less time stamp, so it is as good as this clock. Nothing is changed.
    """
    from pmutools.cli.clock_text import advice, lines
    from pmutools.clocksources.chrony import CHRONYD, Chronyd
    from pmutools.clocksources.gpsd import GPSD, Gpsd
    from pmutools.clocksources.watch import ClockSources, Places

    talk = Talk(quiet, verbose)
    places = Places(Chronyd(*chronyd) if chronyd else CHRONYD, Gpsd(*gpsd) if gpsd else GPSD, ptp4l)
    sources = ClockSources(places)
    quality = sources.ask()
    if as_json:
        said = quality.to_json() | {"silent": sources.silent, "advice": list(advice(quality))}
        click.echo(json.dumps(said, indent=2))
    else:
        for line in lines(quality, sources.silent):
            click.echo(line)
    if limit_ns is None or (quality.bound_ns is not None and quality.bound_ns <= limit_ns):
        return Exit.DONE
    talk.complain(f"pmu clock: --require {limit_ns / MS:g}: {quality.text}")
    return Exit.INCOMPLETE
