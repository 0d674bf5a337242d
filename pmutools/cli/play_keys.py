"""The keys of the interactive player, and what they do; no terminal, no clock.

:data:`KEYS` is the table from which the help line, the help page and the documentation are made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from glob import escape
from typing import NamedTuple

from pmutools.cli.keys import edited
from pmutools.impair.profile import Action
from pmutools.impair.verbs import SPEEDS
from pmutools.parsers import Place
from pmutools.timebase import NS
from pmutools.tools.player.control import BY_NAME, parse_control
from pmutools.tools.player.status import PlayerStatus, PlayState, StreamStatus

EVENTS = 40
"""Events kept for the screen."""
FASTER = 1.1


# --- what the screen shows beside the player's state -------------------------------------------------------------


class Prompt(NamedTuple):
    """A line being typed: what it is for, as :data:`PROMPTS` names it, and its text so far."""

    kind: str
    text: str = ""


@dataclass(frozen=True, slots=True)
class Ui:
    """What belongs to the person at the terminal; each key gives the next one."""

    selected: int = 0
    rows: int = 10
    """Streams on a page."""
    prompt: Prompt | None = None
    help: bool = False
    mark_a: float | None = None
    message: str = ""
    error: bool = False
    """Whether the message is one."""
    events: tuple[str, ...] = ()

    def said(self, message: str, *, error: bool = False) -> Ui:
        return replace(self, message=message, error=error)

    def noted(self, event: str) -> Ui:
        return replace(self, events=(*self.events, event)[-EVENTS:])


class Step(NamedTuple):
    """What a key leads to: the next state, things for the player to do, the end."""

    ui: Ui
    do: tuple[Action, ...] = ()
    quit: bool = False


class Key(NamedTuple):
    """Keys that do the same: their names as decoded, what they are called, their part of the help line, the meaning."""

    names: tuple[str, ...]
    shown: str
    label: str
    meaning: str
    press: Callable[[Ui, PlayerStatus], Step]


def _do(ui: Ui, *lines: str) -> Step:
    """Things to do that were written here, or typed; what cannot be is a message."""
    try:
        actions = tuple(parse_control(line) for line in lines)
    except ValueError as error:
        return Step(ui.said(str(error), error=True))
    if any(BY_NAME[action.verb].internal for action in actions):
        return Step(ui.said("that is on the screen already; '?' lists the keys"))
    return Step(ui.said("; ".join(lines)), actions)


def _pause(ui: Ui, status: PlayerStatus) -> Step:
    return _do(ui, "pause" if status.state is PlayState.PLAYING else "resume")


def _step(ui: Ui, status: PlayerStatus) -> Step:
    return _do(ui, "pause", "step") if status.state is PlayState.PLAYING else _do(ui, "step")


def _times(factor: float) -> Callable[[Ui, PlayerStatus], Step]:
    def press(ui: Ui, status: PlayerStatus) -> Step:
        speed = min(max(status.speed * factor, SPEEDS[0]), SPEEDS[1])
        return _do(ui, f"speed {1 if abs(speed - 1) < 0.02 else speed:.6g}")  # back at exactly 1 on the way

    return press


def _seek(by_s: float) -> Callable[[Ui, PlayerStatus], Step]:
    return lambda ui, status: _do(ui, f"seek {seconds(max(status.position_s + by_s, 0.0))}")


def _mark_a(ui: Ui, status: PlayerStatus) -> Step:
    return Step(replace(ui, mark_a=status.position_s).said(f"A is {seconds(status.position_s)} s; 'b' ends the loop"))


def _mark_b(ui: Ui, status: PlayerStatus) -> Step:
    if ui.mark_a is None:
        return Step(ui.said("no A yet; press 'a' where the loop begins", error=True))
    if status.position_s <= ui.mark_a:
        return Step(ui.said(f"B is not after A, {seconds(ui.mark_a)} s; go on, or mark A anew", error=True))
    return _do(ui, f"loop {seconds(ui.mark_a)} {seconds(status.position_s)}")


def _unmark(ui: Ui, status: PlayerStatus) -> Step:
    return _do(replace(ui, mark_a=None), "loop off")


def _select(by: Callable[[Ui], int], *, wrap: bool = False) -> Callable[[Ui, PlayerStatus], Step]:
    def press(ui: Ui, status: PlayerStatus) -> Step:
        last = len(status.streams) - 1
        wanted = ui.selected + by(ui)
        selected = wanted % (last + 1) if wrap and last >= 0 else max(0, min(wanted, last))
        return Step(replace(ui, selected=selected))

    return press


def _enable(ui: Ui, status: PlayerStatus) -> Step:
    if (stream := chosen(ui, status)) is None:
        return Step(ui.said("there is no stream", error=True))
    return _do(ui, f"{'disable' if stream.enabled else 'enable'} {pattern(stream)}")


def _ask(kind: str) -> Callable[[Ui, PlayerStatus], Step]:
    return lambda ui, status: Step(replace(ui, prompt=Prompt(kind)).said(""))


KEYS = (
    Key(("SPACE",), "SPACE", "SPACE pause", "Pause, resume.", _pause),
    Key((".", "RIGHT"), ". →", ". step", "The next frame instant; pauses first.", _step),
    Key(("+", "=", "UP"), "+ ↑", "+- speed", "Speed times 1.1.", _times(FASTER)),
    Key(("-", "DOWN"), "- ↓", "", "Speed divided by 1.1.", _times(1 / FASTER)),
    Key(("1",), "1", "", "Speed 1.", lambda ui, status: _do(ui, "speed 1")),
    Key(("[", "LEFT"), "[ ←", "[] seek", "Back 1 s.", _seek(-1)),
    Key(("]",), "]", "", "Forward 1 s.", _seek(1)),
    Key(("{",), "{", "", "Back 10 s.", _seek(-10)),
    Key(("}",), "}", "", "Forward 10 s.", _seek(10)),
    Key(("g",), "g", "g goto", "Go to a time: seconds into the source, or UTC.", _ask("goto")),
    Key(("a",), "a", "ab loop", "Mark A, where a loop is to begin.", _mark_a),
    Key(("b",), "b", "", "Mark B, and play from A to B over and over.", _mark_b),
    Key(("c",), "c", "", "End the loop between A and B.", _unmark),
    Key(("n", "TAB"), "n TAB", "", "Select the next stream.", _select(lambda ui: 1, wrap=True)),
    Key(("p", "BACKTAB"), "p", "", "Select the stream before.", _select(lambda ui: -1, wrap=True)),
    Key(("PGDN",), "PGDN", "", "The next page of streams.", _select(lambda ui: ui.rows)),
    Key(("PGUP",), "PGUP", "", "The page before.", _select(lambda ui: -ui.rows)),
    Key(("e",), "e", "e off", "Silence the selected stream, or let it speak again.", _enable),
    Key(("f",), "f", "f fault", "Set a fault of the selected stream: `loss=5%`, `loss=none`.", _ask("fault")),
    Key((":",), ":", ": any", "Anything that `pmu ctl` can do.", _ask("do")),
    Key(("?",), "?", "? help", "These keys.", lambda ui, status: Step(replace(ui, help=True))),
    Key(("q",), "q", "q quit", "End the player.", lambda ui, status: Step(ui.said("ending"), quit=True)),
)
_BY_NAME = {name: key for key in KEYS for name in key.names}

PROMPTS = {"goto": "go to (seconds, or UTC): ", "fault": "fault of {}: ", "do": ": "}
"""What is asked for; the braces stand for the selected stream."""


def press(ui: Ui, name: str, status: PlayerStatus) -> Step:
    """What one key does."""
    if ui.prompt is not None:
        return _typed(ui, ui.prompt, name, status)
    if ui.help:
        return Step(replace(ui, help=False))
    key = _BY_NAME.get(name)
    return key.press(ui, status) if key is not None else Step(ui)


def _typed(ui: Ui, prompt: Prompt, name: str, status: PlayerStatus) -> Step:
    match name:
        case "ENTER":
            return _entered(ui, prompt, status)
        case "BACKSPACE" if not prompt.text:
            return Step(replace(ui, prompt=None).said(""))
        case "ESC":
            return Step(replace(ui, prompt=None).said(""))
    return Step(replace(ui, prompt=prompt._replace(text=edited(prompt.text, name))).said(""))


def _entered(ui: Ui, prompt: Prompt, status: PlayerStatus) -> Step:
    """A typed line; one that cannot be stays, to be mended."""
    text, stream = prompt.text.strip(), chosen(ui, status)
    if not text:
        return Step(replace(ui, prompt=None))
    if prompt.kind == "goto":
        text = f"seek {text}"
    elif prompt.kind == "fault":
        if stream is None:
            return Step(replace(ui, prompt=None).said("there is no stream", error=True))
        text = f"fault {pattern(stream)} {text}"
    step = _do(ui, text)
    return step if step.ui.error else step._replace(ui=replace(step.ui, prompt=None))


def foreseen(status: PlayerStatus, action: Action) -> PlayerStatus:
    """The state once ``action`` is done, as far as it can be told without asking the player."""
    if action.verb == "seek":
        (place,) = action.values
        if isinstance(place, Place) and place.relative:
            return replace(status, position_s=place.ns / NS)
        return status
    if action.verb == "speed":
        return replace(status, speed=float(action.argument))
    return replace(status, state=PlayState.PLAYING) if action.verb == "resume" else status


def chosen(ui: Ui, status: PlayerStatus) -> StreamStatus | None:
    """The selected stream, if there is any."""
    count = len(status.streams)
    return status.streams[min(ui.selected, count - 1)] if count else None


def pattern(stream: StreamStatus) -> str:
    """What fits this stream and no other; its IDCODE where the grammar has no way to write its name."""
    name = stream.name
    if not name.strip() or name != name.strip() or set('",') & set(name) or not name.isprintable():
        return str(stream.idcode)
    return f'"{escape(name)}"'


def seconds(value: float) -> str:
    """Seconds to the microsecond, without zeros at the end."""
    return f"{value:.6f}".rstrip("0").rstrip(".")
