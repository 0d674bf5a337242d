"""The config stage: what data frames and configuration frames say before, during and after a change."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.impairment import CONFIG, CONFIG_FRAME, PERIOD_NS, frame, options, pipeline, play

from pmutools.c37118 import FrameType, StreamConfig, as_kind, decode_config, decode_data, encode_config
from pmutools.c37118.checksum import chk
from pmutools.c37118.constants import Stat
from pmutools.draws import Draws
from pmutools.errors import SettingsError
from pmutools.impair import Outgoing, Pipeline, parse_action
from pmutools.impair.config_change import KEPT, Reconfiguration
from pmutools.impair.stages import parse_setting


def carried(row: Outgoing) -> StreamConfig:
    return row.config or CONFIG


def test_more_analogs_and_back_again() -> None:
    rows = play(pipeline("config=add(analogs=3) when=10-19"), 30)
    for row in rows:
        data, true = decode_data(row.data, carried(row)), decode_data(frame(row.index), CONFIG)
        inside = 10 <= row.index < 20
        assert (row.config is not None) is inside and row.notice
        assert row.faults == ("config:add3" if inside else "")
        assert data.stations[0].analogs == ((0.0,) * 3 if inside else ())
        assert len(row.data) == CONFIG.frame_size + 6 * inside == data.values[1]
        assert [station._replace(analogs=()) for station in data.stations] == [
            station._replace(analogs=()) for station in true.stations
        ]
        assert data.time_ns == true.time_ns


def test_cfgcnt_moves_or_does_not() -> None:
    for text, counts in (
        ("add(analogs=1)", [1, 0]),
        ("add(analogs=1) station=SOUTH", [0, 1]),
        ("count() station=2", [0, 1]),
        ("rename(X) cfgcnt=keep", [0, 0]),
    ):
        (row,) = play(pipeline(f"config={text}"), 1)
        assert [station.cfgcnt for station in carried(row).stations] == counts
    full = replace(CONFIG, stations=(replace(CONFIG.stations[0], cfgcnt=0xFFFF), CONFIG.stations[1]))
    (row,) = Pipeline(options("config=count()"), "N1", config=full).apply(0, frame(0), 0)
    assert carried(row).stations[0].cfgcnt == 0


def test_a_name_or_the_count_alone_leaves_data_as_they_are() -> None:
    for text, mark in (("rename(station=OTHER) station=SOUTH", "config:rename(OTHER)"), ("count()", "config:count")):
        (row,) = play(pipeline(f"config={text}"), 1)
        assert row.data == frame(0) and row.marks == (mark,)
        assert carried(row) != CONFIG
    (row,) = play(pipeline("config=rename(station=OTHER) station=SOUTH"), 1)
    assert [station.name for station in carried(row).stations] == ["NORTH", "OTHER"]


def test_floats_where_the_format_says_so() -> None:
    floats = replace(CONFIG, stations=tuple(replace(s, format=s.format | 4) for s in CONFIG.stations))
    faults = Pipeline(options("config=add(2) station=SOUTH\nadd(1)"), "N1", config=floats)
    (row,) = faults.apply(0, frame(0), 0)
    assert len(row.data) == floats.frame_size + 12
    data = decode_data(row.data, carried(row))
    assert [station.analogs for station in data.stations] == [(0.0,), (0.0, 0.0)]
    assert data.frequency(1) == decode_data(frame(0), CONFIG).frequency(1)


def test_parts_follow_each_other() -> None:
    rows = play(pipeline("config=add(1) when=5-\nadd(2) cfgcnt=keep when=10-\nrename(X) station=NORTH when=15-"), 20)
    for row in rows:
        steps = sum(row.index >= first for first in (5, 10, 15))
        station = carried(row).stations[0]
        assert (station.name, len(station.analogs), station.cfgcnt) == (
            ("NORTH", 0, 0),
            ("NORTH", 1, 1),
            ("NORTH", 3, 1),
            ("X", 3, 2),
        )[steps]
        assert [analog.name for analog in station.analogs] == ["ADDED1", "ADDED2", "ADDED3"][: len(station.analogs)]
        decode_data(row.data, carried(row))


def test_announced_by_stat_bit_10_before_each_range() -> None:
    rows = play(pipeline("config=add(1) station=SOUTH announce=0.5 when=1..2, 4.."), 300)
    for row in rows:
        time_s = row.index * PERIOD_NS / 1e9
        stats = [station.stat for station in decode_data(row.data, carried(row)).stations]
        soon = 0.5 <= time_s < 1 or 3.5 <= time_s < 4
        assert stats == [0, Stat.CONFIG_CHANGE if soon else 0]
        assert row.marks == (("config:announced",) if soon else ("config:add1",) if row.config else ())


def test_without_notice_the_way_back_is_not_told_either() -> None:
    faults = pipeline("config=add(1) notice=no when=5-9\ncount() when=15-16")
    rows = play(faults, 20)
    assert [row.index for row in rows if not row.notice] == list(range(5, 15))
    faults = pipeline("config=add(1) notice=no")
    play(faults, 3, close=False)
    faults.act(parse_action("fault * config=none"))
    assert not faults.clear
    (row,) = faults.apply(3, frame(3), 0)
    assert (row.config, row.notice) == (None, False)
    faults.configure(replace(CONFIG, data_rate=50))
    assert faults.apply(4, frame(4), 0)[0].notice and faults.clear


def test_configuration_frames_say_what_the_data_follow() -> None:
    stamped = encode_config(CONFIG, soc=77, fracsec=5, time_quality=3)
    faults = pipeline("config=add(2) when=10-19")
    for index in range(25):
        faults.apply(index, frame(index), index * PERIOD_NS)
        for kind in (FrameType.CFG2, FrameType.CFG3, FrameType.CFG1):
            sent = encode_config(as_kind(CONFIG, kind), soc=77, fracsec=5, time_quality=3)
            (row,) = faults.apply(index, sent, index * PERIOD_NS)
            prefix, config = decode_config(row.data)
            assert (prefix.soc, prefix.fracsec, prefix.time_quality, prefix.type) == (77, 5, 3, kind)
            changed = 10 <= index < 20 and kind is not FrameType.CFG1
            assert len(config.stations[0].analogs) == 2 * changed
            assert changed or row.data == sent
    assert decode_config(stamped)[1] == CONFIG


def test_damage_done_before_stays_damage() -> None:
    """A wrong CHK or FRAMESIZE is not put right by the change, and a frame cut short is not lengthened."""
    for index, row in enumerate(play(pipeline(options("corrupt=bits(1) field=values", "config=add(2)")), 50)):
        assert chk(row.data) != 0 and row.marks == ("corrupt:1bit", "config:add2")
        assert len(row.data) == CONFIG.frame_size + 4 and row.index == index
    (row,) = play(pipeline(options("corrupt=framesize(40)", "config=add(2)")), 1)
    assert row.data[2:4] == b"\0\x28" and chk(row.data) != 0
    (row,) = play(pipeline(options("corrupt=truncate(20)", "config=add(2)")), 1)
    assert row.data == frame(0)[:20] and row.marks == ("corrupt:truncate=20",) and row.config is not None
    (row,) = play(pipeline(options("corrupt=stat(test) station=SOUTH", "config=add(2)")), 1)
    assert decode_data(row.data, carried(row)).stat(1) == 0x8000


def test_first_after_config() -> None:
    """The run's first data frame, and those after a configuration frame, a change and its end."""
    faults = pipeline(options("config=count() when=10-14", "drop=first after config"))
    rows = list[Outgoing]()
    for index in range(30):
        if index in (20, 25):
            rows += faults.apply(index, CONFIG_FRAME, index * PERIOD_NS)
        if index == 27:
            faults.configure(replace(CONFIG, data_rate=50))
        rows += faults.apply(index, frame(index), index * PERIOD_NS)
    assert [row.index for row in rows if row.fate == "dropped"] == [0, 10, 15, 20, 25, 27]


