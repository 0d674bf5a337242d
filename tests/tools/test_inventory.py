"""What ``pmu info`` counts: slots filled, missing, repeated, overtaken; flags; whatever the order and the rate."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.playing import START_NS, interleaved, recording, stream

from pmutools.c37118 import Message
from pmutools.c37118.constants import Stat
from pmutools.c37118.frames import restamp
from pmutools.cli.info_text import remarks
from pmutools.formats.source import MessageSource
from pmutools.timebase import NS, from_ns
from pmutools.tools.inventory import Inventory, StreamInventory, take_inventory
from pmutools.tools.slots import HOLES, NEAR, SlotCounts


def inventory(messages: list[Message]) -> Inventory:
    return take_inventory(MessageSource(Path("made"), "made", messages))


def only(messages: list[Message]) -> StreamInventory:
    (one,) = inventory(messages).streams
    return one


def counted(slots: list[int], block: int = 1000) -> SlotCounts:
    counts = SlotCounts()
    for first in range(0, len(slots), block):
        counts.add(np.array(slots[first : first + block], np.int64))
    return counts


# --- slots


@given(
    st.lists(st.integers(-30, 30), min_size=1, max_size=200),
    st.sets(st.integers(0, 199)),
    st.integers(1, 50),
    st.data(),
)
def test_slots_in_any_order_are_counted_as_a_set_would(
    shifts: list[int], dropped: set[int], block: int, data: st.DataObject
) -> None:
    order = sorted(range(len(shifts)), key=lambda k: (k + shifts[k], k))
    slots = [10_000 + k for k in order if k not in dropped]
    for at in data.draw(st.lists(st.integers(0, max(len(slots) - 1, 0)), max_size=5)):
        slots[at:at] = slots[at : at + 1]
    counts = counted(slots, block)
    unique = set(slots)
    holes = set(range(min(unique), max(unique) + 1)) - unique if unique else set()
    assert counts.missing == len(holes)
    assert counts.gaps == sum(slot - 1 not in holes for slot in holes)
    assert counts.duplicates == len(slots) - len(unique)
    first_time = [slot for place, slot in enumerate(slots) if slot not in slots[:place]]
    assert counts.reordered == sum(slot < max(first_time[: k + 1]) for k, slot in enumerate(first_time))
    assert counts.backwards == 0


@pytest.mark.parametrize(
    ("slots", "told"),
    [
        ([], (0, 0, 0, 0, 0)),
        ([5], (0, 0, 0, 0, 0)),
        ([1, 2, 4, 3, 5], (0, 0, 0, 1, 0)),
        ([1, 2, 6, 4, 7], (2, 2, 0, 1, 0)),
        ([5, 3, 6], (1, 1, 0, 1, 0)),
        ([1, 1, 1], (0, 0, 2, 0, 0)),
        ([1, 2, 3, 2], (0, 0, 1, 0, 0)),
        ([0, 5_000_000, 5_000_001], (1, 4_999_999, 0, 0, 0)),
        ([5_000_000, 0, 1, 2, 4], (1, 1, 0, 0, 1)),
    ],
)
def test_known_orders(slots: list[int], told: tuple[int, ...]) -> None:
    for block in (1, 2, 100):
        counts = counted(slots, block)
        assert (counts.gaps, counts.missing, counts.duplicates, counts.reordered, counts.backwards) == told


def test_what_is_remembered_of_missing_slots_is_bounded() -> None:
    counts = counted([3 * k for k in range(20 * HOLES)])
    assert counts.missing == 2 * (20 * HOLES - 1)
    assert len(counts._holes) <= HOLES
    assert len(counted([0, NEAR + 2])._holes) == 0, "a gap too long to be filled by what comes late"


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
    assert (one.slots.gaps, one.slots.missing) == (2, 4)
    assert remarks(one) == ["4 frames missing in 2 gaps"]


def test_an_undefined_rate_makes_no_slots() -> None:
    flow = recording(stream(), 0)[0].flow
    messages = recording(stream(), 10, flow=flow)
    undefined = stream(rate=0)
    assert undefined.rate == Fraction(0)
    one = only([message._replace(config=undefined) for message in messages])
    assert (one.frames, one.slots, one.off_grid) == (10, SlotCounts(), 0)
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
    assert only(messages).off_grid == 10
    assert "10 stamps are off the 50/s grid" in remarks(only(messages))


def test_a_changed_configuration_is_counted_and_leaves_no_gap() -> None:
    flow = recording(stream(), 0)[0].flow
    messages = recording(stream(), 10, flow=flow) + recording(stream(rate=25), 10, first_slot=900, flow=flow)
    one = only(messages)
    assert (one.config_changes, one.slots.missing, one.frames) == (1, 0, 20)


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
    assert told.streams[0].slots == SlotCounts(_low=told.streams[0].slots._low, _high=told.streams[0].slots._high)
    assert peak < 30e6, "a block, not the file"
