"""The meters against the definitions written out plainly, frame by frame, over whole lists."""

from __future__ import annotations

import random
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.measured import MS, START_NS, arranged, batch, config, measured

from pmutools.timebase import NS


@st.composite
def arrivals(draw: st.DrawFn) -> list[tuple[int, int, float]]:
    """(slot, arrival, value) in order of arrival: losses, copies and reordering, all within the horizon."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    loss, copies, spread = rng.choice((0, 0.02, 0.3, 0.7)), rng.choice((0, 0.1)), rng.choice((0, 1e7, 2e8))
    count = draw(st.integers(5, 300))
    found = []
    for slot in range(count):
        if rng.random() < loss and slot >= 5:  # the first four frames make an epoch believed
            continue
        for _ in range(1 + (rng.random() < copies)):
            late_ns = int(rng.expovariate(1 / spread)) if spread else 0
            found.append((slot, START_NS + slot * NS // 60 + 20 * MS + late_ns, rng.choice((1.0, 2.0))))
    return sorted(found, key=lambda row: row[1])


@settings(max_examples=200, deadline=None)
@given(arrivals())
def test_by_definition(rows: list[tuple[int, int, float]]) -> None:
    times = np.array([START_NS + (slot * NS + 30) // 60 for slot, *_ in rows])
    delays = (np.array([arrival for _, arrival, _ in rows]) - times) / MS
    frames = batch(times, delays, values=[value for *_, value in rows])
    counts = measured([frames[at : at + 7] for at in range(0, len(rows), 7)], gather=20).counts

    # slots: RFC 7680, RFC 5560
    first: dict[int, tuple[int, float]] = {}
    conflicting = 0
    unique: list[tuple[int, int]] = []
    for slot, arrival, value in rows:
        if slot in first:
            conflicting += first[slot][1] != value
        else:
            first[slot] = (arrival, value)
            unique.append((slot, arrival))
    low, high = min(first), max(first)
    copies = Counter(slot for slot, *_ in rows)
    assert counts.slots.expected == high - low + 1
    assert counts.slots.received == len(first)
    assert counts.slots.duplicated == len(rows) - len(first)
    assert counts.slots.conflicting == conflicting
    assert counts.slots.replicated == sum(count > 1 for count in copies.values())

    # delays and their changes: RFC 7679, RFC 3393
    found = {slot: int(arrival - (START_NS + (slot * NS + 30) // 60)) for slot, (arrival, _) in first.items()}
    changes = [found[slot] - found[slot - 1] for slot in found if slot - 1 in found]
    assert counts.delays.delay.count == len(found)
    assert counts.delays.ipdv.count == len(changes)
    if changes:
        assert (counts.delays.ipdv.min_ns, counts.delays.ipdv.max_ns) == (min(changes), max(changes))
        assert counts.delays.ipdv.mean_ns == pytest.approx(np.mean(changes), abs=1.0)
    assert counts.delays.late == sum(delay > 200 * MS for delay in found.values())
    gaps = np.diff([arrival for _, arrival in unique])
    assert counts.delays.interarrival.count == len(gaps)
    assert counts.delays.interarrival.max_ns == max(gaps, default=None)

    # order: RFC 4737
    expected, reordered, extents, offsets, depths = -1, 0, [], [], []
    for at, (slot, arrival) in enumerate(unique):
        if slot >= expected:
            expected = slot + 1
            continue
        reordered += 1
        j = next(j for j in range(at) if unique[j][0] > slot)
        extents.append(at - j)
        offsets.append(arrival - unique[j][1])
        depths.append(next((n for n in range(at) if unique[at - 1 - n][0] < slot), at))
    assert counts.order.reordered == reordered
    assert counts.order.extent.total == sum(extents)
    assert counts.order.n_reordering.total == sum(depths)
    assert counts.order.late_offset.count == len(offsets)
    assert counts.order.late_offset.max_ns == max(offsets, default=None)

    # losses: RFC 3357
    lost = [slot for slot in range(low, high + 1) if slot not in first]
    periods: list[int] = []
    for slot in lost:
        if periods and slot - 1 not in first:
            periods[-1] += 1
        else:
            periods.append(1)
    assert counts.losses.lost == len(lost)
    assert Counter(dict(counts.losses.periods.items())) == Counter(periods)
    assert Counter(dict(counts.losses.distances.items())) == Counter(np.diff(lost).tolist())

    # bursts and gaps: RFC 3611, Gmin 16
    bursts: list[list[int]] = []
    for slot in lost:
        if bursts and slot - bursts[-1][-1] - 1 < 16:
            bursts[-1].append(slot)
        else:
            bursts.append([slot])
    bursts = [burst for burst in bursts if len(burst) > 1]
    assert counts.losses.bursts == len(bursts)
    assert counts.losses.burst_slots == sum(burst[-1] - burst[0] + 1 for burst in bursts)
    assert counts.losses.burst_lost == sum(map(len, bursts))

    # control windows of the paper's Fig. 11
    held = Counter((arrival * 60) // NS for _, arrival in unique)
    windows = range(min(held), max(held) + 1)
    told = Counter(min(held[window], 2) for window in windows)
    assert counts.windows.to_json() == {"0": told[0], "1": told[1], "2+": told[2]}


def test_the_floor_by_definition() -> None:
    """PDV is the delay above the least of its own bucket and the six before, up to the frame itself."""
    rng = np.random.default_rng(4)
    delays = 40 + np.arange(4500) * 0.02 + rng.exponential(1, 4500)  # the floor rises: what is forgotten shows
    frames = arranged(batch([START_NS + slot * NS // 50 for slot in range(4500)], delays, of=config(50)))
    arrival, delay = frames.arrival_ns.tolist(), (frames.arrival_ns - frames.time_ns).tolist()
    least, most, total = 0, 0, 0
    for at in range(4500):
        bucket = arrival[at] // (10 * NS)
        floor = min(delay[j] for j in range(max(0, at - 4000), at + 1) if arrival[j] // (10 * NS) >= bucket - 6)
        above = delay[at] - floor
        least, most, total = min(least, above), max(most, above), total + above
    pdv = measured([frames[:1700], frames[1700:]]).counts.delays.pdv
    assert (pdv.min_ns, pdv.max_ns) == (least, most)
    assert pdv.mean_ns == pytest.approx(total / 4500)
