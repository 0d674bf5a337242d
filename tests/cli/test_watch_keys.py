"""The live displays' keys and what they do; no terminal."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.cli.keys import decode
from pmutools.cli.watch_columns import VIEWS
from pmutools.cli.watch_keys import EVENTS, KEYS, WORST, Around, Command, Ui, press, with_commands

AROUND = Around(40, ["stream", "lost"], tuple(VIEWS))


def typed(text: str, ui: Ui | None = None, around: Around = AROUND) -> Ui:
    ui = ui or Ui()
    keys, _ = decode(text.encode(), final=True)
    for key in keys:
        ui = press(ui, key, around).ui
    return ui


def test_streams_are_selected() -> None:
    ui = Ui(rows=15)
    for key, wanted in (
        ("DOWN", 1), ("j", 2), ("UP", 1), ("k", 0), ("k", 0), ("PGDN", 15), ("PGDN", 30), ("PGDN", 39), ("PGUP", 24),
        ("END", 39), ("DOWN", 39), ("HOME", 0), ("G", 39), ("g", 0),
    ):  # fmt: skip
        ui = press(ui, key, AROUND).ui
        assert ui.selected == wanted, key
    assert press(ui, "DOWN", AROUND._replace(streams=0)).ui.selected == 0


def test_sorting_goes_round() -> None:
    ui = Ui(selected=7)
    told = []
    for _ in range(4):
        ui = press(ui, "s", AROUND).ui
        told.append((ui.sort, ui.message))
        assert ui.selected == 0
    assert told == [
        ("stream", "sorted by stream"),
        ("lost", "sorted by lost"),
        ("", "in order of appearance"),
        ("stream", "sorted by stream"),
    ]
    assert typed("r", ui).backwards
    assert not typed("rs", ui).backwards


def test_worst_first_and_back() -> None:
    ui = typed("w")
    assert ui.sort == WORST
    assert typed("w", ui).sort == ""
    assert typed("s", ui).sort == ""


def test_the_other_view() -> None:
    ui = typed("v", Ui(sort="lost", backwards=True))
    assert (ui.view, ui.sort, ui.backwards) == ("delay", "", False)
    assert typed("\t", ui).view == "frequency"
    assert typed("v", Ui(sort=WORST)).sort == WORST


def test_a_filter_applies_while_it_is_typed() -> None:
    ui = typed("/n1 q", Ui(selected=5))
    assert (ui.filter, ui.typing, ui.selected) == ("n1 q", True, 0)
    ui = typed("\x7f\x7f\r", ui)
    assert (ui.filter, ui.typing) == ("n1", False)
    assert typed("\x1b", ui).filter == ""
    assert typed("/\x1b", ui).filter == ""
    left = typed("/\x7f\x7f\x7f", ui)
    assert (left.filter, left.typing) == ("", False)


def test_freeze_help_quit() -> None:
    assert typed(" ").frozen
    assert not typed("  ").frozen
    ui = typed("?")
    assert ui.help
    assert not press(ui, "q", AROUND).quit
    assert not typed("x", ui).help
    step = press(Ui(), "q", AROUND)
    assert (step.quit, step.ui.message) == (True, "ending")


def test_every_key_does_something_and_none_has_two_meanings() -> None:
    names = [name for key in KEYS for name in key.names]
    assert len(names) == len(set(names))
    for name in names:
        for around in (AROUND, Around(0, [], tuple(VIEWS))):
            press(Ui(), name, around)
    assert press(Ui(), "F13", AROUND).ui == Ui()


def test_a_programs_own_keys_come_first() -> None:
    own = Command("t", "t trigger", "Write out the ring buffer.", lambda: "written")
    labels = [label for label, _, _ in with_commands([own])]
    assert (labels[0], labels[-2:]) == ("t trigger", ["? help", "q quit"])
    assert "t" not in {name for key in KEYS for name in key.names}


def test_events_are_bounded() -> None:
    ui = Ui()
    for number in range(100):
        ui = ui.noted(str(number))
    assert (len(ui.events), ui.events[-1]) == (EVENTS, "99")


@given(st.binary(max_size=200))
def test_any_bytes_do_no_harm(data: bytes) -> None:
    ui = Ui()
    for key in decode(data, final=True)[0]:
        ui = press(ui, key, AROUND).ui
    assert 0 <= ui.selected < 40


@pytest.mark.parametrize("view", VIEWS)
def test_every_sortable_column_is_reached(view: str) -> None:
    titles = [shown.column.title for shown in VIEWS[view] if shown.by]
    around = Around(3, titles, tuple(VIEWS))
    ui, reached = Ui(view=view), []
    for _ in titles:
        ui = press(ui, "s", around).ui
        reached.append(ui.sort)
    assert reached == titles
