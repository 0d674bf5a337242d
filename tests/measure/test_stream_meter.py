"""A stream's meter: slots, order, losses, delays, windows; the same however the frames are cut into batches."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import fields, is_dataclass
from fractions import Fraction
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.measured import MS, START_NS, arranged, batch, config, measured, rows, stamps

from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.measure.counts import Counts
from pmutools.measure.stream import STATES, Identity, Silence, State, StreamCounts, StreamMeter
from pmutools.measure.windows import WindowMeter
from pmutools.timebase import NS, slots_array


def alike(one: Any, other: Any) -> None:
    """The same counts, floats to their last bits."""
    assert type(one) is type(other)
    if isinstance(one, Counts) and is_dataclass(one):
        for item in fields(one):
            alike(getattr(one, item.name), getattr(other, item.name))
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-3)
    else:
        assert one == other


@st.composite
def wild(draw: st.DrawFn) -> Batch:
    """A stream with losses, copies, reordering, strays, set clocks and outages, in order of arrival."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    slots, arrivals, values = [], [], []
    slot, offset_ns, now_ns = 0, 0, START_NS
    for _ in range(draw(st.integers(1, 400))):
        slot, now_ns = slot + 1, now_ns + NS // 60
        if rng.random() < 0.01:
            outage = rng.choice((5, 100, 4000))
            slot, now_ns = slot + outage, now_ns + outage * NS // 60
        if rng.random() < 0.01:
            offset_ns += rng.choice((-1, 1, 37, 86_400, -86_400)) * NS
        if rng.random() < 0.1:
            continue
        for _ in range(1 + (rng.random() < 0.1)):
            stray = rng.choice((-63 * 86_400, 10**6)) * NS if rng.random() < 0.01 else 0
            slots.append(int(stamps([slot])[0]) + offset_ns + stray)
            arrivals.append(now_ns + int(rng.expovariate(1 / 2e7)))
            values.append(rng.choice((1.0, 1.0, 1.0, 2.0)))
    if not slots:
        slots, arrivals, values = [START_NS], [START_NS], [1.0]
    delays = (np.array(arrivals) - np.array(slots)) / MS
    quality = [rng.choice((0, 0, 0, 4, 0xF)) for _ in slots]
    return arranged(batch(slots, delays, values=values, time_quality=quality))


@settings(max_examples=60, deadline=None)
@given(wild(), st.integers(1, 60), st.sampled_from((1, 64)), st.booleans())
def test_chunked_is_the_whole(frames: Batch, size: int, gather: int, intervals: bool) -> None:
    whole = measured(frames)
    meter = StreamMeter(Identity("N1", 101, "udp"), frames.config, gather=gather)
    told = 0
    for at in range(0, len(frames), size):
        told += sum(len(part.unique()[0]) for part in meter.add(frames[at : at + size]))
        if intervals and at % 3 == 0:
            meter.take_interval()
        if at % 5 == 0:
            meter.result()
    result = meter.result()
    alike(result.counts, whole.counts)
    assert told <= result.counts.slots.received
    assert np.array_equal(result.floor.least_ns, whole.floor.least_ns)
    assert result.silences == whole.silences
    slots = result.counts.slots
    assert slots.frames == len(frames) == slots.received + slots.duplicated + slots.stale
    assert slots.lost == result.counts.losses.lost
    assert slots.expected == result.counts.losses.slots
    assert result.counts.order.received == slots.received


@settings(max_examples=30, deadline=None)
@given(wild(), wild())
def test_merged_counts_are_the_sum(a: Batch, b: Batch) -> None:
    one, other = measured(a).counts, measured(b).counts
    both = one.plus(other)
    assert both.slots.received == one.slots.received + other.slots.received
    assert both.delays.delay.count == one.delays.delay.count + other.delays.delay.count
    assert both.losses.periods.total == one.losses.periods.total + other.losses.periods.total
    assert both.quality.frames == len(a) + len(b)
    alike(StreamCounts().plus(one), one)


