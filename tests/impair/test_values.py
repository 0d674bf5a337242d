"""Selection by decoded values: names as in the tables, comparisons, and what a stream does not have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.impairment import CONFIG, frame, options, pipeline, play

from pmutools.c37118 import (
    AnalogChannel,
    DigitalWord,
    Format,
    PhasorChannel,
    Station,
    StreamConfig,
    decode_data,
)
from pmutools.c37118.batch import decode_batch
from pmutools.errors import SettingsError
from pmutools.formats.columns import columns_of, quantities
from pmutools.impair import Fate, Pipeline
from pmutools.impair.values import comparison, readers

LABELS = tuple(f"D{k}" for k in range(16))
RICH = StreamConfig(
    7,
    (
        Station("A", 1, Format.POLAR, (PhasorChannel("V1", 1000), PhasorChannel("V1", 1000))),
        Station(
            "A", 2, Format(15), (PhasorChannel("V"),), (AnalogChannel("P"), AnalogChannel("")), (DigitalWord(LABELS),)
        ),
        Station("", 3, Format(0), (), (AnalogChannel("Q"),), (DigitalWord(LABELS), DigitalWord(LABELS))),
    ),
    50,
)
SINGLE = replace(CONFIG, stations=CONFIG.stations[:1])


def chosen(text: str, count: int = 100) -> list[int]:
    rows = play(pipeline(options(f"drop={text}")), count)
    return [row.index for row in rows if row.fate is Fate.DROPPED]


@pytest.mark.parametrize("config", [CONFIG, RICH, SINGLE], ids=["two", "rich", "single"])
def test_names_and_values_are_those_of_the_tables(config: StreamConfig) -> None:
    rng = np.random.default_rng(3)
    body = rng.integers(0x40, 0x44, (20, config.frame_size), np.uint8)  # floats from 2 to 800
    batch = decode_batch(body.tobytes(), config, check=False)
    columns = columns_of(config, "polar")
    table, known = quantities(batch, "polar", {"mag", "deg"}), readers(config)
    full = {column.name for column in columns}
    assert full <= known.keys()
    assert known.keys() - full == ({name.partition(".")[2] for name in full} if len(config.stations) == 1 else set())
    for column in columns:
        for data, expected in zip(batch.data(), table[column.quantity][:, column.at], strict=True):
            difference = known[column.name].read(data) - expected
            if column.quantity == "deg":  # of a turn, either end
                difference = (difference + 180) % 360 - 180
            assert abs(difference) <= 1e-9 * max(1.0, abs(expected))
        assert known[column.name].word is (column.quantity in ("stat", "digital"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("value NORTH.freq_hz < 60.0045", [0, 1, 2, 3, 4]),
        ("value NORTH.V1.mag >= 100097", [97, 98, 99]),
        ("value SOUTH.rocof_hz_s == -0.03", [2, 92]),
        ("value SOUTH.V1.deg <= -5.05 and 0-99", [97, 98, 99]),
        ("value SOUTH.freq_hz > 60.088, NORTH.V1.mag", None),
        ("value NORTH.stat & 0x2000", []),
        ("value NORTH.stat == 0 and 5-6", [5, 6]),
        ("value NORTH.stat != 0", []),
        ("not value NORTH.freq_hz>60.001", [0, 1]),
        ('value "NORTH.V1.mag" > 100097.5 or 3', [3, 98, 99]),
        ("(value NORTH.V1.mag > 100097.5 and not 99) or value NORTH.freq_hz<=60", [0, 98]),
    ],
)
def test_comparisons(text: str, expected: list[int] | None) -> None:
    if expected is None:
        with pytest.raises(SettingsError, match=r"'NORTH\.V1\.mag' is not an index"):
            chosen(text)
        return
    assert chosen(text) == expected


def test_a_mask_is_of_the_frame_as_it_came() -> None:
    """Content faults before do not show: a selector looks at what the source said."""
    faults = pipeline(options("corrupt=stat(test)\nvalue(nan)", "drop=value NORTH.stat & 0x8000"))
    assert {row.fate for row in play(faults, 5)} == {Fate.SENT}


def test_an_absent_value_fits_nothing() -> None:
    absent = bytearray(frame(0))
    absent[32:36] = b"\x7f\xc0\0\0"
    for operator in ("<", ">", "==", "!=", "<=", ">="):
        (row,) = pipeline(f"drop=value NORTH.freq_hz {operator} 60").apply(0, bytes(absent), 0)
        assert row.fate is Fate.SENT
    (row,) = pipeline("drop=not value NORTH.freq_hz < 60").apply(0, bytes(absent), 0)
    assert row.fate is Fate.DROPPED


def test_the_only_station_may_be_left_out() -> None:
    faults = Pipeline(options("drop=value freq_hz==60 or value NORTH.V1.mag > 5"), "N1", config=SINGLE)
    assert faults.apply(0, frame(0), 0)[0].fate is Fate.SENT  # a frame of another size has no values
    with pytest.raises(SettingsError, match="no value 'freq_hz'"):
        pipeline("drop=value freq_hz==60")


@pytest.mark.parametrize("option", ["drop=", "disable=", "loss=5% when=", "corrupt=chk when=", "segment=stall when="])
def test_an_unknown_name_is_told_when_the_pipeline_is_built(option: str) -> None:
    with pytest.raises(SettingsError) as error:
        pipeline(options(f"{option}value NORTH.frq_hz < 59.95"))
    name = option.partition("=")[0]
    assert str(error.value) == f"stream N1: {name}: no value 'NORTH.frq_hz'; did you mean 'NORTH.freq_hz'?"
    with pytest.raises(SettingsError, match="only STAT and digital words have bits"):
        pipeline(options(f"{option}value NORTH.freq_hz & 3"))
    with pytest.raises(SettingsError, match="values can only be read in a stream whose configuration is known"):
        Pipeline(options(f"{option}value NORTH.freq_hz < 3"), "N1")


def test_a_new_configuration_is_read_by_the_new_layout_or_refused() -> None:
    faults = pipeline("drop=value SOUTH.freq_hz > 60.005")
    assert faults.apply(5, frame(5), 0)[0].fate is Fate.DROPPED
    turned = replace(CONFIG, stations=CONFIG.stations[::-1])
    faults.configure(turned)
    (row,) = faults.apply(5, frame(5), 0)
    expected = decode_data(frame(5), turned).frequency(0) > 60.005
    assert row.fate is (Fate.DROPPED if expected else Fate.SENT)
    with pytest.raises(SettingsError, match=r"no value 'SOUTH\.freq_hz'"):
        faults.configure(SINGLE)
    assert faults.apply(5, frame(5), 0)[0].fate is row.fate


def test_words() -> None:
    assert comparison("A.WORD1 & 0x10").limit == 16
    assert comparison("A.WORD1==0x10").limit == 16
    assert comparison('"A, B (x).P" >= -1e3') == ("A, B (x).P", ">=", -1000.0)
