"""``dcon ctl``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import click

from pmutools.cli.shell import Exit, Talk, common

if TYPE_CHECKING:
    from dcon.link.orders import SignedOrder
    from pmutools.net.endpoint import Endpoint

LOOKS = ("status", "watch")
PLAIN = (
    *("arm", "activate", "disarm", "estop", "release", "reset", "start", "off"),
    *("open_loop", "closed_loop", "probe_start", "probe_stop"),
)
VERBS = (*LOOKS, *PLAIN, "gain", "ack")
DEFAULT = "127.0.0.1:4790"


BUTTON = "use the emergency stop button"


@click.command(
    name="ctl",
    short_help="An operator's orders, and what the controller is doing.",
    context_settings={"ignore_unknown_options": True},  # a number may begin with a minus
)
@click.argument("verb", type=click.Choice(VERBS), metavar="VERB")
@click.argument("words", nargs=-1, metavar="[VALUE | FLAG]")
@click.option("--to", "to", default=DEFAULT, show_default=True, metavar="HOST:PORT", help="The server.")
@click.option("--who", metavar="NAME", help="Operator; default: the only one of the key file.")
@click.option("--key", metavar="FILE", help="Key file; every order needs it.")
@click.option("--why", default="", metavar="TEXT", help="Goes to the log with the order.")
@common
def command(
    verb: str,
    words: tuple[str, ...],
    to: str,
    who: str | None,
    key: str | None,
    why: str,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Look (status, watch) or order: arm, activate, disarm, gain VALUE, estop, release, reset, ack [FLAG [SUBJECT]],
    open_loop, closed_loop, probe_start, probe_stop, start, off.

    An order is signed, and answered when a tick has taken it. estop goes to the watchdog too; release and reset open
    the way for closing its relays again, and arm nothing. Exit code 0: done, which estop is where the watchdog was
    told; 1: refused, or nobody answers.
    """
    from dcon.cli import status_text
    from dcon.sections import listening
    from dcon.server.client import Client, ask
    from pmutools.errors import SettingsError

    _no_options(words)
    talk = Talk(quiet, verbose)
    try:
        where = listening(to)
    except ValueError as error:
        raise SettingsError(f"--to: {error}") from None
    show: Callable[[dict[str, Any]], str] = json.dumps if as_json else status_text.text
    if verb in LOOKS:
        if words:
            raise SettingsError(f"{verb} takes no value")
        if verb == "status":
            click.echo(show(ask(where, {"ask": "status"})))
            return Exit.DONE
        with Client(where) as client:
            client.send({"ask": "watch"})
            for status in client.answers():
                click.echo(json.dumps(status) if as_json else status_text.line(status))
    return _order(_signed(verb, words, who, key, why), where, talk, as_json)


def _signed(
    verb: str, words: tuple[str, ...], who: str | None, path: str | None, why: str
) -> tuple[SignedOrder, bytes]:
    from dcon.link.keys import read_keys
    from dcon.link.orders import SignedOrder, sign
    from pmutools.errors import SettingsError
    from pmutools.parsers import number

    if path is None:
        raise SettingsError(f"{verb} is an order: give --key FILE (dcon keys makes one)")
    value, text = 0.0, ""
    if verb == "gain":
        try:
            (given,) = words
            value = number(0, 1e6)(given)
        except ValueError as error:
            raise SettingsError(f"gain: {error if len(words) == 1 else 'write gain MW_PER_MHZ'}") from None
    elif verb == "ack":
        text = " ".join(words)
    elif words:
        raise SettingsError(f"{verb} takes no value")
    operators = read_keys(path)
    if who is None and len(operators) > 1:
        raise SettingsError(f"{path}: has {len(operators)} operators; name one with --who")
    operator = operators.get(next(iter(operators)) if who is None else who)
    if operator is None:
        raise SettingsError(f"{path}: has no operator {who!r}; there are {', '.join(operators)}")
    now_ns = time.time_ns()
    order = SignedOrder(operator.name, now_ns, now_ns, verb, value, text, why)
    try:
        return order, sign(order, operator.key)
    except ValueError as error:
        raise SettingsError(str(error)) from None


def _order(order: tuple[SignedOrder, bytes], where: Endpoint, talk: Talk, as_json: bool) -> int:
    from dcon.link.orders import ESTOP
    from dcon.server.client import ask
    from pmutools.errors import SourceError

    wanted, signed = order
    try:
        answer = ask(where, {"signed": signed.decode()})
    except SourceError as error:
        raise (
            SourceError(f"{error}; take nothing as stopped by this: {BUTTON}") if wanted.name == ESTOP else error
        ) from None
    if as_json:
        click.echo(json.dumps(answer))
    if wanted.name == ESTOP:
        return _stopped(answer, talk, as_json)
    watchdog = f"; the watchdog {answer['watchdog']}" if "watchdog" in answer else ""
    if "accepted" in answer:
        if not as_json:
            talk.say(f"{wanted.name}: accepted; {answer.get('state')}{watchdog}")
        return Exit.DONE
    why = answer.get("refused") or answer.get("unknown") or answer.get("error")
    what = "refused" if "refused" in answer else "not answered"
    talk.complain(f"dcon: {wanted.name} {what}: {why}{watchdog}")
    return Exit.FAILED


def _stopped(answer: dict[str, Any], talk: Talk, as_json: bool) -> int:
    """What became of an emergency stop: it is done where the watchdog was told, since only that opens the relays."""
    from dcon.server.watchdog_word import TOLD, UNREACHED

    watchdog = answer.get("watchdog")
    why = answer.get("refused") or answer.get("unknown") or answer.get("error")
    if watchdog == TOLD and "accepted" in answer:
        if not as_json:
            talk.say(f"estop: accepted; {answer.get('state')}; the watchdog {TOLD}")
        return Exit.DONE
    if watchdog == TOLD:
        took = "did not take it" if "refused" in answer else "may not have taken it"
        talk.complain(f"dcon: estop: the watchdog {TOLD}, and opens the relays; the controller {took}: {why}")
        return Exit.DONE
    what = "refused" if "refused" in answer else "not answered"
    said = (
        f"accepted; {answer.get('state')}, and the controller drives 0 V" if "accepted" in answer else f"{what}: {why}"
    )
    if watchdog is not None:
        said += f"; the watchdog {watchdog}"
    nothing = "refused" in answer and watchdog in (None, UNREACHED)
    harm = "nothing was stopped by this" if nothing else "the relays may be closed still"
    talk.complain(f"dcon: estop {said}: {harm}; {BUTTON}")
    return Exit.FAILED


def _no_options(words: tuple[str, ...]) -> None:
    """Raise NoSuchOption for what begins with a minus and is no number."""
    context = click.get_current_context()
    known = [name for option in context.command.params for name in option.opts]
    for word in words:
        if word.startswith("-") and not _is_number(word):
            raise click.NoSuchOption(word, possibilities=get_close_matches(word, known), ctx=context)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
