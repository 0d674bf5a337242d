"""``pmu characterize``."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmutools import parsers
from pmutools.cli.shell import Exit, Parsed, Talk, common, interruptible, visible
from pmutools.cli.sources import DURATION, is_live
from pmutools.errors import SettingsError, SourceError
from pmutools.timebase import NS
from pmutools.tools.characterizer.names import FILES

if TYPE_CHECKING:
    from pmutools.c37118.config import StreamConfig
    from pmutools.c37118.demux import Loss, Message
    from pmutools.cli.stage import Stage
    from pmutools.formats.source import Block
    from pmutools.net.dialogue import LinkEvent
    from pmutools.sites import Site
    from pmutools.tools.characterizer.engine import Engine
    from pmutools.tools.characterizer.job import Job, Observe, Outcome, Settings

PROGRESS_NS = NS // 2


@click.command(name="characterize", short_help="How late, how even, how lossy streams come.")
@click.argument("targets", nargs=-1, metavar="URL...|FILE...")
@click.option("--ini", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="PMUs: [pmu NAME].")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR")
@click.option(
    "--wait",
    "wait_ns",
    type=Parsed(parsers.milliseconds_ns),
    default="200",
    show_default=True,
    metavar="MS",
    help="A concentrator's wait: frames that come later are late.",
)
@click.option(
    "--interval",
    "interval_ns",
    type=Parsed(parsers.duration_ns(NS, 1)),
    metavar="S",
    help="A line every S seconds in intervals.jsonl.",
)
@click.option(
    "--clock-uncertainty",
    "clock_bound_ns",
    type=Parsed(parsers.milliseconds_ns),
    metavar="MS",
    help="You vouch that the clock of the recording was within so much of UTC.",
)
@click.option("--ledger", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="A player's truth.")
@click.option("--compare", "before", type=click.Path(path_type=Path), metavar="DIR", help="An earlier run.")
@click.option("--export-profile", "profile", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE")
@click.option("--exact-profile", is_flag=True, help="Delays as counted, not fitted, in the profile.")
@click.option("--require", metavar="LIMITS", help="delay_p99<=90ms,loss<=0.1%: exit code 3 where one does not hold.")
@click.option("--no-samples", is_flag=True, help="No samples.parquet: for long runs of many streams.")
@click.option("--no-report", is_flag=True, help="No report.html and figures.")
@click.option("--live", "shown", is_flag=True, help="Show all streams on the terminal while they are measured.")
@DURATION
@common
def command(as_json: bool, quiet: bool, verbose: int, no_report: bool, **said: Any) -> int:
    """Measure streams: how late, how even, how lossy, in which order, by whose clock; with what is wrong in words.

    Live from an initialisation file or URLs, or from recordings, whose arrival stamps are used. DIR gets summary.json,
    samples.parquet and a report. Exit code 3 says that bytes came that are no frames, that this machine could not keep
    up, or that a limit does not hold; loss on the network is a result.
    """
    talk, asked = Talk(quiet, verbose), Asked(**said)
    _check(asked)
    live = asked.ini is not None or is_live(asked.targets[0])
    with interruptible() as stop:
        job, why = _live(asked, talk, verbose, stop) if live else _recorded(asked, talk, stop)
        outcome = job.finish()
        stopped = stop()
    if not no_report:
        _report(outcome, asked, talk)
    _tell(outcome, talk, as_json=as_json, quiet=quiet, verbose=verbose)
    if not outcome.received:
        raise SourceError(f"no data from {asked.name}: {why()}")
    if stopped:
        return Exit.INTERRUPTED
    if outcome.failures:
        return Exit.FAILED
    return Exit.INCOMPLETE if outcome.incomplete or not outcome.holds else Exit.DONE


@dataclass(frozen=True)
class Asked:
    """The command line, but for how it is to be told."""

    targets: tuple[str, ...]
    ini: Path | None
    out: Path
    wait_ns: int
    interval_ns: int | None
    clock_bound_ns: int | None
    ledger: Path | None
    before: Path | None
    profile: Path | None
    exact_profile: bool
    require: str | None
    no_samples: bool
    shown: bool
    duration_ns: int | None

    @property
    def name(self) -> str:
        """What is measured, as the user named it."""
        return str(self.ini) if self.ini is not None else ", ".join(self.targets)


def _check(asked: Asked) -> None:
    """What clashes, before anything is opened."""
    targets, before, out = asked.targets, asked.before, asked.out
    if asked.ini is not None and targets:
        raise SettingsError(f"--ini {asked.ini} and {targets[0]}: measure one or the other")
    if asked.ini is None and not targets:
        raise SettingsError("what is to be measured? name URLs, a recording, or --ini FILE")
    if asked.shown and asked.ini is None and not is_live(targets[0]):
        raise SettingsError(f"--live shows live streams; {targets[0]} is a recording: leave it out")
    if asked.clock_bound_ns is not None and (asked.ini is not None or is_live(targets[0])):
        raise SettingsError("--clock-uncertainty is for recordings; live, the clock itself is asked (see pmu clock)")
    if len({is_live(target) for target in targets}) > 1:
        raise SettingsError(f"{targets[0]} and {targets[-1]}: live streams or recordings, not both at once")
    if asked.no_samples and asked.ledger is not None:
        raise SettingsError("--ledger needs the samples: leave out --no-samples")
    for path in filter(None, (*map(Path, targets), asked.ini, asked.ledger)):
        if path.name in FILES and path.exists() and out.exists() and path.resolve().parent.samefile(out):
            raise SettingsError(f"{path} is an input, and would be overwritten; write to another folder than {out}")
    if before is not None and before.exists() and out.exists() and before.samefile(out):
        raise SettingsError(f"--compare {before} is --out too, and would be overwritten; write to another folder")


def _settings(asked: Asked) -> Settings:
    from pmutools.measure.require import parse_requirements
    from pmutools.tools.characterizer.job import Settings, load_summary

    return Settings(
        wait_ns=asked.wait_ns,
        samples=not asked.no_samples,
        interval_ns=asked.interval_ns,
        clock_bound_ns=asked.clock_bound_ns,
        ledger=asked.ledger,
        before=None if asked.before is None else load_summary(asked.before),
        requirements=parse_requirements(asked.require) if asked.require is not None else (),
        profile=asked.profile,
        exact_profile=asked.exact_profile,
    )


Why = Callable[[], str]
"""Why nothing came, as part of a sentence."""


def _live(asked: Asked, talk: Talk, verbose: int, stop: Callable[[], bool]) -> tuple[Job, Why]:
    """Bind first: what has to be imported after that is slow."""
    from pmutools.cli.stage import Stage
    from pmutools.sites import load_sites
    from pmutools.tools.characterizer.wanted import wanted_of
    from pmutools.tools.live import LiveSource

    sites = load_sites(asked.ini) if asked.ini is not None else ()
    wanted = wanted_of(asked.targets, sites)
    stage = Stage(talk, verbose, stop)
    hearing: list[Callable[[LinkEvent], None]] = [stage.hear]

    def tell(event: LinkEvent) -> None:
        for hear in hearing:
            hear(event)

    with ExitStack() as stack:
        endpoints = [each.endpoint for each in wanted]
        source = stack.enter_context(
            LiveSource(
                endpoints,
                duration_ns=asked.duration_ns,
                configs=_saved(sites),
                tell=tell,
                tell_host=stage.hear_host,
                stop=stage.over,
            )
        )
        begin_ns = source.clock.realtime_ns()
        from pmutools.clocksources.watch import ClockWatch
        from pmutools.tools.characterizer.engine import Engine
        from pmutools.tools.characterizer.folder import Folder
        from pmutools.tools.characterizer.job import Job

        settings = _settings(asked)
        engine = Engine(wanted, source.receivers.owners, wait_ns=settings.wait_ns, begin_ns=begin_ns)
        hearing.append(lambda event: engine.hear(event, source.clock.realtime_ns()))
        job = Job(engine, Folder(asked.out), settings, source.clock, source=asked.name)
        watch = stack.enter_context(ClockWatch())
        if asked.shown:
            paths = [asked.out / name for name in FILES]
            how = {
                "view": "delay",
                "out": asked.out,
                "paths": lambda: paths,
                "wait_ns": settings.wait_ns,
                "clock": watch,
            }
            stack.enter_context(stage.open(source, f"pmu characterize {asked.name}", name=engine.name, **how))
        job.live(source, lambda: watch.quality, _progress(talk, stage))
    return job, lambda: stage.reasons.why_all(len(wanted))


def _recorded(asked: Asked, talk: Talk, stop: Callable[[], bool]) -> tuple[Job, Why]:
    from pmutools.cli.sources import Cut
    from pmutools.clock import SystemClock
    from pmutools.tools.characterizer.engine import Engine
    from pmutools.tools.characterizer.folder import Folder
    from pmutools.tools.characterizer.job import Job
    from pmutools.tools.recordings import open_recordings

    settings = _settings(asked)
    source = open_recordings(asked.targets)
    job = Job(Engine(wait_ns=settings.wait_ns), Folder(asked.out), settings, SystemClock(), source=asked.name)
    cut = source if asked.duration_ns is None else Cut(source, asked.duration_ns)
    job.recorded(cut, _progress(talk), stop)
    return job, lambda: f"no C37.118 data frames found in {source.tally.fed} bytes of payload"


def _saved(sites: tuple[Site, ...]) -> tuple[StreamConfig, ...]:
    """Configurations that the initialisation file refers to; to read them is slow, and seldom asked for."""
    if not any(site.config for site in sites):
        return ()
    from pmutools.tools.recordings import saved_configs

    return saved_configs(sites)


def _progress(talk: Talk, stage: Stage | None = None) -> Observe:
    from pmutools.cli.herald import Herald
    from pmutools.clock import SystemClock

    clock, progress = SystemClock(), Herald(talk).progress if stage is None else stage.progress
    due_ns = clock.monotonic_ns() + PROGRESS_NS

    def observe(engine: Engine, items: Sequence[Block | Message | Loss]) -> None:
        nonlocal due_ns
        now_ns = clock.monotonic_ns()
        if stage is not None:
            stage.look(items, now_ns)
        if now_ns >= due_ns:
            due_ns = now_ns + PROGRESS_NS
            progress(lambda: f"{sum(g.frames for g in engine.gauges)} frames of {len(engine.gauges)} streams")

    return observe


def _report(outcome: Outcome, asked: Asked, talk: Talk) -> None:
    """The report and the figures, where what they need is installed."""
    from pmutools.report import write_report
    from pmutools.report.intervals import read_intervals, too_long
    from pmutools.tools.characterizer.names import INTERVALS

    talk.progress("writing the report")
    run, intervals = outcome.run, asked.out / INTERVALS
    left_out = too_long(intervals)
    run = replace(
        run,
        intervals=read_intervals(intervals),
        news=[*run.news, (run.end_ns, left_out)] if left_out else run.news,
        compared_with="" if asked.before is None else str(asked.before),
        command=shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    )
    try:
        page, *figures = write_report(run, asked.out)
        outcome.paths += [page, *sorted({path.parent for path in figures})]
    except SettingsError as error:
        talk.say(f"no report.html and no figures: {error}")
    except SourceError as error:
        outcome.failures.append(str(error))


def _tell(outcome: Outcome, talk: Talk, *, as_json: bool, quiet: bool, verbose: int) -> None:
    from pmutools.cli.characterize_text import told

    talk.progress("")
    run = outcome.run
    if as_json:
        click.echo(json.dumps(run.summary))
    elif not quiet:
        for line in told(run.summary, run.verdicts, run.differences, all_of_them=verbose > 0):
            click.echo(visible(line))  # names are as sent
    for line in outcome.incomplete:
        talk.say(line)
    for failure in outcome.failures:
        talk.complain(failure)
    talk.say(f"-> {', '.join(map(str, outcome.paths)) or 'nothing written'}")
