"""The player's verbs: arguments read once, errors that say how to write it, and what a timeline may have."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.errors import SettingsError
from pmutools.impair import Place, parse_action, parse_profile
from pmutools.impair.profile import PLAYER_VERBS
from pmutools.impair.verbs import PLAYER, Values
from pmutools.timebase import NS, parse_utc

UTC = "2016-09-08T17:05:11Z"


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("pause", ()),
        ("pause 5", (5 * NS,)),
        ("PAUSE 0.25", (NS // 4,)),
        ("resume", ()),
        ("step", (1,)),
        ("step 60", (60,)),
        ("seek 12.5", (Place(25 * NS // 2, True),)),
        (f"seek {UTC}", (Place(parse_utc(UTC), False),)),
        ("speed 0.1", (Fraction(1, 10),)),
        ("speed 1000", (Fraction(1000),)),
        ("loop 5 8.5", (Place(5 * NS, True), Place(17 * NS // 2, True))),
        (f"loop 5 {UTC}", (Place(5 * NS, True), Place(parse_utc(UTC), False))),
        ("loop off", ()),
    ],
)
def test_arguments_are_read(text: str, values: Values) -> None:
    action = parse_action(text)
    assert (action.verb, action.values, action.rule) == (text.split()[0].lower(), values, None)
    assert action.argument == text.partition(" ")[2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pause 0", "pause: 0 is out of range; it must be at least 0.001; write 'pause [SECONDS]'"),
        ("pause 5 6", "pause 5 6: write 'pause [SECONDS]'"),
        ("resume 5", "resume 5: write 'resume'"),
        ("step 0", "step: 0 is out of range; it must be 1 to 1e+06; write 'step [FRAMES]'"),
        ("seek", "seek: write 'seek SECONDS|UTC'"),
        ("seek -5", "seek: -5 is out of range; it must be at least 0; write 'seek SECONDS|UTC'"),
        ("seek nan", "seek: nan is no time"),
        ("seek noon", "seek: 'noon' is no time; write seconds into the source (12.5) or UTC (2016-09-08T17:05:11Z)"),
        ("speed 0", "speed: 0 is out of range; it must be 0.001 to 1000; write 'speed FACTOR'"),
        ("speed 1e9999999", "speed: "),
        ("speed fast", "speed: 'fast' is not a number; write 'speed FACTOR'"),
        ("loop", "loop: write 'loop FROM TO | loop off'"),
        ("loop 5", "loop: a loop has two ends; write 'loop FROM TO | loop off'"),
        ("loop 8 5", "loop: 8 5 runs backwards; write 'loop FROM TO | loop off'"),
        ("rewind", "'rewind' is nothing to do; "),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_action(text)
    assert str(error.value).startswith(message.replace("nan is", "'nan' is"))


@given(st.sampled_from(sorted(PLAYER)), st.text(max_size=20) | st.from_regex(r"[0-9.eE+-]{0,9}( [0-9.T:Z-]{0,12})?"))
def test_any_text_is_values_or_one_line_of_error(verb: str, text: str) -> None:
    try:
        action = parse_action(f"{verb} {text}")
    except ValueError as error:
        assert str(error)
    else:
        assert all(isinstance(value, int | Fraction | Place) for value in action.values)


PROFILE = """
[at 20]
do = loop off
     disable N1
[at 12.5]
do = pause 5
     seek 30
     speed 0.5
     loop 5 8
"""


def test_a_timeline_has_the_players_verbs() -> None:
    profile = parse_profile(PROFILE, "p.ini")
    assert [(action.at_ns, action.verb, action.values) for action in profile.player_timeline] == [
        (25 * NS // 2, "pause", (5 * NS,)),
        (25 * NS // 2, "seek", (Place(30 * NS, True),)),
        (25 * NS // 2, "speed", (Fraction(1, 2),)),
        (25 * NS // 2, "loop", (Place(5 * NS, True), Place(8 * NS, True))),
        (20 * NS, "loop", ()),
    ]
    assert [action.verb for action in profile.timeline][-1] == "disable"
    both = profile.then(parse_profile("[at 13]\ndo = speed 2\n", "q.ini"))
    assert [action.verb for action in both.player_timeline] == ["pause", "seek", "speed", "loop", "speed", "loop"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pause", "pause for how long? stream time stands still meanwhile; write 'pause SECONDS'"),
        ("pause soon", "pause: 'soon' is not a number; write 'pause [SECONDS]'"),
        ("resume", "resume cannot be scheduled: stream time stands still in a pause, so it would never come;"),
        ("step 5", "step cannot be scheduled: stream time stands still in a pause, so it would never come;"),
        ("stats", "'stats' is nothing to do; "),
        ("loop 9 8", "loop: 9 8 runs backwards; write 'loop FROM TO | loop off'"),
        ("speed 2000", "speed: 2000 is out of range; it must be 0.001 to 1000; write 'speed FACTOR'"),
    ],
)
def test_timeline_errors_name_file_and_line(text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        parse_profile(f"[run]\nseed = 1\n[at 5]\ndo = {text}\n", "p.ini")
    assert str(error.value).startswith(f"p.ini:4: [at 5] do: {message}")


def test_all_verbs_are_known() -> None:
    assert PLAYER_VERBS == ("pause", "resume", "step", "seek", "speed", "loop")
