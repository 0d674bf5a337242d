"""The interactive player's keys and what they do; no terminal."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.controlled import FakePlayer, player_status, stream_status

from pmutools.cli.keys import decode
from pmutools.cli.play_keys import KEYS, Prompt, Step, Ui, foreseen, pattern, press
from pmutools.impair.profile import parse_action
from pmutools.tools.player.control import parse_control
from pmutools.tools.player.status import PlayState

PLAYING = player_status()
PAUSED = replace(PLAYING, state=PlayState.PAUSED)


def said(step: Step) -> list[str]:
    player = FakePlayer()
    for action in step.do:
        player.act(action)
    return player.done


def typed(ui: Ui, text: str) -> Step:
    step = Step(ui)
    for key in decode(text.encode())[0]:
        step = press(step.ui, key, PLAYING)
    return step


@pytest.mark.parametrize(
    ("key", "status", "done"),
    [
        ("SPACE", PLAYING, ["pause"]),
        ("SPACE", PAUSED, ["resume"]),
        (".", PAUSED, ["step"]),
        ("RIGHT", PLAYING, ["pause", "step"]),
        ("+", PLAYING, ["speed 1.1"]),
        ("UP", replace(PLAYING, speed=2.0), ["speed 2.2"]),
        ("-", PLAYING, ["speed 0.909091"]),
        ("+", replace(PLAYING, speed=0.909091), ["speed 1"]),
        ("DOWN", replace(PLAYING, speed=0.001), ["speed 0.001"]),
        ("+", replace(PLAYING, speed=1000.0), ["speed 1000"]),
        ("1", replace(PLAYING, speed=3.0), ["speed 1"]),
        ("[", PLAYING, ["seek 11.5"]),
        ("LEFT", replace(PLAYING, position_s=0.25), ["seek 0"]),
        ("]", PLAYING, ["seek 13.5"]),
        ("{", PLAYING, ["seek 2.5"]),
        ("}", PLAYING, ["seek 22.5"]),
        ("c", PLAYING, ["loop off"]),
        ("e", PLAYING, ["disable N1"]),
        ("x", PLAYING, []),
        ("ESC", PLAYING, []),
    ],
)
def test_a_key_is_something_to_do(key: str, status: object, done: list[str]) -> None:
    step = press(Ui(), key, status)  # type: ignore[arg-type]
    assert [line.replace('"', "") for line in said(step)] == done
    assert not step.ui.error


def test_every_key_does_something_and_none_has_two_meanings() -> None:
    names = [name for key in KEYS for name in key.names]
    assert len(names) == len(set(names))
    for name in names:
        for status in (PLAYING, player_status(0)):
            press(Ui(selected=3), name, status)


def test_a_to_b() -> None:
    early = press(Ui(), "b", PLAYING)
    assert early.ui.error
    assert "press 'a'" in early.ui.message
    marked = press(Ui(), "a", PLAYING).ui
    assert marked.mark_a == 12.5
    assert press(marked, "b", PLAYING).ui.error
    assert said(press(marked, "b", replace(PLAYING, position_s=20.125))) == ["loop 12.5 20.125"]
    cleared = press(marked, "c", PLAYING)
    assert (cleared.ui.mark_a, said(cleared)) == (None, ["loop off"])


def test_streams_are_selected() -> None:
    ui = Ui(rows=3)
    for key, wanted in (("n", 1), ("TAB", 2), ("p", 1), ("PGDN", 4), ("PGDN", 7), ("n", 0), ("p", 7), ("PGUP", 4)):
        ui = press(ui, key, PLAYING).ui
        assert ui.selected == wanted, key
    assert said(press(replace(ui, selected=2), "e", PLAYING)) == ["enable S1"]
    assert said(press(replace(ui, selected=99), "e", PLAYING)) == ["disable W2"]


def test_a_fault_is_typed() -> None:
    step = typed(press(Ui(selected=1), "f", PLAYING).ui, "loss=6%\x7f\x7f5%")
    assert step.ui.prompt == Prompt("fault", "loss=5%")
    step = press(step.ui, "ENTER", PLAYING)
    assert said(step) == ["fault N2"]
    assert step.do == (parse_control('fault "N2" loss=5%'),)
    assert step.ui.prompt is None
    assert step.ui.message == 'fault "N2" loss=5%'


def test_what_is_typed_wrongly_can_be_mended() -> None:
    step = press(typed(press(Ui(), "g", PLAYING).ui, "1x").ui, "ENTER", PLAYING)
    assert step.ui.error
    assert step.do == ()
    assert step.ui.prompt == Prompt("goto", "1x")
    step = press(typed(step.ui, "\x7f2.5").ui, "ENTER", PLAYING)
    assert said(step) == ["seek 12.5"]


@pytest.mark.parametrize("end", ["\x1b", "\x15\r", "\x15\x7f", "   \r"])
def test_a_prompt_is_left(end: str) -> None:
    ui = typed(press(Ui(), ":", PLAYING).ui, "pau" if end != "   \r" else "").ui
    step = Step(ui)
    for key in decode(end.encode(), final=True)[0]:
        step = press(step.ui, key, PLAYING)
    assert step.ui.prompt is None
    assert step.do == ()


def test_anything_can_be_typed() -> None:
    step = press(typed(press(Ui(), ":", PLAYING).ui, "disable N*").ui, "ENTER", PLAYING)
    assert said(step) == ["disable N*"]
    step = press(typed(press(Ui(), ":", PLAYING).ui, "stats").ui, "ENTER", PLAYING)
    assert step.do == ()
    assert "on the screen" in step.ui.message
    assert typed(press(Ui(), ":", PLAYING).ui, "q?1").ui.prompt == Prompt("do", "q?1")


def test_help_and_quit() -> None:
    ui = press(Ui(), "?", PLAYING).ui
    assert ui.help
    back = press(ui, "q", PLAYING)
    assert not back.ui.help
    assert not back.quit
    assert press(back.ui, "q", PLAYING).quit


@pytest.mark.parametrize("name", ["N1", "SHELBY PMU", "a[1]", "x*", "a,b", 'q"', " lead", "", "tab\t"])
def test_a_pattern_is_of_one_stream(name: str) -> None:
    stream = stream_status(3, name) if name else replace(stream_status(3), name="")
    for line in (f"disable {pattern(stream)}", f"fault {pattern(stream)} loss=5%"):
        rule = parse_control(line).rule
        assert rule is not None
        assert rule.matches((stream.name, str(stream.idcode)))
        assert not rule.matches(("xyz", "1"))


def test_what_is_foreseen() -> None:
    assert foreseen(PLAYING, parse_action("seek 3")).position_s == 3
    assert foreseen(PLAYING, parse_action("seek 2016-09-08T17:05:11Z")) == PLAYING
    assert foreseen(PLAYING, parse_action("speed 2")).speed == 2
    assert foreseen(PAUSED, parse_action("resume")) == PLAYING
    assert foreseen(PAUSED, parse_action("loop off")) == PAUSED
