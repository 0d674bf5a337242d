"""Silences: what TCP clients see of them, what is kept, and single stations of a concentrator's stream."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

import pytest
from support.impairment import CONFIG, CONFIG_FRAME, PERIOD_NS, frame, options, pipeline, play

from pmutools.c37118 import Format, Station, StreamConfig, decode_data
from pmutools.c37118.checksum import chk, sealed
from pmutools.c37118.config import AnalogChannel, DigitalWord, PhasorChannel
from pmutools.c37118.frames import encode_data, wire_values
from pmutools.errors import SettingsError
from pmutools.flow import Hangup
from pmutools.impair import Fate, Outgoing, Pipeline, Profile, Switch, parse_action, parse_profile
from pmutools.impair.stages import parse_setting


def concentrator(profile: Profile | str, seed: int = 1) -> Pipeline:
    if isinstance(profile, str):
        profile = options(profile)
    names = ("101", "NORTH", "SOUTH")
    return Pipeline(profile, "PDC", seed, config=CONFIG, aliases=names, stations=("NORTH", "SOUTH"))


# --- hangups ---------------------------------------------------------------------------------------------------------


def followed(faults: Pipeline, count: int) -> Iterator[tuple[Fate, Hangup | None]]:
    """What becomes of each frame, and what clients see then."""
    for index in range(count):
        (row,) = faults.apply(index, frame(index), index * PERIOD_NS)
        yield row.fate, faults.hangup


@pytest.mark.parametrize("tcp", list(Hangup))
def test_a_scheduled_silence_says_what_clients_see(tcp: Hangup) -> None:
    faults = pipeline(f"disable=1..2 tcp={tcp}")
    for index in range(150):
        (row,) = faults.apply(index, frame(index), index * PERIOD_NS)
        off = 61 <= index < 121
        assert row.fate is (Fate.DISABLED if off else Fate.SENT)
        assert faults.hangup is (tcp if off else None)


def test_the_first_closure_decides() -> None:
    faults = pipeline("disable=5-9 tcp=fin\n8-12 tcp=rst\n20")
    assert {index: seen for index, (_, seen) in enumerate(followed(faults, 25)) if seen is not None} == {
        **dict.fromkeys(range(5, 10), Hangup.FIN),
        **dict.fromkeys(range(10, 13), Hangup.RST),
        20: Hangup.SILENCE,
    }


def test_the_operators_switch() -> None:
    faults = pipeline(options())
    assert faults.act(parse_action("disable N1 tcp=refuse"))
    assert faults.hangup is Hangup.REFUSE and not faults.enabled and not faults.clear
    (row,) = faults.apply(0, frame(0), 0)
    assert row.fate is Fate.DISABLED
    assert faults.act(parse_action("disable N1"))
    assert faults.hangup is Hangup.SILENCE
    assert faults.act(parse_action("enable N1"))
    assert faults.hangup is None and faults.clear


def test_the_operators_switch_with_a_burst() -> None:
    faults = pipeline(options("delay=5"))
    faults.act(parse_action("disable N1 release=burst tcp=rst"))
    assert play(faults, 10, close=False) == []
    assert faults.hangup is Hangup.RST and faults.holding
    faults.act(parse_action("enable N1"))
    rows = play(faults, 2, 10, close=False)
    assert [row.index for row in rows] == list(range(12))
    assert {row.offset_ns for row in rows[:11]} == {10 * PERIOD_NS + 5_000_000}
    assert [row.marks for row in rows] == [("burst",)] * 10 + [()] * 2
    assert faults.delays_ns is not None and not faults.holding
    faults.act(parse_action("disable N1 release=burst tcp=rst"))
    rows = play(faults, 3, 12)
    assert [row.fate for row in rows] == [Fate.DISABLED] * 3
    assert faults.hangup is Hangup.RST


def test_in_a_timeline() -> None:
    faults = pipeline(parse_profile("[at 1]\ndo = disable N1 tcp=rst\n[at 2]\ndo = enable N1\n", "t.ini"))
    assert Counter(followed(faults, 150)) == {(Fate.SENT, None): 90, (Fate.DISABLED, Hangup.RST): 60}


def test_words_of_the_switch() -> None:
    assert parse_action('disable "BUS 5" release=burst tcp=fin').switch == Switch("burst", Hangup.FIN)
    action = parse_action("disable BUS 5, N* tcp=RST")
    assert action.rule is not None
    assert (action.rule.patterns, action.switch.tcp) == (("BUS 5", "N*"), Hangup.RST)
    for text, message in (
        ("disable N1 tcp=reset", "tcp: 'reset' is not one of silence, fin, rst, refuse"),
        ("disable N1 tpc=rst", "there is no 'tpc'; did you mean 'tcp'?"),
        ("disable N1 tcp=rst tcp=fin", "tcp= is given twice"),
        ("enable N1 tcp=rst", "enable takes a name alone, not tcp=rst"),
        ("disable", "disable whom? write 'disable NAME'"),
    ):
        with pytest.raises(ValueError) as error:
            parse_action(text)
        assert str(error.value) == message
    with pytest.raises(ValueError, match="tcp: 'no' is not one of silence, fin, rst, refuse"):
        parse_setting("disable", "5..8 tcp=no")


# --- stations --------------------------------------------------------------------------------------------------------


def absent(row: Outgoing) -> list[bool]:
    """Whether each station of a frame is filled in; the others are as they were."""
    data, true = decode_data(row.data, CONFIG), decode_data(frame(row.index), CONFIG)
    found = []
    for station, other in zip(data.stations, true.stations, strict=True):
        nothing = station.stat == 0x8000 and math.isnan(station.frequency) and math.isnan(station.rocof)
        assert nothing or station == other
        assert not nothing or all(math.isnan(phasor.real) for phasor in station.phasors)
        found.append(nothing)
    assert row.marks == tuple(f"filler({name})" for name, off in zip(("NORTH", "SOUTH"), found, strict=True) if off)
    return found


def test_a_silent_station_is_filled_in() -> None:
    faults = concentrator("disable=SOUTH@1..2")
    for index in range(150):
        (row,) = faults.apply(index, frame(index), index * PERIOD_NS)
        assert row.fate is Fate.SENT and chk(row.data) == 0 and faults.hangup is None
        assert absent(row) == [False, 61 <= index < 121]
    (row,) = faults.apply(0, CONFIG_FRAME, PERIOD_NS * 80)
    assert row.data == CONFIG_FRAME


def test_fillers_of_every_format() -> None:
    labels = tuple(f"D{k}" for k in range(16))
    for fmt in range(16):
        station = Station(
            "A", 1, Format(fmt), (PhasorChannel("V", 1000),), (AnalogChannel("P"),), (DigitalWord(labels),)
        )
        config = StreamConfig(5, (station, Station("B", 2, Format(fmt))), 60)
        values = [(0, 5, 6, 7, 8, 9, 0x1234), (0, 1, 2)]
        sent = encode_data(wire_values(config, (0xAA01, 0, 5, 0, 0, 0), values))
        faults = Pipeline(options("disable=A@0-"), "5", config=config, stations=("A", "B"))
        (row,) = faults.apply(0, sent, 0)
        data = decode_data(row.data, config)
        first, second = data.stations
        assert first.stat == 0x8000 and not first.valid and math.isnan(first.frequency)
        assert math.isnan(first.phasors[0].real) and first.digitals == (0,)
        assert math.isnan(first.analogs[0]) if fmt & 4 else first.analogs == (-32768,)
        assert second == decode_data(sent, config).stations[1]


def test_whose_silence_a_name_means() -> None:
    for pattern, whole, found in (
        ("PDC", True, [False, False]),
        ("101", True, [False, False]),
        ("*", True, [False, False]),
        ("NORTH", False, [True, False]),
        ("?O*TH", False, [True, True]),
        ("S*, 101", True, [False, False]),
        ("X", False, [False, False]),
    ):
        profile = parse_profile(f"[stream {pattern}]\ndisable = 0-\n", "p.ini")
        (row,) = concentrator(profile).apply(0, frame(0), 0)
        assert (row.fate is Fate.DISABLED) is whole
        assert absent(row) == found
        faults = concentrator(options())
        assert faults.act(parse_action(f"disable {pattern}")) is (whole or any(found))
        (row,) = faults.apply(0, frame(0), 0)
        assert (row.fate is Fate.DISABLED) is whole
        assert absent(row) == found


def test_a_single_station_is_its_stream() -> None:
    faults = Pipeline(options("disable=NORTH@0-"), "N1", config=CONFIG, aliases=("101", "NORTH"), stations=("NORTH",))
    assert faults.apply(0, frame(0), 0)[0].fate is Fate.DISABLED
    faults = Pipeline(options("disable=NORTH@0-"), "N1", config=CONFIG, stations=("NORTH",))
    assert faults.apply(0, frame(0), 0)[0].fate is Fate.DISABLED


def test_other_options_under_a_stations_name_mean_the_stream() -> None:
    faults = concentrator(parse_profile("[stream SOUTH]\ndelay = 5\ndisable = 3\n", "p.ini"))
    rows = play(faults, 5)
    assert {row.delay_ns for row in rows} == {5_000_000}
    assert [absent(row) for row in rows] == [[False, index == 3] for index in range(5)]
    assert faults.act(parse_action("fault NORTH loss=100%"))
    assert faults.apply(5, frame(5), 0)[0].fate is Fate.LOST


def test_later_settings_replace_earlier_ones() -> None:
    def off(text: str) -> tuple[bool, list[bool]]:
        (row,) = concentrator(parse_profile(text, "p.ini")).apply(3, frame(3), 0)
        return row.fate is Fate.DISABLED, absent(row)

    south = "[stream SOUTH]\ndisable = 3\n"
    assert off(south) == (False, [False, True])
    assert off(f"{south}[stream S*]\ndisable = none\n") == (False, [False, False])
    assert off(f"{south}[stream S*]\ndisable = +4\n") == (False, [False, True])
    assert off(f"{south}[stream *]\ndisable = none\n") == (False, [False, False])
    assert off(f"{south}[stream *]\ndisable = +4\n") == (False, [False, True])


def test_switches_of_stations() -> None:
    faults = concentrator(options())
    assert faults.act(parse_action("disable SOUTH"))
    assert faults.enabled and not faults.clear
    assert absent(faults.apply(0, frame(0), 0)[0]) == [False, True]
    assert faults.act(parse_action("disable 101")) and not faults.enabled
    assert faults.act(parse_action("enable 101")) and faults.enabled
    assert absent(faults.apply(1, frame(1), 0)[0]) == [False, True]
    assert faults.act(parse_action("enable *"))
    assert absent(faults.apply(2, frame(2), 0)[0]) == [False, False] and faults.clear
    assert faults.act(parse_action("fault SOUTH disable=3 and 50%"))
    timed = concentrator(parse_profile("[at 1]\ndo = disable SOUTH\n[at 2]\ndo = enable SOUTH\n", "t.ini"))
    assert [absent(row)[1] for row in play(timed, 150)] == [61 <= index < 121 for index in range(150)]


def test_fillers_come_before_content_faults_and_keep_damage() -> None:
    (row,) = concentrator(options("disable=SOUTH@0-", "corrupt=stat(clear=0x8000) station=SOUTH")).apply(0, frame(0), 0)
    assert decode_data(row.data, CONFIG).stat(1) == 0
    assert row.marks == ("filler(SOUTH)", "corrupt:stat+0x0000-0x8000")
    bad = sealed(frame(0)[:-2])[:-1] + b"?"
    (row,) = concentrator("disable=SOUTH@0-").apply(0, bad, 0)
    assert chk(row.data) != 0
    (row,) = concentrator("disable=SOUTH@0-").apply(0, frame(0)[:30], 0)
    assert row.data == frame(0)[:30]


def test_stations_draw_for_themselves() -> None:
    faults = concentrator("disable=?O*TH@50%")
    both = [tuple(absent(row)) for row in play(faults, 2000)]
    counts = Counter(both)
    assert len(counts) == 4 and all(abs(n / 2000 - 0.25) < 5 * math.sqrt(0.1875 / 2000) for n in counts.values())


def test_a_station_needs_a_configuration() -> None:
    for profile in (options("disable=SOUTH@5"), parse_profile("[at 5]\ndo = disable SOUTH\n", "p.ini")):
        with pytest.raises(SettingsError, match="a station can only be silent alone in a stream whose configuration"):
            Pipeline(profile, "PDC", stations=("NORTH", "SOUTH"))
    with pytest.raises(SettingsError, match=r"stream PDC: disable: no value 'freq_hz'"):
        concentrator("disable=SOUTH@value freq_hz < 60")