@pytest.mark.parametrize("passing", [0, 1, 5])
def test_frames_that_took_the_short_cut_have_been_first_too(passing: int) -> None:
    faults = pipeline(options())
    assert faults.clear
    play(faults, passing, close=False)
    faults.act(parse_action("fault * drop=first after config"))
    assert (faults.apply(passing, frame(passing), 0)[0].fate == "dropped") is (not passing)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ad(1)", "'ad' is no change of configuration; did you mean 'add'?"),
        ("add(0)", "add analogs: 0 is out of range; it must be 1 to 1000"),
        ("count() cfgcnt=keep", "count() with cfgcnt=keep changes nothing; leave one out"),
        ("count() announce=60", "announce: only ranges of time have a time before them; write when=5..8"),
        ("count() announce=60 when=10-20", "announce: only ranges of time have a time before them; write when=5..8"),
        ("count() notice=perhaps", "notice: 'perhaps' is neither yes nor no"),
    ],
)
def test_grammar_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_setting("config", text)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("add(1) station=SUOTH", "stream N1: config: no station 'SUOTH'; did you mean 'SOUTH'?"),
        ("rename(A name that is too long)", "stream N1: config: name 'A name that is too long' takes 23 bytes"),
        ("\n".join(["add(1000)"] * 33), "stream N1: config: data frames of 66052 bytes; FRAMESIZE ends at 65535"),
    ],
)
def test_what_this_stream_cannot_have(text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        pipeline(options(f"config={text}"))
    assert str(error.value).startswith(message)
    with pytest.raises(SettingsError, match="stream N1: config: only a stream whose configuration is known"):
        Pipeline(options("config=count()"), "N1")


def test_any_combination_of_parts_is_made_and_few_are_kept() -> None:
    parts = [parse_setting("config", f"add({1 << part}) when=50%").parts[0] for part in range(8)]
    changes = Reconfiguration(parts, lambda name: Draws(1, "N1", name), CONFIG)
    for combination in (*range(1, 256), *range(1, 256)):
        active = tuple(bool(combination >> part & 1) for part in range(8))
        config = changes.config(active)
        assert config is not None and len(config.stations[0].analogs) == combination
        assert changes._changed.cache_info().currsize <= KEPT
