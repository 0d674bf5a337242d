"""One PMU in a tick: order, dropouts, gaps, bounds."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest
from support.rig import BASE_V
from support.streams import MS, START_NS, samples

from dcon.core import pmu as pmus_of
from dcon.core.checks import Supervisor
from dcon.core.params import Params
from dcon.core.quick import next_frame
from dcon.core.rows import CORE
from dcon.core.state import Pmu
from dcon.core.thresholds import Thresholds
from dcon.core.values import Sample
from dcon.frontend import bind
from pmutools.c37118 import Frame
from pmutools.flow import StampSource
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.pmu_model import Measurement, fleet

PARAMS = Params.paired(("N1",), ("S1",), nominal_kv=500.0)
BRIDGING = Params.paired(("N1",), ("S1",), nominal_kv=500.0, interpolate_single_loss=True)


SLOW = replace(CORE, known=((), (), ()))
"""The same checks without the short way."""


def update(params: Params, pmu: Pmu, frames: Sequence[Sample], now_ns: int, by: Supervisor = CORE) -> Pmu:
    return pmus_of.update(params, by, by.tables(params), params.pmus[0], pmu, frames, now_ns)


GOOD = list(samples(lambda t: 0.01 * math.sin(2.5 * t), 40))
PERIOD_NS = 1e9 / 60


def feed(frames: Iterable[Sample], params: Params = PARAMS, start: Pmu | None = None, by: Supervisor = CORE) -> Pmu:
    """One frame a tick."""
    pmu = Pmu() if start is None else start
    for frame in frames:
        pmu = update(params, pmu, (frame,), frame.arrival_ns + 5 * MS, by)
    return pmu


def flags(pmu: Pmu) -> list[str]:
    return CORE.named(pmu.raised)


def test_a_good_stream_raises_nothing_and_fills_the_ring() -> None:
    pmu = feed(GOOD)
    assert flags(pmu) == [] and len(pmu.ring) == 32
    assert pmu.slot == round(GOOD[-1].time_ns * 60 / 1e9)


def test_frames_of_one_tick_are_taken_in_order_of_their_stamps() -> None:
    now = GOOD[5].arrival_ns + MS
    shuffled = update(PARAMS, Pmu(), (GOOD[2], GOOD[0], GOOD[3], GOOD[1]), now)
    assert flags(shuffled) == [] and shuffled.ring == feed(GOOD[:4]).ring


def test_a_lost_frame_starts_another_run() -> None:
    pmu = feed([*GOOD[:10], GOOD[11]])
    assert flags(pmu) == ["stamp_step"] and pmu.filter.frames == 1 and pmu.ring == ()
    pmu = feed(GOOD[12:15], start=pmu)
    assert flags(pmu) == [] and pmu.ring[:2] == feed(GOOD[11:15]).ring


def test_a_frame_that_comes_too_late_is_ignored() -> None:
    before = feed([*GOOD[:10], GOOD[11], GOOD[12]])
    after = update(PARAMS, before, (GOOD[10],), GOOD[12].arrival_ns + 10 * MS)
    assert after[:8] == before[:8] and flags(after) == ["stale_frame"]


def test_a_duplicate_is_ignored() -> None:
    now = GOOD[9].arrival_ns + MS
    twice = update(PARAMS, feed(GOOD[:9]), (GOOD[9], GOOD[9]), now)
    assert twice.ring == feed(GOOD[:10]).ring and flags(twice) == ["stale_frame"]


@pytest.mark.parametrize(("off_ns", "good"), [(9_000, True), (-9_000, True), (11_000, False), (-11_000, False)])
def test_stamp_tolerance_of_10_us(off_ns: int, good: bool) -> None:
    pmu = feed([*GOOD[:10], GOOD[10]._replace(time_ns=GOOD[10].time_ns + off_ns)])
    assert flags(pmu) == ([] if good else ["stamp_step"])


FIFTY = Params.paired(("N1",), ("S1",), nominal_kv=500.0, rate_hz=50)
"""Frames 20 ms apart, which every TIME_BASE below has exactly."""


def over_the_wire(shift_ns: int, time_base: int) -> list[Sample]:
    """Eleven frames through C37.118 bytes, the last stamped ``shift_ns`` late."""
    stream = EmulatedStream(fleet(1)[:1], 50, nominal_hz=60.0)
    stream.config = replace(stream.config, time_base=time_base)
    binding = bind("N1", stream.config, rate_hz=50, voltage=("V1",))
    found = []
    for k in range(11):
        stamp_ns = START_NS + k * 20 * MS + (k == 10) * shift_ns
        v1 = cmath.rect(BASE_V, 0.3)
        data = stream.data_frame([Measurement(stamp_ns, v1, v1, v1, v1, 0j, stream.nominal_hz, 0.0)])
        reading = binding.read(Frame(data, START_NS + k * 20 * MS + 60 * MS, StampSource.CAPTURE, 0))
        assert reading is not None and reading.sample.time_ns == stamp_ns
        found.append(reading.sample)
    return found


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("time_base", "stands_ns", "falls_ns"),
    [(1_000_000, 10_000, 11_000), (10_000_000, 10_000, 10_100), (100_000, 10_000, 20_000), (1_000, MS, 2 * MS)],
)
def test_stamp_step_at_its_tolerance(time_base: int, stands_ns: int, falls_ns: int, sign: int) -> None:
    """10 µs, or a tick of a coarser TIME_BASE: at it good, one tick beyond it a step."""
    for by in (CORE, SLOW):
        assert flags(feed(over_the_wire(sign * stands_ns, time_base), FIFTY, by=by)) == []
        assert flags(feed(over_the_wire(sign * falls_ns, time_base), FIFTY, by=by)) == ["stamp_step"]


def test_stamps_in_whole_milliseconds_are_as_good_as_their_time_base() -> None:
    coarse = [frame._replace(time_ns=frame.time_ns // MS * MS, time_base=1000) for frame in GOOD]
    assert flags(feed(coarse)) == [] and len(feed(coarse).ring) == 32
    assert flags(feed([frame._replace(time_base=1_000_000) for frame in coarse[:3]])) == ["stamp_step"]


def test_fifty_ms_without_a_frame() -> None:
    pmu = feed(GOOD[:10])
    arrival = GOOD[9].arrival_ns
    for late_ms, want in ((33, []), (50, []), (50.1, ["arrival_gap"]), (900, ["arrival_gap"])):
        pmu = update(PARAMS, pmu, (), arrival + round(late_ms * MS))
        assert flags(pmu) == want
    assert pmu.slot is None and pmu.ring == ()


def test_a_clock_set_back_does_not_hide_a_gap() -> None:
    pmu = feed(GOOD[:10])
    for _ in range(6):
        pmu = update(PARAMS, pmu, (), GOOD[9].arrival_ns - 3600 * 1000 * MS)
    assert flags(pmu) == ["arrival_gap"]


def test_an_arrival_from_the_future_does_not_hide_a_gap() -> None:
    frame = GOOD[9]._replace(arrival_ns=GOOD[9].arrival_ns + 100 * MS)
    pmu = update(PARAMS, feed(GOOD[:9]), (frame,), GOOD[9].arrival_ns)
    pmu = update(PARAMS, pmu, (), GOOD[9].arrival_ns + 51 * MS)
    assert "arrival_gap" in flags(pmu) and pmu.slot is None


def test_a_clock_that_jumped_back_gets_a_new_run_after_the_gap() -> None:
    hour = 3600 * 1000 * MS
    pmu = update(PARAMS, feed(GOOD[:10]), (), GOOD[9].arrival_ns + 60 * MS)
    earlier = [frame._replace(time_ns=frame.time_ns - hour, arrival_ns=frame.arrival_ns - hour) for frame in GOOD]
    assert flags(feed(earlier[:5], start=pmu)) == [] and len(feed(earlier[:5], start=pmu).ring) == 3


def changed(**fields: object) -> Sample:
    return GOOD[20]._replace(**fields)  # type: ignore[arg-type]


def turned(frame: Sample, degrees: float = 0.0, scale: float = 1.0) -> Sample:
    return frame._replace(v1=frame.v1 * cmath.rect(scale, math.radians(degrees)))


@pytest.mark.parametrize(
    ("frame", "want"),
    [
        (
            changed(v1=complex(math.nan, 0)),
            ["not_finite", "voltage", "voltage_step", "angle_step", "frequency", "rocof"],
        ),
        (changed(v1=complex(1.5e308, 1.5e308)), ["not_finite", "voltage", "voltage_step", "angle_step", "rocof"]),
        (changed(stat=0x8000), ["stat_error"]),
        (changed(stat=0x4000), ["stat_error"]),
        (changed(stat=0x2000), ["not_synchronised"]),
        (changed(stat=0x0400), ["config_change"]),
        (changed(stat=0x0800), []),
        (changed(stat=0x0010), ["time_quality"]),
        (changed(stat=6 << 6), ["time_quality"]),
        (changed(stat=4 << 6), []),
        (changed(time_quality=0x06), []),
        (changed(time_quality=0x07), ["time_quality"]),
        (changed(time_quality=0x0F), ["time_quality"]),
        (changed(time_quality=0x70), []),
        (changed(arrival_ns=GOOD[20].time_ns + 90 * MS), []),
        (changed(arrival_ns=GOOD[20].time_ns + 91 * MS), ["latency_high"]),
        (changed(arrival_ns=GOOD[20].time_ns + 200 * MS), ["latency_high"]),
        (changed(arrival_ns=GOOD[20].time_ns + 201 * MS), ["latency_high", "latency"]),
        (changed(arrival_ns=GOOD[20].time_ns - 5 * MS), []),
        (changed(arrival_ns=GOOD[20].time_ns - 6 * MS), ["latency"]),
        (turned(GOOD[20], scale=1.099), []),
        (turned(GOOD[20], scale=1.101), ["voltage_step"]),
        (turned(GOOD[20], scale=1.21), ["voltage", "voltage_step"]),
        (turned(GOOD[20], scale=0.79), ["voltage", "voltage_step"]),
        (turned(GOOD[20], degrees=0.2), []),
        (turned(GOOD[20], degrees=5.1), ["angle_step"]),
        (turned(GOOD[20], degrees=20), ["angle_step", "rocof"]),
    ],
)
def test_what_each_check_sees_in_one_frame(frame: Sample, want: list[str]) -> None:
    pmu = feed([*GOOD[:20], frame])
    assert flags(pmu) == want
    assert (pmu.slot is None) == bool(pmu.raised & CORE.disabling)


@pytest.mark.parametrize(("hz", "want"), [(0.99, []), (1.01, ["frequency"]), (-1.01, ["frequency"])])
def test_frequency_bound(hz: float, want: list[str]) -> None:
    pmu = feed(list(samples(lambda _: hz, 3)))
    assert flags(pmu) == want


def test_a_voltage_step_shows_from_the_second_frame_of_a_run() -> None:
    assert flags(feed([GOOD[0], turned(GOOD[1], scale=1.15)])) == ["voltage_step"]
    assert flags(feed([turned(GOOD[0], scale=1.15)])) == []


def test_flags_of_frames_stay_up_while_nothing_comes() -> None:
    pmu = feed([*GOOD[:20], changed(stat=0x8000)])
    pmu = update(PARAMS, pmu, (), GOOD[20].arrival_ns + 20 * MS)
    assert flags(pmu) == ["stat_error"]


def test_voltage_is_not_judged_without_a_nominal() -> None:
    params = Params.paired(("N1",), ("S1",))
    assert flags(feed([turned(frame, scale=0.1) for frame in GOOD], params)) == []


def test_one_lost_frame_is_bridged_where_asked() -> None:
    whole, bridged = feed(GOOD[:30], BRIDGING), feed([*GOOD[:20], *GOOD[21:30]], BRIDGING)
    assert bridged.slot == whole.slot and bridged.filter.frames == 3
    assert max(abs(a - b) for a, b in zip(bridged.ring, whole.ring, strict=False)) < 2e-5  # Hz
    assert flags(feed([*GOOD[:20], GOOD[21]], BRIDGING)) == ["interpolated"]


def test_two_lost_frames_are_not_bridged() -> None:
    assert flags(feed([*GOOD[:20], GOOD[22]], BRIDGING)) == ["stamp_step"]


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_run_without_a_frequency_is_not_bridged(frames: int) -> None:
    """The midpoint of two angles says nothing while the filter has not started: the run begins anew."""
    begun = feed(GOOD[:frames], BRIDGING)
    pmu = feed([GOOD[frames + 1]], BRIDGING, begun)
    if frames == 3:
        assert flags(pmu) == ["interpolated"] and len(pmu.ring) == 3
    else:
        assert flags(pmu) == ["stamp_step"] and pmu.filter.frames == 1 and pmu.ring == ()


def test_the_bridge_holds_where_the_angle_wraps() -> None:
    frames = list(samples(lambda _: 0.5, 30, theta=math.pi - 0.6))
    assert any(abs(cmath.phase(b.v1) - cmath.phase(a.v1)) > 3 for a, b in pairwise(frames))
    for lost in (10, 11, 12, 13):
        pmu = feed([*frames[:lost], *frames[lost + 1 :]], BRIDGING)
        assert pmu.ring[0] == pytest.approx(0.5, abs=1e-6)


def test_an_unseen_lost_frame_would_have_been_a_spike() -> None:
    """0.112 of the deviation, as Fig. 12; the reason for the rule."""
    frames = list(samples(lambda _: 0.02, 60))
    hidden = [
        frame._replace(time_ns=START_NS + round(k * PERIOD_NS)) for k, frame in enumerate(frames[:30] + frames[31:])
    ]
    spikes = []
    pmu = Pmu()
    for frame in hidden:
        pmu = update(PARAMS, pmu, (frame,), frame.time_ns + 60 * MS)
        spikes.append(abs(pmu.ring[0] - 0.02) if pmu.ring else 0.0)
    assert max(spikes) == pytest.approx(0.112 * 0.02, rel=0.01)


KEYS = {
    "latency_high": "latency_warn_ms",
    "voltage": "voltage_max_pu",
    "voltage_step": "voltage_step_pu",
    "unbalance": "unbalance_max_percent",
    "angle_step": "angle_step_deg",
    "frequency": "frequency_max_hz",
    "rocof": "rocof_max_hz_s",
    "freq_differs": "freq_max_mhz",
}
LIVELY = [
    frame._replace(
        v1=frame.v1 * (1.01 + 1e-3 * math.sin(k)),
        v2=frame.v1 * 0.01 * math.sin(k + 1),
        frequency_hz=frame.frequency_hz + 1e-3 * math.sin(3 * k),
        arrival_ns=frame.arrival_ns + round(1e6 * math.sin(k)),
    )
    for k, frame in enumerate(samples(lambda t: 0.01 * math.sin(2.5 * t), 40))
]


@pytest.mark.parametrize("name", KEYS)
def test_the_short_way_passes_nothing_that_a_row_would_not(name: str) -> None:
    """With the threshold at, and within a hair of, what a frame shows."""
    row = next(row for row in CORE.frame if row.name == name)
    last = feed(LIVELY[:-1])
    new = feed(LIVELY)
    shown = row.value(PARAMS, PARAMS.pmus[0], last, new, LIVELY[-1])
    assert shown is not None and shown > 0 and flags(new) == []
    passed = set()
    for limit in (shown, *(math.nextafter(shown, to) for to in (0, 9e9)), *(shown * (1 + e) for e in HAIRS)):
        params = replace(PARAMS, thresholds=Thresholds(**{KEYS[name]: limit}, freq_warn_s=0))
        now_ns = LIVELY[-1].arrival_ns + 5 * MS
        quick = CORE.tables(params).quick
        assert quick is not None
        short = next_frame(quick, params.pmus[0].base_v, last, LIVELY[-1], now_ns)
        long = pmus_of.update(params, SLOW, SLOW.tables(params), params.pmus[0], last, LIVELY[-1:], now_ns)
        passed.add(short is not None)
        assert short is None or repr(short) == repr(long)
        assert short is None or limit > shown
    assert passed == {True, False}


HAIRS = (-1e-3, -1e-8, -1e-10, 1e-12, 1e-10, 1e-8, 1e-3)


def test_the_short_way_of_a_session_is_that_of_the_tables() -> None:
    one = other = Pmu()
    for k, frame in enumerate(LIVELY):
        now_ns = frame.arrival_ns + 5 * MS
        given = () if k == 30 else (frame,)
        one = update(PARAMS, one, given, now_ns)
        other = pmus_of.update(PARAMS, SLOW, SLOW.tables(PARAMS), PARAMS.pmus[0], other, given, now_ns)
        assert repr(one) == repr(other)
