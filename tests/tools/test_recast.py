"""Streams recast: the bytes and the numbers of other IDCODEs, names, FORMATs, and of one concentrator."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.frames import Described, random_stream, streams
from support.recordings import messages_of

from pmutools import timebase
from pmutools.c37118 import FrameType, Message, StreamConfig, decode_config
from pmutools.c37118.batch import NO_TIME, Batch, decode_batch
from pmutools.c37118.checksum import chk_array
from pmutools.c37118.config import encode_config
from pmutools.c37118.config_kinds import as_kind
from pmutools.c37118.constants import Format
from pmutools.c37118.demux import Demux, Loss
from pmutools.c37118.session import served
from pmutools.errors import SettingsError
from pmutools.flow import Chunk, Flow
from pmutools.formats.source import Block, frames_of, gather
from pmutools.tools.recast import (
    Changes,
    check_renumbering,
    concentrated,
    described,
    parse_form,
    reformatted,
    renamed,
    renumbered,
)

Items = list[Any]


def items_of(stream: Described, kind: str = "cfg2", **options: Any) -> Items:
    return list(gather(messages_of(stream, kind, **options)))


def blocks(items: Iterable[Any]) -> list[Block]:
    return [item for item in items if isinstance(item, Block)]


def batch_of(items: Iterable[Any]) -> Batch:
    (block,) = blocks(items)
    return block.batch


def octets_of(batch: Batch) -> np.ndarray[Any, Any]:
    assert batch.wire is not None
    return np.ascontiguousarray(batch.wire).view(np.uint8).reshape(len(batch), batch.config.frame_size)


def hold_whole(batch: Batch) -> None:
    """CHK right, both configurations can be made and read, what is in the columns is what the bytes say."""
    octets = octets_of(batch)
    assert not chk_array(octets).any()
    same_numbers(decode_batch(octets.tobytes(), batch.config), batch)
    offered = served(batch.config)
    for kind in (FrameType.CFG2, FrameType.CFG3):
        config = decode_config(offered.frames[kind])[1]
        assert (config.idcode, config.frame_size) == (batch.config.idcode, batch.config.frame_size)
        assert config == as_kind(batch.config, kind)


def same_numbers(one: Batch, other: Batch) -> None:
    for name in ("time_ns", "time_quality", "stat", "digitals", "valid"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    for name in ("phasors", "frequency", "rocof", "analogs"):
        assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True), name


# --- IDCODE -----------------------------------------------------------------------------------------------------


@given(stream=streams(idcode=7), kind=st.sampled_from(["cfg2", "cfg3"]), new=st.integers(1, 65534))
@settings(max_examples=40, deadline=None)
def test_another_idcode_changes_nothing_else(stream: Described, kind: str, new: int) -> None:
    items, changes = items_of(stream, kind), Changes()
    before = batch_of(items)
    out = list(renumbered(items, {7: new}, changes))
    batch = batch_of(out)
    hold_whole(batch)
    same_numbers(before, batch)
    changed = octets_of(before) != octets_of(batch)
    assert not np.delete(changed, [4, 5, -2 % changed.shape[1], -1 % changed.shape[1]], axis=1).any()
    opening = out[0]
    assert opening.frame.idcode == batch.config.idcode == new
    assert decode_config(opening.frame.data)[1] == batch.config == opening.config
    assert changes.renumbered == {7: new}


def test_a_single_station_of_the_same_idcode_moves_along() -> None:
    stream = random_stream(random.Random(1), stations=1, idcode=7)
    items = items_of(stream)
    config = items[0].config
    for own, expected in ((7, 9), (61, 61)):
        here = replace(config, stations=(replace(config.stations[0], idcode=own),))
        block = blocks(items)[0]
        batch = batch_of(renumbered([block._replace(batch=replace(block.batch, config=here))], {7: 9}))
        assert batch.config.stations[0].idcode == expected


def test_idcodes_may_be_exchanged_but_not_shared() -> None:
    one, two = (items_of(random_stream(random.Random(n), idcode=n)) for n in (1, 2))
    swapped = [block.batch.config.idcode for block in blocks(renumbered([*one, *two], {1: 2, 2: 1}))]
    assert swapped == [2, 1]
    with pytest.raises(SettingsError, match="1=2: the source has a stream 2"):
        list(renumbered([*one, *two], {1: 2}))
    with pytest.raises(SettingsError, match="1=2: the source has a stream 2"):
        check_renumbering({1: 2}, [1, 2])
    with pytest.raises(SettingsError, match="2=5: stream 1 becomes 5 too"):
        list(renumbered([], {1: 5, 2: 5}))
    for wrong in (0, 65535, -1):
        with pytest.raises(SettingsError, match="1 to 65534"):
            list(renumbered([], {1: wrong}))


def test_commands_and_losses_on_the_way() -> None:
    from support.wire import command_frame

    stream = random_stream(random.Random(1), idcode=7)
    demux = Demux()
    flow = Flow("tcp", "a:1", "b:2")
    raw = b"".join((stream.config(), command_frame(7, 2), b"junk", *stream.data))
    items = [*demux.feed(Chunk(raw, 5, flow)), *demux.close()]
    out = list(renumbered(gather(items), {7: 300}))
    assert [type(item) for item in out] == [Message, Message, Loss, Block]
    assert [item.frame.idcode for item in out[:2]] == [300, 300]
    assert not any(chk_array(np.frombuffer(item.frame.data, np.uint8)[None]) for item in out[:2])


def test_what_is_not_there_is_told() -> None:
    items, changes = items_of(random_stream(random.Random(1), idcode=7)), Changes()
    out = list(renamed(renumbered(items, {8: 9}, changes), {"nobody": "N"}, changes))
    assert [item is old for item, old in zip(out, items, strict=True)] == [True] * len(items)
    assert described(changes) == [
        "IDCODE 8: not in the source, so nothing was changed",
        "station nobody: not in the source, so nothing was changed",
    ]


# --- names ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cfg2", "cfg3"])
def test_another_name(kind: str) -> None:
    items, changes = items_of(random_stream(random.Random(3), stations=2, long_names=False), kind), Changes()
    old = items[0].config.stations[0].name
    out = list(renamed(items, {old: "Näsudden"}, changes))
    batch = batch_of(out)
    hold_whole(batch)
    assert decode_config(out[0].frame.data)[1] == batch.config
    assert [station.name for station in batch.config.stations] == ["Näsudden", "STATION 1"]
    assert np.array_equal(octets_of(batch), octets_of(batch_of(items)))
    assert described(changes) == [f"station {old} sent as Näsudden"]


def test_names_that_do_not_fit() -> None:
    two, three = (
        items_of(random_stream(random.Random(3), stations=2, long_names=False), kind) for kind in ("cfg2", "cfg3")
    )
    old, other = (station.name for station in two[0].config.stations)
    long = "a name of 20 letters"
    assert batch_of(renamed(three, {old: long})).config.stations[0].name == long
    for items, new, problem in (
        (two, long, "20 bytes, CFG2 has room for 16"),
        (two, "ä" * 9, "18 bytes"),
        (three, "x" * 256, "256 bytes"),
        (two, " ", "cannot be empty"),
        (two, other, "two stations"),
    ):
        with pytest.raises(SettingsError, match=problem):
            list(renamed(items, {old: new}))


# --- FORMAT -----------------------------------------------------------------------------------------------------


def test_forms_are_parsed() -> None:
    everything = Format.PHASOR_FLOAT | Format.ANALOG_FLOAT | Format.FREQ_FLOAT
    assert parse_form("polar,int").of(Format(0xE)) == Format.POLAR
    assert parse_form("rect, FLOAT").of(Format(1)) == everything
    assert parse_form("phasor=int,freq=float,analog=float,polar").of(Format(2)) == Format(0b1101)
    assert parse_form("float,phasor=int").of(Format(0)) == Format.ANALOG_FLOAT | Format.FREQ_FLOAT
    assert parse_form("phasor=int,float").of(Format(2)) == Format.ANALOG_FLOAT | Format.FREQ_FLOAT
    assert parse_form("freq=int").of(Format(0xF)) == Format(0b0111)
    assert parse_form("polar").of(Format(0xFFF0)) == Format(0xFFF1)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "'' is none of"),
        ("polar,", "'' is none of"),
        ("integer", "'integer' is none of polar, rect"),
        ("phasor=double", "is none of"),
        ("polar=int", "is none of"),
        ("polar,rect", "'rect' contradicts"),
        ("int,float", "'float' contradicts"),
        ("freq=int,freq=float", "'freq=float' contradicts"),
    ],
)
def test_forms_that_are_none(text: str, problem: str) -> None:
    with pytest.raises(SettingsError, match=problem) as raised:
        parse_form(text)
    assert "\n" not in str(raised.value)


def plausible(rng: random.Random, formats: Sequence[int], frames: int = 20, **options: Any) -> Described:
    """A stream whose float magnitudes lie within a decade: PHUNIT comes from the first block, which is all of it."""
    return random_stream(
        rng, formats=formats, frames=frames, scaled_floats=False, time_base=1_000_000, data_rate=50, **options
    )


@given(
    rng=st.randoms(use_true_random=False),
    formats=st.lists(st.integers(0, 15), min_size=1, max_size=3),
    target=st.integers(0, 15),
    kind=st.sampled_from(["cfg2", "cfg3"]),
)
@settings(max_examples=80, deadline=None)
def test_another_format_keeps_the_numbers_to_within_their_steps(
    rng: random.Random, formats: list[int], target: int, kind: str
) -> None:
    words = ["polar" if target & 1 else "rect"]
    words += [
        f"{name}={'float' if target & bit else 'int'}" for name, bit in (("phasor", 2), ("analog", 4), ("freq", 8))
    ]
    changes = Changes()
    items = items_of(plausible(rng, formats), kind)
    before = batch_of(items)
    out = list(reformatted(items, parse_form(",".join(words)), changes))
    after = batch_of(out)
    config = after.config
    if all(fmt == target for fmt in formats):
        assert out == items
        return
    hold_whole(after)
    assert changes.reformatted == len(before)
    assert isinstance(out[0], Message)
    assert decode_config(out[0].frame.data)[1] == config
    assert [int(station.format) & 0xF for station in config.stations] == [target] * len(formats)
    assert [station.cfgcnt for station in config.stations] == [s.cfgcnt for s in before.config.stations]
    for name in ("time_ns", "arrival_ns", "stamp_source", "time_quality", "stat", "digitals"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    tolerate_phasors(before, after, changes)
    if not target & 8:
        good = np.isfinite(before.frequency) & (np.abs(before.frequency - 55) < 20)
        assert np.nanmax(np.abs(after.frequency - before.frequency)[good], initial=0) <= 0.5e-3 + 1e-9
        assert np.nanmax(np.abs(after.rocof - before.rocof)[good], initial=0) <= 0.5e-2 + 1e-9
    else:
        assert np.allclose(after.frequency, before.frequency, rtol=1e-6, equal_nan=True)


def tolerate_phasors(before: Batch, after: Batch, changes: Changes) -> None:
    """Half a step of PHUNIT, half a step of the angle, float32 beside."""
    channels = [(channel, station.format) for station in after.config.stations for channel in station.phasors]
    for column, (channel, fmt) in enumerate(channels):
        x, y = before.phasors[:, column], after.phasors[:, column]
        assert np.array_equal(np.isnan(x), np.isnan(y))
        unit = channel.phscale.scale if channel.phscale else channel.unit
        if unit == 0 and not fmt & Format.PHASOR_FLOAT:
            continue  # integers whose PHUNIT the source had left at 0
        step = 0.0 if fmt & Format.PHASOR_FLOAT else unit * 0.75
        if not fmt & Format.PHASOR_FLOAT:  # the largest PHUNIT there is takes fewer volts as parts than as magnitude
            sent = x * np.exp(1j * channel.phscale.angle_offset_rad) if channel.phscale else x
            largest = np.maximum(np.abs(sent.real), np.abs(sent.imag))
            reach = np.abs(x) / 65535.5 if fmt & Format.POLAR else largest / 32767.5
            clipped = reach > unit * (1 + 1e-9)
            assert not clipped.any() or changes.clipped, "what does not fit is counted"
            x, y = x[~clipped], y[~clipped]
        angle = 0.51e-4 if fmt & Format.POLAR and not fmt & Format.PHASOR_FLOAT else 1e-6
        assert np.nanmax(np.abs(y - x) - step - angle * np.abs(x), initial=-1) <= 1e-9 * np.nanmax(np.abs(x), initial=1)


def test_what_grows_beyond_its_headroom_is_clipped_and_told() -> None:
    stream = next(
        stream
        for seed in range(100)
        if (stream := plausible(random.Random(seed), [0b1110], absent=0.0)).spec.stations[0].phasors
    )
    items = items_of(stream)
    first = blocks(items)[0]
    later = first._replace(batch=replace(first.batch, phasors=first.batch.phasors * 10, wire=None))
    changes = Changes()
    one, two = blocks(reformatted([first, later], parse_form("rect,int"), changes))
    assert one.batch.config is two.batch.config
    assert changes.clipped > 0
    assert f"{changes.clipped} values clipped to the range of their 16-bit field" in described(changes)
    reach = 0x7FFF * max(channel.unit for channel in one.batch.config.stations[0].phasors)
    assert np.abs(two.batch.phasors.real).max() <= reach


def test_a_channel_that_is_silent_at_first_has_a_unit_all_the_same() -> None:
    stream = next(
        stream
        for seed in range(100)
        if len((stream := plausible(random.Random(seed), [0b1110], absent=0.0)).spec.stations[0].phasors) > 1
    )
    block = blocks(items_of(stream))[0]
    silent = block.batch.phasors.copy()
    silent[:, 0] = np.nan
    batch = batch_of(
        reformatted([block._replace(batch=replace(block.batch, phasors=silent, wire=None))], parse_form("int"))
    )
    assert all(channel.unit > 0 for channel in batch.config.stations[0].phasors)
    assert np.isnan(batch.phasors[:, 0]).all()


# --- concentration ----------------------------------------------------------------------------------------------

START = 1_700_000_000


def pmu(
    idcode: int, *, formats: Sequence[int] = (0b1110,), frames: int = 40, skip: int = 0, rate: int = 50, **options: Any
) -> list[Message]:
    """A stream whose frames lie on the grid from second START on, the first ``skip`` instants left out."""
    from support.frames import Stamp

    base = options.pop("time_base", 1_000_000)
    stream = random_stream(
        random.Random(idcode), formats=formats, frames=frames, idcode=idcode, data_rate=rate, time_base=base, absent=0.0
    )
    stamps = [divmod(number + skip, rate) for number in range(frames)]
    quality = options.pop("quality", 0)
    stream = replace(stream, stamps=tuple(Stamp(START + s, quality, k * base // rate) for s, k in stamps))
    first_ns = START * timebase.NS + options.pop("delay_ns", 0)
    return messages_of(
        stream, options.pop("kind", "cfg2"), flow=Flow("udp", f"192.0.2.{idcode}:1", "x:2"), first_ns=first_ns
    )


def joined(*recordings: list[Message], changes: Changes | None = None, **options: Any) -> Items:
    def open_again() -> Iterable[Any]:
        return gather([message for recording in recordings for message in recording])

    return list(concentrated(open_again, 300, changes=changes, **options))


def whole(items: Items) -> Batch:
    """All blocks' frames as one batch."""
    parts = [block.batch for block in blocks(items)]
    raw = b"".join(octets_of(part).tobytes() for part in parts)
    arrivals = np.concatenate([part.arrival_ns for part in parts])
    return decode_batch(raw, parts[0].config, arrivals)


