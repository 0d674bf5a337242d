"""``dcon run``."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmutools.cli.shell import Exit, Parsed, Talk, common
from pmutools.errors import SettingsError
from pmutools.parsers import number

if TYPE_CHECKING:
    from dcon.settings import Settings


@click.command(name="run", short_help="Controller, watchdog, server and output, started and looked after.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--run-dir", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Where they meet.")
@click.option("--duration", type=Parsed(number(1e-3, 1e9)), metavar="S", help="Stop S seconds after --start.")
@click.option("--start", metavar="UTC", help="What --duration counts from; default: when the controller is started.")
@common
def command(
    ini: str,
    run_dir: Path | None,
    duration: float | None,
    start: str | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Run the controller as it is meant to be run: as processes that share nothing but sockets in one folder.

    What dies is started again, with more and more time between; nothing is armed again but by an operator. Ctrl-C or
    SIGTERM end them in order: the command ramps down, the log is closed, the relays open.

    Research software: it has never moved a real HVDC line.
    """
    if sys.platform != "linux":
        raise SettingsError("dcon run needs Linux; dcon platform alone runs elsewhere too")
    from dcon.effective import warnings_of
    from dcon.household.household import Household, NotStarted
    from dcon.link.notify import Notifier
    from dcon.settings import load
    from pmutools.log_thread import log_in_thread
    from pmutools.timebase import NS, format_utc, parse_utc

    talk = Talk(quiet, verbose)
    settings = load(ini)
    for warning in warnings_of(settings):
        talk.say(f"warning: {warning}")
    try:
        start_ns = None if start is None else parse_utc(start)
    except ValueError as error:
        raise SettingsError(f"--start: {error}") from None
    flags = ("--quiet",) if quiet else ("-v",) * verbose
    begun: list[int] = [] if start_ns is None else [start_ns]

    def timed() -> tuple[str, ...]:
        """The same time for a controller that is started again."""
        if not begun:
            begun.append(time.time_ns())
        start = ("--start", format_utc(begun[0]))
        return start if duration is None else (*start, "--duration", repr(duration))

    def is_over() -> bool:
        return duration is not None and bool(begun) and time.time_ns() >= begun[0] + round(duration * NS)

    with _folder(run_dir or settings.platform.run_dir) as folder:
        before = _sessions_in(folder)
        commands = _commands(settings, ini, folder, flags, timed)
        household = Household(folder, commands, Notifier(), is_over)
        with household.stopped_by_signals(), log_in_thread():  # who looks after others waits for no reader of stderr
            try:
                outcome = household.run()
            except NotStarted as error:
                if not error.is_told:
                    raise
                return error.code
    summary = _summary(outcome.said, before)
    missing = summary.get("unlogged_ticks", 0)
    restarts = sum(outcome.restarts.values())
    if as_json:
        click.echo(json.dumps({**summary, "restarts": outcome.restarts}))
    if restarts:
        told = ", ".join(f"{name} {count} times" for name, count in outcome.restarts.items())
        talk.complain(f"started again: {told}")
    if missing:
        logs = "session log" if len(outcome.said.get("platform", ())) < 2 else "session logs"
        talk.complain(f"{missing} ticks are missing in the {logs}")
    if household.stopping:
        return Exit.INTERRUPTED
    return Exit.INCOMPLETE if (restarts or missing) and not outcome.code else outcome.code


def _sessions_in(folder: Path) -> frozenset[int]:
    """Sessions that a server has recorded there: those of an earlier run, when this one begins."""
    from dcon.server.state import load

    state = load(folder)
    return frozenset() if state is None else frozenset((state.session, *(session for session, _ in state.earlier)))


def _summary(said: Mapping[str, Sequence[str]], before: Collection[int]) -> dict[str, Any]:
    """The last controller's summary, with what is known of the logs of all sessions but those from ``before``.

    Controller and server both count ticks that are missing in a session: the controller those that the server never
    confirmed, the server those that the disk did not take and those that the controller could not keep for it. Some are
    both, so the larger number counts.
    """
    controllers, servers = ([_parsed(text) for text in said.get(name, ())] for name in ("platform", "server"))
    counts = [(told.get("session", 0), told.get("unlogged_ticks", 0)) for told in controllers]
    counts += [
        (int(session), ticks) for told in servers for session, ticks in told.get("unlogged_by_session", {}).items()
    ]
    missing: dict[int, int] = {}
    for session, ticks in counts:
        if session not in before:
            missing[session] = max(missing.get(session, 0), ticks)
    last, log = (told[-1] if told else {} for told in (controllers, servers))
    return {**last, "unlogged_ticks": sum(missing.values()), "log_parts": log.get("log_parts", [])}


def _parsed(text: str) -> dict[str, Any]:
    """Nothing of a process that was killed while it spoke."""
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _commands(
    settings: Settings, ini: str, folder: Path, flags: Sequence[str], timed: Callable[[], tuple[str, ...]]
) -> dict[str, Callable[[], Sequence[str]]]:
    """Arguments of Python for each process that is needed."""

    def alone(name: str) -> Sequence[str]:
        return ("-m", "dcon.cli", name, "--ini", ini, "--run-dir", str(folder), *flags)

    commands: dict[str, Callable[[], Sequence[str]]] = {
        "watchdog": lambda: alone("watchdog"),
        "server": lambda: (*alone("server"), "--json"),
        "platform": lambda: (*alone("platform"), "--json", *timed()),
    }
    if settings.output.needs_process:
        commands["output"] = lambda: alone("output")
    return commands


@contextmanager
def _folder(given: Path | None) -> Iterator[Path]:
    """The run folder, made; one that nobody named is removed afterwards."""
    from dcon.link.paths import prepare

    if given is not None:
        yield prepare(given)
        return
    with tempfile.TemporaryDirectory(prefix="dcon-") as made:
        yield prepare(made)
