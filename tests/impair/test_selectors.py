"""Which frames a stage acts on."""

from __future__ import annotations

import math

import pytest

from pmutools.c37118.constants import FrameType
from pmutools.draws import Draws
from pmutools.impair.moment import CONTROL_LANE, Moment
from pmutools.impair.selectors import ANY, DATA, selector, selector_of_any
from pmutools.timebase import NS

DRAWS = Draws(1, "N1", "loss.when")


def chosen(text: str, count: int = 60, kind: FrameType = FrameType.DATA) -> list[int]:
    """Indices among the first ``count`` frames, ten a second."""
    test = selector(text).test(DRAWS)
    lane = 0 if kind is FrameType.DATA else CONTROL_LANE
    return [index for index in range(count) if test(Moment(index, index * NS // 10, kind, lane))]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("10", [10]),
        ("10, 20-22", [10, 20, 21, 22]),
        ("55-", [55, 56, 57, 58, 59]),
        ("every 20 offset 3", [3, 23, 43]),
        ("1..1.5", [10, 11, 12, 13, 14]),
        ("5.5..", [55, 56, 57, 58, 59]),
        ("..0.3, 57", [0, 1, 2, 57]),
        ("10-19 and every 3", [12, 15, 18]),
        ("10-19 and not 12-18", [10, 11, 19]),
        ("3 or 10-12 and not 11", [3, 10, 12]),
        ("type data and 4", [4]),
        ("type header", []),
        ("0%", []),
        ("100% and 7", [7]),
    ],
)
def test_frames(text: str, expected: list[int]) -> None:
    assert chosen(text) == expected


def test_a_probability_is_a_keyed_draw() -> None:
    n = 20_000
    some = chosen("10%", n)
    assert abs(len(some) / n - 0.1) < 5 * math.sqrt(0.09 / n)
    assert set(chosen("5%", n)) < set(some)
    assert chosen("10% and 0-4999", n) == [index for index in some if index < 5000]
    both = chosen("50% and 50%", n)
    assert abs(len(both) / n - 0.25) < 5 * math.sqrt(0.1875 / n)


def test_types() -> None:
    assert chosen("0-3", 10, FrameType.CFG2) == []
    assert chosen("type config and 0-3", 10, FrameType.CFG2) == [0, 1, 2, 3]
    assert chosen("type config, type header", 2, FrameType.HEADER) == [0, 1]
    assert chosen("type any", 2, FrameType.COMMAND) == [0, 1]
    test = selector_of_any("1..2").test(DRAWS)
    assert test(Moment(0, NS, FrameType.CFG2, CONTROL_LANE)) and not test(Moment(0, 0, FrameType.CFG2, CONTROL_LANE))


def test_the_usual_ones_are_short_cuts() -> None:
    for kind in FrameType:
        at = Moment(0, 0, kind)
        assert DATA.test(DRAWS)(at) is (kind is FrameType.DATA)
        assert ANY.test(DRAWS)(at) is True
    assert selector("type data") == DATA


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "nothing is selected"),
        ("3 and", "'3 and' has nothing on one side of 'and'"),
        ("not", "'not' stands alone; say what is not to be selected"),
        ("8..5", "8..5 runs backwards; write START..END in seconds"),
        ("a..5", "'a' is not a number"),
        ("type frames", "'frames' is no frame type; known: data, config, header, command, any"),
        ("5%, 6%", "'5%, 6%' has two probabilities; give one"),
        ("101%", "101% is not a probability; write 0% to 100%"),
        ("1,,2", "'1,,2' has an empty item; remove the extra ','"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        selector(text)
    assert str(error.value) == message
