"""``dcon replay``."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dcon.cli.spare import named_in, spare
from pmutools.cli.shell import Exit, Parsed, Talk, common
from pmutools.errors import SettingsError, SourceError
from pmutools.parsers import duration_ns
from pmutools.timebase import NS

if TYPE_CHECKING:
    from dcon.core.values import Record
    from dcon.replay.replay import Driven, Observer

TOLD_TICKS = 3600


@click.command(name="replay", short_help="A recorded session through the engine again; commands must be identical.")
@click.argument("sessions", metavar="SESSION...", nargs=-1, required=True)
@click.option("--set", "changes", multiple=True, metavar="SECTION.KEY=VALUE", help="Change a setting; repeatable.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Commands as CSV.")
@click.option(
    *("--duration", "duration_ns"),
    type=Parsed(duration_ns(NS, 0.001)),
    metavar="S",
    help="Stop after S seconds of the session.",
)
@common
def command(
    sessions: tuple[str, ...],
    changes: tuple[str, ...],
    out: Path | None,
    duration_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Replay a session log, tick by tick, from its logged bytes and arrivals.

    The first part of a session brings those that follow it; or name the parts. Behind a gap, and in a later part alone,
    the replay begins with the next checkpoint; the ticks before it are counted as not replayed.

    Exit code 3 says that something came out otherwise (without --set), or that the log could not be replayed whole.
    With --set the answer is what the controller would have commanded, not what the grid would have done.
    """
    from dcon.replay.replay import NOT_THE_GRID, replay

    talk = Talk(quiet, verbose)
    if out is not None:
        spare(out, (*sessions, *named_in(changes)))
        if out.suffix.lower() == ".mcap":
            raise SettingsError(f"--out {out}: commands are written as CSV; name it {out.with_suffix('.csv').name}")
    replayed = itertools.count(1)
    with _commands(out) as write:

        def observe(recorded: Driven, now: Record) -> None:
            write(recorded, now)
            if (count := next(replayed)) % TOLD_TICKS == 0:
                talk.progress(f"{count} ticks")

        result = replay(sessions, changes, observe, duration_ns)
    talk.progress("")
    if as_json:
        click.echo(json.dumps(result.to_json()))
    elif quiet:
        pass
    elif changes:
        click.echo(
            f"{result.ticks} ticks with {', '.join(changes)}: commands differ by up to "
            f"{result.largest.command_mw:.3f} MW, probing signals by {result.largest.probe_mw:.3f} MW, outputs by "
            f"{result.largest.output_v:.4f} V. {NOT_THE_GRID}"
        )
    elif result.different:
        click.echo(f"{result.different} of {result.ticks} ticks differ; first: {result.first}")
    else:
        click.echo(f"{result.ticks} ticks: identical" if result.ticks else "no tick could be replayed")
    if result.newer:
        talk.say(f"warning: {sessions[0]} {result.newer}")
    for problem in result.problems:
        talk.say(problem)
    if result.stopped:
        talk.say(f"{'not whole' if result.gaps and result.to_the_end else 'stopped'}: {result.stopped}")
    return Exit.INCOMPLETE if result.stopped or (result.different and not changes) else Exit.DONE


@contextmanager
def _commands(out: Path | None) -> Iterator[Observer]:
    """Writes one row a tick to ``out``, which is there whole or as it was."""
    if out is None:
        yield lambda recorded, now: None
        return
    from dcon.replay.replay import Driven
    from pmutools.formats.output import whole

    columns = [f"{which}_{name}" for name in Driven._fields for which in ("recorded", "replayed")]
    try:
        with whole(out) as path, path.open("w", encoding="ascii") as file:
            file.write(f"tick_ns,{','.join(columns)}\n")

            def write(recorded: Driven, now: Record) -> None:
                pairs = zip(recorded, Driven.of(now), strict=True)
                file.write(f"{now.tick_ns},{','.join(f'{one!r},{other!r}' for one, other in pairs)}\n")

            yield write
    except SourceError:
        raise
    except OSError as error:
        raise SourceError(f"--out {out}: {error.strerror}") from None
