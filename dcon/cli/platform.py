"""``dcon platform``."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Exit, Parsed, Talk, common
from pmutools.errors import SettingsError, SourceError
from pmutools.parsers import number

if TYPE_CHECKING:
    from dcon.control.loop import Platform
    from dcon.control.summary import Summary
    from dcon.engine import Tick
    from dcon.link.notify import Notifier
    from dcon.settings import Settings


@click.command(name="platform", short_help="The real-time controller: PMU streams in, command out, session log.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--run-dir", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Be one of several.")
@click.option("--log", metavar="FILE", help="Session log, or NAME-2 ...; default: [log] path. Not with --run-dir.")
@click.option("--duration", type=Parsed(number(1e-3, 1e9)), metavar="S", help="Stop S seconds after --start.")
@click.option("--start", metavar="UTC", help="What --duration and --order count from; default: now.")
@click.option("--order", "orders", multiple=True, metavar="S:NAME[=VALUE]", help="An order for later; repeatable.")
@common
def command(
    ini: str,
    run_dir: Path | None,
    log: str | None,
    duration: float | None,
    start: str | None,
    orders: tuple[str, ...],
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Run the controller: PMU streams in, 60 ticks a second, the command out, everything logged.

    Alone it receives, drives [output] and writes the session log itself, without a watchdog. With --run-dir (or
    [platform] run_dir) it is one of several processes that meet in that folder: the command goes to the watchdog, the
    log to the server. `dcon run` starts them all.

    Ctrl-C ramps the command down, which takes a second, and ends; a second Ctrl-C ends at once.

    Research software: it has never moved a real HVDC line.
    """
    from dcon.control.orders import parse_order
    from dcon.link.notify import STOPPING, Notifier
    from dcon.settings import load
    from pmutools.log_thread import log_in_thread
    from pmutools.timebase import parse_utc

    talk = Talk(quiet, verbose)
    settings = load(ini)
    timed = [parse_order(order) for order in orders]
    try:
        start_ns = None if start is None else parse_utc(start)
    except ValueError as error:
        raise SettingsError(f"--start: {error}") from None
    folder = run_dir or settings.platform.run_dir
    required = settings.params.required._asdict() if folder is None else {}
    if untold := ", ".join(name for name, is_required in required.items() if is_required):
        talk.say(f"warning: alone, nobody tells what is required ({untold}), so nothing can be armed")
    if folder is not None and log is not None:
        raise SettingsError("--log: with a run folder the server writes the log; set [log] path for it")
    notifier = Notifier()
    with log_in_thread(), _session(settings, Path(ini), folder, log or settings.log.path, notifier) as platform:
        summary = platform.run(orders=timed, start_ns=start_ns, duration_s=duration)
    notifier.tell(STOPPING)
    if as_json:
        click.echo(json.dumps(asdict(summary)))
    return _told(summary, settings, talk, stopped=platform.stopping)


def _told(summary: Summary, settings: Settings, talk: Talk, *, stopped: bool) -> int:
    from dcon.link.counts import words

    where = f"; session log {summary.log_parts[0]}" if summary.log_parts else ""
    talk.say(f"{summary.ticks} ticks, {summary.frames} frames, ended {summary.final_state}{where}")
    if counted := words(summary.counts):
        talk.say(f"not taken: {counted}")
    if len(summary.log_parts) > 1:
        talk.say(f"in {len(summary.log_parts)} parts, the last {summary.log_parts[-1]}")
    if summary.unlogged_ticks:
        talk.complain(f"{summary.unlogged_ticks} ticks were not logged")
    if summary.trouble:
        raise SourceError(summary.trouble)
    if stopped:
        return Exit.INTERRUPTED
    if not summary.frames:
        urls = ", ".join(str(site.url) for site in settings.sites)
        raise SourceError(f"no frame came from any PMU ({urls}); are they on, and the ports and IDCODEs right?")
    return Exit.INCOMPLETE if summary.unlogged_ticks else Exit.DONE


@contextmanager
def _session(
    settings: Settings, ini: Path, folder: Path | None, log_path: str, notifier: Notifier
) -> Iterator[Platform]:
    """A platform that signals end: alone, or with its children in a run folder."""
    from dcon.control.loop import SPIN_NS, Platform
    from pmutools.clock import SystemClock

    clock = SystemClock(spin_ns=SPIN_NS)
    with _Signals() as signals:
        if folder is None:
            from dcon.control.alone import own_ends

            ends = own_ends(settings, clock, log_path)
        else:
            from dcon.control.linked import Linked
            from dcon.link.paths import prepare

            ends = Linked(settings, ini, prepare(folder), clock).ends
        platform = Platform(settings, ends, clock, ticked=_Herald(notifier))
        signals.concern(platform)
        yield platform


class _Herald:
    """Tells systemd, once a second, that ticks are run, and in which state."""

    PERIOD_NS = 1_000_000_000

    def __init__(self, notifier: Notifier) -> None:
        self._notifier = notifier
        self._told_ns: int | None = None

    def __call__(self, tick: Tick, now_ns: int) -> None:
        from dcon.link.notify import ALIVE, READY

        if self._told_ns is not None and now_ns - self._told_ns < self.PERIOD_NS:
            return
        first, self._told_ns = self._told_ns is None, now_ns
        record = tick.record
        status = f"{record.state} {record.mode}, {record.output_v:.2f} V"
        self._notifier.tell(*((READY,) if first else ()), ALIVE, status=status)


class _Signals:
    """SIGINT and SIGTERM ask the platform to stop, as soon as there is one; a second one interrupts."""

    def __init__(self) -> None:
        self._asked = False
        self._platform: Platform | None = None

    def concern(self, platform: Platform) -> None:
        self._platform = platform
        if self._asked:
            platform.stop()

    def _ask(self, signum: int, frame: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
        if self._platform is not None:
            self._platform.stop()

    def __enter__(self) -> _Signals:
        self._before = {each: signal.signal(each, self._ask) for each in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)
