"""``dcon watchdog``."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import common

if TYPE_CHECKING:
    from dcon.settings import Settings


@click.command(name="watchdog", short_help="Passes the command on while all is well; opens the relays when it is not.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--run-dir", required=True, metavar="DIR", help="Folder of the sockets; made if it is not there.")
@common
def command(ini: str, run_dir: str, as_json: bool, quiet: bool, verbose: int) -> None:
    """Stand between the controller and the output: pass the command on while every beat and input is good.

    It reads the initialisation file and then becomes `python -m dcon.watchdog`, a process that shares no code with the
    controller. What happens is told as JSON lines, on stderr or in [watchdog] log. SIGTERM opens the relays, sends 0 V
    and ends.

    Research software: it has never moved a real HVDC line.
    """
    from dcon.settings import load

    program = [sys.executable, "-P", "-m", "dcon.watchdog", *arguments(load(ini), run_dir)]
    os.execv(program[0], program)


def arguments(settings: Settings, run_dir: str) -> list[str]:
    """Arguments of ``python -m dcon.watchdog`` for an initialisation file: everything in force."""
    from dcon.link.paths import OUTPUT

    of, output = settings.watchdog, settings.output
    datagrams = None if output.needs_process else output.url
    lines = ("estop_a", "estop_b", "contact_a", "contact_b", "relay_a", "relay_b")
    return [
        *("--run-dir", run_dir),
        *("--output", OUTPUT if datagrams is None else str(datagrams)),
        *("--status", ",".join(of.status)),
        *("--beats", ",".join(of.beats)),
        *(["--readback-required"] if of.readback == "required" else []),
        *(f"--{name.replace('_', '-')}={path}" for name in lines if (path := getattr(of, name))),
        *(["--pulse"] if of.drive == "pulse" else []),
        *([f"--log={of.log}"] if of.log else []),
        *("--log-mb", repr(of.log_mb)),
        *([] if of.fifo else ["--no-fifo"]),
        *(f"--limit={name}={value!r}" for name, value in of.rules.limits._asdict().items()),
    ]
