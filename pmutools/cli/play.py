"""``pmu play``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmutools import linux, parsers
from pmutools.cli.shell import Exit, F, Parsed, Talk, common, interruptible
from pmutools.cli.sources import DURATION, END, START, Watched, spare
from pmutools.errors import SettingsError
from pmutools.timebase import NS, format_utc, parse_utc

if TYPE_CHECKING:
    from pmutools.cli.play_display import Display
    from pmutools.impair.profile import Profile
    from pmutools.net.endpoint import Endpoint
    from pmutools.net.outlet import ServerEvent
    from pmutools.pacing import LatenessSummary
    from pmutools.tools.player.cast import Spread
    from pmutools.tools.player.material import Choice
    from pmutools.tools.player.play import Options, Player
    from pmutools.tools.player.results import Results
    from pmutools.tools.recast import Form
    from pmutools.tools.synth import Recipe

MS = 1_000_000
FAULTS = {
    "corrupt": ("P%", "Damage frames."),
    "config": ("CHANGE", "Change the configuration midstream: count() when=5..8, add(analogs=1), ..."),
    "disable": ("NAME@T1..T2", "Switch a stream off from T1 to T2 s of stream time."),
    "drop": ("LIST", "Leave out these data frames: 10,50-59,every 100 offset 3."),
    "loss": ("P%", "Lose frames at random, or by a model: gemodel(1%,20%)."),
    "duplicate": ("P%", "Send frames twice."),
    "delay": ("DIST", "Delay in ms: constant(16), normal(16,2), ..."),
    "reorder": ("P%", "Let frames overtake."),
    "rate": ("BITS", "Send through a link of so many bit/s: 64k."),
    "slot": ("DIST", "Let frames leave only every so many ms."),
    "segment": ("P%", "Cut what is written to TCP: split(parts=2), coalesce(frames=4), reset(), ..."),
}
"""The options of :mod:`pmutools.impair`, in the order in which they apply; each is one of the command's."""
TOLD_STREAMS = 20
"""Results of more streams are told of the latest only, unless -v asks for all."""


def _faults(function: F) -> F:
    for name, (metavar, text) in reversed(FAULTS.items()):
        function = click.option(f"--{name}", f"fault_{name}", multiple=True, metavar=metavar, help=text)(function)
    return function


def _speed(text: str) -> Fraction:
    from pmutools.impair.verbs import speed

    return speed(text)


def _pair(text: str) -> tuple[str, str]:
    old, equals, new = text.partition("=")
    if not equals or not old.strip() or not new.strip():
        raise ValueError(f"{text!r} is not of the form OLD=NEW")
    return old.strip(), new.strip()


def _idcodes(text: str) -> tuple[int | str, int]:
    old, new = _pair(text)
    return parsers.integer(0, 0xFFFF)(old) if old.isdecimal() else old, parsers.integer(1, 65534)(new)


def _form(text: str) -> Form:
    from pmutools.tools.recast import parse_form

    return parse_form(text)


def _spread(text: str) -> Spread:
    from pmutools.tools.player.cast import parse_spread

    return parse_spread(text)


