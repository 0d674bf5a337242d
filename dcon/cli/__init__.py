"""The ``dcon`` command. Each subcommand lives in a module of its own, imported when it is called."""

from __future__ import annotations

import sys

from pmutools.cli.shell import LazyGroup, run

COMMANDS = {
    "demo": ("dcon.cli.demo", "The whole chain live on this machine: grid, PMUs, controller; open loop, then closed."),
    "simulate": ("dcon.cli.simulate", "A scenario in virtual time, through the same bytes and the same engine."),
    "replay": ("dcon.cli.replay", "A recorded session through the engine again; commands must be identical."),
    "export": ("dcon.cli.export", "A session log as a table."),
    "analyze": ("dcon.cli.analyze", "What recorded sessions tell: a report, figures, and JSON."),
    "check": ("dcon.cli.check", "Dry check of an initialisation file; prints every effective setting."),
    "run": ("dcon.cli.run", "Controller, watchdog, server and output, started and looked after."),
    "platform": ("dcon.cli.platform", "The real-time controller: PMU streams in, command out, session log."),
    "output": ("dcon.cli.output", "The output process: commands from the watchdog to a DAC or a Modbus device."),
    "watchdog": ("dcon.cli.watchdog", "Passes the command on while all is well; opens the relays when it is not."),
    "server": ("dcon.cli.server", "Writes the session log of a platform, and serves its operators."),
    "ctl": ("dcon.cli.ctl", "An operator's orders, and what the controller is doing."),
    "keys": ("dcon.cli.keys", "Make a key for a new operator."),
}


def dcon() -> LazyGroup:
    """The command group, built without importing any subcommand."""
    from pmutools import __version__

    return LazyGroup(
        "dcon",
        COMMANDS,
        help="A wide-area damping controller fed by C37.118 streams. Research software: it has never moved a real "
        "HVDC line.",
        version=__version__,
    )


def main() -> None:
    sys.exit(run(dcon(), sys.argv[1:]))
