"""``pmu play``."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmutools import parsers
from pmutools.cli.shell import Exit, F, Parsed, Talk, common, interruptible
from pmutools.cli.sources import DURATION, END, START, Watched, spare
from pmutools.errors import SettingsError

if TYPE_CHECKING:
    from pmutools.impair.profile import Profile
    from pmutools.net.endpoint import Endpoint
    from pmutools.tools.player.results import StreamResult
    from pmutools.tools.window import Moment

MS = 1_000_000
FAULTS = ("loss", "delay", "drop", "duplicate", "reorder", "corrupt", "disable")


def _fault(name: str, metavar: str, text: str) -> Callable[[F], F]:
    return click.option(f"--{name}", f"fault_{name}", multiple=True, metavar=metavar, help=text)


def _speed(text: str) -> Fraction:
    parsers.number(0.001, 1000)(text)
    return Fraction(text.strip())


@click.command(name="play", short_help="Stream a recording live, as any number of PMUs.")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--to", multiple=True, metavar="URL", help="Send to udp://HOST:PORT; repeatable, ?idcode=N picks one.")
@click.option("--listen", multiple=True, metavar="URL", help="Serve at tcp://, udp+cmd:// or tcp+udp://; repeatable.")
@click.option("--stamp", type=click.Choice(("shift", "keep", "now-grid", "now")), default="shift", show_default=True)
@click.option("--timing", type=click.Choice(("stamp", "arrival")), help="Default: arrival where recorded, else stamp.")
@click.option("--speed", type=Parsed(_speed), default="1", show_default=True, metavar="X")
@click.option("--fps", type=Parsed(parsers.integer(1, 1000)), metavar="N", help="New stamps and DATA_RATE.")
@click.option(
    "--interval", "interval_ns", type=Parsed(parsers.duration_ns(MS, 0.001)), metavar="MS", help="Send spacing only."
)
@click.option("--loop", "loops", type=click.IntRange(0), default=1, show_default=True, help="0: for ever.")
@START
@END
@click.option("--select", multiple=True, metavar="NAME|IDCODE", help="Only this stream; repeatable.")
@click.option("--exclude", multiple=True, metavar="NAME|IDCODE", help="Not this stream; repeatable.")
@click.option(
    "--cfg-period",
    "cfg_period_ns",
    type=Parsed(parsers.seconds_ns),
    default="60",
    show_default=True,
    metavar="S",
    help="0: at start.",
)
@click.option("--impair", metavar="PROFILE", help="Impairment profile: a ready one's name, or a file.")
@_fault("loss", "P%", "Lose frames at random, or by a model: gemodel(1%,20%).")
@_fault("delay", "DIST", "Delay in ms: constant(16), normal(16,2), ...")
@_fault("drop", "LIST", "Leave out these data frames: 10,50-59,every 100 offset 3.")
@_fault("duplicate", "P%", "Send frames twice.")
@_fault("reorder", "P%", "Let frames overtake.")
@_fault("corrupt", "P%", "Damage frames.")
@_fault("disable", "NAME@T1..T2", "Switch a stream off from T1 to T2 s of stream time.")
@click.option("--seed", type=Parsed(parsers.integer(0, 2**64 - 1)), metavar="N", help="Same seed, same faults.")
@click.option("--emulate", type=click.IntRange(1, 65534), metavar="N", help="N PMUs that share the source's streams.")
@click.option("--ledger", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE.parquet")
@DURATION
@common
def command(
    files: tuple[str, ...],
    to: tuple[str, ...],
    listen: tuple[str, ...],
    stamp: str,
    timing: str | None,
    speed: Fraction,
    fps: int | None,
    interval_ns: int | None,
    loops: int,
    start: Moment | None,
    end: Moment | None,
    select: tuple[str, ...],
    exclude: tuple[str, ...],
    cfg_period_ns: int,
    impair: str | None,
    seed: int | None,
    emulate: int | None,
    ledger: Path | None,
    duration_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
    **faults: tuple[str, ...],
) -> int:
    """Play recordings live: every stream as a PMU of its own, restamped, on absolute deadlines.

    With --listen alone, playing begins at the first start command. --duration ends it S seconds after it began to
    listen or send. At the end each stream's pacing error is told: that is the player's accuracy.
    """
    from pmutools.clock import SystemClock
    from pmutools.net.endpoint import parse_endpoint
    from pmutools.tools.player.cast import as_recorded, emulated
    from pmutools.tools.player.ledger import LedgerWriter
    from pmutools.tools.player.play import Options, Player
    from pmutools.tools.player.reel import at_interval, at_rate, record
    from pmutools.tools.player.stamps import StampPolicy
    from pmutools.tools.recordings import losses, open_recordings
    from pmutools.tools.window import Window

    talk = Talk(quiet, verbose)
    if not to and not listen:
        raise SettingsError("where to? give --to udp://HOST:PORT or --listen tcp://HOST:PORT")
    if fps is not None and interval_ns is not None:
        raise SettingsError("--fps and --interval clash: the first changes the stamps too, the second the spacing only")
    if fps is not None and stamp == StampPolicy.KEEP:
        raise SettingsError("--fps makes new stamps, --stamp keep keeps the old: leave one out")
    options = Options(
        to=[_sent_to(parse_endpoint(url)) for url in to],
        listen=[_listening(parse_endpoint(url)) for url in listen],
        policy=StampPolicy(stamp),
        speed=speed,
        loops=loops,
        cfg_period_ns=cfg_period_ns,
        profile=_profile(impair, faults),
        seed=seed,
        duration_ns=duration_ns,
    )
    if ledger is not None:
        spare(ledger, files)
    source = open_recordings(files)
    reel = record(Watched(source, talk).blocks(), timing, Window(start, end), select, exclude)
    lost = losses(source)
    if interval_ns is not None:
        reel = at_interval(reel, interval_ns)
    if fps is not None:
        reel = at_rate(reel, fps)
    cast = emulated(reel, emulate, options.seed or 0) if emulate else as_recorded(reel)
    for pattern in options.profile.unmatched(cast.names(part) for part in range(len(cast.parts))):
        talk.say(f"no stream is called {pattern!r}; there are {', '.join(part.name for part in cast.parts)}")
    with (
        interruptible() as stop,
        Player(
            cast,
            options,
            SystemClock(spin_ns=100_000),
            stop=stop,
            tell=lambda event: talk.say(f"{event.client} {event.kind} {event.idcode or ''} {event.detail}".rstrip()),
            warn=talk.say,
            stamp_departures=ledger is not None,
        ) as player,
    ):
        for url in (*to, *listen):
            talk.say(f"{len(cast.parts)} streams, {len(reel.rows)} data frames: {url}")
        with LedgerWriter(ledger) if ledger is not None else nullcontext() as rows:
            player.play(rows, lambda: talk.progress(f"{player.results.sent} frames sent"))
        stopped = stop()
    if as_json:
        click.echo(json.dumps({"streams": [result.to_json() for result in player.results], "losses": lost}))
    for result in player.results:
        talk.say(_told(result))
    for name, count in lost.items():
        talk.say(f"  {name}: {count}")
    if stopped:
        return Exit.INTERRUPTED
    return Exit.INCOMPLETE if lost else Exit.DONE


def _sent_to(endpoint: Endpoint) -> Endpoint:
    if endpoint.scheme.commanded:
        raise SettingsError(f"--to {endpoint}: that is served to those who connect; give --listen {endpoint}")
    return endpoint


def _listening(endpoint: Endpoint) -> Endpoint:
    if not endpoint.scheme.commanded:
        raise SettingsError(f"--listen {endpoint}: udp:// knows no commands; give --to, or udp+cmd://")
    return endpoint


def _told(result: StreamResult) -> str:
    fates = ", ".join(f"{count} {fate}" for fate, count in result.fates.items()) or "nothing due"
    late = result.late
    p50, p99, most = (f"{ns / 1000:.0f} us" for ns in (late.p50_ns, late.p99_ns, late.max_ns))
    return f"  {result.name:<16} {fates}; late p50 {p50}, p99 {p99}, max {most}, {late.misses} misses"


def _profile(impair: str | None, faults: dict[str, tuple[str, ...]]) -> Profile:
    from pmutools.impair.profile import Profile, profile_of_options
    from pmutools.impair.profiles import load_profile

    profile = load_profile(impair) if impair is not None else Profile()
    given = [(name, value) for name in FAULTS for value in faults.get(f"fault_{name}", ())]
    return profile.then(profile_of_options(given)) if given else profile