def test_a_clean_stream() -> None:
    result = measured(batch(stamps(range(600)), 20.0), end_ns=START_NS + 12 * NS)
    slots, delays = result.counts.slots, result.counts.delays
    assert (slots.expected, slots.received, slots.lost, slots.duplicated, slots.off_grid) == (600, 600, 0, 0, 0)
    assert delays.delay.summary_ms()["p99"] == pytest.approx(20.0, abs=0.02)
    assert delays.ipdv.max_ns == delays.pdv.max_ns == 0
    assert delays.jitter_ns == 0
    assert result.silent_ns == pytest.approx(12 * NS - 599 * NS / 60 - 20 * MS, abs=2)
    assert delays.interarrival.mean_ns == pytest.approx(NS / 60, rel=1e-6)


@pytest.mark.parametrize("rate", [-5, 1, 25, 30, 50, 60, 120])
def test_losses_at_any_rate(rate: int) -> None:
    of = config(rate)
    instants = [slot * NS * -rate if rate < 0 else slot * NS // rate for slot in range(200)]
    frames = batch(START_NS + np.array(instants), 20.0, of=of)
    kept = np.ones(200, bool)
    kept[[10, 11, 50]] = False
    result = measured(rows(frames, kept))
    assert (result.counts.slots.expected, result.counts.slots.lost) == (200, 3)
    assert result.counts.losses.periods.items() == [(1, 1), (2, 1)]


def test_copies_and_conflicts() -> None:
    slots = [0, 1, 1, 2, 2, 2, 3]
    result = measured(batch(stamps(slots), 20.0 + np.arange(7) * 0.1, values=[1, 1, 1, 1, 1, 5, 1]))
    counts = result.counts.slots
    assert (counts.received, counts.duplicated, counts.conflicting, counts.replicated) == (4, 3, 1, 2)
    assert result.counts.delays.delay.count == 4
    assert result.counts.order.reordered == 0


def test_stale_first_frames_spoil_nothing() -> None:
    """A device sends what it had: two frames 63 days old, then live ones."""
    live = stamps(range(600))
    frames = batch(
        np.concatenate((live[:2] - 63 * 86_400 * NS, live)),
        np.concatenate(([63 * 86_400_000.0] * 2, [20.0] * 600)),
    )
    result = measured(arranged(frames))
    counts = result.counts.slots
    assert (counts.stale, counts.expected, counts.received, counts.epochs) == (2, 600, 600, 1)
    assert result.counts.delays.delay.max_ns == 20 * MS


def test_a_clock_that_is_set_begins_an_epoch() -> None:
    times = stamps(range(600))
    times[300:] += 5 * 86_400 * NS
    delays = np.where(np.arange(600) < 300, 20.0, 20.0 - 5 * 86_400_000)
    result = measured(batch(times, delays))
    counts = result.counts.slots
    assert (counts.epochs, counts.expected, counts.received, counts.stale) == (2, 600, 600, 0)
    assert result.counts.delays.negative == 300


@pytest.mark.parametrize("by_slots", [300, -300, 60, -60])
@pytest.mark.parametrize("size", [1, 7, 512])
def test_a_clock_that_is_set_by_seconds_begins_an_epoch(by_slots: int, size: int) -> None:
    slots = np.arange(600) + np.where(np.arange(600) >= 300, by_slots, 0)
    come, times = START_NS + np.arange(600) * NS // 60, stamps(slots.tolist())
    delays = (come - times) / MS + 20 + np.random.default_rng(2).exponential(3, 600)
    frames, meter = arranged(batch(times, delays)), StreamMeter(Identity("N1", 101), config(), gather=1)
    for at in range(0, 600, size):
        meter.add(frames[at : at + size])
    result = meter.result()
    counts, (step,) = result.counts.slots, result.clock_steps
    assert (counts.epochs, counts.expected, counts.received, counts.duplicated) == (2, 600, 600, 0)
    assert step.change_ns == pytest.approx(by_slots * NS / 60, abs=10 * MS)


@pytest.mark.parametrize("behind", [300, 60])
def test_frames_that_are_behind_are_no_clock(behind: int) -> None:
    """A lump of old frames, one late frame, and a second sender whose clock is behind."""
    slots = np.arange(1200)
    late = np.full(1200, 20.0)
    late[400] += behind * 1000 / 60
    lump = np.where((slots >= 600 - behind) & (slots < 600), (600 - slots) * 1000 / 60 + 20, 20.0)
    other = batch(stamps((slots - behind).tolist()), behind * 1000 / 60 + 28)
    both = np.concatenate((stamps(slots.tolist()), other.time_ns))
    delays = np.concatenate((np.full(1200, 20.0), np.full(1200, behind * 1000 / 60 + 28)))
    for frames in (
        batch(stamps(slots.tolist()), late),
        batch(stamps(slots.tolist()), lump),
        batch(both, delays),
    ):
        result = measured(arranged(frames))
        assert (result.clock_steps, result.counts.slots.epochs) == ((), 1)
        assert result.counts.slots.lost == 0


@pytest.mark.parametrize("arrivals", [True, False])
def test_an_outage_is_loss(arrivals: bool) -> None:
    slots = [*range(100), *range(60 * 3600, 60 * 3600 + 100)]
    result = measured(batch(stamps(slots), 20.0 if arrivals else None))
    counts = result.counts
    assert (counts.slots.expected, counts.slots.received, counts.slots.outages) == (60 * 3600 + 100, 200, 1)
    assert counts.losses.periods.items()[0][1] == 1
    assert counts.losses.longest == 60 * 3600 - 100
    assert (counts.windows.empty > 0) == arrivals
    if arrivals:
        assert result.silences == (Silence(99 * NS // 60, int(np.diff(stamps([99, 60 * 3600]))[0])),)


def test_late_and_stale() -> None:
    """What comes after the wait is late; after the horizon it is lost, and stale when it comes."""
    times = stamps(range(6000))
    delays = np.full(6000, 20.0)
    delays[100], delays[200] = 500.0, 40_000.0
    counts = measured(arranged(batch(times, delays))).counts
    assert counts.delays.late == 1
    assert (counts.slots.stale, counts.slots.lost, counts.slots.received) == (1, 1, 5999)


@given(st.lists(st.integers(0, 3), min_size=1, max_size=60), st.integers(1, 9))
def test_the_longest_run_of_one_stamp(instants: list[int], size: int) -> None:
    runs = [(stamp, len(list(each))) for stamp, each in groupby(instants)]
    most = max(count for _, count in runs)
    frames, meter = batch(stamps(instants), 20.0), StreamMeter(Identity("N1", 101), config(), gather=1)
    for at in range(0, len(frames), size):
        meter.add(frames[at : at + size])
    still = meter.result().standstill
    stamp, at = next((stamp, at) for at, (stamp, count) in enumerate(runs) if count == most)
    assert (still.frames, still.stamp_ns, still.ended) == (most, stamps([stamp])[0], at < len(runs) - 1)


def test_copies_are_nothing_new() -> None:
    """One stamp for 5 s on end is a silence of that length."""
    slots = [*range(600), *[599] * 300]
    come = START_NS + np.arange(900) * NS // 60
    times = stamps(slots)
    result = measured(batch(times, (come - times) / MS), end_ns=int(come[-1]))
    assert result.silent_ns == 5 * NS
    assert result.counts.slots.received == 600


def test_off_grid() -> None:
    times = stamps(range(100))
    times[::10] += 3 * MS
    assert measured(batch(times, 20.0)).counts.slots.off_grid == 10


def test_a_config_without_rate_has_no_losses() -> None:
    times = stamps(range(100))
    counts = measured(batch(times, 20.0, of=config(0))).counts
    assert (counts.slots.expected, counts.slots.received, counts.windows.windows) == (100, 100, 0)


def test_another_rate_is_another_epoch() -> None:
    one = batch(stamps(range(60)), 20.0)
    two = batch(stamps(range(60, 90), 30, START_NS - NS), 20.0, of=config(30, cfgcnt=1))
    counts = measured([one, two]).counts
    assert (counts.slots.epochs, counts.slots.lost, counts.slots.received) == (2, 0, 90)
    assert (counts.quality.config_changes, counts.quality.cfgcnt_changes) == (1, 1)


def test_the_example_of_rfc_4737() -> None:
    """Arrivals 1 2 3 7 8 9 4 5 6 10: frames 4, 5, 6 are reordered, by 3, 4, 5; n-reordering 3, 0, 0."""
    slots = [1, 2, 3, 7, 8, 9, 4, 5, 6, 10]
    times = stamps(slots)
    arrivals = START_NS + NS + np.arange(10) * 10 * MS
    order = measured(batch(times, (arrivals - times) / MS)).counts.order
    assert order.reordered == 3
    assert order.extent.items() == [(3, 1), (4, 1), (5, 1)]
    assert order.n_reordering.items() == [(0, 2), (3, 1)]
    assert order.late_offset.min_ns == 30 * MS
    assert order.late_offset.max_ns == 50 * MS
    assert order.free_runs.items() == [(6, 1)]
    assert order.to_json()["ratio"] == 0.3


def test_loss_distances_and_periods_of_rfc_3357() -> None:
    """Of slots 0-99, 10, 11, 12, 20 and 80 are lost."""
    kept = [slot for slot in range(100) if slot not in (10, 11, 12, 20, 80)]
    losses = measured(batch(stamps(kept), 20.0)).counts.losses
    assert losses.periods.items() == [(1, 2), (3, 1)]
    assert losses.distances.items() == [(1, 2), (8, 1), (60, 1)]
    told = losses.to_json(NS / 60)
    assert told["noticeable"] == 4 / 5
    assert told["bursts"] == pytest.approx(
        {  # 10 to 20 is a burst: 7 received in a row are fewer than 16
            "gmin": 16,
            "count": 1,
            "density": 4 / 11,
            "mean_ms": 11 / 60 * 1000,
            "gap_density": 1 / 89,
            "gap_mean_ms": 89 / 60 * 1000 / 2,
        }
    )


def test_ipdv_is_undefined_next_to_a_loss() -> None:
    delays = 20.0 + np.arange(10) % 2
    kept = np.array([slot != 5 for slot in range(10)])
    counts = measured(rows(batch(stamps(range(10)), delays), kept)).counts.delays
    assert counts.ipdv.count == 7
    assert (counts.ipdv.min_ns, counts.ipdv.max_ns) == (-MS, MS)


def test_ipdv_follows_the_slots_whatever_the_order_of_arrival() -> None:
    delays = np.array([20.0, 60.0, 20.0, 20.0])
    counts = measured(arranged(batch(stamps(range(4)), delays))).counts
    assert counts.order.reordered == 1
    assert (counts.delays.ipdv.count, counts.delays.ipdv.min_ns, counts.delays.ipdv.max_ns) == (3, -40 * MS, 40 * MS)


def test_jitter_of_rfc_3550() -> None:
    delays = np.random.default_rng(5).normal(40, 2, 5000)
    frames = arranged(batch(stamps(range(5000)), delays))
    found, jitter = (frames.arrival_ns - frames.time_ns).tolist(), 0.0
    for before, now in pairwise(found):
        jitter += (abs(now - before) - jitter) / 16
    counts = measured([frames[:1000], frames[1000:]], gather=1).counts.delays
    assert counts.jitter_ns == pytest.approx(jitter, rel=1e-6)
    assert counts.owamp_jitter_ns == pytest.approx(2 * 1.645 * MS, rel=0.05)


def test_pdv_is_free_of_offset_and_of_a_step() -> None:
    delays = np.random.default_rng(5).exponential(2, 12_000)
    plain = measured(arranged(batch(stamps(range(12_000)), delays))).counts.delays.pdv
    moved = measured(arranged(batch(stamps(range(12_000)), delays - 37_000))).counts.delays
    assert moved.pdv.quantile_ns(0.99) == pytest.approx(plain.quantile_ns(0.99), rel=1e-3)
    assert moved.negative == 12_000


def test_locked_and_unlocked_apart() -> None:
    quality = np.where(np.arange(600) < 200, 0xF, 0)
    stat = np.where((np.arange(600) >= 200) & (np.arange(600) < 300), 0x2000, 0)
    delays = np.where((quality > 0) | (stat > 0), 25.0, 20.0)
    counts = measured(arranged(batch(stamps(range(600)), delays, stat=stat, time_quality=quality))).counts
    assert (counts.delays.locked.count, counts.delays.unlocked.count) == (300, 300)
    assert counts.delays.locked.max_ns == 20 * MS
    assert (counts.quality.tq_codes, counts.quality.time_quality_changes) == ({0: 400, 15: 200}, 1)
    assert counts.quality.usable == 300


def test_windows_as_in_fig_11() -> None:
    """Frames of two, zero, two, zero ... per window; and one each."""
    even = measured(batch(stamps(range(600)), 5.0)).counts.windows
    assert even.to_json() == {"0": 0, "1": 600, "2+": 0}
    delays = np.where(np.arange(600) % 2 == 0, 5.0 + 1000 / 60, 5.0)
    uneven = measured(arranged(batch(stamps(range(600)), delays))).counts.windows
    assert uneven.to_json() == {"0": 299, "1": 0, "2+": 300}
    assert uneven.empty_runs.items() == [(1, 299)]
    assert even.to_tick.mean_ns == pytest.approx((1000 / 60 - 5) * MS, rel=1e-3)


def test_without_arrivals_only_slots_are_told() -> None:
    result = measured(batch(stamps(range(100)), None))
    assert result.counts.slots.received == 100
    assert result.counts.delays.delay.count == result.counts.windows.windows == 0
    assert result.first_arrival_ns is None


def test_memory_is_bounded() -> None:
    """Stamps that leap about by days cost counters, not rings."""
    rng = np.random.default_rng(3)
    times = START_NS + rng.integers(-(10**17), 10**17, 3000)
    meter = StreamMeter(Identity("N1", 101), config())
    for at in range(0, 3000, 100):
        meter.add(batch(times[at : at + 100], 20.0))
    counts = meter.result().counts
    assert counts.slots.stale > 2900
    assert counts.slots.expected < 1000
    assert meter._slots._ring._size == 4096
    assert NO_TIME not in (counts.delays.delay.min_ns, counts.delays.delay.max_ns)


def test_every_frame_is_told_of_with_its_state() -> None:
    """For ``samples.parquet``: frames in order of arrival, and the slots found to be lost."""
    times = stamps([*range(100), *range(101, 4000)])
    delays = np.full(3999, 20.0)
    delays[50], delays[60], delays[70] = 30.0, 50.0, 500.0
    times[80] += 3 * MS
    frames = arranged(
        batch(np.append(times, times[90:92]), np.append(delays, [21.0, 21.0]), values=[1.0] * 4000 + [2.0])
    )
    meter = StreamMeter(Identity("N1", 101), frames.config)
    seen = [part for at in range(0, 4001, 300) for part in meter.add(frames[at : at + 300])] + meter.drain()
    names = [STATES[code] for part in seen for code in part.state.tolist()]
    assert len(names) == 4001
    assert Counter(names) == {
        State.ON_TIME: 3996,
        State.REORDERED: 1,
        State.LATE: 1,
        State.OFF_GRID: 1,
        State.DUPLICATE: 1,
        State.CONFLICTING: 1,
    }
    lost = np.concatenate([part.lost for part in seen])
    assert np.array_equal(lost, slots_array(stamps([100]), Fraction(60)))
    assert sum(len(part.unique()[0]) for part in seen) == meter.result().counts.slots.received == 3999


@pytest.mark.parametrize("rate", [1, 25, 30, 50, 60, 120])
def test_windows_begin_exactly_at_their_instants(rate: int) -> None:
    """A frame that comes at the very nanosecond belongs to the window that begins; one before, to the one that ends."""
    first = -(-NS // rate) if NS % rate else NS // rate
    for base_ns in (START_NS, START_NS + 300 * 365 * 86_400 * NS // 100):
        arrivals = np.array([base_ns, base_ns + first - 1, base_ns + first, base_ns + NS - 1, base_ns + NS])
        meter = WindowMeter(Fraction(rate))
        meter.add(np.sort(arrivals))
        meter.close()
        held = Counter((int(arrival) * rate) // NS for arrival in arrivals)
        windows = range(min(held), max(held) + 1)
        told = Counter(min(held[window], 2) for window in windows)
        assert meter.counts.to_json() == {"0": told[0], "1": told[1], "2+": told[2]}
        whole = WindowMeter(Fraction(rate))
        whole.add(np.array([base_ns, base_ns + 4 * 365 * 86_400 * NS]))  # the receiver's clock was set
        assert whole.counts.empty == 0


@pytest.mark.parametrize(("behind", "stale"), [(1799, 0), (1800, 1)])
def test_the_horizon_is_exact(behind: int, stale: int) -> None:
    """30 s at 60/s are 1800 slots: what comes so far behind the newest is stale."""
    slots = [slot for slot in range(4000) if slot != 3999 - behind] + [3999 - behind]
    counts = measured(batch(stamps(slots), None)).counts.slots
    assert (counts.stale, counts.lost) == (stale, stale)


@pytest.mark.parametrize(("old", "stale", "epochs"), [(3, 3, 1), (4, 0, 2)])
def test_four_frames_in_a_row_are_believed(old: int, stale: int, epochs: int) -> None:
    times = np.concatenate((stamps(range(old)) - 63 * 86_400 * NS, stamps(range(600))))
    for part in (measured(batch(times, None)), measured([batch(times[at : at + 1], None) for at in range(len(times))])):
        assert (part.counts.slots.stale, part.counts.slots.epochs) == (stale, epochs)


def test_the_ring_keeps_no_memory_of_the_turn_before() -> None:
    """Slots more than a ring's turn ago are no neighbours; a copy makes the meter look at each frame for itself."""
    slots = np.repeat(np.arange(10_000), np.where(np.arange(10_000) % 50 == 0, 2, 1))
    counts = measured(batch(stamps(slots.tolist()), 20.0 + slots * 0.001)).counts
    assert counts.slots.duplicated == 200
    assert counts.delays.ipdv.count == 9999
    assert (counts.delays.ipdv.min_ns, counts.delays.ipdv.max_ns) == (1000, 1000)


def test_a_delay_of_the_wait_is_in_time() -> None:
    delays = np.full(100, 200.0)
    delays[10] = 200.001
    assert measured(batch(stamps(range(100)), delays)).counts.delays.late == 1


@pytest.mark.parametrize(("stat", "locked"), [(0x0000, 100), (0x0010, 0), (0x0030, 0), (0x2000, 0), (0x1800, 100)])
def test_what_counts_as_locked(stat: int, locked: int) -> None:
    assert measured(batch(stamps(range(100)), 20.0, stat=stat)).counts.delays.locked.count == locked


def test_usable_frames_are_valid_whole_and_synchronised() -> None:
    frames = batch(stamps(range(100)), 20.0, time_quality=np.where(np.arange(100) < 10, 4, 0))
    frames.valid[10:30] = False
    frames.phasors[30:35] = complex(np.nan, np.nan)
    frames.frequency[40:42] = np.nan
    quality = measured(frames).counts.quality
    assert (quality.usable, quality.invalid, quality.absent) == (63, 20, 7)
    told = quality.to_json(200, 100)
    assert (told["availability"], told["completeness"]) == (0.5, 63 / 200)
