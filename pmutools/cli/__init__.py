"""The ``pmu`` command. Each subcommand lives in a module of its own, imported when it is called."""

from __future__ import annotations

import sys

import click

from pmutools.cli.shell import LazyGroup, run

COMMANDS = {
    "info": ("pmutools.cli.info", "What a recording or a live stream holds, and what is wrong with it."),
    "dump": ("pmutools.cli.dump", "Every frame, one a line."),
    "convert": ("pmutools.cli.convert", "Recordings to another format."),
    "synth": ("pmutools.cli.synth", "A recording made by a simulated grid and its PMUs."),
    "ini": ("pmutools.cli.ini", "A starter initialisation file from live streams."),
    "play": ("pmutools.cli.play", "Stream a recording live, as any number of PMUs."),
    "ctl": ("pmutools.cli.ctl", "Control a running player."),
    "read": ("pmutools.cli.read", "Read live streams and log them."),
    "characterize": ("pmutools.cli.characterize", "How late, how even, how lossy streams come."),
    "clock": ("pmutools.cli.clock", "How good this machine's clock is, by all who can tell."),
}


def pmu() -> LazyGroup:
    """The command group, built without importing any subcommand."""
    from pmutools import __version__

    return LazyGroup(
        "pmu",
        COMMANDS,
        help="IEEE C37.118 PMU streams: look into them, convert them, play them live, read them live.",
        version=__version__,
    )


def main() -> None:
    sys.exit(run(pmu(), sys.argv[1:]))


def player() -> None:
    """``stream-player``: the paper's Advanced Stream Player, ``pmu play``."""
    sys.exit(_alone("play", "stream-player"))


def reader() -> None:
    """``stream-reader``: the paper's StreamReader, ``pmu read``."""
    sys.exit(_alone("read", "stream-reader"))


def characterizer() -> None:
    """``network-characterizer``: the paper's PMU Network Characterizer, ``pmu characterize``."""
    sys.exit(_alone("characterize", "network-characterizer"))


def _alone(subcommand: str, name: str) -> int:
    group = pmu()
    command = group.get_command(click.Context(group), subcommand)
    return run(command, sys.argv[1:], name=name)