@pytest.mark.parametrize("kinds", [("cfg2", "cfg2"), ("cfg3", "cfg3"), ("cfg2", "cfg3")])
def test_stations_stand_side_by_side(kinds: tuple[str, str]) -> None:
    one = pmu(11, formats=(0b1110,), kind=kinds[0], quality=3, delay_ns=7)
    two = pmu(12, formats=(0b0001, 0b0000), kind=kinds[1], quality=0x25, delay_ns=5)
    changes = Changes()
    items = joined(one, two, changes=changes)
    batch = whole(items)
    hold_whole(blocks(items)[0].batch)
    assert (batch.config.idcode, len(batch)) == (300, 40)
    assert batch.config.kind is (FrameType.CFG3 if "cfg3" in kinds else FrameType.CFG2)
    assert isinstance(items[0], Message)
    assert items[0].config == batch.config == decode_config(items[0].frame.data)[1]
    parts = [batch_of(gather(recording)) for recording in (one, two)]
    same_station_values(batch, parts)
    assert set(batch.time_quality.tolist()) == {0x25}
    assert np.array_equal(batch.arrival_ns, np.maximum(parts[0].arrival_ns, parts[1].arrival_ns))
    assert np.array_equal(batch.time_ns, parts[0].time_ns)
    assert (changes.concentrated, changes.filled, changes.late, changes.repeated) == (40, 0, 0, 0)


