"""What ``pmu info`` counts: slots filled, missing, repeated, overtaken; flags; whatever the order and the rate."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.playing import START_NS, interleaved, recording, stream

from pmutools.c37118 import Frame, Message, Prefix, StreamConfig, encode_data
from pmutools.c37118.constants import Stat
from pmutools.c37118.frames import restamp, wire_values
from pmutools.cli.info_text import remarks
from pmutools.flow import Flow, StampSource
from pmutools.formats.source import Block, MessageSource, gather
from pmutools.measure.slots import SlotCounts
from pmutools.timebase import NS, from_ns
from pmutools.tools.inventory import Inventory, StreamInventory, take_inventory


def inventory(messages: list[Message]) -> Inventory:
    return take_inventory(MessageSource(Path("made"), "made", messages))


def only(messages: list[Message]) -> StreamInventory:
    (one,) = inventory(messages).streams
    return one


def counted(slots: list[int], block: int = 1000) -> StreamInventory:
    """Frames of these slots, at 50 a second, in this order and in blocks of this size."""
    config = stream()
    _, *messages = recording(config, len(slots), slots=slots)
    one = StreamInventory(messages[0].flow, config.idcode, config)
    for first in range(0, len(messages), block):
        for item in gather(messages[first : first + block]):
            assert isinstance(item, Block)
            one.add(item.batch)
    one.close()
    return one


# --- slots


@given(
    st.lists(st.integers(-30, 30), min_size=1, max_size=100),
    st.sets(st.integers(0, 99)),
    st.integers(1, 50),
    st.data(),
)
def test_slots_in_any_order_are_counted_as_a_set_would(
    shifts: list[int], dropped: set[int], block: int, data: st.DataObject
) -> None:
    order = sorted(range(len(shifts)), key=lambda k: (k + shifts[k], k))
    slots = [10_000 + k for k in order if k not in dropped] or [10_000]
    for at in data.draw(st.lists(st.integers(0, len(slots) - 1), max_size=5)):
        slots[at:at] = slots[at : at + 1]
    one = counted(slots, block)
    unique = set(slots)
    holes = set(range(min(unique), max(unique) + 1)) - unique
    assert one.slots.lost == len(holes)
    assert one.gaps == sum(slot - 1 not in holes for slot in holes)
    assert one.slots.duplicated == len(slots) - len(unique)
    first_time = [slot for place, slot in enumerate(slots) if slot not in slots[:place]]
    assert one.reordered == sum(slot < max(first_time[: k + 1]) for k, slot in enumerate(first_time))
    assert (one.backwards, one.slots.stale) == (0, 0)


DAY = 86_400 * 50


@pytest.mark.parametrize(
    ("slots", "told"),
    [
        ([5], (0, 0, 0, 0, 0, 0)),
        ([1, 2, 4, 3, 5], (0, 0, 0, 1, 0, 0)),
        ([1, 2, 6, 4, 7], (2, 2, 0, 1, 0, 0)),
        ([5, 3, 6], (1, 1, 0, 1, 0, 0)),
        ([1, 1, 1], (0, 0, 2, 0, 0, 0)),
        ([1, 2, 3, 2], (0, 0, 1, 0, 0, 0)),
        ([1, 2, 3, 4, DAY, DAY + 1], (1, DAY - 5, 0, 0, 0, 0)),
        ([1, 2, 3, 4, 2 * DAY, 2 * DAY + 1, 2 * DAY + 2, 2 * DAY + 3], (0, 0, 0, 0, 0, 0)),
        ([DAY, 0, 1, 2, 4], (1, 1, 0, 0, 1, 1)),
        ([DAY, DAY + 1, DAY + 2, DAY + 3, 0, 1, 2, 4], (1, 1, 0, 0, 1, 0)),
    ],
)
def test_known_orders(slots: list[int], told: tuple[int, ...]) -> None:
    for block in (1, 2, 100):
        one = counted(slots, block)
        counts = one.slots
        found = (one.gaps, counts.lost, counts.duplicated, one.reordered, one.backwards, counts.stale)
        assert found == told, block


def test_frames_of_one_stamp_and_other_values_are_told() -> None:
    messages = recording(stream(), 20)
    again = messages[5]._replace(
        frame=messages[5].frame._replace(data=recording(stream(), 1, first_slot=4)[1].frame.data)
    )
    assert remarks(only([*messages[:6], messages[5], *messages[6:]])) == ["1 frames repeat a time stamp"]
    assert remarks(only([*messages[:6], again, *messages[6:]])) == ["1 frames repeat a time stamp, 1 with other values"]


# --- streams


@pytest.mark.parametrize(("rate", "seconds"), [(60, 1), (50, 1), (120, 1), (1, 1), (-1, 1), (-5, 5), (-60, 60)])
@pytest.mark.parametrize("time_base", [1_000_000, 0xFFFFFF, 1000])
def test_a_clean_stream_of_any_rate_has_no_remarks(rate: int, seconds: int, time_base: int) -> None:
    one = only(recording(stream(rate=rate, time_base=time_base), 100))
    assert remarks(one) == []
    assert one.measured_hz == pytest.approx(rate if rate > 0 else 1 / seconds, rel=1e-3)


@pytest.mark.parametrize("rate", [50, -2, -7])
def test_missing_frames_are_counted_at_any_rate(rate: int) -> None:
    one = only(recording(stream(rate=rate), 6, slots=[0, 1, 2, 5, 6, 9]))
    assert (one.gaps, one.slots.lost) == (2, 4)
    assert remarks(one) == ["4 frames missing in 2 gaps"]


def test_an_undefined_rate_makes_no_slots() -> None:
    flow = recording(stream(), 0)[0].flow
    messages = recording(stream(), 10, flow=flow)
    undefined = stream(rate=0)
    assert undefined.rate == Fraction(0)
    one = only([message._replace(config=undefined) for message in messages])
    assert (one.frames, one.slots, remarks(one)) == (10, SlotCounts(), [])
    assert one.to_json()["rate_hz"] == 0


def test_flags_and_bad_clocks_are_counted() -> None:
    messages = recording(stream(), 20)
    for place, stat, quality in ((3, Stat.NOT_SYNCHRONISED, 6), (4, Stat.NOT_SYNCHRONISED, 15), (9, 0x8000, 0)):
        frame = bytearray(messages[place].frame.data)
        frame[14:16], frame[10] = int(stat).to_bytes(2, "big"), quality
        messages[place] = messages[place]._replace(frame=messages[place].frame._replace(data=bytes(frame)))
    one = only(messages)
    assert (one.not_synchronised, one.data_error, one.invalid) == (2, 1, 1)
    assert one.time_quality == {0: 18, 6: 1, 15: 1}
    assert remarks(one) == [
        "STAT says data error in 1 of 20 frames",
        "STAT says not synchronised in 2 of 20 frames",
        "time quality not locked: code 6 in 1, code F in 1",
    ]


def test_stamps_off_the_grid_are_counted() -> None:
    messages = recording(stream(rate=50), 20)
    for place in range(5, 15):
        soc, fracsec = from_ns(START_NS + place * NS // 50 + 7_000_000, 1_000_000)
        frame = messages[place].frame
        messages[place] = messages[place]._replace(frame=frame._replace(data=restamp(frame.data, soc, fracsec)))
    assert only(messages).slots.off_grid == 10
    assert "10 stamps are off the 50/s grid" in remarks(only(messages))


def test_a_changed_configuration_is_counted_and_leaves_no_gap() -> None:
    flow = recording(stream(), 0)[0].flow
    messages = recording(stream(), 10, flow=flow) + recording(stream(rate=25), 10, first_slot=900, flow=flow)
    one = only(messages)
    assert (one.config_changes, one.slots.lost, one.frames) == (1, 0, 20)


def test_streams_are_kept_apart_by_flow_and_idcode() -> None:
    messages = interleaved(recording(stream(1), 10), recording(stream(2), 12), recording(stream(251), 14))
    told = inventory(messages)
    assert [(one.idcode, one.frames) for one in told.streams] == [(1, 10), (2, 12), (251, 14)]
    assert told.to_json()["frames"] == {"data": 36, "cfg2": 3}


def test_a_stream_without_data_is_listed() -> None:
    one = only(recording(stream(), 0))
    assert (one.frames, remarks(one), one.measured_hz) == (0, ["no data frames"], None)
    assert one.to_json()["first"] is None


def test_an_hour_of_frames_needs_little_memory() -> None:
    config = stream(rate=60)
    sample = recording(config, 60)
    opening, second = sample[0], sample[1:]

    def hours() -> Iterator[Message]:
        yield opening
        for k in range(1000):
            for message in second:
                data = message.frame.data
                soc = int.from_bytes(data[6:10], "big") + k
                yield message._replace(frame=message.frame._replace(data=data[:6] + soc.to_bytes(4, "big") + data[10:]))

    tracemalloc.start()
    try:
        told = take_inventory(MessageSource(Path("made"), "made", hours()))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert told.streams[0].frames == 60_000
    assert remarks(told.streams[0]) == []
    assert peak < 30e6, "a block, not the file"


def test_a_stream_without_stations_is_counted() -> None:
    """NUM_PMU 0: frames of a prefix and a CHK."""
    config = StreamConfig(7, (), 50)
    frames = []
    for k in range(10):
        soc, fracsec = from_ns(START_NS + k * NS // 50, 1_000_000)
        frames.append(encode_data(wire_values(config, Prefix(0xAA01, config.frame_size, 7, soc, 0, fracsec), [])))
    flow = Flow("udp", "192.0.2.7:4713", "192.0.2.1:4713")
    one = only([Message(Frame(frame, None, StampSource.CAPTURE, 0), flow, config) for frame in frames])
    assert (one.frames, one.slots.received, one.slots.lost) == (10, 10, 0)
