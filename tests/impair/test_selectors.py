"""Which frames a stage acts on."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support.impairment import CONFIG, frame

from pmutools.c37118 import decode_data
from pmutools.c37118.constants import FrameType
from pmutools.draws import Draws
from pmutools.impair.moment import CONTROL_LANE, Moment, Original
from pmutools.impair.selectors import ANY, DATA, selector, selector_of_any
from pmutools.timebase import NS, parse_utc, slot_time_ns

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


START_NS = parse_utc("2016-09-08T17:05:58Z")


def by_stamp(text: str, count: int = 200) -> list[int]:
    """Indices among frames at 60 a second whose recorded stamps begin at 17:05:58, played at twice the speed."""
    test = selector(text).test(DRAWS)
    found = list[int]()
    for index in range(count):
        stamp_ns = START_NS + slot_time_ns(index, CONFIG.rate)
        original = Original(b"", CONFIG, stamp_ns)
        at = Moment(index, index * NS // 60, offset_ns=index * NS // 120, fresh=index in (0, 70), original=original)
        if test(at):
            found.append(index)
    return found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stamp 2016-09-08T17:05:59Z..2016-09-08T17:05:59.05Z", [60, 61, 62]),
        ("stamp ..2016-09-08T17:05:58.02Z", [0, 1]),
        ("stamp 2016-09-08T17:06:01Z..", [*range(180, 200)]),
        ("stamp 2016-09-08T19:06:01+02:00..", [*range(180, 200)]),
        ("second 59", [*range(60, 120)]),
        ("second 0,1-30", [*range(120, 200)]),
        ("second 0, 58 and slot 0", [0, 120]),
        ("slot 0 or slot 58-59", [0, 58, 59, 60, 118, 119, 120, 178, 179, 180]),
        ("slot 0, 59-, 30", [0, 30, 59, 60, 90, 119, 120, 150, 179, 180]),
        ("wall 1..1.02", [120, 121, 122]),
        ("wall 1..1.01, ..0.01", [0, 1, 120, 121]),
        ("first after config", [0, 70]),
        ("3, first after config", [0, 3, 70]),
        ("4, wall ..0.01", [0, 1, 4]),
        ("(0-9 or 20-29) and every 5", [0, 5, 20, 25]),
        ("not (5- and not 190-) and every 2", [0, 2, 4, 190, 192, 194, 196, 198]),
        ("((7))", [7]),
        ("Not(1-)", [0]),
    ],
)
def test_by_stamp_slot_wall_and_groups(text: str, expected: list[int]) -> None:
    assert by_stamp(text) == expected


def test_slots_snap_to_the_grid_and_slow_streams_have_one() -> None:
    """Devices cut FRACSEC off: a stamp a microsecond early is in the slot it means."""
    for rate, stamp_ns, number in ((60, 16_666_000, 1), (60, 999_999_999, 0), (50, 20_000_000, 1), (-5, 3 * NS, 0)):
        original = Original(b"", replace(CONFIG, data_rate=rate), START_NS + stamp_ns)
        for slot in range(3):
            assert selector(f"slot {slot}").test(DRAWS)(Moment(0, 0, original=original)) is (slot == number)


def test_the_stamp_of_the_frame_where_none_is_given() -> None:
    original = Original(frame(61), CONFIG)
    assert original.stamp_ns == decode_data(frame(61), CONFIG).time_ns
    assert Original(frame(61), CONFIG, 5).stamp_ns == 5
    assert Original(frame(61)).stamp_ns is None and Original(b"\xaa\x01", CONFIG).stamp_ns is None
    assert Original(frame(61)[:-1], CONFIG).data is None


def test_groups_keep_the_draws_of_a_selector_without() -> None:
    """Atoms are counted as they stand, so that parentheses that change nothing change no draw."""
    n = 2000
    assert chosen("10% and 0-999 or 20% and 1000-", n) == chosen("(10% and 0-999) or (20% and 1000-)", n)
    assert chosen("not (10%)", n) == chosen("not 10%", n)


@pytest.mark.parametrize("text", ["5..8", "wall 5..8", "stamp 1970-01-01T00:00:05Z..", "5..8 or 20..30"])
def test_the_time_before(text: str) -> None:
    before = selector(text).before(2 * NS).test(DRAWS)
    for time_s, expected in ((2.9, False), (3, True), (4.99, True), (5, False), (7, False), (8, False)):
        ns = round(time_s * NS)
        assert before(Moment(0, ns, offset_ns=ns, original=Original(b"", CONFIG, ns))) is expected


@pytest.mark.parametrize(
    "text", ["10-20", "5..8 and 10%", "not 5..8", "(5..8)", "5..8, 3", "type data", "type any and 5.."]
)
def test_no_time_before(text: str) -> None:
    with pytest.raises(ValueError, match=r"only ranges of time have a time before them; write when=5\.\.8"):
        selector(text).before(NS)


def test_what_needs_a_configuration() -> None:
    for text in ("stamp 2016-09-08T17:05:59Z..", "second 5", "not (slot 3)", "value stat & 1"):
        with pytest.raises(ValueError, match="can only be read in a stream whose configuration is known"):
            selector(text).check(None)
    selector("wall 5.. or first after config").check(None)
    selector("slot 3").check(CONFIG)
    with pytest.raises(ValueError, match="DATA_RATE is 0"):
        selector("slot 3").check(replace(CONFIG, data_rate=0))


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
        ("(1 and 2", "'(1 and 2' has a '(' without ')'"),
        ("1) and 2", "'1) and 2' has a ')' without '('"),
        ("(1) 2", "'(1) 2': write 'and' or 'or' after ')'"),
        ("()", "nothing is selected"),
        ("(" * 5000 + "1" + ")" * 5000, "more than 100 brackets; write it shorter"),
        ("wall 5", "wall 5: write START..END in seconds"),
        ("stamp 2016-09-08T17:05:11Z", "stamp 2016-09-08T17:05:11Z: write START..END in UTC"),
        ("stamp 5..8", "not an ISO-8601 time: '5' (as in 2016-09-08T17:05:11.25Z)"),
        ("second 60", "second: a minute has the seconds 0 to 59"),
        ("second 5..8", "'5..8' is not an index, a range like 50-59, or 'every 100 offset 3'"),
        ("value N1.freq_hz = 60", "'N1.freq_hz = 60' is not of the form NAME < NUMBER (or <=, >, >=, ==, !=, & MASK)"),
        ("value stat & 0.5", "'0.5' is not a whole number"),
        ("1,,2", "'1,,2' has an empty item; remove the extra ','"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        selector(text)
    assert str(error.value) == message
