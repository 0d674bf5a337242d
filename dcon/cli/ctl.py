"""``dcon ctl``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
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


@click.command(name="ctl", short_help="An operator's orders, and what the controller is doing.")
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
    the way for closing its relays again, and arm nothing. Exit code 0: done; 1: refused, or nobody answers.
    """
    from dcon.server.client import Client, ask
    from pmutools.errors import SettingsError
    from pmutools.net.endpoint import parse_endpoint

    talk = Talk(quiet, verbose)
    where = parse_endpoint(to if "://" in to else f"tcp://{to}")
    show: Callable[[dict[str, Any]], str] = json.dumps if as_json else _text
    if verb in LOOKS:
        if words:
            raise SettingsError(f"{verb} takes no value")
        if verb == "status":
            click.echo(show(ask(where, {"ask": "status"})))
            return Exit.DONE
        with Client(where) as client:
            client.send({"ask": "watch"})
            for status in client.answers():
                click.echo(json.dumps(status) if as_json else _line(status))
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
    from dcon.server.client import ask

    wanted, signed = order
    answer = ask(where, {"signed": signed.decode()})
    if as_json:
        click.echo(json.dumps(answer))
    if "accepted" in answer:
        if not as_json:
            talk.say(f"{wanted.name}: accepted; {answer.get('state')}")
        return Exit.DONE
    why = answer.get("refused") or answer.get("unknown") or answer.get("error")
    talk.complain(f"dcon: {wanted.name} {'refused' if 'refused' in answer else 'not answered'}: {why}")
    return Exit.FAILED


def _line(status: dict[str, Any]) -> str:
    """One line of what changes."""
    if status.get("state") is None:
        return "no controller has been heard yet"
    flags = " ".join(dict.fromkeys(flag["name"] for flag in status["flags"] if flag["up"]))
    return (
        f"{_old(status)}{status['state']:<8} {status['mode']:<11} {status['active'] or '-':<10} "
        f"{status['command_mw']:8.2f} MW {status['output_v']:7.3f} V  log {_lag(status)}  {flags}".rstrip()
    )


def _old(status: dict[str, Any]) -> str:
    """What goes before a state that nobody may take for the present one; "" for one that is present."""
    return "" if status["controller_connected"] else f"OLD, by {_age(status['tick_age_ms'])}; last known: "


def _age(age_ms: float | None) -> str:
    return "nobody knows how much" if age_ms is None else f"{age_ms / 1000:.1f} s"


def _lag(status: dict[str, Any]) -> str:
    lag_s = status["log"]["lag_s"]
    return "none" if lag_s is None else f"{lag_s:.1f} s behind"


def relays_line(watchdog: dict[str, Any]) -> str:
    """What the watchdog says, and why."""
    said = watchdog["last_said"]
    words = [f"relays {'closed' if said['relays_closed'] else 'open'}"]
    if said["latched"]:
        words.append("tripped")
    if said["causes"]:
        words.append(f"causes: {' '.join(said['causes'])}")
    if watchdog["silent"]:
        return f"relays NOT KNOWN: the watchdog is silent; {_age(watchdog['age_ms'])} ago it said: {'; '.join(words)}"
    if beats := [f"{name} {age:.0f}" for name, age in watchdog["beats_ms"].items() if age is not None]:
        words.append(f"beats in ms: {' '.join(beats)}")
    return "; ".join(words)


def _text(status: dict[str, Any]) -> str:
    watchdog = [] if status["watchdog"] is None else [relays_line(status["watchdog"])]
    if status.get("state") is None:
        return "\n".join([_line(status), *watchdog])
    from dcon.link.counts import words

    log, is_old = status["log"], not status["controller_connected"]
    was, last = ("was ", "last known: ") if is_old else ("", "")
    lines = [
        f"{last}{status['state']}, {status['mode']}, gain {status['gain_mw_per_mhz']:g} MW/mHz, "
        f"instance {status['active'] or 'none'}",
        f"{last}command {status['command_mw']:.2f} MW, output {status['output_v']:.3f} V, "
        f"probe {status['probe_mw']:.2f} MW",
    ]
    if is_old:
        age = _age(status["tick_age_ms"])
        lines.insert(0, f"OLD, by {age}: the controller is silent; what it was doing when it was last heard:")
    lines += watchdog
    for pmu in status["pmus"]:
        age, f = pmu["age_ms"], pmu["f_hz"]
        shown = "nothing yet" if age is None else f"{was}{age:.0f} ms old" + ("" if f is None else f", {f:.4f} Hz")
        lines.append(f"  {pmu['name']:<12} {shown}")
    for flag in status["flags"]:
        state = f"{was}up" if flag["up"] else "latched"
        lines.append(f"  {state:<8} {flag['name']} {flag['subject']}: {flag['text']}")
    if counted := words(status["counts"] or {}):
        lines.append(f"not taken: {counted}")
    disk = "" if log["disk_free_percent"] is None else f", disk {log['disk_free_percent']:.0f} % free"
    lines.append(f"log {log['file'] or 'none'}, {_lag(status)}, {log['unlogged_ticks']} ticks missing{disk}")
    return "\n".join(lines)
