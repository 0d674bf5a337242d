"""The keys of the live displays, and what they do; no terminal, no clock.

:data:`KEYS` is the table from which the help line, the help page and the documentation are made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from pmutools.cli.keys import edited

EVENTS = 40
"""Events kept for the screen."""
WORST = "worst"
"""Sorted by what wants attention."""


@dataclass(frozen=True, slots=True)
class Ui:
    """What belongs to the person at the terminal; each key gives the next one."""

    view: str = "frequency"
    selected: int = 0
    """Place in the list as it is sorted and filtered."""
    rows: int = 10
    """Streams on a page."""
    sort: str = ""
    """Title of a column, or :data:`WORST`; empty: in order of appearance."""
    backwards: bool = False
    filter: str = ""
    typing: bool = False
    """Whether the filter is being typed."""
    frozen: bool = False
    help: bool = False
    message: str = ""
    error: bool = False
    events: tuple[str, ...] = ()

    def said(self, message: str, *, error: bool = False) -> Ui:
        return replace(self, message=message, error=error)

    def noted(self, event: str) -> Ui:
        return replace(self, events=(*self.events, event)[-EVENTS:])


class Around(NamedTuple):
    """What a key depends on: how many streams are listed, by what they can be sorted, which views there are."""

    streams: int
    sortable: Sequence[str]
    views: Sequence[str]


class Step(NamedTuple):
    """What a key leads to: the next state, the end."""

    ui: Ui
    quit: bool = False


class Key(NamedTuple):
    """Keys that do the same: their names as decoded, what they are called, their part of the help line, the meaning."""

    names: tuple[str, ...]
    shown: str
    label: str
    meaning: str
    press: Callable[[Ui, Around], Step]


class Command(NamedTuple):
    """A key of one program: ``do`` gives what is to be said, and raises PmuError or ValueError where it cannot."""

    key: str
    label: str
    meaning: str
    do: Callable[[], str]


def _select(to: Callable[[Ui, Around], int]) -> Callable[[Ui, Around], Step]:
    return lambda ui, around: Step(replace(ui, selected=max(0, min(to(ui, around), around.streams - 1))))


def _sort(ui: Ui, around: Around) -> Step:
    choices = ("", *around.sortable)
    sort = choices[(choices.index(ui.sort) + 1) % len(choices)] if ui.sort in choices else ""
    return _sorted(ui, sort, f"sorted by {sort}" if sort else "in order of appearance")


def _worst(ui: Ui, around: Around) -> Step:
    if ui.sort == WORST:
        return _sorted(ui, "", "in order of appearance")
    return _sorted(ui, WORST, "worst first: what does not stream, loss, quality, p99")


def _sorted(ui: Ui, sort: str, message: str) -> Step:
    return Step(replace(ui, sort=sort, backwards=False, selected=0).said(message))


def _reverse(ui: Ui, around: Around) -> Step:
    return Step(replace(ui, backwards=not ui.backwards))


def _view(ui: Ui, around: Around) -> Step:
    view = around.views[(around.views.index(ui.view) + 1) % len(around.views)]
    sort = ui.sort if ui.sort == WORST else ""  # the other view has other columns
    return Step(replace(ui, view=view, sort=sort, backwards=False).said(""))


def _freeze(ui: Ui, around: Around) -> Step:
    return Step(replace(ui, frozen=not ui.frozen).said("" if ui.frozen else "frozen; what comes is still taken"))


KEYS = (
    Key(("DOWN", "j"), "↓ j", "↑↓ select", "Select the next stream.", _select(lambda ui, around: ui.selected + 1)),
    Key(("UP", "k"), "↑ k", "", "Select the stream before.", _select(lambda ui, around: ui.selected - 1)),
    Key(("PGDN",), "PGDN", "", "The next page.", _select(lambda ui, around: ui.selected + ui.rows)),
    Key(("PGUP",), "PGUP", "", "The page before.", _select(lambda ui, around: ui.selected - ui.rows)),
    Key(("HOME", "g"), "HOME g", "", "The first stream.", _select(lambda ui, around: 0)),
    Key(("END", "G"), "END G", "", "The last stream.", _select(lambda ui, around: around.streams - 1)),
    Key(("v", "TAB"), "v TAB", "v view", "The other view: frequency, or delay.", _view),
    Key(("s",), "s", "s sort", "Sort by the next column.", _sort),
    Key(("r",), "r", "", "Sort the other way.", _reverse),
    Key(("w",), "w", "w worst", "Worst first: what does not stream, then loss, quality, p99.", _worst),
    Key(
        ("/",),
        "/",
        "/ filter",
        "Show only streams with these words in name, IDCODE, transport, sender or state; ESC: all.",
        lambda ui, around: Step(replace(ui, typing=True).said("")),
    ),
    Key(
        ("SPACE",),
        "SPACE",
        "SPACE freeze",
        "Hold the picture, or let it go on; what comes is still taken.",
        _freeze,
    ),
    Key(("?",), "?", "? help", "These keys.", lambda ui, around: Step(replace(ui, help=True))),
    Key(("q",), "q", "q quit", "End.", lambda ui, around: Step(ui.said("ending"), quit=True)),
)
_BY_NAME = {name: key for key in KEYS for name in key.names}


def press(ui: Ui, name: str, around: Around) -> Step:
    """What one key does."""
    if ui.typing:
        return Step(_typed(ui, name))
    if ui.help:
        return Step(replace(ui, help=False))
    if name == "ESC":
        return Step(replace(ui, filter="", selected=0).said(""))
    key = _BY_NAME.get(name)
    return key.press(ui, around) if key is not None else Step(ui)


def _typed(ui: Ui, name: str) -> Ui:
    """The filter applies while it is typed; ESC and an emptied line leave it."""
    if name == "ESC" or (name == "BACKSPACE" and not ui.filter):
        return replace(ui, typing=False, filter="", selected=0)
    if name == "ENTER":
        return replace(ui, typing=False)
    return replace(ui, filter=edited(ui.filter, name), selected=0)


def with_commands(commands: Sequence[Command]) -> list[tuple[str, str, str]]:
    """Label, name and meaning of all keys, a program's own first."""
    keys = [(key.label, key.shown, key.meaning) for key in KEYS]
    own = [(command.label, command.key, command.meaning) for command in commands]
    return [*own, *keys]
