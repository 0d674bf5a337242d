"""Profiles: one grammar for files, options and live control; errors that name their line; the ready ones."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.impairment import CONFIG, PERIOD_NS, delays_ms, frame, options, pipeline, play

from pmutools.errors import SettingsError
from pmutools.impair import (
    OPTIONS,
    READY,
    Fate,
    Pipeline,
    load_profile,
    parse_action,
    parse_profile,
    profile_of_options,
    read_profile_file,
    ready_profile,
)
from pmutools.impair.stages import SEVERAL, parse_setting

EXAMPLE = """
; all that the grammar has
[run]
seed = 7
[stream N*, 101]
delay = normal(16, 2) corr=30%
corrupt = 1% field=stat when=every 7
          stat(do_not_use) when=5..8
[stream N2]
delay = +constant(3)
loss = gemodel(1%, 20%)
[stream *]
duplicate = none
[at 12.5]
do = disable N1
     fault N2 loss=5%
[at 3]
do = enable N1
"""


def test_rules_apply_in_order() -> None:
    profile = parse_profile(EXAMPLE, "p.ini")
    assert profile.seed == 7
    one, two, other = (profile.treatment([name]).stages for name in ("N1", "n2", "S1"))
    assert len(one.delay) == 1 and len(one.corrupt) == 2 and not one.loss
    assert len(two.delay) == 2 and len(two.loss) == 1
    assert other == type(other)()
    assert profile.treatment(["X", "101"]).stages == one
    assert [(action.at_ns, action.verb) for action in profile.timeline] == [
        (3_000_000_000, "enable"),
        (12_500_000_000, "disable"),
        (12_500_000_000, "fault"),
    ]


def test_a_pipeline_takes_the_profiles_seed_unless_told() -> None:
    profile = parse_profile(EXAMPLE, "p.ini")
    assert Pipeline(profile, "X").seed == 7
    assert Pipeline(profile, "X", 0).seed == 0
    assert Pipeline(parse_profile("", "p"), "X").seed == 0


def test_one_grammar() -> None:
    """The same words in a file, on a command line and in live control make the same stages."""
    values = {
        "corrupt": "1% bits(2) field=stat when=every 7",
        "config": "add(analogs=2) cfgcnt=keep announce=60 notice=no when=5..8",
        "disable": "5..8 release=burst tcp=rst",
        "drop": "100,200-210,every 100 offset 3",
        "loss": "gemodel(1%, 20%)",
        "duplicate": "5% count=2",
        "delay": "normal(16, 2) + constant(1) corr=30%",
        "reorder": "5% depth=2",
        "rate": "64k overhead=28",
        "slot": "uniform(80, 120) frames=4",
        "segment": "5% split(parts=3, gap=5) when=every 2",
    }
    assert values.keys() == OPTIONS.keys()
    for option, text in values.items():
        in_file = parse_profile(f"[stream *]\n{option} = {text}\n", "p.ini").treatment(["N1"]).stages
        assert in_file == profile_of_options([(option, text)]).treatment(["N1"]).stages
        live = pipeline(parse_profile("", "p.ini"))
        assert live.act(parse_action(f"fault N1 {option}={text}"))
        assert live.stages == in_file != type(in_file)()


def test_options_of_a_command_line() -> None:
    profile = options(
        "disable=N1@5..8", "disable=N1@10..", "loss=S*,201@5%", "delay=constant(5)", "corrupt=chk", "corrupt=sync"
    )
    north, south = profile.treatment(["N1"]).stages, profile.treatment(["S9"]).stages
    assert len(north.disable) == 2 and not north.loss
    assert len(south.loss) == 1 and not south.disable
    assert profile.treatment(["201"]).stages == south
    assert len(north.corrupt) == 2 and len(north.delay) == 1
    on_top = ready_profile("table1").then(options("delay=constant(5)"))
    assert on_top.treatment(["N1"]).stages == options("delay=constant(5)").treatment(["N1"]).stages
    assert ready_profile("table1").then(options("delay=none")).treatment(["N1"]).stages.delay == ()


def test_misspelt_streams_are_found() -> None:
    profile = parse_profile("[stream N1]\nloss = 1%\n[stream Q*, Z]\nloss = 1%\n", "p.ini")
    assert profile.unmatched([("N1", "101"), ("S1", "201")]) == ("Q*, Z",)
    assert profile.unmatched([("N1",), ("z",)]) == ()
    profile = parse_profile(
        "[at 1]\ndo = disable TYPO\n     pause 1\n[at 2]\ndo = enable TYPO\n     enable N1\n", "p.ini"
    )
    assert profile.unmatched([("N1", "101")]) == ("TYPO",)


def test_numbers_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "delays.txt").write_text("# ms\n10, 20\n30 40\n")
    path = tmp_path / "p.ini"
    path.write_text("[stream *]\ndelay = trace(@delays.txt) + empirical(1, @delays.txt)\n")
    stages = read_profile_file(path).treatment(["N1"]).stages
    assert stages == options("delay=trace(10,20,30,40) + empirical(1,10,20,30,40)").treatment(["N1"]).stages
    path.write_text("[stream *]\nloss = trace(@missing.txt)\n")
    with pytest.raises(SettingsError, match=r"p\.ini:2: .* loss: .*missing\.txt: No such file"):
        read_profile_file(path)
    with pytest.raises(SettingsError, match=r"--loss: @x: no file can be named here"):
        options("loss=trace(@x)")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[stream *]\ndelya = 5", "p.ini:2: [stream *] delya: no such fault; did you mean 'delay'?"),
        ("[stream *]\n\nloss = 5", "p.ini:3: [stream *] loss: 5 is not a probability; did you mean 5%?"),
        ("[strem *]\nloss = 5%", "p.ini:1: [strem *]: unknown section; did you mean 'stream NAME'?"),
        ("[stream]\nloss = 5%", "p.ini:1: [stream]: unknown section; did you mean 'stream NAME'?"),
        ("[run]\nsede = 5", "p.ini:2: [run] sede: unknown key; did you mean 'seed'?"),
        ("[run]\nseed = -5", "p.ini:2: [run] seed: -5 is out of range; it must be 0 to 1.84467e+19"),
        ("[at noon]\ndo = pause 5", "p.ini:1: [at noon]: 'noon' is not a number; write [at SECONDS]"),
        ("[at 5]", "p.ini:1: [at 5]: nothing to do; add a line 'do = disable NAME'"),
        (
            "[at 5]\ndo = disable N1\n     pause",
            "p.ini:2: [at 5] do: pause for how long? stream time stands still meanwhile; write 'pause SECONDS'",
        ),
        ("[at 5]\ndp = pause", "p.ini:2: [at 5] dp: unknown key; known: do"),
        ("[at 5]\ndo = disabel N1", "p.ini:2: [at 5] do: 'disabel' is nothing to do; did you mean 'disable'?"),
        ("[at 5]\ndo = disable", "p.ini:2: [at 5] do: disable whom? write 'disable NAME'"),
        ("[at 5]\ndo = fault N1", "p.ini:2: [at 5] do: 'fault N1' is not of the form 'fault NAME OPTION=VALUE'"),
        ("[at 5]\ndo = fault N1 loss=5", "p.ini:2: [at 5] do: loss: 5 is not a probability; did you mean 5%?"),
        ("[at 5]\ndo = fault N1 lost=5", "p.ini:2: [at 5] do: lost: no such fault; did you mean 'slot'?"),
        ("[stream *]\nrate = +64k", "p.ini:2: [stream *] rate: only one of these a stream; give it once, without '+'"),
        ("[stream *]\ndelay =", "p.ini:2: [stream *] delay: no value; write 'none' to switch the stage off"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        parse_profile(text, "p.ini")
    assert str(error.value) == message


def test_option_errors() -> None:
    with pytest.raises(SettingsError) as error:
        options("delay=N1@nromal(16, 2)")
    assert str(error.value) == "--delay: 'nromal' is no delay; did you mean 'normal'?"
    with pytest.raises(SettingsError, match="--dlay: no such fault; did you mean 'delay'"):
        options("dlay=5")


PIECES = """
normal ( ) 16 , 2 % + corr= when= every 7 .. not and or type data gemodel trace bits field= stat k none - = é mixture
order= mixture( normal(16,2) 50% @x value A.freq_hz < & == "A wall stamp second slot first after config
2016-09-08T17:05:11Z add(1) announce=5 split tcp=rst histogram(1,2,3) diurnal leap(1)
"""
WORDS = st.lists(st.sampled_from([*PIECES.split(), " ", "\n"]), max_size=10).map("".join)


@given(st.sampled_from(sorted(OPTIONS)), WORDS | st.text(max_size=20))
def test_any_text_is_a_setting_or_one_line_of_error(option: str, text: str) -> None:
    try:
        setting = parse_setting(option, text)
    except ValueError as error:
        assert "\n" not in str(error) and str(error)
    else:
        assert len(setting.parts) <= 1 or option in SEVERAL


def test_ready_profiles_are_complete() -> None:
    assert set(READY) >= {"table1", "fig10-irregular", "two-zero", "asymmetry-3", "asymmetry-6", "single-dropout"}
    for name in READY:
        assert load_profile(name) == ready_profile(name)
        assert ready_profile(name).rules
    with pytest.raises(SettingsError, match="did you mean 'table1'"):
        ready_profile("tabel1")
    with pytest.raises(SettingsError, match="neither a file nor a ready profile; did you mean 'two-zero'"):
        load_profile("two-zeros")


def test_table1() -> None:
    """PMU 44 ms within 40 to 48 and communication 16 within 15 to 40, heavy-tailed: 60 ms, within 55 to 88."""
    delay = np.array(delays_ms(play(pipeline(ready_profile("table1")), 20_000)))
    assert abs(delay.mean() - 60) < 5 * delay.std() / np.sqrt(delay.size)
    assert delay.min() >= 55 and delay.max() <= 88
    assert np.quantile(delay, 0.999) - 60 > 3 * (60 - np.quantile(delay, 0.001)), "no heavy tail"


def test_fig10_irregular() -> None:
    rows = play(pipeline(ready_profile("fig10-irregular")), 5000)
    gaps = np.diff([row.offset_ns for row in rows]) / 1e6
    assert gaps.min() > 0 and gaps.max() < 34
    assert abs(gaps.mean() - PERIOD_NS / 1e6) < 0.01
    assert 5 < gaps.std() < 8
    assert (gaps < 10).mean() > 0.1 and (gaps > 25).mean() > 0.05


def test_two_zero() -> None:
    """In windows of one period: 2, 0, 2, 0, whatever the phase but for a hundredth of it, and in order."""
    rows = play(pipeline(ready_profile("two-zero")), 200)
    assert all(row.offset_ns < later.offset_ns for row, later in pairwise(rows))
    for phase in (0.0, 0.1, 0.3, 0.45, 0.5, 0.7, 0.9):
        windows = [int(row.offset_ns / PERIOD_NS - phase) for row in rows[4:-4]]
        assert np.bincount(windows)[min(windows) :].tolist() == [2, 0] * 95 + [2]


def test_asymmetry_concerns_the_south_alone() -> None:
    for name, extra_ms in (("asymmetry-3", 50), ("asymmetry-6", 100)):
        profile = options("delay=constant(60)").then(ready_profile(name))
        for stream, aliases, expected in (
            ("N1", (), 60),
            ("S1", (), 60 + extra_ms),
            ("MALIN", ("south",), 60 + extra_ms),
        ):
            faults = Pipeline(profile, stream, config=CONFIG, aliases=aliases)
            assert faults.apply(0, frame(0), 0)[0].delay_ns == expected * 10**6
        assert Pipeline(profile, "SOUTHERN").apply(0, frame(0), 0)[0].delay_ns == 60 * 10**6


def test_single_dropout() -> None:
    rows = play(pipeline(ready_profile("single-dropout")), 1000)
    assert [row.index for row in rows if row.fate is not Fate.SENT] == [600]
    assert all(row.offset_ns < later.offset_ns for row, later in pairwise(rows))
