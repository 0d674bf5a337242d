"""``pmu ctl``."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

import click

from pmutools import parsers
from pmutools.cli.shell import Exit, Parsed, common
from pmutools.errors import SettingsError

if TYPE_CHECKING:
    from pmutools.tools.player.control_client import ControlClient


def _every_s(text: str) -> float:
    from pmutools.tools.player.control import EVERY_S

    return parsers.number(*EVERY_S)(text)


@click.command(
    name="ctl", short_help="Control a running player.", context_settings={"ignore_unknown_options": True}
)  # a time may begin with a minus
@click.argument("target", metavar="TARGET")
@click.argument("words", nargs=-1, required=True, type=click.UNPROCESSED, metavar="VERB [ARGUMENT]...")
@click.option(
    "--watch",
    "every_s",
    type=Parsed(_every_s),
    metavar="S",
    help="With stats: again every S seconds, until the player ends.",
)
@common
def command(
    target: str, words: tuple[str, ...], every_s: float | None, as_json: bool, quiet: bool, verbose: int
) -> int:
    """Control a player that was started with --control TARGET, a path or HOST:PORT.

    VERB is pause, resume, step, seek, speed, loop, enable, disable, fault or stats; the verb help tells what follows
    each. Silent when done; --json prints the player's answer.
    """
    from pmutools.tools.player.control import parse_control
    from pmutools.tools.player.control_address import parse_control_address

    address = parse_control_address(target)
    do = _sentence(words)
    try:
        action = parse_control(do)
    except ValueError as error:
        raise SettingsError(str(error)) from None
    if action.verb in ("watch", "unwatch"):
        raise SettingsError(f"{action.verb} is of the protocol; write 'stats --watch S'")
    if every_s is not None and action.verb != "stats":
        raise SettingsError(f"--watch goes with stats; leave it out of {action.verb}")
    from pmutools.tools.player.control_client import ControlClient

    with ControlClient(address) as client:
        if every_s is not None:
            _watch(client, every_s, as_json)
            return Exit.DONE
        answer = client.ask(do)
    if action.verb == "stats":
        _show(answer["result"], as_json)
    elif as_json:
        click.echo(json.dumps(answer))
    elif action.verb == "help":
        for usage, meaning in answer["result"].items():
            click.echo(f"{usage:<24}{meaning}")
    return Exit.DONE


def _sentence(words: tuple[str, ...]) -> str:
    """The words as the grammar wants them: a name with a space in it, which the shell has taken apart, in quotes."""
    verb, *rest = words
    if verb.lower() == "fault" and rest and " " in rest[0] and '"' not in rest[0] and "=" not in rest[0]:
        rest[0] = f'"{rest[0]}"'
    return " ".join((verb, *rest))


def _watch(client: ControlClient, every_s: float, as_json: bool) -> None:
    first = True
    for state in client.states(every_s):
        if not first and not as_json:
            click.echo("")
        first = False
        _show(state, as_json)


def _show(result: object, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(result))
        return
    from pmutools.cli.status_text import status_lines
    from pmutools.tools.player.status import PlayerStatus

    click.echo("\n".join(status_lines(PlayerStatus.from_json(result), shutil.get_terminal_size().columns)))