def same_station_values(batch: Batch, parts: Sequence[Batch]) -> None:
    for name in ("stat", "frequency", "rocof", "digitals", "analogs", "phasors"):
        expected = np.hstack([getattr(part, name) for part in parts])
        tolerance = 1e-6 if name in ("phasors", "analogs") else 0  # PHUNIT as a float32 of CFG-3
        assert np.allclose(getattr(batch, name), expected, rtol=tolerance, atol=0, equal_nan=True), name


def test_who_has_nothing_is_filled_in() -> None:
    one, two = pmu(11, formats=(0b1110, 0b0001)), pmu(12, formats=(0b0000,), skip=10, frames=20, quality=9)
    changes = Changes()
    batch = whole(joined(one, two, changes=changes))
    absent = np.r_[np.ones(10, bool), np.zeros(20, bool), np.ones(10, bool)]
    assert (batch.stat[absent, 2] == 0x8000).all()
    assert np.isnan(batch.frequency[absent, 2]).all()
    phasors = slice(sum(len(s.phasors) for s in batch.config.stations[:2]), None)
    assert np.isnan(batch.phasors[absent, phasors]).all()
    assert not batch.valid[absent, 2].any()
    assert set(batch.time_quality[absent].tolist()) == {0}
    assert set(batch.time_quality[~absent].tolist()) == {9}
    assert changes.filled == 20
    assert described(changes) == ["40 frames concentrated, 20 stations filled in as absent"]


