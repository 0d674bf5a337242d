"""The pipeline as a whole: keyed independence, determinism, gates, live changes, and that counts add up."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.impairment import CONFIG, CONFIG_FRAME, PERIOD_NS, delays_ms, frame, options, pipeline, play

from pmutools.errors import SettingsError
from pmutools.impair import Fate, Outgoing, Pipeline, Profile, parse_action, parse_profile, ready_profile
from pmutools.timebase import NS

EVERYTHING = options(
    "corrupt=5% bits(2)",
    "corrupt=3% stat(test) station=SOUTH",
    "disable=1..2 release=burst",
    "drop=every 50 offset 7",
    "loss=gemodel(2%, 20%)",
    "duplicate=4%",
    "delay=normal(16, 5) + exponential(2) corr=40%",
    "reorder=5% depth=2",
    "rate=1M overhead=28",
    "slot=uniform(20, 30)",
)


def fates(rows: list[Outgoing]) -> dict[int, Fate]:
    return {row.index: row.fate for row in rows if not row.copy}


def test_nothing_asked_nothing_done() -> None:
    rows = play(pipeline(Profile()), 20)
    assert [(row.index, row.copy, row.data, row.offset_ns, row.fate, row.faults) for row in rows] == [
        (index, 0, frame(index), index * PERIOD_NS, Fate.SENT, "") for index in range(20)
    ]


def test_the_same_again() -> None:
    first, second = (play(pipeline(EVERYTHING), 2000) for _ in range(2))
    assert first == second
    assert first != play(pipeline(EVERYTHING, seed=2), 2000)
    assert first != play(pipeline(EVERYTHING, stream="N2"), 2000)


def test_streams_do_not_disturb_each_other() -> None:
    alone = play(pipeline(EVERYTHING, "N1"), 500)
    first, other = pipeline(EVERYTHING, "N1"), pipeline(EVERYTHING, "S1")
    together = list[Outgoing]()
    for index in range(500):
        together += first.apply(index, frame(index), index * PERIOD_NS)
        other.apply(index, frame(index), index * PERIOD_NS)
    assert [*together, *first.close()] == alone


def test_the_short_cut_takes_nothing_away() -> None:
    """Delays alone go a shorter way; a stage that does nothing forces the long one."""
    for delay in ("constant(5)", "normal(0, 5)", "trace(1, 2)", "uniform(0, 30) corr=50%"):
        short, long = (play(pipeline(options(f"delay={delay}", *more)), 600) for more in ((), ("loss=0%",)))
        assert short == long


@pytest.mark.parametrize(
    "more",
    [
        ("loss=30%",),
        ("loss=gemodel(5%, 10%)",),
        ("duplicate=50%",),
        ("corrupt=50%",),
        ("drop=every 3",),
        ("disable=2..5",),
        ("reorder=20%",),
        ("loss=30%", "duplicate=10%", "corrupt=20% chk", "disable=1..2,7..8"),
    ],
)
def test_a_stage_leaves_the_others_draws_alone(more: tuple[str, ...]) -> None:
    base = ("delay=normal(100, 5) corr=60%", "corrupt=5% chk when=type data")
    plain = {row.index: row for row in play(pipeline(options(*base)), 1500)}
    mixed = play(pipeline(options(base[0], base[1], *more)), 1500)
    for row in mixed:
        if row.copy or row.fate is not Fate.SENT:
            continue
        assert row.delay_ns == plain[row.index].delay_ns
        assert row.data == plain[row.index].data or any(name.startswith("corrupt") for name in more)
        assert (
            plain[row.index].marks
            == tuple(mark for mark in row.marks if mark == "corrupt:chk")[: len(plain[row.index].marks)]
        )


def test_a_change_of_p_keeps_the_later_draws() -> None:
    low, high = (play(pipeline(options(f"loss={p}%", "delay=normal(100, 5)")), 2000) for p in (5, 10))
    lost = [{row.index for row in rows if row.fate is Fate.LOST} for rows in (low, high)]
    assert lost[0] < lost[1]
    by_index = {row.index: row.delay_ns for row in low}
    assert all(by_index[row.index] == row.delay_ns for row in high if row.fate is Fate.SENT)


def test_a_gate_or_a_seek_does_not_shift_a_loss_chain() -> None:
    text = "loss=gemodel(5%, 10%)"
    straight = fates(play(pipeline(text), 3000))
    gated = fates(play(pipeline(options(text, "disable=10..20")), 3000))
    assert {index: fate for index, fate in gated.items() if fate is not Fate.DISABLED} == {
        index: straight[index] for index, fate in gated.items() if fate is not Fate.DISABLED
    }
    sought = pipeline(text)
    for first in (2500, 100, 1700):
        assert fates(play(sought, 200, first)) == {index: straight[index] for index in range(first, first + 200)}


def test_disable_by_time_and_index() -> None:
    rows = play(pipeline("disable=1..2, 300-309"), 400)
    off = [row.index for row in rows if row.fate is Fate.DISABLED]
    assert off == [*range(61, 121), *range(300, 310)]
    assert len(rows) == 400


def test_burst_on_return() -> None:
    rows = play(pipeline(options("disable=1..2 release=burst", "delay=constant(5)")), 200)
    assert {row.fate for row in rows} == {Fate.SENT}
    assert [row.index for row in rows] == list(range(200))
    held = [row for row in rows if "burst" in row.marks]
    assert [row.index for row in held] == list(range(61, 121))
    assert {row.offset_ns for row in held} == {121 * PERIOD_NS + 5_000_000}


def test_a_burst_that_never_comes() -> None:
    rows = play(pipeline("disable=1.. release=burst"), 100)
    assert Counter(row.fate for row in rows) == {Fate.SENT: 61, Fate.DISABLED: 39}
    assert sorted(row.index for row in rows) == list(range(100))


def test_dropped_before_lost() -> None:
    rows = play(pipeline(options("loss=100%", "drop=2, 5-6")), 8)
    assert [row.index for row in rows if row.fate is Fate.DROPPED] == [2, 5, 6]
    assert [row.fate for row in rows].count(Fate.LOST) == 5


def test_configuration_frames_pass_but_for_the_gate() -> None:
    faults = pipeline(options("drop=0-", "loss=100%", "disable=5..6"))
    (row,) = faults.apply(0, CONFIG_FRAME, 0)
    assert row.fate is Fate.SENT
    (row,) = faults.apply(0, frame(0), 0)
    assert row.fate is Fate.DROPPED
    (row,) = faults.apply(300, CONFIG_FRAME, 5 * NS)
    assert row.fate is Fate.DISABLED


def test_live_enable_and_disable() -> None:
    for profile in (Profile(), options("loss=0%")):
        faults = pipeline(profile)
        rows = play(faults, 10, close=False)
        assert faults.act(parse_action("disable N1"))
        assert not faults.enabled
        rows += play(faults, 10, 10, close=False)
        assert not faults.act(parse_action("enable S*"))
        assert faults.act(parse_action("enable n*"))
        rows += play(faults, 10, 20)
        assert [row.index for row in rows if row.fate is Fate.DISABLED] == list(range(10, 20))


def test_live_faults_keep_the_other_stages_state() -> None:
    faults = pipeline(options("rate=20k", "reorder=100% depth=50"))
    rows = play(faults, 5, close=False)
    assert [row.index for row in rows] == [1, 2, 3, 4]
    assert faults.act(parse_action("fault * loss=100%"))
    rows += play(faults, 1, 5, close=False)
    assert rows[-1].fate is Fate.LOST
    assert faults.act(parse_action("fault * loss=none")) and faults.act(parse_action("fault * reorder=none"))
    rows += play(faults, 2, 6)
    assert [row.index for row in rows] == [1, 2, 3, 4, 5, 0, 6, 7]
    queue = [row.offset_ns for row in rows if row.fate is Fate.SENT]
    assert queue == sorted(queue)
    assert not faults.act(parse_action("pause"))


def test_a_live_fault_that_the_stream_cannot_have_changes_nothing() -> None:
    faults = pipeline("corrupt=100% chk")
    with pytest.raises(SettingsError, match="no station 'X'"):
        faults.act(parse_action("fault * corrupt=stat(test) station=X"))
    assert play(faults, 1)[0].marks == ("corrupt:chk",)


TIMELINE = """
[stream *]
delay = constant(5)
[at 2]
do = fault N* loss=100%
     fault * delay=+constant(7)
