"""``pmu read``."""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Exit, Talk, common, interruptible
from pmutools.cli.sources import DURATION

if TYPE_CHECKING:
    from pmutools.cli.live_show import LiveShow
    from pmutools.tools.reader import Reading


@click.command(name="read", short_help="Read live streams and log them.")
@click.argument("urls", nargs=-1, required=True, metavar="URL...")
@click.option("--out", required=True, metavar="FILE", help="Format by suffix; - is CSV to stdout.")
@click.option("--phasors", type=click.Choice(("polar", "rect")), default="polar", show_default=True)
@click.option("--long", "long_form", is_flag=True, help="Tables in long form, all streams in one file.")
@click.option("--live", is_flag=True, help="Show all streams on the terminal while they are read.")
@DURATION
@common
def command(
    urls: tuple[str, ...],
    out: str,
    phasors: str,
    long_form: bool,
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
    from pmutools.errors import SourceError
    from pmutools.net.dialogue import LinkEvent, LinkKind
    from pmutools.tools.tap import TappedSource

    talk = Talk(quiet, verbose)
    show: LiveShow | None = None
    warnings = frozenset(LinkKind) - {LinkKind.BOUND, LinkKind.CONNECTED, LinkKind.CONFIGURED, LinkKind.STREAMING}

    def tell(event: LinkEvent) -> None:
        if verbose or event.kind in warnings:
            detail = event.detail.removeprefix(f"{event.where}: ")
            text = f"{event.where}: {event.kind}" + (f": {detail}" if detail else "")
            (talk.say if show is None else show.screen.note)(text)
        if show is not None:
            show.hear(event)

    def asked() -> bool:
        return stop() or (show is not None and show.screen.quit_asked)

    with (
        interruptible() as stop,
        TappedSource(urls, duration_ns=duration_ns, tell=tell, stop=asked) as source,
        ExitStack() as stack,
    ):
        from pmutools.formats import open_sink  # slow to import: the sockets are bound by now
        from pmutools.tools.reader import read

        if live:
            from pmutools.cli.live_show import LiveShow

            show = stack.enter_context(LiveShow(source, f"pmu read {out} ← {', '.join(urls)}", out=out, talk=talk))
            source.each_round = show.each_round

        def progress(now: Reading) -> None:
            if show is None:
                talk.progress(f"{now.frames} frames, {len(now.streams)} streams")

        with open_sink(out, phasors="rect" if phasors == "rect" else "polar", long=long_form) as sink:
            reading = read(source, sink, progress)
        stopped = stop()
    paths = [str(path) for path in sink.paths]
    if as_json and out != "-":
        click.echo(json.dumps(reading.to_json() | {"paths": paths}))
    talk.say(f"{reading.frames} frames of {len(reading.streams)} streams -> {', '.join(paths) or 'nothing written'}")
    for reason, nbytes in reading.skipped.items():
        talk.say(f"  {nbytes} bytes skipped: {reason}")
    if reading.own_drops:
        talk.say(f"  {reading.own_drops} datagrams lost in this machine's receive buffer, not in the network")
    if stopped:
        return Exit.INTERRUPTED
    if not reading.frames and not reading.skipped:
        raise SourceError(
            f"no data came from {', '.join(urls)}; is the sender on, and the port right? "
            "A device answers to its own IDCODE only: name it with ?idcode=N"
        )
    return Exit.INCOMPLETE if reading.skipped or reading.own_drops else Exit.DONE
