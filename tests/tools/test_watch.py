"""What live streams do just now, against the meters of the characterizer, and what the network says of them."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.measured import MS, batch, config, stamps
from support.watched import PER_ROUND, ROUND_NS, block, stream, watched

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.demux import Loss
from pmutools.c37118.framer import Skipped, SkipReason
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.measure.stream import Identity, StreamMeter
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS
from pmutools.tools.watch import Row, Snapshot, StreamState, Watch
from pmutools.tools.watch.recent import DELAYS
from pmutools.tools.watch.slots import CONFIRM, REACH

URL = "tcp://10.9.9.9:4712"
SEED = np.random.default_rng(5)


def rows(snapshot: Snapshot) -> dict[str, Row]:
    return {row.name: row for row in map(snapshot.row, range(len(snapshot)))}


def after(*blocks: list[Block], every_ns: int = ROUND_NS) -> Snapshot:
    """The streams after rounds of blocks."""
    watch = Watch()
    for number, of_round in enumerate(blocks, 1):
        watch.add(of_round, number * every_ns)
    return watch.look(len(blocks) * every_ns)


# --- the same as the meters --------------------------------------------------------------------------------------

Frames = list[tuple[int, float]]


@st.composite
def arrivals(draw: st.DrawFn) -> Frames:
    """(slot, delay) of frames in order of arrival: some lost, some twice, some late by up to two hundred slots."""
    count = draw(st.integers(1, 120))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    frames = [(0, 20.0)]
    for slot in range(1, count):
        copies = random.choice([0, 1, 1, 1, 1, 2])
        frames += [(slot, float(random.choice([20, 25, 199, 201, 3000]))) for _ in range(copies)]
    place = [slot + (delay / 1000) * 60 for slot, delay in frames]
    return [frames[at] for at in np.argsort(place, kind="stable")]


@settings(max_examples=40, deadline=None)
@given(st.lists(arrivals(), min_size=1, max_size=4), st.integers(1, 40))
def test_counts_are_those_of_the_meter(streams: list[Frames], size: int) -> None:
    watch, meters = Watch(), []
    for number, frames in enumerate(streams):
        _, of = stream(number)
        meter = StreamMeter(Identity(str(number), of.idcode), of)
        meter.add(batch(stamps(slot for slot, _ in frames), [delay for _, delay in frames], of=of))
        meters.append(meter)
    for at in range(0, max(map(len, streams)), size):
        parts = [(number, frames[at : at + size]) for number, frames in enumerate(streams)]
        blocks = [
            block(number, [slot for slot, _ in part], [delay for _, delay in part]) for number, part in parts if part
        ]
        watch.add(blocks, (at // size + 1) * ROUND_NS)
    snapshot = watch.look(10**12)
    for number, meter in enumerate(meters):
        counts, row = meter.result().counts, snapshot.row(number)
        assert row.frames == counts.slots.frames
        assert row.lost == counts.slots.lost
        assert row.duplicated == counts.slots.duplicated
        assert row.late == counts.delays.late
        if counts.delays.delay.count > 1:
            assert row.jitter_ms == pytest.approx(counts.delays.jitter_ns / MS, rel=1e-6)
            assert row.all_max_ms == pytest.approx((counts.delays.delay.max_ns or 0) / MS, rel=1e-6)
            for share, told in ((0.5, row.all_p50_ms), (0.99, row.all_p99_ms)):
                exact = counts.delays.delay.quantile_ns(share)
                assert exact is not None
                assert told == pytest.approx(exact / MS, rel=0.04)


@pytest.mark.parametrize("rate", [1, 25, 50, 60, 100, 240])
def test_slots_at_any_rate(rate: int) -> None:
    slots = [slot for slot in range(4 * rate) if slot % 7 != 3]
    row = after([block(0, slots, rate=rate)]).row(0)
    assert (row.configured_hz, row.lost) == (rate, len([slot for slot in range(slots[-1]) if slot % 7 == 3]))


def test_seconds_a_frame_and_no_rate_at_all() -> None:
    of = config(-10)
    time_ns = stamps([0, 10, 30], 1)
    row = after([Block(stream(0)[0], batch(time_ns, of=of))]).row(0)
    assert (row.configured_hz, row.lost) == (0.1, 1)
    row = after([Block(stream(0)[0], batch(time_ns, of=config(0)))]).row(0)
    assert math.isnan(row.configured_hz)
    assert row.lost == 0


def came_evenly(slots: list[int], first: int = 0) -> Block:
    """Frames that arrive one after the other, whatever their stamps say."""
    return block(0, slots, [(first + place - slot) * 1000 / 60 + 20 for place, slot in enumerate(slots)])


def test_a_sender_whose_clock_is_set_loses_nothing() -> None:
    slots, jumped = list(range(60)), list(range(10**6, 10**6 + 60))
    row = after([came_evenly(slots)], [came_evenly(jumped, 60)]).row(0)
    assert (row.lost, row.stale, row.frames) == (0, 0, 120)
    back = after([came_evenly(jumped)], [came_evenly(slots, 60)]).row(0)
    assert (back.lost, back.stale) == (0, 0)


def test_strays_are_no_loss() -> None:
    slots = [*range(30), 10**7, *range(30, 60), -(10**7), *range(60, 90)]
    row = after([came_evenly(slots)]).row(0)
    assert (row.lost, row.stale, row.frames) == (0, 2, 92)
    assert CONFIRM > 1


def test_an_outage_that_the_arrivals_confirm_is_a_loss() -> None:
    gone = 4 * REACH
    row = after([block(0, range(60))], [block(0, range(60 + gone, 120 + gone))]).row(0)
    assert (row.lost, row.stale) == (gone, 0)


def test_another_rate_begins_anew() -> None:
    watch = Watch()
    watch.add([block(0, range(60))], ROUND_NS)
    watch.add([block(0, range(100, 150), rate=50)], 2 * ROUND_NS)
    row = watch.look(2 * ROUND_NS).row(0)
    assert (len(watch), row.configured_hz, row.lost) == (1, 50, 0)


def test_two_blocks_of_a_stream_in_a_round() -> None:
    row = after([block(0, range(30)), block(1, range(30)), block(0, [29, 31])]).row(0)
    assert (row.lost, row.duplicated, row.frames) == (1, 1, 32)


def test_frames_whose_arrival_nobody_saw() -> None:
    flow, of = stream(0)
    made = batch(stamps(range(10)), None, of=of)
    assert (made.arrival_ns == NO_TIME).all()
    row = after([Block(flow, made)], [block(0, range(10, 20))]).row(0)
    assert (row.lost, row.late, row.p50_ms) == (0, 0, 20.0)


# --- the last seconds --------------------------------------------------------------------------------------------


def test_the_last_ten_seconds() -> None:
    watch, delays = Watch(), SEED.exponential(10, (80, PER_ROUND))
    for number in range(80):
        slots = range(PER_ROUND * number, PER_ROUND * (number + 1))
        watch.add([block(0, slots, delays[number], stat=0x2000 * (number >= 70))], (number + 1) * ROUND_NS)
    row = watch.look(80 * ROUND_NS).row(0)
    recent = np.sort(delays[40:].reshape(-1))
    rank = [recent[math.ceil(share * len(recent)) - 1] for share in (0.5, 0.99, 1.0)]
    assert [row.p50_ms, row.p99_ms, row.max_ms] == pytest.approx(rank, abs=1e-3)
    assert row.recent_good == pytest.approx(0.75)
    assert (row.rate_hz, row.recent_hz) == (60, 60)
    assert row.all_max_ms == pytest.approx(delays.max(), rel=1e-6)


def test_loss_and_completeness_of_the_last_ten_seconds() -> None:
    watch = Watch(wait_ns=100 * MS)
    for number in range(60):
        first = PER_ROUND * number
        slots = [slot for slot in range(first, first + PER_ROUND) if number < 40 or slot % 5]
        watch.add(
            [block(0, slots, [150.0 if slot % 5 == 1 and number >= 40 else 20.0 for slot in slots])],
            (number + 1) * ROUND_NS,
        )
    row = watch.look(60 * ROUND_NS).row(0)
    assert row.recent_loss == pytest.approx(0.1, abs=0.005)
    assert row.recent_complete == pytest.approx(0.8, abs=0.005)
    assert (row.lost, row.late) == (60, 60)


def test_rates_are_those_of_frames_that_came() -> None:
    half = [[block(0, range(PER_ROUND * number, PER_ROUND * number + PER_ROUND, 2))] for number in range(48)]
    row = after(*half).row(0)
    assert row.recent_hz == pytest.approx(32, abs=1)
    late_comer = [
        [*of_round, *([block(1, range(PER_ROUND * n, PER_ROUND * (n + 1)))] if n >= 44 else [])]
        for n, of_round in enumerate(half)
    ]
    snapshot = after(*late_comer)
    assert snapshot.row(1).recent_hz == pytest.approx(60)
    assert snapshot.rate_hz == pytest.approx(92, abs=2)


def test_series_of_quarters_of_a_second() -> None:
    watch = Watch()
    for number in range(100):
        if number % 10:
            slots = range(PER_ROUND * number, PER_ROUND * (number + 1))
            watch.add([block(0, slots, float(number), hz=50 + number / 100)], (number + 1) * ROUND_NS)
        else:
            watch.add([], (number + 1) * ROUND_NS)
    row = watch.look(100 * ROUND_NS).row(0)
    places = np.arange(40, 100)
    gaps = places % 10 == 0
    assert row.frequencies_hz == pytest.approx(np.where(gaps, np.nan, 50 + places / 100), nan_ok=True, abs=1e-4)
    assert row.delays_ms == pytest.approx(np.where(gaps, np.nan, places), nan_ok=True, abs=1e-4)


def test_rounds_that_follow_at_once_share_a_place() -> None:
    many = after(*([block(0, [slot])] for slot in range(120)), every_ns=NS // 60).row(0)
    assert 7 <= len(many.frequencies_hz) <= 10
    assert many.rate_hz == pytest.approx(60, abs=3)


def test_percentiles_of_many_streams_are_renewed_in_turns() -> None:
    watch, count = Watch(), 300
    for number in range(8):
        slots = range(PER_ROUND * number, PER_ROUND * (number + 1))
        watch.add([block(row, slots, float(1 + number // 4)) for row in range(count)], (number + 1) * ROUND_NS)
        snapshot = watch.look((number + 1) * ROUND_NS)
        told = {snapshot.row(row).max_ms for row in range(count)}
        if number >= 1:
            assert told <= {1.0, 2.0}, "known from the first look on"
    assert told == {2.0}, "each within a second"
    for number in range(8, 52):
        watch.add([], (number + 1) * ROUND_NS)
    row = watch.look(52 * ROUND_NS).row(0)
    assert math.isnan(row.p99_ms), "nothing came for 10 s"
    assert row.all_p99_ms == pytest.approx(2, rel=0.06)


def test_quick_streams_are_told_by_their_last_frames() -> None:
    fast = [[block(0, range(60 * number, 60 * (number + 1)), float(number), rate=240)] for number in range(20)]
    row = after(*fast).row(0)
    assert row.p50_ms > 12, f"the last {DELAYS} frames"
    assert row.rate_hz == 240


# --- state and news ----------------------------------------------------------------------------------------------


def test_eight_streams_at_one_look() -> None:
    snapshot = watched().look(60 * ROUND_NS)
    told = rows(snapshot)
    assert list(told) == ["N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4"]
    assert [row.state is StreamState.STREAMING for row in told.values()] == [True] * 6 + [False, True]
    assert told["S3"].state is StreamState.SILENT
    assert told["S3"].silent_s == pytest.approx(4.75)
    assert told["N2"].recent_loss == pytest.approx(0.05, abs=0.03)
    assert told["N2"].lost == snapshot.lost > 0
    assert (told["N4"].recent_good, told["N4"].stat) == (0, 0x2000)
    assert told["S1"].late == PER_ROUND
    assert [snapshot.row(row).name for row in snapshot.worst_first().tolist()][:3] == ["S3", "N2", "N4"]
    assert (snapshot.count(StreamState.STREAMING), snapshot.running_s) == (7, 14.75)


def test_a_stream_that_comes_again_streams() -> None:
    watch = watched()
    watch.add([block(6, range(900, 915))], 61 * ROUND_NS)
    assert rows(watch.look(61 * ROUND_NS))["S3"].state is StreamState.STREAMING


def event(kind: LinkKind, **options: object) -> LinkEvent:
    return LinkEvent(kind, options.pop("where", URL), options.pop("owners", (0,)), **options)  # type: ignore[arg-type]


def test_what_never_came_is_told() -> None:
    watch = Watch()
    flow = Flow("udp", "10.0.0.9:4000", "10.1.0.1:4713")
    watch.hear(event(LinkKind.FAILED, detail="connection refused", idcode=7), NS)
    watch.hear(event(LinkKind.NO_CONFIG, where="udp://10.1.0.1:4713", owners=(1,), idcode=9, flow=flow), NS)
    watch.hear(event(LinkKind.FOREIGN, where="udp://10.0.0.9", owners=(1,), idcode=11, flow=flow), NS)
    watch.hear(event(LinkKind.NOTHING, where="udp://10.1.0.1:4714", owners=(2,)), NS)
    told = rows(watch.look(3 * NS))
    assert {name: row.state for name, row in told.items()} == {
        URL: StreamState.FAILED,
        "IDCODE 9": StreamState.NO_CONFIG,
        "IDCODE 11": StreamState.FOREIGN,
        "udp://10.1.0.1:4714": StreamState.NOTHING,
    }
    assert (told[URL].news, told[URL].news_s) == ("failed: connection refused", 2.0)
    assert math.isnan(told[URL].rate_hz)


def test_an_endpoint_that_has_a_stream_needs_no_row_of_its_own() -> None:
    watch = Watch()
    flow, of = Flow("tcp", "10.9.9.9:4712", "10.1.0.1:50000"), config()
    watch.hear(event(LinkKind.FAILED, detail="refused"), NS)
    watch.hear(event(LinkKind.FAILED, detail="refused"), 2 * NS)
    assert len(watch.look(2 * NS)) == 1
    watch.hear(event(LinkKind.CONNECTED, flow=flow, idcode=of.idcode), 3 * NS)
    watch.hear(event(LinkKind.CONFIGURED, flow=flow, idcode=of.idcode), 3 * NS)
    snapshot = watch.look(3 * NS)
    assert [row.state for row in rows(snapshot).values()] == [StreamState.WAITING]
    watch.add([Block(flow, batch(stamps(range(15)), of=of))], 4 * NS)
    watch.hear(event(LinkKind.STREAMING, flow=flow, idcode=of.idcode), 4 * NS)
    assert [row.state for row in rows(watch.look(4 * NS)).values()] == [StreamState.STREAMING]
    watch.hear(event(LinkKind.LOST, flow=flow, idcode=of.idcode, detail="reset"), 5 * NS)
    watch.hear(event(LinkKind.FAILED, detail="refused"), 6 * NS)
    lost = rows(watch.look(6 * NS))
    assert [row.state for row in lost.values()] == [StreamState.FAILED], "in its own row"
    again = flow._replace(destination="10.1.0.1:50001", connection=1)
    watch.add([Block(again, batch(stamps(range(600, 615)), of=of))], 7 * NS)
    (row,) = rows(watch.look(7 * NS)).values()
    assert (row.state, row.frames) == (StreamState.STREAMING, 30), "the connection is another, the device is not"


def test_own_drops_and_bytes_that_are_no_frame() -> None:
    watch = Watch()
    watch.hear(event(LinkKind.OWN_DROPS, datagrams=5), NS)
    watch.add([Loss(Skipped(SkipReason.BAD_CHK, 0, 66), stream(0)[0])] * 2, NS)
    snapshot = watch.look(NS)
    assert (snapshot.own_drops, dict(snapshot.skipped), len(snapshot)) == (5, {"bad-chk": 132}, 0)


def test_names() -> None:
    watch = Watch(name=lambda flow, config: "SITE" if config.idcode == 101 else None)
    of = config(idcode=7)
    two = StreamMeter(Identity("", 7), of).config
    pdc = type(of)(7, (two.stations[0], two.stations[0]), 60)
    made = batch(stamps(range(3)), of=of)
    wide = {name: np.repeat(getattr(made, name), 2, axis=1) for name in ("stat", "frequency", "rocof", "valid")}
    joined = replace(made, config=pdc, wire=None, **wide)
    watch.add([block(0, [0]), block(1, [0]), Block(stream(2)[0], joined)], NS)
    told = rows(watch.look(NS))
    assert list(told) == ["SITE", "N2", "PDC7"]
    assert told["PDC7"].stations == 2


# --- bounds ------------------------------------------------------------------------------------------------------


def test_streams_beyond_the_bound_are_counted() -> None:
    watch = Watch(streams=5)
    for number in range(9):
        watch.add([block(number, range(10))], (number + 1) * ROUND_NS)
    snapshot = watch.look(9 * ROUND_NS)
    assert (len(watch), watch.untold, snapshot.untold, snapshot.frames) == (5, 40, 40, 50)


def test_a_flood_of_senders_that_nobody_asked_for_is_bounded() -> None:
    watch = Watch()
    for number in range(1000):
        flow = Flow("udp", f"10.0.{number >> 8}.{number & 255}:1", "x")
        watch.hear(event(LinkKind.FOREIGN, flow=flow, idcode=1), NS)
    assert len(watch) == 64


def test_a_device_that_connects_for_ever_keeps_its_row() -> None:
    watch, of = Watch(streams=3), config()
    for number in range(50):
        flow = Flow("tcp", "10.9.9.9:4712", f"10.1.0.1:{50000 + number}", number)
        watch.add([Block(flow, batch(stamps([number]), of=of))], (number + 1) * ROUND_NS)
    assert len(watch) == 1
    assert len(watch._known) <= 6
    assert watch.look(NS).row(0).frames == 50


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32), st.lists(st.integers(1, 40), min_size=1, max_size=12), st.sampled_from([1, 60, -7, 0, 240])
)
def test_any_stamps_and_arrivals(seed: int, sizes: list[int], rate: int) -> None:
    """Whatever a device stamps: nothing is raised, and no count goes below nothing."""
    random, watch, of = np.random.default_rng(seed), Watch(), config(rate)
    for number, size in enumerate(sizes, 1):
        spread = int(random.choice([1, 60, 5000, 2**31]))
        time_ns = 1_700_000_000 * NS + random.integers(-spread, spread + 1, size) * (NS // 60)
        made = batch(np.clip(time_ns, 0, (2**32 - 1) * NS), of=of)
        arrival_ns = 1_700_000_000 * NS + random.integers(0, 10**12, size)
        arrival_ns[random.random(size) < 0.1] = NO_TIME
        watch.add([Block(stream(0)[0], replace(made, arrival_ns=arrival_ns))], number * ROUND_NS)
        row = watch.look(number * ROUND_NS).row(0)
        assert row.frames == sum(sizes[:number])
        assert row.lost >= 0
        assert row.duplicated >= 0
        assert row.stale >= 0
        assert row.frames >= row.duplicated + row.stale
        assert not row.recent_loss < 0


def test_a_concentrator_without_a_pmu() -> None:
    of = replace(config(), stations=())
    made = batch(stamps(range(20)))
    none = {name: getattr(made, name)[:, :0] for name in ("stat", "frequency", "rocof", "valid", "phasors")}
    empty = Block(stream(0)[0], replace(made, config=of, **none))
    row = after([empty], [empty]).row(0)
    assert (row.frames, row.stations, row.recent_good, row.duplicated) == (40, 0, 0, 20)


@pytest.mark.realtime
def test_thousands_of_streams_cost_little() -> None:
    """Some 0.7 us of processor time a frame; judged at ten times that."""
    rounds = [
        [block(row, range(PER_ROUND * number, PER_ROUND * (number + 1))) for row in range(1000)] for number in range(4)
    ]
    watch = Watch()
    best = math.inf
    for number, of_round in enumerate(rounds, 1):
        began = time.process_time()
        watch.add(of_round, number * ROUND_NS)
        best = min(best, time.process_time() - began)
    assert best / (1000 * PER_ROUND) < 6e-6
    assert watch.look(4 * ROUND_NS).rate_hz == pytest.approx(60_000)