def test_first_stations_may_be_missing_too_and_no_instant_is_made_up() -> None:
    one, two = pmu(11, frames=5), pmu(12, frames=5, skip=7)
    batch = whole(joined(one, two))
    assert batch.time_ns.tolist() == [START * timebase.NS + k * 20_000_000 for k in (0, 1, 2, 3, 4, 7, 8, 9, 10, 11)]
    assert (batch.stat == 0x8000)[:, 1].tolist() == [True] * 5 + [False] * 5 or batch.stat[:5, 1].tolist() == [
        0x8000
    ] * 5


def test_the_largest_time_base_and_unknown_arrivals() -> None:
    one, two = pmu(11, time_base=1000), pmu(12, time_base=0xFFFFFF)
    two = [message._replace(frame=message.frame._replace(arrival_ns=None)) for message in two]
    batch = whole(joined(one, two))
    assert batch.config.time_base == 0xFFFFFF
    assert np.array_equal(batch.arrival_ns, batch_of(gather(one)).arrival_ns)
    assert (whole(joined(two)).arrival_ns == NO_TIME).all()


def test_frames_in_any_order_within_the_window() -> None:
    one, two = pmu(11), pmu(12)
    rng = random.Random(1)
    shuffled = [one[0], *rng.sample(one[1:], 40)]
    changes = Changes()
    assert np.array_equal(
        octets_of(blocks(joined(shuffled, two, changes=changes))[0].batch), octets_of(blocks(joined(one, two))[0].batch)
    )
    assert changes.late == 0


