"""``pmu read``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import click

from pmutools import parsers
from pmutools.cli.shell import Exit, Parsed, Talk, common, interruptible
from pmutools.cli.sources import DURATION
from pmutools.errors import SettingsError
from pmutools.timebase import NS

if TYPE_CHECKING:
    from pmutools.net.dialogue import LinkEvent
    from pmutools.tools.live import LiveSource
    from pmutools.tools.reader import Reading
    from pmutools.tools.reader.log import Recorder
    from pmutools.tools.reader.recorder import Recording
    from pmutools.tools.reader.run import Observer

FORMS = ("csv", "jsonl", "arrow", "raw", "pcapng", "pcap")
SHOWN_PATHS = 4
MANY_TABLES = 64
"""Streams beside each other as tables, above which one table in long form is recommended."""
RING_NS, AFTER_NS = 60 * NS, 10 * NS


def _fields(text: str) -> Any:
    from pmutools.formats.fields import parse_fields  # which needs numpy

    return parse_fields(text)


def _split(text: str) -> Any:
    from pmutools.tools.reader.rolling import parse_split

    return parse_split(text)


def _triggers(text: str) -> Any:
    from pmutools.tools.reader.conditions import parse_triggers

    return parse_triggers(text)

if TYPE_CHECKING:
    from pmutools.cli.live_show import LiveShow
    from pmutools.tools.reader import Reading


@click.command(name="read", short_help="Read live streams and log them.")
@click.argument("urls", nargs=-1, metavar="[URL]...")
@click.option("--ini", metavar="FILE", help="Initialisation file: its [pmu NAME] sections are read too.")
@click.option("--out", metavar="FILE", help="Where to: format by suffix; - is standard output.")
@click.option("--format", "form", type=click.Choice(FORMS), help="Format of standard output.  [default: csv]")
@click.option(
    "--fields", type=Parsed(_fields), metavar="LIST", help="Columns of tables, in this order: time,*.freq_hz,N1.V1.*"
)
@click.option("--list-fields", is_flag=True, help="Print the columns that there are, with their units, and end.")
@click.option("--phasors", type=click.Choice(("polar", "rect")), default="polar", show_default=True)
@click.option("--long", "long_form", is_flag=True, help="Tables in long form, all streams in one file.")
@click.option("--per-stream", is_flag=True, help="A folder with one file a stream.")
@click.option(
    "--split",
    type=Parsed(_split),
    metavar="SIZE|SPAN",
    help="Numbered files of this size, or up to multiples of this span of UTC: 100MB, 1h, or both (100MB,1h).",
)
@click.option(
    "--trigger",
    "triggers",
    type=Parsed(_triggers),
    metavar="LIST",
    help="Record around events only: signal, key, stat:trigger, freq<59.95, |freq-60|>0.05, rocof>1, loss, silence>2s.",
)
@click.option(
    "--ring",
    "ring_ns",
    type=Parsed(parsers.span_ns),
    metavar="SPAN",
    help="With --trigger: what is recorded from before the event.  [default: 60s]",
)
@click.option(
    "--after",
    "after_ns",
    type=Parsed(parsers.span_ns),
    metavar="SPAN",
    help="With --trigger: what is recorded after the last trigger.  [default: 10s]",
)
@click.option(
    "--keep",
    type=Parsed(parsers.integer(1)),
    metavar="N",
    help="With --split or --trigger: delete the oldest files of this run, so that N are left.",
)
@DURATION
@common
def command(
    urls: tuple[str, ...],
    ini: str | None,
    out: str | None,
    form: str | None,
    fields: Any,
    list_fields: bool,
    phasors: str,
    long_form: bool,
    per_stream: bool,
    split: Any,
    triggers: Any,
    ring_ns: int | None,
    after_ns: int | None,
    keep: int | None,
    duration_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Read streams from URLs (udp://, tcp://, udp+cmd://, tcp+udp://) into a file, until Ctrl-C or --duration.

    Several streams are written side by side into a folder named as the file, without suffix.
    Exit code 3 says that bytes came that are no frames, or that this machine could not keep up.
    """
    from pmutools.tools.live import LiveSource

    if not (out or list_fields):
        raise SettingsError("where to? give --out FILE, or --out - for standard output")
    if triggers is None and (ring_ns or after_ns):
        raise SettingsError("--ring and --after are for --trigger; add one, as in --trigger freq<59.95")
    talk = Talk(quiet, verbose)
    with interruptible() as stop, ExitStack() as stack:
        source = stack.enter_context(
            LiveSource(_endpoints(urls, ini), duration_ns=duration_ns, tell=_teller(talk, verbose), stop=stop)
        )
        from pmutools.tools.reader.recorder import Recording  # slow to import: the sockets are bound by now
        from pmutools.tools.reader.ring import Window

        polar: Literal["polar", "rect"] = "rect" if phasors == "rect" else "polar"
        if list_fields:
            return _list_fields(source, polar, talk, as_json)
        window = Window(ring_ns or RING_NS, after_ns or AFTER_NS)
        recording = Recording(
            cast("str", out), form, polar, long_form, fields, per_stream, split, keep, triggers or (), window
        )
        reading, recorder = _read(source, recording, talk, stack)
        stopped = stop()
    return _report(source, recording, reading, recorder, talk, as_json=as_json, stopped=stopped)


