"""Who plays what: tracks as themselves, and emulated PMUs with numbers, names, phases and values of their own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.playing import MS, START_NS, Played, config_of, interleaved, play, recording, reel_of, stream

from pmutools.c37118 import (
    AnalogChannel,
    DigitalWord,
    Format,
    Frame,
    FrameType,
    Message,
    PhasorChannel,
    Prefix,
    Station,
    StreamConfig,
    decode_config,
    decode_prefix,
    encode_data,
)
from pmutools.c37118.batch import decode_batch
from pmutools.c37118.checksum import chk
from pmutools.c37118.frames import wire_values
from pmutools.errors import SettingsError
from pmutools.flow import Flow, StampSource
from pmutools.timebase import NS, from_ns
from pmutools.tools.player.cast import Cast, Part, Spread, as_recorded, clone_name, emulated, parse_spread
from pmutools.tools.player.reel import Reel

SECOND = recording(stream(), 50)


def as_many(count: int, **options: Any) -> Callable[[Reel], Cast]:
    return lambda reel: emulated(reel, count, 1, **options)


def frames_by_part(played: Played) -> dict[int, list[bytes]]:
    frames: dict[int, list[bytes]] = {}
    for sent in played.data:
        frames.setdefault(sent.stream, []).append(sent.frame)
    return frames


def times_by_part(played: Played) -> dict[int, list[int]]:
    times: dict[int, list[int]] = {}
    for sent in played.data:
        times.setdefault(sent.stream, []).append(sent.at_ns)
    return times


# --- numbers, names, phases


@pytest.mark.parametrize("count", [1, 8, 2000])
def test_emulated_pmus_send_their_tracks_data_as_their_own(count: int) -> None:
    played = play(recording(stream(), 5), cast=as_many(count))
    parts, times = frames_by_part(played), times_by_part(played)
    original = [message.frame.data for message in recording(stream(), 5)[1:]]
    assert len(parts) == count
    for number, frames in parts.items():
        assert [decode_prefix(frame).idcode for frame in frames] == [7 + number] * 5
        assert all(chk(frame) == 0 for frame in frames)
        assert [frame[14:-2] for frame in frames] == [frame[14:-2] for frame in original]
        assert [frame[10:14] for frame in frames] == [frame[10:14] for frame in original], "stamps of the track"
    period_ns = 20 * MS
    for number in range(count):
        begin = times[0][0] + period_ns * number // count
        assert times[number] == [begin + k * period_ns for k in range(5)]


def test_together_all_send_at_one_instant() -> None:
    played = play(SECOND, cast=as_many(8, stagger=False))
    assert all(played.times(part) == played.times(0) for part in range(8))


def test_phases_are_within_the_new_interval() -> None:
    played = play(SECOND, cast=as_many(4), fps=25)
    assert [played.times(part)[0] for part in range(4)] == [k * 10 * MS for k in range(4)]
    played = play(SECOND, cast=as_many(4), interval_ns=MS, policy="keep", loops=3)
    assert [played.times(part)[0] for part in range(4)] == [k * MS // 4 for k in range(4)]
    assert all(played.numbers(part) == [*range(50)] * 3 for part in range(4))
    assert all(set(np.diff(played.times(part))) == {MS} for part in range(4))


@pytest.mark.parametrize("fps", [None, 25, 50, 120])
def test_no_frame_of_an_emulated_pmu_is_lost_in_a_loop(fps: int | None) -> None:
    """Latency and phase together may be more than an interval."""
    source = recording(stream(), 30, latency_ns=lambda k: (1 + k * 7 % 40) * MS)
    played = play(source, cast=as_many(7), fps=fps, loops=3)
    assert all(sorted(played.numbers(part)) == sorted([*range(30)] * 3) for part in range(7))


def test_idcodes_go_round_and_skip_those_that_mean_none() -> None:
    reel = reel_of(recording(stream(65_530), 2))
    idcodes = [part.idcode for part in emulated(reel, 65_534, 1).parts]
    assert idcodes[:7] == [65_530, 65_531, 65_532, 65_533, 65_534, 1, 2]
    assert sorted(idcodes) == [*range(1, 65_535)]
    for count in (0, 65_535):
        with pytest.raises(SettingsError, match="between 1 and 65534"):
            emulated(reel, count, 1)


@settings(deadline=None)
@given(
    st.lists(st.text(st.characters(exclude_categories=("Cs",)), max_size=16), min_size=1, max_size=4),
    st.sampled_from([1, 9, 10, 300]),
)
def test_names_are_unique_and_fit(names: list[str], count: int) -> None:
    names = [name.encode()[:16].decode(errors="ignore") for name in names]
    reel = reel_of([m for k, name in enumerate(names) for m in recording(stream(k + 1, name=name or "x"), 1)])
    parts = emulated(reel, count, 1).parts
    assert len({part.name for part in parts}) == count
    assert all(1 <= len(part.name.encode()) <= 16 for part in parts)


def test_a_long_name_is_cut_between_characters() -> None:
    reel = reel_of(recording(stream(name="Zürich-Süd-Ös"), 1))
    assert clone_name(reel.tracks[0], 6, 2000) == "Zürich-Sü-0007"
    assert clone_name(replace(reel.tracks[0], name="ééééééééé"), 0, 10) == "éééééé-01"


def test_configurations_announce_who_sends() -> None:
    source = interleaved(recording(stream(7, name="NORTH"), 3), recording(stream(9, name="SOUTH"), 3))
    played = play(source, cast=as_many(5))
    told = [decode_config(offer.frames[FrameType.CFG2])[1] for offer in played.stage.offered]
    assert [config.idcode for config in told] == [7, 8, 9, 10, 11]
    assert [config.stations[0].name for config in told] == ["NORTH-1", "SOUTH-2", "NORTH-3", "SOUTH-4", "NORTH-5"]
    assert [config.stations[0].idcode for config in told] == [7, 8, 9, 10, 11]
    assert [part.track for part in played.cast.parts] == [0, 1, 0, 1, 0]
    assert [decode_config(offer.frames[FrameType.CFG3])[1].stations[0].name for offer in played.stage.offered] == [
        part.name for part in played.cast.parts
    ]


def test_several_stations_keep_their_names_behind_a_number_of_their_own() -> None:
    stations = tuple(Station(f"S{k}", 20 + k, Format(0), (PhasorChannel("V1", 100),)) for k in range(3))
    config = StreamConfig(50, stations, 50)
    played = play(pdc_recording(config, 20), cast=as_many(3, spread=Spread(mag=1)))
    told = [decode_config(offer.frames[FrameType.CFG2])[1] for offer in played.stage.offered]
    assert [(c.idcode, [s.name for s in c.stations], [s.idcode for s in c.stations]) for c in told] == [
        (50 + k, ["S0", "S1", "S2"], [20, 21, 22]) for k in range(3)
    ]
    assert all(chk(sent.frame) == 0 for sent in played.data)
    assert [part.name for part in played.cast.parts] == ["50-1", "50-2", "50-3"]


def test_a_changed_configuration_is_announced_by_every_emulated_pmu() -> None:
    plain, other = stream(), stream(cfgcnt=1, name="RENAMED")
    flow = recording(plain, 0)[0].flow
    source = recording(plain, 10) + recording(other, 10, first_slot=10, flow=flow)
    played = play(source, cast=as_many(3))
    announced = [config_of(sent) for sent in played.stage.sent if sent.type is FrameType.CFG2]
    assert [(config.idcode, config.stations[0].name) for config in announced] == [
        (7 + k, f"PMU 7-{k + 1}") for k in range(3)
    ]


# --- values


def pdc_recording(config: StreamConfig, frames: int, polar: bool = False) -> list[Message]:
    flow = Flow("udp", "192.0.2.9:4713", "192.0.2.1:4713")
    messages = []
    for k in range(frames):
        soc, fracsec = from_ns(START_NS + k * 20 * MS, config.time_base)
        prefix = Prefix(FrameType.DATA.sync, config.frame_size, config.idcode, soc, 0x25, fracsec)
        rows = [_row(station, k) for station in config.stations]
        data = encode_data(wire_values(config, prefix, rows))
        messages.append(Message(Frame(data, None, StampSource.CAPTURE, 0), flow, config))
    return messages


ABSENT = 11
"""The frame that has no measurements."""


def _row(station: Station, k: int) -> list[Any]:
    form = station.format
    real = form & Format.FREQ_FLOAT
    values: list[Any] = [0x2000 + k]
    if k == ABSENT:
        count = 2 * len(station.phasors), 2, len(station.analogs)
        floats = (Format.PHASOR_FLOAT, Format.FREQ_FLOAT, Format.ANALOG_FLOAT)
        for several, bit in zip(count, floats, strict=True):
            values += [math.nan if form & bit else -32768] * several
        if form & (Format.POLAR | Format.PHASOR_FLOAT) == Format.POLAR:
            values[1 : 1 + 2 * len(station.phasors) : 2] = [32768] * len(station.phasors)  # magnitudes have no sign
        return [*values, *(0xA5A5 for _ in station.digitals)]
    for n in range(len(station.phasors)):
        if form & Format.PHASOR_FLOAT:
            values += [1000.5 + k, 0.25 + n] if form & Format.POLAR else [1000.5 + k, -20.0 * n]
        else:
            values += [1000 + k, 2500 * n] if form & Format.POLAR else [1000 + k, -700 * n]
    values += [60.01 + k / 1000, 0.125] if real else [10 + k, 13]
    values += [1.1 * k if form & Format.ANALOG_FLOAT else k - 7 for _ in station.analogs]
    values += [0xA5A5 for _ in station.digitals]
    return values


def every_format(word: int) -> StreamConfig:
    form = Format(word)
    station = Station(
        "ALL",
        7,
        form,
        tuple(PhasorChannel(f"V{k}", 100_000) for k in range(2)),
        tuple(AnalogChannel(f"A{k}") for k in range(3)),
        (DigitalWord(tuple(f"D{k}" for k in range(16))),),
    )
    return StreamConfig(7, (station,), 50)


@pytest.mark.parametrize("word", range(16))
def test_a_spread_changes_phasors_and_frequency_as_drawn_and_nothing_else(word: int) -> None:
    config = every_format(word)
    source = pdc_recording(config, 40)
    spread = Spread(mag=2, deg=20, mhz=30)
    plain, other = (play(source, cast=as_many(3, spread=s), policy="keep") for s in (None, spread))
    layout = config.stations[0]
    phasor_bytes = len(layout.phasors) * (8 if layout.format & Format.PHASOR_FLOAT else 4)
    freq_bytes = 4 if layout.format & Format.FREQ_FLOAT else 2
    changed = slice(16, 16 + phasor_bytes + freq_bytes)
    for part in range(3):
        ours, theirs = frames_by_part(plain)[part], frames_by_part(other)[part]
        own = other.cast.parts[part]
        before, after = (decode_batch(b"".join(frames), other.cast.config(part, 0)) for frames in (ours, theirs))
        for a, b in zip(ours, theirs, strict=True):
            assert a[: changed.start] == b[: changed.start]
            assert a[changed.stop : -2] == b[changed.stop : -2], "ROCOF, analogs and digitals are as they were"
        seconds = before.time_ns % (3600 * NS) / NS
        turn = own.turn_rad + math.tau * own.offset_hz * seconds
        expected = before.phasors * (own.gain * np.exp(1j * turn))[:, None]
        coarse = 1e-6 if layout.format & Format.PHASOR_FLOAT else 2e-3
        assert np.array_equal(np.isnan(after.phasors), np.isnan(expected))
        assert np.nanmax(np.abs(after.phasors - expected)) <= coarse * np.nanmax(np.abs(expected))
        assert np.nanmax(np.abs(after.frequency - before.frequency - own.offset_hz)) <= (
            1e-5 if layout.format & Format.FREQ_FLOAT else 0.00051
        )
        assert abs(own.gain - 1) < 0.1
        assert abs(own.offset_hz) < 0.15


def test_a_spread_is_the_same_by_seed_and_follows_its_deviations() -> None:
    reel = reel_of(SECOND)
    spread = Spread(mag=1, deg=5, mhz=2)
    one, same, other = (emulated(reel, 2000, seed, spread=spread) for seed in (3, 3, 4))
    assert one.parts == same.parts
    assert one.parts != other.parts
    gains = np.array([part.gain for part in one.parts])
    degrees = np.degrees([part.turn_rad for part in one.parts])
    millihertz = np.array([part.offset_hz * 1000 for part in one.parts])
    for drawn, mean, deviation in ((gains, 1, 0.01), (degrees, 0, 5), (millihertz, 0, 2)):
        assert drawn.mean() == pytest.approx(mean, abs=deviation / 10)
        assert drawn.std() == pytest.approx(deviation, rel=0.1)
    assert abs(np.corrcoef(gains, degrees)[0, 1]) < 0.1
    few = emulated(reel, 3, 3, spread=Spread())
    assert not any(part.altered for part in few.parts)


@pytest.mark.parametrize(
    ("text", "spread"),
    [("mag=1,deg=5,mhz=2", Spread(1, 5, 2)), ("mhz=0.5", Spread(mhz=0.5)), ("1, 2", Spread(1, 2))],
)
def test_a_spread_is_written(text: str, spread: Spread) -> None:
    assert parse_spread(text) == spread


@pytest.mark.parametrize("text", ["mag=-1", "mag=1,mag=2", "volts=1", "mag=x", "deg=361"])
def test_a_spread_that_cannot_be(text: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        parse_spread(text)


# --- looking things up


def brute_force(cast: Cast) -> list[tuple[int, int, int]]:
    """(position, row, part) of everything there is."""
    rows = cast.reel.rows
    return sorted(
        (int(due) - cast.reel.first_due_ns + part.phase_ns, row, number)
        for row, (due, track) in enumerate(zip(rows.due_ns, rows.track, strict=True))
        for number, part in enumerate(cast.parts)
        if part.track == track
    )


tracks = st.lists(
    st.tuples(st.sampled_from([10, 50, 60]), st.lists(st.integers(0, 300), min_size=1, max_size=12, unique=True)),
    min_size=1,
    max_size=3,
)


@settings(deadline=None, max_examples=150)
@given(
    tracks,
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 120 * MS)), min_size=1, max_size=6),
    st.booleans(),
    st.lists(st.integers(-MS, 8 * NS) | st.integers(0, 300).map(lambda k: k * 20 * MS), min_size=1, max_size=12),
)
def test_frames_between_two_positions_are_those_there_are(
    streams: list[tuple[int, list[int]]], parts: list[tuple[int, int]], plain: bool, bounds: list[int]
) -> None:
    """Whatever is looked up in whatever order, ahead or back."""
    source = [
        message
        for k, (rate, slots) in enumerate(streams)
        for message in recording(stream(k + 1, rate=rate), len(slots), slots=sorted(slots))
    ]
    reel = reel_of(source)
    several = [Part(t % len(streams), f"P{n}", n + 1, phase, emulated=True) for n, (t, phase) in enumerate(parts)]
    cast = as_recorded(reel) if plain else Cast(reel, several)
    everything = brute_force(cast)
    for low, high in zip(bounds, [*bounds[1:], bounds[0] + NS], strict=True):
        low, high = min(low, high), max(low, high)
        cut = cast.between(low, high)
        found = list(zip(cut.position_ns.tolist(), cut.row.tolist(), cut.part.tolist(), strict=True))
        assert [position for position, *_ in found] == sorted(position for position, *_ in found)
        assert sorted(found) == [entry for entry in everything if low <= entry[0] < high]
        later = [position for position, *_ in everything if position >= low]
        assert cast.next_position(low) == (later[0] if later else None)