@click.command(name="play", short_help="Stream a recording live, as any number of PMUs.")
@click.argument("files", nargs=-1, metavar="FILE...")
@click.option("--to", multiple=True, metavar="URL", help="Send to udp://HOST:PORT; repeatable, ?idcode=N picks one.")
@click.option("--listen", multiple=True, metavar="URL", help="Serve at tcp://, udp+cmd:// or tcp+udp://; repeatable.")
@click.option("--plant", metavar="NAME", help="Instead of files: a simulated grid, say modal.")
@click.option("--scenario", default=None, metavar="NAME", help="What happens to it: cjb (default), ambient, ...")
@click.option("--pmus", type=click.IntRange(1, 200), metavar="N", help="PMUs of the plant; default 8.")
@click.option("--select", multiple=True, metavar="NAME|IDCODE", help="Only this stream; repeatable.")
@click.option("--exclude", multiple=True, metavar="NAME|IDCODE", help="Not this stream; repeatable.")
@START
@END
@click.option(
    "--skip-gaps",
    "skip_gaps_ns",
    type=Parsed(parsers.duration_ns(NS, 0)),
    metavar="S",
    help="Cut silences longer than S seconds down to S (whole seconds are left out).",
)
@click.option(
    "--idcode",
    "idcodes",
    type=Parsed(_idcodes),
    multiple=True,
    metavar="OLD=NEW",
    help="Renumber a stream; OLD may be its name.",
)
@click.option("--station", "stations", type=Parsed(_pair), multiple=True, metavar="OLD=NEW", help="Rename a station.")
@click.option("--format", "form", type=Parsed(_form), metavar="WORDS", help="Another FORMAT: polar,int or rect,float.")
@click.option(
    "--pdc", "pdc_idcode", type=click.IntRange(1, 65534), metavar="IDCODE", help="All streams as one, a PDC's."
)
@click.option("--emulate", type=click.IntRange(1, 65534), metavar="N", help="N PMUs that share the source's streams.")
@click.option("--spread", type=Parsed(_spread), metavar="mag=1,deg=5,mhz=2", help="Standard deviations among them.")
@click.option("--together", is_flag=True, help="Emulated PMUs send at one instant, not spread over the interval.")
@click.option("--data-rate", type=click.IntRange(1, 240), metavar="FPS", help="DATA_RATE of a table that does not say.")
@click.option("--nominal", type=click.Choice(("50", "60")), help="Nominal frequency of a table that does not say.")
@click.option("--stamp", type=click.Choice(("shift", "keep", "now-grid", "now")), default="shift", show_default=True)
@click.option("--timing", type=click.Choice(("stamp", "arrival")), help="Default: arrival where recorded, else stamp.")
@click.option("--speed", type=Parsed(_speed), default="1", show_default=True, metavar="X")
@click.option("--fps", type=Parsed(parsers.integer(1, 1000)), metavar="N", help="New stamps and DATA_RATE.")
@click.option(
    "--interval", "interval_ns", type=Parsed(parsers.duration_ns(MS, 0.001)), metavar="MS", help="Send spacing only."
)
@click.option("--loop", "loops", type=click.IntRange(0), default=1, show_default=True, help="0: for ever.")
@click.option("--at", "begin_utc_ns", type=Parsed(parse_utc), metavar="UTC", help="Begin at this time.")
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
@_faults
@click.option("--seed", type=Parsed(parsers.integer(0, 2**64 - 1)), metavar="N", help="Same seed, same faults.")
@click.option("--ledger", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE.parquet", help="The truth.")
@click.option("--control", metavar="PATH|HOST:PORT", help="Take orders from pmu ctl there.")
@click.option("--interactive", is_flag=True, help="Keys, and a screen on this terminal.")
@click.option("--paused", is_flag=True, help="Begin with a pause.")
@click.option("--fifo", is_flag=True, help="Ask for the real-time scheduling policy SCHED_FIFO.")
@click.option("--portable", is_flag=True, help="Do without batched system calls and kernel stamps.")
@DURATION
@common
def command(
    to: tuple[str, ...],
    listen: tuple[str, ...],
    control: str | None,
    interactive: bool,
    paused: bool,
    fifo: bool,
    portable: bool,
    ledger: Path | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
    **said: Any,
) -> int:
    """Play recordings, or a simulated grid, live: every stream as a PMU of its own, restamped, on absolute deadlines.

    With --listen alone, playing begins at the first start command. --duration ends it S seconds after it began to
    listen or send. At the end each stream's pacing error is told: that is the player's accuracy.
    """
    from pmutools.c37118.session import Outcome
    from pmutools.cli.herald import Herald
    from pmutools.clock import SystemClock
    from pmutools.impair.profile import parse_action
    from pmutools.net.endpoint import parse_endpoint
    from pmutools.realtime import go_realtime
    from pmutools.tools.player.control_address import parse_control_address
    from pmutools.tools.player.ledger import LedgerWriter
    from pmutools.tools.player.material import material
    from pmutools.tools.player.play import Player

    talk = Talk(quiet, verbose)
    if not to and not listen:
        raise SettingsError("where to? give --to udp://HOST:PORT or --listen tcp://HOST:PORT")
    endpoints = [_sent_to(parse_endpoint(url)) for url in to], [_listening(parse_endpoint(url)) for url in listen]
    address = parse_control_address(control) if control else None
    if interactive:
        _require_terminal()
    if said["begin_utc_ns"] is not None and said["begin_utc_ns"] < SystemClock().realtime_ns():
        raise SettingsError(f"--at {format_utc(said['begin_utc_ns'])} is past; give a time to come")
    options, choice = _options(*endpoints, said), _choice(said)
    if ledger is not None:
        spare(ledger, choice.files)
        if ledger.suffix != ".parquet":
            raise SettingsError(f"--ledger {ledger}: it is a Parquet table; name it {ledger.with_suffix('.parquet')}")
    stuff = material(choice, lambda source: Watched(source, talk))
    cast = stuff.cast
    for note in stuff.notes:
        talk.say(note)
    for pattern in options.profile.unmatched(map(cast.names, range(len(cast.parts)))):
        talk.say(parsers.no_such_stream(pattern, [part.name for part in cast.parts]))

    native = linux.NATIVE and not portable
    display: Display | None = None
    herald = Herald(talk)

    def tell(text: str) -> None:
        (herald.say if display is None else display.note)(text)

    def hear(event: ServerEvent) -> None:
        if display is not None or verbose or event.kind is not Outcome.ANSWERED:
            tell(f"{event.client} {event.kind} {event.idcode or ''} {event.detail}".rstrip())

    def progress() -> None:
        if display is None:
            from pmutools.cli.status_text import progress_line

            herald.progress(lambda: progress_line(player.status()))

    with interruptible() as asked, ExitStack() as stack:
        player = stack.enter_context(
            Player(
                cast,
                options,
                SystemClock(spin_ns=0 if fifo else SPIN_NS, native=native),
                stop=lambda: asked() or (display is not None and display.quit),
                tell=hear,
                warn=tell,
                stamp_departures=ledger is not None,
                native=native,
            )
        )
        if paused:
            player.act(parse_action("pause"))
        if address is not None:
            from pmutools.tools.player.control_server import ControlServer

            stack.enter_context(ControlServer(address, player, player.senders.reactor, tell))
        rows = stack.enter_context(LedgerWriter(ledger)) if ledger is not None else None
        for url in (*to, *listen):
            talk.say(f"{len(cast.parts)} streams, {len(cast.reel.rows)} data frames: {url}")
        if interactive:
            display = stack.enter_context(_display(player, _source(choice), (*to, *listen)))
        shortfall = go_realtime(fifo=fifo)
        if shortfall.fifo is not None:
            tell(shortfall.fifo)
        player.play(rows, progress)
        stopped = asked()
    display = None
    if as_json:
        click.echo(json.dumps({"streams": player.to_json(), "losses": dict(stuff.losses)}))
    _tell_results(player.results, talk, all_of_them=verbose > 0)
    for name, count in stuff.losses.items():
        talk.say(f"  {name}: {count}")
    if stopped:
        return Exit.INTERRUPTED
    fates = player.results.fates()
    if fates.get("failed") and not fates.get("sent"):
        talk.complain("no frame could be sent; is there a route to where they go?")
        return Exit.FAILED
    return Exit.INCOMPLETE if stuff.losses else Exit.DONE


SPIN_NS = 200_000
"""A busy wait of this length before each deadline takes the wake-up error away, for some percent of a core."""


def _options(to: Sequence[Endpoint], listen: Sequence[Endpoint], said: dict[str, Any]) -> Options:
    from pmutools.tools.player.play import Options
    from pmutools.tools.player.stamps import StampPolicy

    if said["fps"] is not None and said["interval_ns"] is not None:
        raise SettingsError("--fps and --interval clash: the first changes the stamps too, the second the spacing only")
    if said["fps"] is not None and said["stamp"] == StampPolicy.KEEP:
        raise SettingsError("--fps makes new stamps, --stamp keep keeps the old: leave one out")
    return Options(
        to=to,
        listen=listen,
        policy=StampPolicy(said["stamp"]),
        profile=_profile(said["impair"], {name: said[f"fault_{name}"] for name in FAULTS}),
        **{name: said[name] for name in ("speed", "loops", "begin_utc_ns", "cfg_period_ns", "seed", "duration_ns")},
    )


def _choice(said: dict[str, Any]) -> Choice:
    from pmutools.tools.player.material import Choice
    from pmutools.tools.window import Window

    start: parsers.Place | None = said["start"]
    same = ("timing", "select", "exclude", "form", "pdc_idcode", "skip_gaps_ns", "interval_ns", "emulate", "spread")
    plant = _plant(said)
    idcodes = _each_once("--idcode", said["idcodes"])
    return Choice(
        files=said["files"],
        plant=plant,
        data_rate=said["data_rate"],
        fnom_hz=float(said["nominal"]) if said["nominal"] else None,
        window=Window(start, said["end"]),
        idcodes={old: new for old, new in idcodes.items() if isinstance(old, int)},
        names={old: new for old, new in idcodes.items() if isinstance(old, str)},
        stations=_each_once("--station", said["stations"]),
        fps=None if plant is not None else said["fps"],
        stagger=not said["together"],
        seed=said["seed"] or 0,
        **{name: said[name] for name in same},
    )


def _plant(said: dict[str, Any]) -> Recipe | None:
    from pmutools.tools.synth import Recipe

    if said["plant"] is None:
        if not said["files"]:
            raise SettingsError("what is to be played? name a recording, or give --plant NAME")
        for option in ("scenario", "pmus"):
            if said[option] is not None:
                raise SettingsError(f"--{option} is of a simulated grid; give --plant NAME too")
        return None
    if said["files"]:
        raise SettingsError(f"--plant and {said['files'][0]}: play one or the other")
    return Recipe(
        said["scenario"] or "cjb", said["plant"], said["pmus"] or 8, said["fps"] or 60, seed=said["seed"] or 1
    )


def _each_once(option: str, pairs: Sequence[tuple[Any, Any]]) -> dict[Any, Any]:
    found: dict[Any, Any] = {}
    for old, new in pairs:
        if found.setdefault(old, new) != new:
            raise SettingsError(f"{option} {old}: given twice, once as {found[old]} and once as {new}")
    return found


def _source(choice: Choice) -> str:
    return ", ".join(choice.files) if choice.plant is None else f"{choice.plant.scenario} on {choice.plant.plant}"


def _require_terminal() -> None:
    from pmutools.cli.play_display import require_terminal

    require_terminal()


def _display(player: Player, source: str, targets: tuple[str, ...]) -> Display:
    from pmutools.cli.play_display import Display
    from pmutools.cli.play_screen import Title

    return Display(player, player.senders.reactor, Title(source, targets))


def _sent_to(endpoint: Endpoint) -> Endpoint:
    if endpoint.scheme.commanded:
        raise SettingsError(f"--to {endpoint}: that is served to those who connect; give --listen {endpoint}")
    return endpoint


def _listening(endpoint: Endpoint) -> Endpoint:
    if not endpoint.scheme.commanded:
        raise SettingsError(f"--listen {endpoint}: udp:// knows no commands; give --to, or udp+cmd://")
    return endpoint


def _tell_results(results: Results, talk: Talk, *, all_of_them: bool) -> None:
    """What became of every stream, or of many: of all together, and of those that kept time worst."""
    told = list(results)
    if len(told) > TOLD_STREAMS and not all_of_them:
        late = results.lateness.summary()
        talk.say(f"  {len(told)} streams: {_told(results.fates(), late)}; the latest were (-v: all)")
        told = sorted(told, key=lambda result: -result.late.p99_ns)[:5]
    for result in told:
        talk.say(f"  {result.name:<16} {_told(result.fates, result.late)}")


def _told(fates: dict[str, int], late: LatenessSummary) -> str:
    from pmutools.tools.player.status import PacingStatus

    pacing = PacingStatus.of(late)
    text = ", ".join(f"{count} {fate}" for fate, count in fates.items()) or "nothing due"
    p50, p99, most = (f"{us:.0f} us" for us in (pacing.p50_us, pacing.p99_us, pacing.max_us))
    return f"{text}; late p50 {p50}, p99 {p99}, max {most}, {pacing.misses} misses"


def _profile(impair: str | None, faults: dict[str, tuple[str, ...]]) -> Profile:
    from pmutools.impair.profile import Profile, profile_of_options
    from pmutools.impair.profiles import load_profile

    profile = load_profile(impair) if impair is not None else Profile()
    given = [(name, value) for name, values in faults.items() for value in values]
    return profile.then(profile_of_options(given)) if given else profile