def _endpoints(urls: Sequence[str], ini: str | None) -> list[Any]:
    if ini is None and not urls:
        raise SettingsError("what is to be read? give URLs, as in udp://0.0.0.0:4713, or --ini FILE")
    if ini is None:
        return list(urls)
    from pmutools.sites import load_sites

    return [*urls, *load_sites(ini)]


def _teller(talk: Talk, verbose: int) -> Callable[[LinkEvent], None]:
    from pmutools.cli.herald import Herald
    from pmutools.net.dialogue import LinkKind

    herald = Herald(talk)
    news = frozenset(LinkKind) - {LinkKind.BOUND, LinkKind.CONNECTED, LinkKind.CONFIGURED, LinkKind.STREAMING}

    def tell(event: LinkEvent) -> None:
        if verbose or event.kind in news:
            detail = event.detail.removeprefix(f"{event.where}: ")
            herald.say(f"{event.where}: {event.kind}" + (f": {detail}" if detail else ""))

    return tell


def _read(source: LiveSource, recording: Recording, talk: Talk, stack: ExitStack) -> tuple[Reading, Recorder]:
    from pmutools.cli.herald import Herald
    from pmutools.tools.live import ROUND_NS
    from pmutools.tools.reader import read
    from pmutools.tools.reader.known import FieldCheck, Known
    from pmutools.tools.reader.recorder import open_recorder
    from pmutools.tools.reader.ring import Ring
    from pmutools.tools.reader.run import FLUSH_NS

    herald = Herald(talk)
    recorder = stack.enter_context(open_recorder(recording, source, herald.say))
    observers: list[Observer] = []
    check = None
    if recording.fields is not None:
        check = FieldCheck(recording.fields, recording.phasors, Known(source), herald.say)
        observers.append(check)
    if isinstance(recorder, Ring):
        observers += _triggered_by_hand(recorder, recording, talk, stack)
    soon = recording.to_stdout or isinstance(recorder, Ring)

    def observe(found: Any) -> None:
        for each in observers:
            each(found)

    def progress(now: Reading) -> None:
        herald.progress(lambda: f"{now.frames} frames, {len(now.streams)} streams")

    reading = read(
        source,
        recorder,
        progress,
        observe=observe,
        round_ns=ROUND_NS if soon else FLUSH_NS,
        flush_ns=0 if recording.to_stdout else FLUSH_NS,
    )
    if check is not None and reading.frames:
        for item in check.unmatched:
            talk.say(f"--fields: {item!r} has fitted no column of the streams that came")
    return reading, recorder