[at 1]
do = disable N1
[at 1.5]
do = enable 101
     disable S1
[at 3]
do = fault "N1" loss=none
"""


def test_timeline() -> None:
    profile = parse_profile(TIMELINE, "t.ini")
    rows = play(pipeline(profile), 240)
    changes = [(0, Fate.SENT), (NS, Fate.DISABLED), (3 * NS // 2, Fate.SENT), (2 * NS, Fate.LOST), (3 * NS, Fate.SENT)]
    expected = [[fate for at_ns, fate in changes if at_ns <= index * PERIOD_NS][-1] for index in range(240)]
    assert [row.fate for row in rows] == expected
    assert delays_ms(rows[:3]) == [5, 5, 5] and delays_ms(rows[-3:]) == [12, 12, 12]
    assert [action.verb for action in profile.timeline] == [
        "disable",
        "enable",
        "disable",
        "fault",
        "fault",
        "fault",
    ]


def test_timeline_by_stream_time() -> None:
    faults = pipeline(parse_profile("[at 10]\ndo = disable *\n", "t.ini"))
    assert faults.apply(0, frame(0), 20 * NS, 9 * NS)[0].fate is Fate.SENT
    assert faults.apply(1, frame(1), 21 * NS, 10 * NS)[0].fate is Fate.DISABLED


def test_a_timeline_is_checked_before_it_begins() -> None:
    with pytest.raises(SettingsError, match="no station 'X'"):
        pipeline(parse_profile("[at 10]\ndo = fault * corrupt=stat(test) station=X\n", "t.ini"))


def test_a_new_configuration() -> None:
    faults = Pipeline(options("corrupt=idcode(7)"), "N1")
    faults.configure(CONFIG)
    faults.act(parse_action("fault * corrupt=stat(test)"))
    assert faults.apply(0, frame(0), 0)[0].faults == "corrupt:stat+0x8000-0x0000"


OPTION = st.sampled_from(
    [
        "corrupt=10% bits(3)",
        "corrupt=truncate(10) when=20%",
        "disable=0.5..1, 2..2.2",
        "disable=30%",
        "disable=0.2..0.7 release=burst",
        "drop=every 9",
        "loss=20%",
        "loss=gemodel(10%, 30%)",
        "loss=onoff(0.5, 0.2)",
        "duplicate=20% count=3",
        "delay=normal(10, 10)",
        "delay=uniform(0, 60) order=keep",
        "reorder=20% depth=4",
        "reorder=20% mode=early",
        "rate=30k queue=5",
        "slot=40 frames=3",
    ]
)
LIVE = st.sampled_from(
    ["enable *", "disable *", "fault * loss=50%", "fault * reorder=none", "fault * reorder=50% depth=9"]
)


@settings(max_examples=150)
@given(
    st.lists(OPTION, max_size=6, unique=True),
    st.integers(0, 120),
    st.lists(st.tuples(st.integers(0, 120), LIVE), max_size=4),
)
def test_counts_add_up(chosen: list[str], count: int, live: list[tuple[int, str]]) -> None:
    """Every frame comes out once as copy 0, copies are numbered, nothing leaves before it was due."""
    seen, kept = set[str](), list[str]()
    for text in chosen:
        name = text.partition("=")[0]
        if name not in seen or name in ("corrupt", "disable", "drop", "loss", "delay"):
            kept.append(text)
        seen.add(name)
    faults, rows = pipeline(options(*kept)), list[Outgoing]()
    for index in range(count):
        for when, text in live:
            if when == index:
                faults.act(parse_action(text))
        rows += faults.apply(index, frame(index), index * PERIOD_NS)
    rows += faults.close()
    assert faults.close() == ()
    assert sorted(row.index for row in rows if row.copy == 0) == list(range(count))
    copies = Counter((row.index, row.copy) for row in rows)
    assert not copies or max(copies.values()) == 1
    assert all((index, copy - 1) in copies for index, copy in copies if copy)
    assert all(row.offset_ns >= row.index * PERIOD_NS for row in rows)
    assert all(row.copy == 0 for row in rows if row.fate in (Fate.DROPPED, Fate.DISABLED))


def test_no_release_of_ours_changes_a_run() -> None:
    """Known answers of the whole path from seed to nanosecond; a change here breaks users' recorded seeds."""
    rows = play(pipeline(ready_profile("table1"), "N1", 1), 5)
    assert [row.delay_ns for row in rows] == [59884253, 59190204, 60612576, 58616160, 62320989]
    rows = play(pipeline(options("loss=gemodel(20%, 50%)", "duplicate=20%", "corrupt=30% bits(2)"), "N1", 1), 40)
    assert (
        "".join("L" if row.fate is Fate.LOST else str(row.copy) for row in rows)
        == "0000000010100000L000000000100010L01LL0010001L010"
    )
    assert [row.index for row in rows if row.marks and not row.copy] == [
        0,
        1,
        6,
        8,
        11,
        14,
        18,
        20,
        23,
        28,
        29,
        30,
        31,
        34,
        35,
        36,
        39,
    ]


