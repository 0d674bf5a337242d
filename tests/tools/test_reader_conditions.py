"""Triggers as text, and what rounds they are true of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.reading import block, flow_of, stream

from pmutools.c37118 import Format, PhasorChannel, Station, StreamConfig
from pmutools.c37118.constants import Stat
from pmutools.timebase import NS, parse_utc
from pmutools.tools.reader.conditions import (
    FLAGS,
    Condition,
    Flag,
    Gap,
    Limit,
    Manual,
    Silence,
    parse_condition,
    parse_triggers,
)
from pmutools.tools.reader.watch import Watch

FLOATS = Format.PHASOR_FLOAT | Format.FREQ_FLOAT
PDC = StreamConfig(
    60,
    tuple(
        Station(name, 60 + k, FLOATS, (PhasorChannel("V1"), PhasorChannel("I1", 1 << 24)))
        for k, name in enumerate(("N1", "N2", "S1"))
    ),
    50,
)


@pytest.mark.parametrize(
    ("text", "condition"),
    [
        ("signal", Manual("signal")),
        ("key", Manual("key")),
        ("stat:trigger", Flag("stat:trigger", 0x0800)),
        ("stat:data-error", Flag("stat:data-error", 0xC000)),
        ("N1.stat:not-synchronised", Flag("N1.stat:not-synchronised", 0x2000, "N1")),
        ("freq>60.05", Limit("freq>60.05", "freq_hz", True, 60.05)),
        ("freq_hz < 59.95", Limit("freq_hz < 59.95", "freq_hz", False, 59.95)),
        ("|freq-60|>0.05", Limit("|freq-60|>0.05", "freq_hz", True, 0.05, True, 60.0)),
        ("|rocof|>1", Limit("|rocof|>1", "rocof_hz_s", True, 1.0, True, 0.0)),
        ("rocof>-1e-1", Limit("rocof>-1e-1", "rocof_hz_s", True, -0.1)),
        ("N-1.V-1.mag<280e3", Limit("N-1.V-1.mag<280e3", "mag", False, 280e3, False, 0.0, "N-1.V-1")),
        ("|N-1.freq-60|>.05", Limit("|N-1.freq-60|>.05", "freq_hz", True, 0.05, True, 60.0, "N-1")),
        ("loss", Gap("loss")),
        ("loss > 5", Gap("loss > 5", 5)),
        ("silence>1.5s", Silence("silence>1.5s", 1_500_000_000)),
    ],
)
def test_what_is_understood(text: str, condition: Condition) -> None:
    assert parse_condition(text) == condition


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "names no trigger"),
        ("freq>60.05,", "empty item"),
        ("sgnal", "did you mean 'signal'"),
        ("stat:triger", "did you mean 'trigger'"),
        ("frequency>60", "did you mean 'freq'"),
        ("freq>sixty", "is no trigger"),
        ("freq", "is no trigger"),
        ("angle>3", "cannot be compared; known: freq, rocof, mag"),
        ("silence>2", "write as in 10s"),
        ("freq>1e999", "not a finite number"),
    ],
)
def test_what_is_not(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_triggers(text)


def test_every_single_bit_of_stat_has_a_name() -> None:
    bits = {int(flag) for flag in Stat} - {0x8000, 0x4000}
    assert set(FLAGS.values()) == bits | {0xC000}


def test_the_documentation_names_every_condition() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reader.md").read_text(encoding="utf-8")
    assert all(f"`{flag}`" in page for flag in FLAGS)
    for text in ("signal", "key", "freq<59.95", "rocof>1", "mag<280e3", "loss>5", "silence>2s", "N1.stat:trigger"):
        assert f"`{text}`" in page
        assert parse_condition(text)


def fired(text: str, *blocks: object, now_s: float = 0.0) -> list[str]:
    """Conditions, places and values, as told, without times."""
    found = Watch(parse_triggers(text)).look(blocks, round(now_s * NS), 0)  # type: ignore[arg-type]
    return [f"{each.condition}: {each.where} {each.value}".strip() for each in found]


def pdc(**columns: object) -> object:
    """Ten frames of three stations at 60 Hz and 300 kV; ``columns`` set (row, column) cells of columns."""
    values = {
        "frequency": np.full((10, 3), 60.0),
        "rocof": np.zeros((10, 3)),
        "phasors": np.full((10, 6), 300e3 + 0j),
        "stat": np.zeros((10, 3)),
    }
    for name, cells in columns.items():
        for (row, column), value in cells.items():  # type: ignore[attr-defined]
            values[name][row, column] = value
    config = PDC
    base = block(stream(60), 10).batch
    from pmutools.c37118.batch import Batch, decode_batch, encode_batch
    from pmutools.formats.source import Block

    batch = Batch(
        config,
        base.time_ns,
        base.arrival_ns,
        base.stamp_source,
        base.time_quality,
        values["stat"].astype(np.uint16),
        values["phasors"],
        values["frequency"],
        values["rocof"],
        np.empty((10, 0)),
        np.empty((10, 0), np.uint16),
        np.ones((10, 3), bool),
    )
    return Block(flow_of(60), decode_batch(encode_batch(batch)[0].tobytes(), config, base.arrival_ns))


def test_values_are_compared_station_by_station_and_channel_by_channel() -> None:
    low = pdc(frequency={(4, 1): 59.9, (6, 2): 59.8}, phasors={(2, 4): 100e3}, rocof={(3, 0): -2.0})
    assert fired("freq<59.95", low) == [
        "freq<59.95: N2 (stream 60) 59.9 Hz",
        "freq<59.95: S1 (stream 60) 59.8 Hz",
    ]
    assert fired("S*.freq<59.95", low) == ["S*.freq<59.95: S1 (stream 60) 59.8 Hz"]
    assert fired("|freq-60|>0.15", low) == ["|freq-60|>0.15: S1 (stream 60) 59.8 Hz"]
    assert fired("mag<200e3", low) == ["mag<200e3: S1.V1 (stream 60) 100000"]
    assert fired("N*.mag<200e3,*.I1.mag<200e3", low) == []
    assert fired("|rocof|>1", low) == ["|rocof|>1: N1 (stream 60) -2 Hz/s"]
    assert fired("rocof>1", low) == []


def test_flags_of_stat() -> None:
    flagged = pdc(stat={(2, 0): 0x0800, (3, 1): 0x8000})
    assert fired("stat:trigger", flagged) == ["stat:trigger: N1 (stream 60) STAT 0x0800"]
    assert fired("stat:data-error", flagged) == ["stat:data-error: N2 (stream 60) STAT 0x8000"]
    assert fired("S1.stat:trigger", flagged) == []


def test_values_that_stat_calls_bad_are_not_judged() -> None:
    """A concentrator's filler has any frequency."""
    absent = pdc(frequency={(4, 1): 0.0, (5, 2): np.nan}, stat={(4, 1): 0x8000})
    assert fired("freq<59.95", absent) == []


