"""``dcon server``."""

from __future__ import annotations

import json
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
    from pmutools.log_thread import log_in_thread

    talk = Talk(quiet, verbose)
    settings = load(ini)
    if log is not None:
        settings = replace(settings, log=replace(settings.log, path=log))
    with log_in_thread() as aside:  # a stuck reader of stderr must hold up neither operators nor the log

        def say(text: str) -> None:
            aside(lambda: talk.say(text))

        server = Server(settings, run_dir, notifier=Notifier(), begun=lambda path: say(f"session log: {path}"))

        def stop(signum: int, frame: FrameType | None) -> None:
            server.stopping = True

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        say(f"operators: {server.operators.address}; the session log begins with a controller's first tick")
        if settings.server.keys is None:
            aside(lambda: talk.complain("no keys in [server]: nobody can order anything"))
        server.run()
    report = server.report
    if as_json:
        by_session = dict(report.lacking)
        said = {"log_parts": report.paths, "unlogged_ticks": report.unlogged, "unlogged_by_session": by_session}
        click.echo(json.dumps(said))
    if report.file:
        talk.say(f"session log {report.file}, {len(report.paths)} part(s), {report.unlogged} ticks are missing")
    elif report.unlogged:
        talk.complain(f"no session log: {report.unlogged} ticks are missing")
    if earlier := sum(ticks for _, ticks in report.lacking) - report.unlogged:
        talk.say(f"{earlier} ticks are missing in earlier sessions of this run folder")
    return Exit.INCOMPLETE if report.unlogged else Exit.DONE
