"""``dcon server``."""

from __future__ import annotations

import signal
from types import FrameType

import click

from pmutools.cli.shell import Exit, Talk, common


@click.command(name="server", short_help="Writes the session log of a platform, and serves its operators.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--run-dir", required=True, metavar="DIR", help="Folder of the platform's sockets.")
@click.option("--log", metavar="FILE", help="Session log; default: [log] path.")
@common
def command(ini: str, run_dir: str, log: str | None, as_json: bool, quiet: bool, verbose: int) -> int:
    """Write the session log of the platform that runs in DIR, and serve operators (dcon ctl) at [server] listen.

    Control does not depend on it: a server that is away is sent what it missed when it is back. Ctrl-C ends the log.
    """
    from dataclasses import replace

    from dcon.link.notify import Notifier
    from dcon.server.server import Server
    from dcon.settings import load

    talk = Talk(quiet, verbose)
    settings = load(ini)
    if log is not None:
        settings = replace(settings, log=replace(settings.log, path=log))
    server = Server(settings, run_dir, notifier=Notifier())

    def stop(signum: int, frame: FrameType | None) -> None:
        server.stopping = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    talk.say(f"operators: {server.operators.address}; session log: {settings.log.path}")
    if settings.server.keys is None:
        talk.complain("no keys in [server]: nobody can order anything")
    server.run()
    report = server.report
    if report.file:
        talk.say(f"session log {report.file}, {report.parts} part(s), {report.unlogged} ticks are missing")
    return Exit.INCOMPLETE if report.unlogged else Exit.DONE