# --- what clients are told at once


def test_configurations_meet_the_faults_that_name_them() -> None:
    faulty = pipeline(options("corrupt=chk() when=type config", "loss=100%", "disable=0.. "))
    (told,) = faulty.told(CONFIG_FRAME)
    assert told != CONFIG_FRAME
    assert told[:-2] == CONFIG_FRAME[:-2]
    lossy = pipeline(options("loss=100% when=type config"))
    assert lossy.told(CONFIG_FRAME) == ()
    assert [row.fate for row in play(lossy, 3)] == [Fate.SENT] * 3
    twice = pipeline(options("duplicate=100% when=type config"))
    assert twice.told(CONFIG_FRAME) == (CONFIG_FRAME, CONFIG_FRAME)
    assert pipeline(options("loss=50%", "delay=constant(5)", "corrupt=100%")).told(CONFIG_FRAME) == (CONFIG_FRAME,)


def test_half_of_the_configurations_are_lost_and_the_data_draw_as_before() -> None:
    some, none = pipeline(options("loss=50% when=type config or type data")), pipeline(options("loss=50%"))
    told = [len(some.told(CONFIG_FRAME)) for _ in range(400)]
    assert 150 < sum(told) < 250
    assert fates(play(some, 300)) == fates(play(none, 300))