def small_blocks(*recordings: list[Message], size: int) -> Callable[[], Iterable[Any]]:
    """The recordings one after the other, in blocks of ``size`` frames."""
    return lambda: (item for recording in recordings for item in gather(recording, size))


def test_late_and_repeated_frames_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pmutools.tools.recast.concentrate.WINDOW_FRAMES", 10)
    one, two = pmu(11, frames=40), pmu(12, frames=40)
    changes = Changes()
    items = list(concentrated(small_blocks([*one, one[-1]], two, size=8), 300, changes=changes))
    assert changes.repeated == 1
    assert changes.late == 31  # ten of the first stream, with one twice, still waited for the second
    assert sum(len(block.batch) for block in blocks(items)) == changes.concentrated == 40
    assert f"{changes.late} frames came too late to be concentrated and were left out" in described(changes)


def test_blocks_of_any_size_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = pmu(11, frames=100), pmu(12, frames=90, skip=5)
    expected = octets_of(whole(joined(one, two)))
    for size in (1, 7, 64):
        items = list(concentrated(small_blocks(one, two, size=size), 300))
        assert np.array_equal(octets_of(whole(items)), expected)


def test_a_stream_that_changes_its_scale_or_its_channels() -> None:
    one, two = pmu(11, formats=(0b0000,), frames=10), pmu(12, frames=30)
    other_format = pmu(11, formats=(0b1110,), frames=10, skip=10)
    changes = Changes()
    batch = whole(joined([*one, *other_format], two, changes=changes))
    layouts = [[len(m.config.stations[0].phasors) for m in recording if m.config] for recording in (one, other_format)]
    assert layouts[0][0] == layouts[1][0]
    assert changes.reconfigured == 0
    assert len(batch) == 30
    changes = Changes()
    more = [m._replace(flow=one[0].flow) for m in pmu(11, formats=(0b1110, 0b1110), frames=10, skip=10)]
    batch = whole(joined([*one, *more], two, changes=changes))
    assert changes.reconfigured == 10
    assert (batch.stat[10:, 0] == 0x8000).all()
    assert "10 frames left out after their stream changed its channels" in described(changes)


