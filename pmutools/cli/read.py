"""``pmu read``."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Literal, cast

import click

from pmutools import parsers
from pmutools.cli.read_hands import triggered_by_hand
from pmutools.cli.read_report import list_fields, report
from pmutools.cli.shell import Parsed, Talk, common, interruptible
from pmutools.cli.sources import DURATION
from pmutools.errors import SettingsError

if TYPE_CHECKING:
    from pmutools.cli.stage import Stage
    from pmutools.cli.watch_keys import Command
    from pmutools.tools.live import LiveSource
    from pmutools.tools.reader import Reading
    from pmutools.tools.reader.log import Recorder
    from pmutools.tools.reader.recorder import Recording
    from pmutools.tools.reader.run import Observer

FORMS = ("csv", "jsonl", "arrow", "raw", "pcapng", "pcap")
MANY_TABLES = 64
"""Tables side by side, above which one in long form is recommended."""


def _fields(text: str) -> Any:
    from pmutools.formats.fields import parse_fields

    return parse_fields(text)


def _split(text: str) -> Any:
    from pmutools.tools.reader.split import parse_split

    return parse_split(text)


def _triggers(text: str) -> Any:
    from pmutools.tools.reader.conditions import parse_triggers

    return parse_triggers(text)


@click.command(name="read", short_help="Read live streams and log them.")
@click.argument("urls", nargs=-1, metavar="[URL]...")
@click.option("--ini", metavar="FILE", help="Initialisation file: its [pmu NAME] sections are read too.")
@click.option("--out", metavar="FILE", help="Where to: format by suffix; - is standard output.")
@click.option("--format", "form", type=click.Choice(FORMS), help="Format of standard output.  [default: csv]")
@click.option(
    "--fields", type=Parsed(_fields), metavar="LIST", help="Columns of tables, in this order: time,*.freq_hz,N1.V1.*"
)
@click.option(
    "--list-fields", "listing", is_flag=True, help="Print the columns that there are, with their units, and end."
)
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
@click.option("--live", is_flag=True, help="Show all streams on the terminal while they are read.")
@DURATION
@common
def command(
    urls: tuple[str, ...],
    ini: str | None,
    out: str | None,
    form: str | None,
    fields: Any,
    listing: bool,
    phasors: str,
    long_form: bool,
    per_stream: bool,
    split: Any,
    triggers: Any,
    ring_ns: int | None,
    after_ns: int | None,
    keep: int | None,
    live: bool,
    duration_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Read streams from URLs (udp://, tcp://, udp+cmd://, tcp+udp://) into a file, until Ctrl-C or --duration.

    Several streams are written side by side into a folder named as the file, without suffix.
    Exit code 3 says that bytes came that are no frames, or that this machine could not keep up.
    """
    from pmutools.cli.stage import Stage
    from pmutools.tools.live import LiveSource

    if not (out or listing):
        raise SettingsError("where to? give --out FILE, or --out - for standard output")
    if triggers is None and (ring_ns or after_ns):
        raise SettingsError("--ring and --after are for --trigger; add one, as in --trigger freq<59.95")
    talk = Talk(quiet, verbose)
    with interruptible() as stop, ExitStack() as stack:
        stage = Stage(talk, verbose, stop)
        source = stack.enter_context(
            LiveSource(
                _endpoints(urls, ini),
                duration_ns=duration_ns,
                tell=stage.hear,
                tell_host=stage.hear_host,
                stop=stage.over,
            )
        )
        from pmutools.tools.reader.recorder import Recording  # slow to import: the sockets are bound by now
        from pmutools.tools.reader.ring import WINDOW, Window

        polar: Literal["polar", "rect"] = "rect" if phasors == "rect" else "polar"
        if listing:
            return list_fields(source, polar, stage, talk, as_json)
        window = Window(ring_ns or WINDOW.before_ns, after_ns or WINDOW.after_ns)
        recording = Recording(
            cast("str", out), form, polar, long_form, fields, per_stream, split, keep, triggers or (), window
        )
        what = f"pmu read {out} ← {ini or ', '.join(urls)}" if live else ""
        reading, recorder = _read(source, recording, talk, stage, what, stack)
        stopped = stop()
    return report(source, recording, reading, recorder, stage, talk, as_json=as_json, stopped=stopped)


def _endpoints(urls: Sequence[str], ini: str | None) -> list[Any]:
    if ini is None and not urls:
        raise SettingsError("what is to be read? give URLs, as in udp://0.0.0.0:4713, or --ini FILE")
    if ini is None:
        return list(urls)
    from pmutools.sites import load_sites

    return [*urls, *load_sites(ini)]


def _read(
    source: LiveSource, recording: Recording, talk: Talk, stage: Stage, shown: str, stack: ExitStack
) -> tuple[Reading, Recorder]:
    """``shown`` is the title of the display, empty for none."""
    from pmutools.tools.live import ROUND_NS
    from pmutools.tools.reader import read
    from pmutools.tools.reader.known import FieldCheck, Known
    from pmutools.tools.reader.recorder import open_recorder
    from pmutools.tools.reader.ring import Ring
    from pmutools.tools.reader.run import FLUSH_NS

    recorder = stack.enter_context(open_recorder(recording, source, stage.say))
    observers: list[Observer] = []
    check = None
    if recording.fields is not None:
        check = FieldCheck(recording.fields, recording.phasors, Known(source), stage.say)
        observers.append(check)
    if isinstance(recorder, Ring):
        kinds = [each.text for each in recording.triggers]
        observers += triggered_by_hand(recorder, [kind for kind in kinds if not (shown and kind == "key")], talk, stack)
    many = False
    soon = recording.to_stdout or isinstance(recorder, Ring)

    if shown:
        stack.enter_context(
            stage.open(source, shown, out=recording.out, paths=lambda: recorder.paths, commands=_commands(recorder))
        )

    def observe(found: Any) -> None:
        stage.look(found, source.clock.monotonic_ns())
        for each in observers:
            each(found)

    def progress(now: Reading) -> None:
        nonlocal many
        stage.progress(lambda: f"{now.frames} frames, {len(now.streams)} streams")
        if not (many or recording.per_stream) and len(recorder.paths) > MANY_TABLES:
            many = True
            stage.say(f"more than {MANY_TABLES} tables side by side: --long writes all streams into one, for less work")

    reading = read(
        source,
        recorder,
        progress,
        observe=observe,
        round_ns=ROUND_NS if soon or shown else FLUSH_NS,
        flush_ns=0 if recording.to_stdout else FLUSH_NS,
        threaded=True,
    )
    if reading.frames:
        for item in check.unmatched if check is not None else ():
            talk.say(f"--fields: {item!r} has fitted no column of the streams that came")
        for text in recorder.idle if isinstance(recorder, Ring) else ():
            talk.say(f"--trigger: {text} has fitted no station or channel of the streams that came")
    return reading, recorder


def _commands(recorder: Recorder) -> tuple[Command, ...]:
    """Keys of the display that are the recording's own."""
    from pmutools.cli.watch_keys import Command
    from pmutools.tools.reader.ring import Ring

    if not isinstance(recorder, Ring):
        return ()

    def fire() -> str:
        if not recorder.fire("key"):
            raise SettingsError("'key' is not among the triggers: add it, as in --trigger key,freq<59.95")
        return "recording"

    return (Command("t", "t trigger", "record now", fire),)
