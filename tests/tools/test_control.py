"""The player's control protocol: every verb, every kind of nonsense, long answers in portions, who is sent away."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.controlled import FakePlayer, player_status, whole_json

from pmutools.impair.profile import PLAYER_VERBS, STREAM_VERBS
from pmutools.timebase import NS
from pmutools.tools.player.control import (
    DO_CHARACTERS,
    FLOOD_REQUESTS,
    LINE_BYTES,
    PATIENCE,
    PORTION,
    VERBS,
    ControlSession,
    parse_control,
)
from pmutools.tools.player.status import PacingStatus


def work(session: ControlSession, now_ns: int = 0) -> bytes:
    """Steps until there is nothing left to do."""
    said = session.step(now_ns)
    while session.busy:
        said += session.step(now_ns)
    return said


def answers(*lines: str | bytes, player: FakePlayer | None = None) -> list[Any]:
    session = ControlSession(player or FakePlayer())
    for line in lines:
        session.feed((line if isinstance(line, bytes) else line.encode()) + b"\n")
    return [json.loads(line) for line in work(session).splitlines()]


def answer(line: str | bytes, player: FakePlayer | None = None) -> Any:
    (only,) = answers(line, player=player)
    return only


def test_it_says_who_it_is() -> None:
    assert json.loads(ControlSession.greeting()) == {"hello": "pmutools player", "protocol": 1}


def test_the_table_has_every_verb_of_the_grammar() -> None:
    known = [verb.name for verb in VERBS]
    assert set(known) >= {*STREAM_VERBS, *PLAYER_VERBS}
    assert {verb.name for verb in VERBS if verb.internal} == {*known} - {*STREAM_VERBS, *PLAYER_VERBS}


GOOD = [
    ("pause", "pause"),
    ("resume", "resume"),
    ("step", "step"),
    ("step 3", "step 3"),
    ("seek 12.5", "seek 12.5"),
    ("speed 0.5", "speed 0.5"),
    ("loop 5 10", "loop 5 10"),
    ("loop off", "loop off"),
    ("enable N1", "enable N1"),
    ("disable 'N*'".replace("'", ""), "disable N*"),
    ("fault N1 loss=gemodel(1%,20%)", "fault N1"),
    ('fault "SHELBY PMU" delay=normal(16,2) corr=30%', "fault SHELBY PMU"),
    ("  PAUSE  ", "pause"),
]


@pytest.mark.parametrize(("do", "done"), GOOD)
def test_what_is_asked_is_done_in_either_form(do: str, done: str) -> None:
    player = FakePlayer()
    assert answer(json.dumps({"id": 7, "do": do}), player) == {"id": 7, "ok": True}
    assert answer(do, player) == {"ok": True}
    assert player.done == [done, done]


BAD = [
    ("paws", "'paws' is nothing to do; did you mean 'pause'?"),
    ("pause now", "pause: 'now' is not a number; write 'pause [SECONDS]'"),
    ("step 0", "step: 0 is out of range"),
    ("step one", "step: 'one' is not a whole number; write 'step [FRAMES]'"),
    ("seek", "seek: write 'seek SECONDS|UTC'"),
    ("seek yesterday", "seek: 'yesterday' is no time; write seconds into the source (12.5) or UTC"),
    ("seek nan", "seek: 'nan' is no time"),
    ("seek -1", "seek: -1 is out of range; it must be at least 0"),
    ("resume now", "resume now: write 'resume'"),
    ("speed 0", "speed: 0 is out of range; it must be 0.001 to 1000"),
    ("speed 1e999999999", "not a finite number"),
    ("loop 5", "loop: a loop has two ends; write 'loop FROM TO | loop off'"),
    ("loop 10 5", "loop: 10 5 runs backwards; write 'loop FROM TO | loop off'"),
    ("enable", "enable whom? write 'enable NAME'"),
    ("fault N1", "is not of the form 'fault NAME OPTION=VALUE'"),
    ("fault N1 losss=5%", "losss: no such fault; did you mean 'loss'?"),
    ("fault N1 loss=500", "loss: 500 is not a probability"),
    ("fault N1 loss=trace(@/etc/passwd)", "@/etc/passwd: no file can be named here"),
    ("disable N9", "disable N9: no such stream; there are N1, N2, S1"),
    ("watch 0", "watch [SECONDS]: 0 is out of range"),
    (f"fault N1 drop={'1,' * DO_CHARACTERS}", "characters are too many"),
]


@pytest.mark.parametrize(("do", "why"), BAD)
def test_what_cannot_be_done_is_one_line_with_the_remedy(do: str, why: str) -> None:
    player = FakePlayer()
    for line, known in ((do, {}), (json.dumps({"id": "x", "do": do}), {"id": "x"})):
        said = answer(line, player)
        assert why in said.pop("error")
        assert said == {"ok": False} | known
    assert player.done == []


NONSENSE = [
    (b"\xff\xfe pause", "byte 0 of the line is not UTF-8"),
    (b"{", "no JSON"),
    (b"[" * 60_000, "nested too deeply"),
    (b'{"do":' * 10_000, "nested too deeply"),
    (b"[1, 2]", "no JSON object"),
    (b'"pause"', "no JSON object"),
    (b'{"do": 5}', "what to do is missing"),
    (b'{"id": 1}', "what to do is missing"),
    (b'{"id": NaN, "do": "pause"}', "NaN is not a number"),
    (b'{"id": Infinity, "do": "pause"}', "Infinity is not a number"),
    (b'{"id": [1], "do": "pause"}', "an id is a whole number or a short text"),
    (b'{"id": 1' + b"0" * 5000 + b', "do": "pause"}', "no JSON"),
    (b'{"id": 1, "do": "pause", "dont": 1}', "unknown key 'dont'; did you mean 'do'?"),
    (b'{"id": 1, "do": "pause", "every_s": 1}', "unknown key 'every_s'"),
    (b'{"do": "watch", "every_s": "1"}', "every_s is a number of seconds"),
    (b'{"do": "watch", "every_s": 1e999}', "out of range"),
    (b'{"do": "\\ud800"}', "nothing to do"),
    (b"\0\0\0\0", "nothing to do"),
    (b"x" * (LINE_BYTES + 1), "a line of more than 65536 bytes"),
    (b"x" * (5 * LINE_BYTES), "a line of more than 65536 bytes"),
]


@pytest.mark.parametrize(("line", "why"), NONSENSE, ids=[str(number) for number in range(len(NONSENSE))])
def test_nonsense_is_an_answer_and_the_session_goes_on(line: bytes, why: str) -> None:
    first, second = answers(line, b"pause")
    assert first["ok"] is False
    assert why in first["error"]
    assert len(json.dumps(first)) < 400
    assert second == {"ok": True}


def test_pieces_make_no_difference() -> None:
    lines = b'{"id": 1, "do": "stats"}\npause\n' + b"x" * (LINE_BYTES + 5) + b"\nstats\r\nresume"
    whole = ControlSession(FakePlayer())
    whole.feed(lines)
    whole.end()
    wanted = work(whole)
    player = FakePlayer()
    session, said = ControlSession(player), b""
    for at in range(0, len(lines), 7):
        session.feed(lines[at : at + 7])
        said += work(session)
    session.end()
    assert said + work(session) == wanted
    assert player.done == ["pause", "resume"]


@given(st.lists(st.binary(max_size=200) | st.text(max_size=50).map(lambda text: json.dumps({"do": text}).encode())))
def test_nothing_raises(pieces: list[bytes]) -> None:
    session = ControlSession(FakePlayer())
    for piece in pieces:
        session.feed(piece + b"\n")
    for line in work(session).splitlines():
        said = json.loads(line)
        assert "error" in said or said.get("ok") or said.get("event") == "bye"


# --- states


@pytest.mark.parametrize("streams", [0, 1, PORTION, PORTION + 1, 2000])
def test_a_state_is_the_players_whatever_its_size(streams: int) -> None:
    said = answer('{"id": 1, "do": "stats"}', FakePlayer(streams))
    assert said.pop("result") == whole_json(player_status(streams))
    assert said == {"id": 1, "ok": True}


def test_a_long_answer_comes_in_portions_and_others_wait() -> None:
    session = ControlSession(FakePlayer(10 * PORTION))
    session.feed(b"stats\npause\n")
    said, steps = b"", 0
    while session.busy:
        portion = session.step(0)
        assert len(portion) < 10_000
        said += portion
        steps += 1
    assert steps >= 12
    assert [json.loads(line)["ok"] for line in said.splitlines()] == [True, True]


def test_what_is_not_a_number_is_null() -> None:
    player = FakePlayer()
    player.now = replace(player.now, pacing=PacingStatus(float("nan"), float("inf"), 0.0, 0))
    assert answer("stats", player)["result"]["pacing"] == {"p50_us": None, "p99_us": None, "max_us": 0.0, "misses": 0}


def test_watching_sends_states_until_it_is_ended() -> None:
    session = ControlSession(FakePlayer())
    session.feed(b'{"id": 5, "do": "watch", "every_s": 0.5}\n')
    assert json.loads(session.step(0)) == {"id": 5, "ok": True}
    times = []
    for now_ns in range(0, 2 * NS, NS // 10):
        if said := work(session, now_ns):
            assert json.loads(said)["event"] == "status"
            times.append(now_ns / NS)
    assert times == [0, 0.5, 1, 1.5]
    assert session.due_ns == 2 * NS
    assert work(session, 10 * NS)  # late, so one only
    assert session.due_ns == 10.5 * NS
    session.feed(b"unwatch\n")
    assert json.loads(work(session, 11 * NS)) == {"ok": True}
    assert session.due_ns is None


def test_help_lists_the_verbs() -> None:
    said = answer("help")["result"]
    assert "seek SECONDS|UTC" in said
    assert len(said) == len(VERBS)


# --- who is sent away


def sent_away(session: ControlSession, now_ns: int = 0) -> str:
    last = json.loads(work(session, now_ns).splitlines()[-1])
    assert last["event"] == "bye"
    assert session.over == last["reason"]
    session.feed(b"pause\n")
    assert not session.hungry
    assert session.step(now_ns) == b""
    return str(last["reason"])


def test_garbage_is_borne_for_a_while() -> None:
    session = ControlSession(FakePlayer())
    session.feed(b"x\n" * (PATIENCE - 1) + b"pause\n" + b"x\n" * (PATIENCE - 1))
    work(session)
    assert not session.over
    session.feed(b"y\n")
    assert f"{PATIENCE} lines in a row said nothing; the last: 'y' is nothing to do" in sent_away(session)


def test_a_flood_is_ended() -> None:
    session = ControlSession(FakePlayer())
    session.feed(b"pause\n" * FLOOD_REQUESTS)
    work(session)
    assert not session.over
    session.feed(b"pause\n")
    assert "ask less often" in sent_away(session)


def test_a_steady_client_is_no_flood() -> None:
    session, player = ControlSession(player := FakePlayer()), player
    for second in range(100):
        session.feed(b"pause\n" * (FLOOD_REQUESTS // 10))
        work(session, second * NS)
    assert not session.over
    assert len(player.done) == 10 * FLOOD_REQUESTS


def test_a_browser_controls_nothing() -> None:
    player = FakePlayer()
    session = ControlSession(player)
    session.feed(b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\npause\n")
    assert sent_away(session) == "this is no web server"
    assert player.done == []


def test_others_are_told_what_was_done() -> None:
    heard: list[str] = []
    session = ControlSession(FakePlayer(), heard.append)
    session.feed(b"seek 5\nfault N1 loss=5%\nstats\ndisable N9\nenable 'N1\n")
    work(session)
    assert heard == ["seek 5", "fault N1 loss", "enable 'N1"]


def test_parsing_is_quick_whatever_is_written() -> None:
    """A thing to do of the greatest length, of kinds that regular expressions fear."""
    fill = DO_CHARACTERS - 40
    for text in (
        "fault " + " " * fill,
        "fault N1 loss=" + "(" * fill,
        "fault N1 delay=" + "normal(1,1)+" * (fill // 12),
        "fault N1 drop=" + "1," * (fill // 2) + "1",
        "fault N1 corrupt=1% when=" + "1 or " * (fill // 5) + "2",
        "fault N1 corrupt=1% when=" + "not " * (fill // 4) + "2",
        "seek " + "1" * fill,
        "speed 1." + "1" * fill,
        "fault " + "a" * fill,
        "fault N1 loss=" + "a=" * (fill // 2),
    ):
        began = time.perf_counter()
        with suppress(ValueError):
            parse_control(text)
        assert time.perf_counter() - began < 0.2, text[:40]