def test_what_cannot_be_concentrated() -> None:
    with pytest.raises(SettingsError, match=r"12 \(25/s\), others 50/s"):
        joined(pmu(11), pmu(12, rate=25))
    with pytest.raises(SettingsError, match="without a DATA_RATE"):
        items = [m._replace(config=replace(m.config, data_rate=0)) for m in pmu(11) if m.config]
        list(concentrated(lambda: gather(items), 300))
    with pytest.raises(SettingsError, match="no data frames"):
        joined([])
    for wrong in (0, 65535):
        with pytest.raises(SettingsError, match="1 to 65534"):
            list(concentrated(list, wrong))


def test_a_frame_has_65535_bytes_at_most() -> None:
    block = blocks(gather(pmu(11)))[0]

    def many() -> Iterable[Any]:
        stations = block.batch.config.stations * 1000
        fat = replace(block.batch.config, stations=stations)
        assert fat.frame_size < 65535
        return [Block(Flow("udp", f"{n}"), empty_batch(replace(fat, idcode=n + 1))) for n in range(60)]

    with pytest.raises(SettingsError, match=r"bytes.*leave some"):
        list(concentrated(many, 300))


def empty_batch(config: StreamConfig) -> Batch:
    return decode_batch(bytes(config.frame_size), config, check=False)


def test_a_concentrated_stream_can_be_recast_and_read_again() -> None:
    one, two = pmu(11, formats=(0b1110,)), pmu(12, formats=(0b1111,))
    items = list(renumbered(reformatted(joined(one, two), parse_form("polar,float")), {300: 301}))
    demux = Demux()
    raw = [message.frame.data for block in blocks(items) for message in frames_of(block, {})]
    messages = demux.feed(Chunk(b"".join(raw), None, Flow("file", "x")))
    assert [m.frame.idcode for m in messages if isinstance(m, Message)] == [301] * 41
    assert encode_config(decode_config(raw[0])[1]) == encode_config(blocks(items)[0].batch.config)
