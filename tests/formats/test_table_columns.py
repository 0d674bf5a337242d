"""Frames to columns and back: names, values, and which bytes survive for each FORMAT and notation."""

from __future__ import annotations

import dataclasses
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.frames import ALL_FORMATS, Described, random_stream, streams

from pmutools.c37118 import Format, Station, StreamConfig, decode_config
from pmutools.c37118.batch import Batch, decode_batch, encode_batch
from pmutools.c37118.config import AnalogChannel, DigitalWord, PhasorChannel
from pmutools.formats.columns import FrameValues, Phasors, batch_of, columns_of, quantities, unique
from pmutools.formats.infer import columns_from_names, infer

LABELS = ("",) * 16
FLOAT32 = 2.0**-23
STYLES: tuple[Phasors, ...] = ("polar", "rect")


def decoded(stream: Described, kind: str = "cfg2") -> Batch:
    return decode_batch(b"".join(stream.data), decode_config(stream.config(kind))[1])


def through_columns(batch: Batch, style: Phasors) -> Batch:
    values, columns = quantities(batch, style, {"mag", "deg"}), columns_of(batch.config, style)
    by_name = {column.name: values[column.quantity][:, column.at] for column in columns}
    frames = FrameValues(batch.time_ns, batch.arrival_ns, batch.stamp_source, batch.time_quality)
    return batch_of(batch.config, columns, frames, by_name.get, exact=True)


def reencoded(batch: Batch) -> bytes:
    return batch.wire.tobytes() if batch.wire is not None else encode_batch(batch)[0].tobytes()