def _triggered_by_hand(ring: Any, recording: Recording, talk: Talk, stack: ExitStack) -> list[Observer]:
    """Connect the signal and the keyboard, where they are among the triggers."""
    kinds = {condition.text for condition in recording.triggers}
    if "signal" in kinds:
        _on_signal(lambda: ring.fire("signal"), talk)
    if "key" not in kinds:
        return []
    pressed = stack.enter_context(_keyboard())
    talk.say("any key records")
    return [lambda found: ring.fire("key") if pressed() else None]


def _on_signal(fire: Callable[[], object], talk: Talk) -> None:
    import os
    import signal

    if not hasattr(signal, "SIGUSR1"):
        raise SettingsError("this system has no SIGUSR1; use --trigger key")
    signal.signal(signal.SIGUSR1, lambda number, frame: fire())
    talk.say(f"kill -USR1 {os.getpid()} records")


@contextmanager
def _keyboard() -> Iterator[Callable[[], bool]]:
    """Whether a key was pressed since the last look. Raises SettingsError where there is no terminal."""
    import os
    import select
    import sys

    if sys.platform == "win32" or not sys.stdin.isatty():
        raise SettingsError("--trigger key: standard input is no terminal; use --trigger signal")
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield lambda: bool(select.select([terminal], [], [], 0)[0] and os.read(terminal, 1 << 10))
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _list_fields(source: LiveSource, phasors: Literal["polar", "rect"], talk: Talk, as_json: bool) -> int:
    """Print the columns of all streams once they are known, or at the end."""
    from pmutools.formats.columns import FRAME_COLUMNS
    from pmutools.tools.live import ROUND_NS
    from pmutools.tools.reader.known import Known

    known = Known(source)
    for found in source.rounds(ROUND_NS):
        known.see(found)
        if known.settled:
            break
    if not known.configs:
        raise _nothing(source)
    units = dict.fromkeys(FRAME_COLUMNS, "") | {"time_ns": "ns", "arrival_ns": "ns"}
    units |= {name: column.unit for name, column in known.columns(phasors).items()}
    if as_json:
        click.echo(json.dumps([{"name": name, "unit": unit or None} for name, unit in units.items()]))
    else:
        for name, unit in units.items():
            click.echo(f"{name}\t{unit}" if unit else name)
    talk.say(f"{len(units)} columns of {len(known.configs)} streams")
    return Exit.DONE


def _report(
    source: LiveSource,
    recording: Recording,
    reading: Reading,
    recorder: Recorder,
    talk: Talk,
    *,
    as_json: bool,
    stopped: bool,
) -> int:
    paths = [str(path) for path in recorder.paths]
    if as_json and not recording.to_stdout:
        click.echo(json.dumps(reading.to_json() | {"paths": paths}))
    talk.say(f"{reading.frames} frames of {len(reading.streams)} streams -> {_paths_text(paths)}")
    for reason, nbytes in reading.skipped.items():
        talk.say(f"  {nbytes} bytes skipped: {reason}")
    if reading.own_drops:
        talk.say(f"  {reading.own_drops} datagrams lost in this machine's receive buffer, not in the network")
    if stopped:
        return Exit.INTERRUPTED
    if not reading.frames and not reading.skipped:
        raise _nothing(source)
    return Exit.INCOMPLETE if reading.skipped or reading.own_drops else Exit.DONE


def _paths_text(paths: Sequence[str]) -> str:
    if not paths:
        return "nothing written"
    if len(paths) <= SHOWN_PATHS:
        return ", ".join(paths)
    folders = sorted({str(Path(path).parent) for path in paths})
    return f"{len(paths)} files in {', '.join(folders[:SHOWN_PATHS])}{' ...' if len(folders) > SHOWN_PATHS else ''}"


def _nothing(source: LiveSource) -> Exception:
    from pmutools.errors import SourceError

    endpoints = [str(endpoint) for endpoint in source.receivers.endpoints]
    named = ", ".join(endpoints[:SHOWN_PATHS]) + (" ..." if len(endpoints) > SHOWN_PATHS else "")
    return SourceError(
        f"no data came from {named}; is the sender on, and the port right? "
        "A device answers to its own IDCODE only: name it with ?idcode=N"
    )
