"""Duplicates, reordering, bit rate and slots."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from support.impairment import PERIOD_NS, delays_ms, frame, options, pipeline, play

from pmutools.impair.outgoing import Fate, Outgoing
from pmutools.impair.stages import parse_setting


def departures(rows: list[Outgoing]) -> list[int]:
    """Indices in the order in which frames leave; equal times leave in the order given."""
    return [row.index for row in sorted(rows, key=lambda row: row.offset_ns)]


def test_duplicates() -> None:
    n = 20_000
    rows = play(pipeline("duplicate=5% count=2"), n)
    copies = Counter(row.index for row in rows)
    doubled = sum(count == 3 for count in copies.values())
    assert set(copies.values()) == {1, 3} and len(copies) == n
    assert abs(doubled / n - 0.05) < 5 * math.sqrt(0.0475 / n)
    assert [row.copy for row in rows if copies[row.index] == 3] == [0, 1, 2] * doubled


def test_a_lost_frame_has_no_duplicates() -> None:
    rows = play(pipeline(options("loss=50%", "duplicate=100%")), 400)
    copies = Counter(row.index for row in rows)
    assert {copies[row.index] for row in rows if row.fate is Fate.LOST} == {1}
    assert {copies[row.index] for row in rows if row.fate is Fate.SENT} == {2}


@pytest.mark.parametrize("depth", [1, 2, 5])
def test_a_late_frame_is_overtaken_by_exactly_so_many(depth: int) -> None:
    rows = play(pipeline(f"reorder=100% depth={depth}"), 4 * (depth + 1))
    order = [row.index for row in rows]
    group = [*range(1, depth + 1), 0]
    assert order == [start + k for start in range(0, len(rows), depth + 1) for k in group]
    assert departures(rows) == order
    assert {row.faults for row in rows} == {"", f"reorder:{depth}"}


def test_reordering_extent_holds_whatever_the_delays() -> None:
    """RFC 4737: frame s at place i is reordered if an earlier one is above it; extent i - first such place."""
    rows = play(pipeline(options("reorder=5% depth=3", "delay=uniform(0, 10)")), 5000)
    order = departures(rows)
    marked = {row.index for row in rows if "reorder:3" in row.marks}
    assert abs(len(marked) / 5000 - 0.05 / (1 + 3 * 0.05)) < 5 * math.sqrt(0.05 / 5000)
    for place, index in enumerate(order):
        above = [at for at in range(max(0, place - 8), place) if order[at] > index]
        assert bool(above) is (index in marked)
        if above:
            assert place - above[0] == 3


def test_reordering_without_its_draws_changes_nothing_else() -> None:
    plain = {row.index: row.delay_ns for row in play(pipeline("delay=normal(100, 5)"), 500)}
    mixed = play(pipeline(options("delay=normal(100, 5)", "reorder=10%")), 500)
    assert {row.index: row.delay_ns for row in mixed} == plain


def test_early_frames_lose_their_delay_as_in_netem() -> None:
    rows = play(pipeline(options("delay=constant(100)", "reorder=100% gap=4 mode=early")), 100)
    early = [row.index for row in rows if row.faults == "reorder:early"]
    assert early == list(range(0, 100, 5))
    assert all(row.offset_ns == row.index * PERIOD_NS for row in rows if row.index in early)
    assert {row.delay_ns for row in rows if row.index not in early} == {100_000_000}


def test_the_last_frame_is_not_forgotten() -> None:
    rows = play(pipeline("reorder=100% depth=5"), 3)
    assert [row.index for row in rows] == [1, 2, 0]
    assert rows[-1].offset_ns == rows[1].offset_ns and rows[-1].faults == "reorder:2"


def test_rate_is_serialisation_and_fifo() -> None:
    """52 bytes + 28 at 64 kbit/s take 10 ms; two in a row at one time take 20."""
    faults = pipeline("rate=64k overhead=28")
    rows = [row for index, due in enumerate((0, 0, 5, 100)) for row in faults.apply(index, frame(index), due * 10**6)]
    assert [row.offset_ns / 1e6 for row in rows] == [10, 20, 30, 110]
    assert [row.faults for row in rows] == ["rate:10ms", "rate:20ms", "rate:25ms", "rate:10ms"]


def test_rate_keeps_the_order_of_arrival() -> None:
    rows = play(pipeline(options("delay=uniform(0, 100)", "rate=1M")), 500)
    assert departures(rows) == list(range(500))


def test_a_full_queue_loses() -> None:
    """At half the needed rate, half is lost in the long run and the wait never exceeds the queue."""
    needed = 52 * 8 * 60
    rows = play(pipeline(f"rate={needed / 2} queue=10"), 2000)
    lost = [row for row in rows if row.fate is Fate.LOST]
    assert abs(len(lost) / 2000 - 0.5) < 0.01
    assert {row.faults for row in lost} == {"rate:full"}
    wait = max(row.offset_ns - row.index * PERIOD_NS for row in rows if row.fate is Fate.SENT)
    assert wait <= 10 * 2 * PERIOD_NS + 1000


def test_slots_release_in_bursts() -> None:
    rows = play(pipeline("slot=100"), 60)
    times = [row.offset_ns for row in rows]
    assert all(time % 100_000_000 == 0 for time in times) and times == sorted(times)
    assert all(0 <= time - index * PERIOD_NS < 100_000_000 for index, time in enumerate(times))
    assert times[0] == 0 and set(list(Counter(times[1:]).values())[:-1]) == {6}


def test_slots_of_few_frames_and_drawn_intervals() -> None:
    rows = play(pipeline("slot=constant(50) frames=2"), 300)
    assert max(Counter(row.offset_ns for row in rows).values()) == 2
    assert rows[-1].offset_ns == 150 * 50_000_000
    rows = play(pipeline("slot=uniform(80, 120)"), 6000)
    gaps = np.diff(sorted({row.offset_ns for row in rows})) / 1e6
    assert gaps.min() >= 80 and gaps.max() <= 120
    assert abs(gaps.mean() - 100) < 5 * 40 / math.sqrt(12 * len(gaps))


def test_the_link_comes_after_the_delay() -> None:
    rows = play(pipeline(options("delay=constant(30)", "slot=constant(100)")), 60)
    assert all(row.offset_ns % 100_000_000 == 0 for row in rows)
    assert set(delays_ms(rows)) == {30.0}


@pytest.mark.parametrize(
    ("option", "text", "message"),
    [
        ("duplicate", "5% count=0", "count: 0 is out of range; it must be 1 to 64"),
        ("duplicate", "5%\n6%", "only one of these a stream; give it once, without '+'"),
        ("reorder", "5% mode=swap", "mode: 'swap' is not one of late, early"),
        ("rate", "fast", "'fast' is not a bit rate; write 64k or 1.5M (bit/s)"),
        ("rate", "0", "'0' is not a bit rate; write 64k or 1.5M (bit/s)"),
        ("slot", "100ms", "'100ms' is not a number"),
    ],
)
def test_errors(option: str, text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_setting(option, text)
    assert str(error.value) == message