def same_parts(before: Batch, after: Batch) -> None:
    """All but the phasors, bit for bit."""
    for name in ("time_ns", "arrival_ns", "stamp_source", "time_quality", "stat", "digitals", "valid"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    for name in ("frequency", "rocof", "analogs"):
        assert np.array_equal(getattr(before, name), getattr(after, name), equal_nan=True), name


# --- names ------------------------------------------------------------------------------------------------------


def station(name: str, *phasors: str, analogs: tuple[str, ...] = (), words: int = 0) -> Station:
    return Station(
        name,
        7,
        Format(15),
        tuple(map(PhasorChannel, phasors)),
        tuple(map(AnalogChannel, analogs)),
        (DigitalWord(LABELS),) * words,
    )


def names(*stations: Station, style: Phasors = "polar") -> list[str]:
    return [column.name for column in columns_of(StreamConfig(7, stations, 50), style)]


def test_columns_are_named_as_documented() -> None:
    assert names(station("North", "VA", analogs=("P",), words=2)) == [
        "North.stat",
        "North.freq_hz",
        "North.rocof_hz_s",
        "North.VA.mag",
        "North.VA.deg",
        "North.P",
        "North.WORD1",
        "North.WORD2",
    ]
    assert names(station("North", "VA"), style="rect")[3:] == ["North.VA.re", "North.VA.im"]


def test_duplicates_are_numbered() -> None:
    assert names(station("A", "V", "V"))[3:] == ["A.V.mag", "A.V.deg", "A.V#2.mag", "A.V#2.deg"]
    assert names(station("A"), station("A"))[3:] == ["A#2.stat", "A#2.freq_hz", "A#2.rocof_hz_s"]
    assert names(station("A", analogs=("stat",)))[3:] == ["A.stat#2"]
    assert names(station(" A ", analogs=("", "")))[3:] == ["A.AN1", "A.AN2"]
    assert names(station(""))[0] == "PMU7.stat"


@given(st.lists(st.sampled_from(["a", "a#2", "a#3", "b", ""])))
def test_unique_names_are_unique_and_keep_the_first(given_names: list[str]) -> None:
    out = unique(given_names)
    assert len(set(out)) == len(given_names)
    first = {name: number for number, name in reversed(list(enumerate(given_names)))}
    assert all(out[number].startswith(name) for number, name in enumerate(given_names))
    assert out[:1] == given_names[:1]
    assert all(out[number] == name for name, number in first.items() if "#" not in name)


# --- values and bytes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("style", STYLES)
@settings(deadline=None, max_examples=60)
@given(stream=streams(frames=5), kind=st.sampled_from(["cfg1", "cfg2", "cfg3"]))
def test_values_survive(style: Phasors, stream: Described, kind: str) -> None:
    before = decoded(stream, kind)
    after = through_columns(before, style)
    same_parts(before, after)
    assert np.array_equal(np.isnan(before.phasors), np.isnan(after.phasors))
    present = ~np.isnan(before.phasors)
    error = np.abs(after.phasors - before.phasors)[present]
    assert (error <= 1e-14 * np.abs(before.phasors[present])).all()


@pytest.mark.parametrize("fmt", ALL_FORMATS)
@settings(deadline=None, max_examples=25)
@given(rng=st.randoms(use_true_random=False), both=st.booleans())
def test_frames_come_back_byte_for_byte_in_their_own_notation(fmt: int, rng: random.Random, both: bool) -> None:
    """Also in the other notation where the phasors are rectangular integers."""
    stream = without_lost_parts(random_stream(rng, formats=[fmt] * (1 + both), frames=4, scaled_floats=False))
    batch = decoded(stream)
    own: Phasors = "polar" if fmt & Format.POLAR else "rect"
    styles = STYLES if fmt & 3 == 0 else (own,)
    for style in styles:
        assert reencoded(through_columns(batch, style)) == b"".join(stream.data)


@pytest.mark.parametrize("fmt", [fmt for fmt in ALL_FORMATS if fmt & 3])
@settings(deadline=None, max_examples=25)
@given(rng=st.randoms(use_true_random=False))
def test_the_other_notation_keeps_values_to_the_last_count(fmt: int, rng: random.Random) -> None:
    stream = without_lost_parts(random_stream(rng, formats=[fmt], frames=4, scaled_floats=False))
    before = decoded(stream)
    after = decode_batch(reencoded(through_columns(before, "rect" if fmt & 1 else "polar")), before.config)
    same_parts(before, after)
    tolerance = FLOAT32 if fmt & Format.PHASOR_FLOAT else 1e-4 / 2
    present = ~np.isnan(before.phasors)
    error = np.abs(after.phasors - before.phasors)[present]
    assert (error <= tolerance * np.abs(before.phasors[present])).all()


def without_lost_parts(stream: Described) -> Described:
    """The stream without what a table cannot hold: PHUNIT 0, and a magnitude beside a polar filler."""
    stations = tuple(
        dataclasses.replace(spec, phasors=tuple(dataclasses.replace(p, phunit=p.phunit or 1) for p in spec.phasors))
        for spec in stream.spec.stations
    )
    integer_polar = [spec.format & 3 == 1 for spec in stations]
    blocks = tuple(
        tuple(
            block._replace(
                phasors=tuple((0, angle) if angle == -0x8000 else (size, angle) for size, angle in block.phasors)
            )
            if polar
            else block
            for polar, block in zip(integer_polar, frame, strict=True)
        )
        for frame in stream.blocks
    )
    return dataclasses.replace(stream, spec=dataclasses.replace(stream.spec, stations=stations), blocks=blocks)


def polar_frame(fmt: int, size: float, angle: float) -> tuple[bytes, StreamConfig]:
    rng = random.Random(3)
    stream = random_stream(rng, formats=[fmt], frames=1, absent=0.0)
    while not stream.spec.stations[0].phasors:
        stream = random_stream(rng, formats=[fmt], frames=1, absent=0.0)
    stream = without_lost_parts(stream)
    block = stream.blocks[0][0]
    frame = (block._replace(phasors=((size, angle),) * len(block.phasors)),)
    stream = dataclasses.replace(stream, blocks=(frame,))
    return stream.data[0], decode_config(stream.config("cfg2"))[1]


@pytest.mark.parametrize(("size", "angle"), [(0, 12345), (5, 31416), (5, -31416), (5, 32767), (0xFFFF, -32767)])
def test_polar_counts_keep_what_a_complex_number_cannot(size: int, angle: int) -> None:
    data, config = polar_frame(0b0001, size, angle)
    assert reencoded(through_columns(decode_batch(data, config), "polar")) == data


@pytest.mark.parametrize(("size", "angle"), [(0.0, 2.5), (1.0, 7.0), (-3.0, 0.5), (1.0, 3.1415927410125732)])
def test_polar_floats_keep_what_a_complex_number_cannot(size: float, angle: float) -> None:
    data, config = polar_frame(0b0011, size, angle)
    assert reencoded(through_columns(decode_batch(data, config), "polar")) == data


def test_magnitude_beside_a_filler_is_lost() -> None:
    data, config = polar_frame(0b0001, 123, -0x8000)
    expected, _ = polar_frame(0b0001, 0, -0x8000)
    assert reencoded(through_columns(decode_batch(data, config), "polar")) == expected


def test_what_a_table_lacks_is_absent() -> None:
    config = StreamConfig(7, (station("A", "V", analogs=("P",)), station("B", "V")), 50)
    count = 2
    frames = FrameValues(
        np.arange(count), np.zeros(count, np.int64), np.zeros(count, np.uint8), np.zeros(count, np.uint8)
    )
    given_columns = {
        "A.freq_hz": np.array([50.0, np.nan]),
        "B.V.mag": np.array([2.0, 3.0]),
        "B.V.deg": np.full(2, 90.0),
    }
    batch = batch_of(config, columns_of(config, "polar"), frames, given_columns.get, exact=False)
    assert batch.stat.tolist() == [[0, 0], [0x8000, 0]]
    assert batch.valid.tolist() == [[True, True], [False, True]]
    assert batch.phasors[:, 1].tolist() == [2j, 3j]
    assert np.isnan(batch.analogs).all()


# --- configurations from names ----------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(stream=streams(frames=1), style=st.sampled_from(STYLES))
def test_columns_tell_stations_and_channels(stream: Described, style: Phasors) -> None:
    """What is written by one configuration is read as another with the same channels, all of them float."""
    config = decode_config(stream.config("cfg2"))[1]
    written = columns_of(config, style)
    found = infer(columns_from_names([c.name for c in written], "file"), idcode=1, data_rate=50, fnom_hz=50)
    assert found.config.frame_size
    assert [c.name for c in found.columns] == [c.name for c in written]
    assert [(c.quantity, c.at) for c in found.columns] == [(c.quantity, c.at) for c in written]
    for before, after in zip(config.stations, found.config.stations, strict=True):
        assert len(after.phasors) == len(before.phasors)
        assert len(after.analogs) == len(before.analogs)
        assert len(after.digitals) == len(before.digitals)
        expected = Format(14) if style == "rect" and before.phasors else Format(15)
        assert after.format == expected
        assert [p.kind for p in after.phasors] == ["I" if p.name[0] == "I" else "V" for p in before.phasors]


def test_long_and_equal_names_become_valid_ones() -> None:
    columns = columns_from_names(
        ["A long station name.freq_hz", "A long station nominal.freq_hz", "A long station name.VOLTAGE_ABCDEFGHIJ"],
        "file",
    )
    config = infer(columns, idcode=1, data_rate=1, fnom_hz=60).config
    assert [s.name for s in config.stations] == ["A long station n", "A long station#2"]
    assert config.stations[0].analogs[0].name == "VOLTAGE_ABCDEFGH"


def test_columns_without_a_station_belong_to_the_file() -> None:
    columns = columns_from_names(["time", "freq_hz", "V1.mag", "V1.deg", "comment", "idcode"], "bus 7")
    assert [(c.station, c.channel, c.quantity) for c in columns] == [
        ("bus 7", "", "freq_hz"),
        ("bus 7", "V1", "mag"),
        ("bus 7", "V1", "deg"),
    ]


def test_stations_may_have_dots_and_single_halves_are_analogs() -> None:
    columns = columns_from_names(["Sub.1.stat", "Sub.1.V.mag", "Sub.1.V.deg", "Sub.1.I.mag", "Sub.1.WORD3"], "file")
    assert {c.station for c in columns} == {"Sub.1"}
    assert [(c.channel, c.quantity) for c in columns] == [
        ("", "stat"),
        ("V", "mag"),
        ("V", "deg"),
        ("I.mag", "analog"),
        ("WORD3", "digital"),
    ]