def test_a_condition_that_stays_true_fires_once_and_holds() -> None:
    watch = Watch(parse_triggers("freq<59.95"))
    low = {(row, 0): 59.9 for row in range(10)}
    times = []
    for cells in ({}, {(8, 0): 59.9, (9, 0): 59.9}, low, {(0, 0): 59.9}, {(5, 0): 59.9}):
        found = watch.look([pdc(frequency=cells)], 0, 0)  # type: ignore[list-item]
        times.append((len(found), watch.holding))
    assert times == [(0, False), (1, True), (0, True), (0, False), (1, False)]


def test_the_moment_is_that_of_the_first_frame_over_the_limit() -> None:
    (found,) = Watch(parse_triggers("freq>60.01")).look([pdc(frequency={(7, 0): 60.02, (8, 0): 60.03})], 0, 0)  # type: ignore[list-item]
    assert str(found) == "freq>60.01: N1 (stream 60) 60.02 Hz at 2016-09-08T17:05:11.140000000Z"
    assert found.time_ns == parse_utc("2016-09-08T17:05:11.14Z")


def test_gaps_within_a_round_and_between_rounds() -> None:
    config = stream(7)
    watch = Watch(parse_triggers("loss,loss>3"))
    texts = []
    for first, frames in ((0, 5), (5, 5), (11, 5), (20, 5)):
        texts += [f"{each.condition} {each.value}" for each in watch.look([block(config, frames, first=first)], 0, 0)]
    assert texts == ["loss 1 frames missing before", "loss 4 frames missing before", "loss>3 4 frames missing before"]
    assert not watch.holding


def test_silence_is_told_once_until_the_stream_comes_again() -> None:
    watch = Watch(parse_triggers("silence>2s"))
    assert watch.look([block(stream(7))], 0, 0) == []
    counts = [len(watch.look([], round(second * NS), 0)) for second in (1, 1.9, 2.1, 5)]
    assert counts == [0, 0, 1, 0]
    watch.look([block(stream(7), first=300)], 6 * NS, 0)
    assert [len(watch.look([], second * NS, 0)) for second in (7, 9)] == [0, 1]


def test_conditions_that_nothing_fits_are_known() -> None:
    watch = Watch(parse_triggers("Z9.freq<59,signal,loss,freq<59"))
    watch.look([pdc()], 0, 0)  # type: ignore[list-item]
    assert watch.idle == ("Z9.freq<59",)


def test_another_configuration_begins_anew() -> None:
    watch = Watch(parse_triggers("stat:trigger"))
    flagged = {"stat": np.full((12, 1), 0x0800)}
    assert len(watch.look([block(stream(7), **flagged)], 0, 0)) == 1
    assert len(watch.look([block(stream(7), **flagged)], 0, 0)) == 0
    assert len(watch.look([block(stream(7, cfgcnt=1), **flagged)], 0, 0)) == 1
