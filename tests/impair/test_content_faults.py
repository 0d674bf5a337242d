"""Content faults: exactly the named bytes change, CHK fits or does not as it should, receivers see what is meant."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.impairment import CONFIG, CONFIG_FRAME, PERIOD_NS, frame, options, pipeline, play

from pmutools.c37118 import decode_data, decode_prefix
from pmutools.c37118.checksum import chk
from pmutools.c37118.constants import LeapFlag, stat_pmu_tq, stat_unlocked_time
from pmutools.errors import ChecksumError, SettingsError
from pmutools.impair import Outgoing, Pipeline
from pmutools.impair.content import KINDS
from pmutools.impair.stages import parse_setting

SIZE = CONFIG.frame_size


def corrupted(text: str, count: int = 1, first: int = 0) -> list[Outgoing]:
    return play(pipeline(options(f"corrupt={text}")), count, first)


def differing_bits(a: bytes, b: bytes) -> list[int]:
    assert len(a) == len(b)
    return np.flatnonzero(
        np.unpackbits(np.frombuffer(a, np.uint8)) ^ np.unpackbits(np.frombuffer(b, np.uint8))
    ).tolist()


def test_one_bit_in_the_given_share_of_frames() -> None:
    n = 10_000
    rows = corrupted("10%", n)
    hit = [row for row in rows if row.marks]
    assert abs(len(hit) / n - 0.1) < 5 * math.sqrt(0.09 / n)
    places = Counter[int]()
    for row in rows:
        bits = differing_bits(row.data, frame(row.index))
        assert len(bits) == (1 if row.marks else 0)
        places.update(bit // 8 for bit in bits)
        if row.marks:
            assert row.faults == "corrupt:1bit"
            with pytest.raises((ChecksumError, ValueError)):
                decode_data(row.data, CONFIG)
    expected = len(hit) / SIZE
    assert sum((places[k] - expected) ** 2 / expected for k in range(SIZE)) < SIZE - 1 + 5 * math.sqrt(2 * (SIZE - 1))


@given(st.integers(1, 64), st.integers(0, 10_000))
def test_so_many_different_bits(count: int, index: int) -> None:
    (row,) = corrupted(f"bits({count})", first=index)
    assert len(differing_bits(row.data, frame(index))) == count
    assert row.faults == f"corrupt:{count}bit"


@pytest.mark.parametrize(
    ("where", "first", "last"),
    [
        ("field=sync", 0, 1),
        ("field=framesize", 2, 3),
        ("field=idcode", 4, 5),
        ("field=soc", 6, 9),
        ("field=fracsec", 10, 13),
        ("field=stat station=NORTH", 14, 15),
        ("field=phasors station=NORTH", 16, 31),
        ("field=freq station=1", 32, 35),
        ("field=dfreq station=NORTH", 36, 39),
        ("field=stat station=SOUTH", 40, 41),
        ("field=phasors station=SOUTH", 42, 45),
        ("field=values station=2", 42, 49),
        ("field=chk", 50, 51),
        ("bytes=10-12", 10, 12),
        ("bytes=7", 7, 7),
        ("bytes=48-999", 48, 51),
    ],
)
def test_bits_stay_where_they_are_told(where: str, first: int, last: int) -> None:
    rows = corrupted(f"bits(2) {where}", 400)
    touched = {bit // 8 for row in rows for bit in differing_bits(row.data, frame(row.index))}
    assert touched == set(range(first, last + 1))


def test_wrong_chk() -> None:
    for row in corrupted("chk", 300):
        assert row.data[:-2] == frame(row.index)[:-2] and row.data[-2:] != frame(row.index)[-2:]
    assert corrupted("chk(0)")[0].data[-2:] == b"\0\0"


def test_prefix_words() -> None:
    (row,) = corrupted("sync")
    assert row.data == b"\xab\x01" + frame(0)[2:] and row.faults == "corrupt:sync=0xab01"
    (row,) = corrupted("framesize(40)")
    assert row.data == frame(0)[:2] + b"\0\x28" + frame(0)[4:]
    (row,) = corrupted("idcode(102)")
    assert decode_prefix(row.data).idcode == 102 and chk(row.data) == 0
    (row,) = corrupted("idcode(102) chk=keep")
    assert decode_prefix(row.data).idcode == 102 and row.data[-2:] == frame(0)[-2:]


def test_truncated() -> None:
    (row,) = corrupted("truncate(20)")
    assert row.data == frame(0)[:20] and row.faults == "corrupt:truncate=20"
    sizes = [len(row.data) for row in corrupted("truncate", 2000)]
    assert set(sizes) == set(range(1, SIZE))
    assert abs(np.mean(sizes) - SIZE / 2) < 5 * SIZE / math.sqrt(12 * 2000)


def test_a_frame_cut_short_is_left_alone_afterwards() -> None:
    (row,) = corrupted("truncate(10)\nstat(test)\nquality(15)\nbits(3)")
    assert row.faults == "corrupt:truncate=10" and row.data == frame(0)[:10]


def test_stat() -> None:
    (row,) = corrupted("stat(not_synchronised|0x0030) station=SOUTH")
    data = decode_data(row.data, CONFIG)
    assert (data.stat(0), data.stat(1)) == (0, 0x2030)
    (row,) = corrupted("stat(do_not_use)\nstat(clear=0x8000) station=NORTH")
    data = decode_data(row.data, CONFIG)
    assert (data.stat(0), data.stat(1)) == (0x4000, 0xC000)
    assert row.faults == "corrupt:stat+0xc000-0x0000,corrupt:stat+0x0000-0x8000"
    (row,) = corrupted("stat(unlocked_1000s|pmu_tq_unknown|sorted_by_arrival|config_change)")
    stat = decode_data(row.data, CONFIG).stat(1)
    assert (stat_unlocked_time(stat), stat_pmu_tq(stat), stat & ~0x01F0) == (3, 7, 0x1400)


def test_stamps() -> None:
    for row in corrupted("stamp(500)", 120):
        assert decode_data(row.data, CONFIG).time_ns - decode_data(frame(row.index), CONFIG).time_ns == 500_000_000
    (row,) = corrupted("stamp(-0.5)", first=60)
    assert decode_data(row.data, CONFIG).time_ns == decode_data(frame(60), CONFIG).time_ns - 500_000
    rows = corrupted("stamp(drift=100)", 1200)
    last = decode_data(rows[-1].data, CONFIG).time_ns - decode_data(frame(1199), CONFIG).time_ns
    assert abs(last - 100e-6 * 1199 * PERIOD_NS) <= 500
    assert rows[-1].faults == "corrupt:stamp+1.998ms"


def test_leap_second_errors() -> None:
    """SOC alone moves, by whole seconds, whatever TIME_BASE; flags replace those sent, MSG_TQ stays."""
    (row,) = corrupted("leap(1)", first=7)
    data = decode_data(row.data, CONFIG)
    assert data.time_ns - decode_data(frame(7), CONFIG).time_ns == 10**9 and data.time_quality == 0
    assert row.faults == "corrupt:leap+1s"
    (row,) = corrupted("quality(0x7B)\nleap(-1, flags=pending|direction_delete)", first=7)
    data = decode_data(row.data, CONFIG)
    assert data.time_ns - decode_data(frame(7), CONFIG).time_ns == -(10**9)
    assert data.time_quality == LeapFlag.PENDING | LeapFlag.DIRECTION_DELETE | 0x0B
    (row,) = corrupted("quality(0x7B)\nleap(flags=0)")
    assert decode_data(row.data, CONFIG).time_quality == 0x0B
    (row,) = Pipeline(options("corrupt=leap(1)"), "N1").apply(0, frame(0), 0)
    assert decode_data(row.data, CONFIG).time_ns == decode_data(frame(60), CONFIG).time_ns


def test_repeated_stamp() -> None:
    rows = corrupted("repeat when=3-5", 8)
    times = [decode_data(row.data, CONFIG).time_ns for row in rows]
    true = [decode_data(frame(index), CONFIG).time_ns for index in range(8)]
    assert times == [*true[:3], true[2], true[2], true[2], *true[6:]]
    assert [row.faults for row in rows[2:4]] == ["", "corrupt:repeat"]
    (row,) = corrupted("repeat")
    assert row.data == frame(0) and row.faults == ""


def test_a_frame_cut_short_is_no_model_for_the_next() -> None:
    rows = corrupted("truncate(10) when=2\nrepeat when=3", 4)
    assert decode_data(rows[3].data, CONFIG).time_ns == decode_data(frame(1), CONFIG).time_ns


def test_quality() -> None:
    (row,) = corrupted("quality(0x4F)")
    assert decode_data(row.data, CONFIG).time_quality == 0x4F


def test_values() -> None:
    (row,) = corrupted("value(nan)", first=9)
    for station in decode_data(row.data, CONFIG).stations:
        assert all(math.isnan(part) for phasor in station.phasors for part in (phasor.real, phasor.imag))
        assert math.isnan(station.frequency) and math.isnan(station.rocof) and station.stat == 0
    (row,) = corrupted("value(zero) field=phasors station=SOUTH", first=9)
    data = decode_data(row.data, CONFIG)
    assert data.phasor(2) == 0 and data.phasor(0) != 0 and data.frequency(1) != 60
    assert row.faults == "corrupt:zero(phasors)"


def test_frozen_values_are_those_of_the_last_good_frame() -> None:
    rows = corrupted("value(frozen) station=NORTH when=3-5", 8)
    found = [decode_data(row.data, CONFIG).phasor(0).real for row in rows]
    assert found == [1e5 + k for k in (0, 1, 2, 2, 2, 2, 6, 7)]
    assert [decode_data(row.data, CONFIG).phasor(2).real for row in rows] == [
        decode_data(frame(index), CONFIG).phasor(2).real for index in range(8)
    ]
    times = [decode_data(row.data, CONFIG).time_ns for row in rows]
    assert times == [decode_data(frame(index), CONFIG).time_ns for index in range(8)]


def test_every_kind_is_repeatable_and_leaves_the_rest_alone() -> None:
    kinds = {
        "idcode": "idcode(5)",
        "quality": "quality(1)",
        "stat": "stat(1)",
        "value": "value(nan)",
        "leap": "leap(1)",
    }
    for kind in KINDS:
        rows, again = (corrupted(f"30% {kinds.get(kind, kind)}", 200) for _ in range(2))
        assert rows == again
        assert any(row.marks for row in rows)
        assert all(row.data == frame(row.index) for row in rows if not row.marks)
    picked = [{row.index for row in corrupted(f"{p}% chk", 1000) if row.marks} for p in (5, 10)]
    assert picked[0] < picked[1]


def test_control_frames() -> None:
    faults = pipeline("corrupt=chk when=type config")
    (row,) = faults.apply(0, CONFIG_FRAME, 0)
    assert row.marks and chk(row.data) != 0
    (row,) = faults.apply(0, frame(0), 0)
    assert not row.marks
    (row,) = pipeline("corrupt=stat(test) when=type any").apply(0, CONFIG_FRAME, 0)
    assert row.data == CONFIG_FRAME


def test_both_copies_carry_the_fault() -> None:
    first, second = play(pipeline(options("corrupt=50% bits(3)", "duplicate=100%")), 1, 4)[:2]
    assert first.data == second.data and first.marks == second.marks


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1% bitz(3)", "'bitz' is no content fault; did you mean 'bits'?"),
        ("bits(65)", "bits n: 65 is out of range; it must be 1 to 64"),
        (
            "1% field=frequency",
            "field: 'frequency' is not one of sync, framesize, idcode, soc, fracsec, stat, phasors,",
        ),
        ("1% field=stat bytes=3", "field= and bytes= both say where; give one"),
        ("bytes=9-3", "the value is missing; write VALUE [field=...] [station=...] [bytes=...] [chk=...] [when=...]"),
        ("1% bytes=9-3", "bytes: '9-3' is not a range of byte positions like 10-20"),
        (
            "stat(not_synchronized)",
            "stat set: 'not_synchronized' is no STAT flag or mask; did you mean 'not_synchronised'?",
        ),
        ("1% chk=maybe", "chk: 'maybe' is not one of keep, fix"),
        ("value(wrong)", "value what: 'wrong' is not one of nan, zero, frozen"),
        ("idcode", "value is missing; write idcode(value)"),
        ("leap", "leap: nothing is wrong; give seconds or flags, as in leap(1) or leap(flags=pending)"),
        ("leap(flags=pendign)", "leap flags: 'pendign' is no leap flag or mask; did you mean 'pending'?"),
        ("leap(flags=0x80)", "leap flags: 0x80 is out of range; it must be 0 to 112"),
    ],
)
def test_grammar_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_setting("corrupt", text)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stat(test) station=SUOTH", "stream N1: corrupt: no station 'SUOTH'; did you mean 'SOUTH'?"),
        ("1% field=analogs", "stream N1: corrupt: the stream has no analogs"),
        (
            "value(nan) field=stat",
            "stream N1: corrupt: value: field=stat is not measured; known: phasors, freq, dfreq,",
        ),
    ],
)
def test_what_this_stream_cannot_have(text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        pipeline(options(f"corrupt={text}"))
    assert str(error.value).startswith(message)


@pytest.mark.parametrize("text", ["stat(test)", "1% field=freq", "stamp(5)", "value(nan)"])
def test_no_configuration(text: str) -> None:
    with pytest.raises(SettingsError, match="configuration"):
        Pipeline(options(f"corrupt={text}"), "N1")
    Pipeline(options("corrupt=1% bits(2) field=soc"), "N1")
