"""``dcon replay``."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Exit, Talk, common
from pmutools.errors import SourceError

if TYPE_CHECKING:
    from dcon.core.values import Record
    from dcon.session.replay import Observer

TOLD_TICKS = 3600


@click.command(name="replay", short_help="A recorded session through the engine again; commands must be identical.")
@click.argument("sessions", metavar="SESSION...", nargs=-1, required=True)
@click.option("--set", "changes", multiple=True, metavar="SECTION.KEY=VALUE", help="Change a setting; repeatable.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Commands as CSV.")
@common
def command(
    sessions: tuple[str, ...], changes: tuple[str, ...], out: Path | None, as_json: bool, quiet: bool, verbose: int
) -> int:
    """Replay a session log, tick by tick, from its logged bytes and arrivals.

    The first part of a session brings those that follow it; or name the parts.

    Exit code 3 says that something came out otherwise (without --set), or that the log could not be replayed whole.
    With --set the answer is what the controller would have commanded, not what the grid would have done.
    """
    from dcon.session.replay import replay

    talk = Talk(quiet, verbose)
    replayed = itertools.count(1)
    with _commands(out) as write:

        def observe(recorded_mw: float, now: Record) -> None:
            write(recorded_mw, now)
            if (count := next(replayed)) % TOLD_TICKS == 0:
                talk.progress(f"{count} ticks")

        result = replay(sessions, changes, observe)
    talk.progress("")
    if as_json:
        click.echo(json.dumps(result.to_json()))
    elif changes:
        click.echo(
            f"{result.ticks} ticks with {', '.join(changes)}: commands differ by up to {result.largest_mw:.3f} MW. "
            "This is the command, not the grid: the recorded grid answered to the recorded command."
        )
    elif result.different:
        click.echo(f"{result.different} of {result.ticks} ticks differ; first: {result.first}")
    else:
        click.echo(f"{result.ticks} ticks: identical")
    for problem in result.problems:
        talk.say(problem)
    if result.stopped:
        talk.say(f"stopped: {result.stopped}")
    return Exit.INCOMPLETE if result.stopped or (result.different and not changes) else Exit.DONE


@contextmanager
def _commands(out: Path | None) -> Iterator[Observer]:
    """Writes one row a tick to ``out``."""
    if out is None:
        yield lambda recorded_mw, now: None
        return
    try:
        with out.open("w", encoding="ascii") as file:
            file.write("tick_ns,recorded_command_mw,replayed_command_mw\n")

            def write(recorded_mw: float, now: Record) -> None:
                file.write(f"{now.tick_ns},{recorded_mw!r},{now.command_mw!r}\n")

            yield write
    except SourceError:
        raise
    except OSError as error:
        raise SourceError(f"--out {out}: {error.strerror}") from None
