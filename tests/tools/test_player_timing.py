"""When the player sends what, with which stamp: in virtual time, to the nanosecond."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from support.playing import (
    MS,
    START_NS,
    Played,
    Stage,
    at,
    faults,
    interleaved,
    play,
    recording,
    reel_of,
    started,
    stream,
)

from pmutools.c37118 import Format, FrameType, PhasorChannel, Station, StreamConfig, decode_config, decode_prefix
from pmutools.c37118.checksum import chk
from pmutools.c37118.session import Served
from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError, SourceError
from pmutools.impair.pipeline import Pipeline
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.outlet import ServerEvent
from pmutools.pacing import Playback
from pmutools.parsers import parse_place
from pmutools.timebase import NS, slot, slot_time_ns
from pmutools.tools.player.cast import Cast, Spread, as_recorded, emulated
from pmutools.tools.player.plan import Plan
from pmutools.tools.player.reel import Reel
from pmutools.tools.player.stamps import StampPolicy
from pmutools.tools.window import Window

LISTEN = parse_endpoint("tcp://127.0.0.1:4712")
NOW_NS = 1_790_000_000 * NS + 123_456_789


def clock() -> VirtualClock:
    return VirtualClock(NOW_NS, 77_000_000_001)


def spaced(times: list[int], period_ns: Fraction | int) -> bool:
    """Whether each time is exactly its multiple of the period (rounded down) after the first."""
    return times == [times[0] + int(k * period_ns) for k in range(len(times))]


def utc(played: Played, stream: int = 0) -> list[int]:
    """UTC at which the frames of a stream left."""
    return [played.began_ns + time for time in played.times(stream)]


# --- deadlines


def test_a_frame_leaves_when_its_new_stamp_is_due_and_keeps_fracsec() -> None:
    config = stream(rate=60, time_base=0xFFFFFF)
    source = recording(config, 3 * 60, first_slot=7)
    played = play(source, clock=clock())
    recorded = [decode_prefix(message.frame.data) for message in source[1:]]
    sent = [decode_prefix(item.frame) for item in played.data]
    assert [prefix.fracsec for prefix in sent] == [prefix.fracsec for prefix in recorded]
    assert len({new.soc - old.soc for new, old in zip(sent, recorded, strict=True)}) == 1
    assert utc(played) == played.stamps()
    assert 0 <= played.stamps()[0] - NOW_NS < NS, "the first frame is due now, at most a second away"


@pytest.mark.parametrize(("rate", "speed"), [(60, "1"), (60, "0.1"), (30, "3"), (120, "7.3"), (50, "1000")])
def test_no_drift_over_an_hour(rate: int, speed: str) -> None:
    count = 3600 * rate // 50
    slots = [50 * k for k in range(count)]  # every 50th frame, to keep the test short
    played = play(recording(stream(rate=rate), count, slots=slots), clock=clock(), speed=speed)
    first = played.reel.first_due_ns
    expected = [int(slot_time_ns(rate * (START_NS // NS) + s, Fraction(rate)) // 1000 * 1000 - first) for s in slots]
    times = played.times()
    offsets = [time - times[0] for time in times]
    for offset, stream_ns in zip(offsets, expected, strict=True):
        assert abs(offset - stream_ns / Fraction(speed)) <= 1000 / Fraction(speed) + 1, "TIME_BASE is 1 us"
    assert played.player.results[0].late.max_ns == 0


def test_a_slow_send_delays_no_later_frame() -> None:
    timing = clock()
    stage = Stage(timing, cost_ns=5 * MS)
    played = play(recording(stream(), 200), clock=timing, stage=stage)
    assert spaced(played.times(), 20 * MS)


class Stalling(Stage):
    """Stalls for 0.3 s when it is given another configuration."""

    def replace(self, handle: int, offer: Served) -> None:
        super().replace(handle, offer)
        self.clock.advance(300 * MS)


def test_a_stall_is_caught_up_with_in_order_and_counted() -> None:
    timing = clock()
    flow = recording(stream(), 0)[0].flow
    source = recording(stream(), 50) + recording(stream(cfgcnt=1), 150, first_slot=50, flow=flow)
    played = play(source, clock=timing, stage=Stalling(timing))
    assert played.numbers() == [*range(50), *range(150)]
    late = [time - due for time, due in zip(utc(played), played.stamps(), strict=True)]
    assert late[50] == 300 * MS
    assert all(not value for value in late[:50] + late[70:])
    assert played.player.results[0].late.misses == sum(value > 10 * MS for value in late)


def test_speed_scales_send_times_not_stamps() -> None:
    played = play(recording(stream(), 100), speed="2.5")
    assert spaced(played.times(), 8 * MS)
    assert spaced(played.stamps(), 20 * MS)


def test_wall_time_is_exact_however_long_it_plays() -> None:
    clock = Playback(0, 0, Fraction(1, 3))
    assert clock.target_ns(10**17 + 1) == 3 * 10**17 + 3
    assert clock.targets_ns(np.array([10**17, 10**17 + 1])).tolist() == [3 * 10**17, 3 * 10**17 + 3]


def test_interval_sets_the_spacing_of_each_stream_and_leaves_the_stamps() -> None:
    slow, fast = recording(stream(1, rate=25), 40), recording(stream(2, rate=50), 80, first_slot=50)
    played = play(interleaved(slow, fast), interval_ns=7_300_000)
    assert spaced(played.times(0), 7_300_000)
    assert spaced(played.times(1), 7_300_000)
    assert played.times(1)[0] - played.times(0)[0] == NS, "what was recorded a second later begins a second later"
    assert (spaced(played.stamps(0), 40 * MS), spaced(played.stamps(1), 20 * MS)) == (True, True)
    assert played.numbers(0) == [*range(40)]
    assert played.numbers(1) == [*range(80)]


@pytest.mark.parametrize("policy", ["shift", "now-grid"])
@pytest.mark.parametrize("fps", [1, 25, 60, 120, 1000])
def test_fps_makes_new_stamps_on_the_new_grid_and_another_data_rate(fps: int, policy: str) -> None:
    config = stream(rate=50)
    source = recording(config, 300, first_slot=13)
    played = play(source, clock=clock(), fps=fps, policy=policy)
    rate = Fraction(fps)
    first = slot(played.stamps()[0], rate)
    assert [at(ns, config) for ns in played.stamps()] == [
        at(slot_time_ns(first + k, rate), config) for k in range(300)
    ], "consecutive reporting instants"
    for left, stamp in zip(utc(played), played.stamps(), strict=True):
        assert abs(left - stamp) <= 500, "sent when due, to the resolution of TIME_BASE"
    for kind in (FrameType.CFG1, FrameType.CFG2, FrameType.CFG3):
        assert decode_config(played.stage.offered[0].frames[kind])[1].data_rate == fps


@pytest.mark.parametrize("first_slot", [0, 1, 2, 59])
def test_fps_at_the_recorded_rate_moves_no_stamp(first_slot: int) -> None:
    """Recorded stamps are rounded to TIME_BASE, so some lie just after their reporting instant."""
    source = recording(stream(rate=60), 120, first_slot=first_slot)
    assert play(source, clock=clock(), fps=60).stamps() == play(source, clock=clock()).stamps()


def test_fps_brings_streams_of_different_rates_together() -> None:
    slow, fast = recording(stream(1, rate=10), 30), recording(stream(2, rate=50), 150)
    played = play(interleaved(slow, fast), clock=clock(), fps=25)
    assert played.times(0) == played.times(1)[:30]
    assert played.numbers(0) == [*range(30)]
    assert played.numbers(1) == [*range(150)]
    assert spaced(played.times(1), 40 * MS)


def test_fps_with_recorded_latency_sends_that_much_after_the_new_stamp() -> None:
    source = recording(stream(rate=50), 100, latency_ns=lambda k: (30 + k % 3) * MS)
    played = play(source, clock=clock(), fps=25)
    late = [left - stamp for left, stamp in zip(utc(played), played.stamps(), strict=True)]
    assert late == [(30 + k % 3) * MS for k in range(100)]


# --- stamp policies


def test_keep_sends_the_bytes_as_recorded() -> None:
    source = recording(stream(), 60)
    played = play(source, policy="keep")
    assert [item.frame for item in played.data] == [message.frame.data for message in source[1:]]
    assert spaced(played.times(), 20 * MS)
    assert played.times()[0] == 0, "no stamp to wait for"


def test_now_stamps_with_the_time_of_sending() -> None:
    config = stream(time_base=1_000_000)
    played = play(recording(config, 50), clock=clock(), policy="now", speed="4")
    for left, stamp in zip(utc(played), played.stamps(), strict=True):
        assert abs(left - stamp) <= 500
    assert utc(played)[0] == NOW_NS


@pytest.mark.parametrize(("rate", "speed"), [(60, "1"), (30, "1"), (25, "0.5")])
def test_now_grid_stamps_with_the_nearest_reporting_instant(rate: int, speed: str) -> None:
    config = stream(rate=rate)
    played = play(recording(config, 100, first_slot=3), clock=clock(), policy="now-grid", speed=speed)
    slots = [slot(stamp, config.rate) for stamp in played.stamps()]
    step = int(1 / Fraction(speed))
    assert slots == [*range(slots[0], slots[0] + 100 * step, step)]
    assert all(
        at(slot_time_ns(k, config.rate), config) == at(s, config) for k, s in zip(slots, played.stamps(), strict=True)
    )
    assert all(abs(left - stamp) < 1000 for left, stamp in zip(utc(played), played.stamps(), strict=True))


# --- arrival or stamp


def test_arrivals_are_played_with_their_latency_and_without_it_on_request() -> None:
    source = recording(stream(), 100, latency_ns=lambda k: (20 + k * 7 % 15) * MS)
    as_recorded, by_stamp = play(source, clock=clock()), play(source, clock=clock(), timing="stamp")
    latencies = [left - stamp for left, stamp in zip(utc(as_recorded), as_recorded.stamps(), strict=True)]
    assert latencies == [(20 + k * 7 % 15) * MS for k in range(100)]
    assert utc(by_stamp) == by_stamp.stamps()


@pytest.mark.parametrize("latency_ns", [-1, -5 * 86400 * NS, NS + 1, 3600 * NS])
def test_a_latency_that_cannot_be_true_counts_as_none(latency_ns: int) -> None:
    source = recording(stream(), 50, latency_ns=lambda k: latency_ns if k % 2 else 10 * MS)
    played = play(source, clock=clock())
    late = [left - stamp for left, stamp in zip(utc(played), played.stamps(), strict=True)]
    assert late == [0 if k % 2 else 10 * MS for k in range(50)]


def test_the_limits_of_a_latency_are_played() -> None:
    source = recording(stream(), 2, latency_ns=lambda k: k * NS)
    played = play(source, clock=clock())
    assert [left - stamp for left, stamp in zip(utc(played), played.stamps(), strict=True)] == [0, NS]


def test_frames_that_came_late_leave_late_and_out_of_order_as_recorded() -> None:
    source = recording(stream(), 50, latency_ns=lambda k: 70 * MS if k == 10 else MS)
    played = play(sorted(source, key=lambda message: message.frame.arrival_ns or 0), clock=clock())
    assert played.numbers() == [*range(10), 11, 12, 13, 10, *range(14, 50)]


def test_frames_recorded_out_of_order_are_played_by_their_stamps_if_so_asked() -> None:
    source = recording(stream(), 50, latency_ns=lambda k: 70 * MS if k == 10 else MS)
    played = play(sorted(source, key=lambda message: message.frame.arrival_ns or 0), timing="stamp")
    assert played.numbers() == [*range(50)]
    assert spaced(played.times(), 20 * MS)


# --- loops


@pytest.mark.parametrize("frames", [50, 51, 73, 99])
def test_a_loop_keeps_the_phase_of_fracsec_and_moves_whole_seconds(frames: int) -> None:
    config = stream(rate=50)
    played = play(recording(config, frames, first_slot=11), clock=clock(), loops=3)
    assert played.numbers() == [*range(frames)] * 3
    assert utc(played) == played.stamps()
    rounds = [played.stamps()[frames * k : frames * (k + 1)] for k in range(3)]
    shift = -(-frames // 50) * NS
    assert rounds[1] == [stamp + shift for stamp in rounds[0]]
    assert rounds[2] == [stamp + 2 * shift for stamp in rounds[0]]


def test_a_loop_at_another_rate_goes_on_without_a_gap() -> None:
    played = play(recording(stream(), 37), clock=clock(), loops=4, fps=30)
    assert [slot(stamp, Fraction(30)) for stamp in played.stamps()] == [
        *range(slot(played.stamps()[0], Fraction(30)), slot(played.stamps()[0], Fraction(30)) + 4 * 37)
    ]


def test_loop_zero_goes_on_until_the_duration_ends() -> None:
    played = play(recording(stream(), 50), loops=0, duration_ns=10 * NS)
    assert 450 <= len(played.data) <= 500, "ten seconds less the wait for the first stamp"
    assert played.stage.now_ns == 10 * NS


def test_duration_longer_than_the_source_serves_on_to_its_end() -> None:
    played = play(recording(stream(), 50), duration_ns=10 * NS)
    assert (len(played.data), played.stage.now_ns) == (50, 10 * NS)


# --- windows and choices


def test_start_and_end_cut_by_stamp_and_the_rest_is_due_now() -> None:
    window = Window(parse_place("1"), parse_place("2016-09-08T17:05:13.5Z"))
    played = play(recording(stream(), 200), clock=clock(), window=window)
    assert played.numbers() == [*range(50, 125)]
    assert 0 <= played.stamps()[0] - NOW_NS < NS


def test_indices_count_over_the_source_whatever_part_is_played_and_over_its_loops() -> None:
    window = Window(parse_place("1"), parse_place("1.1"))
    source = recording(stream(), 100)
    reel = reel_of(source, None, window)
    assert reel.rows.number.tolist() == [50 + k for k in range(5)]
    assert (reel.tracks[0].total, reel.tracks[0].frames) == (100, 5)


def test_chosen_streams_alone_decide_what_is_due_first() -> None:
    source = interleaved(recording(stream(1), 100), recording(stream(2, name="LATE"), 100, first_slot=500))
    played = play(source, clock=clock(), select=["LATE"])
    assert [t.name for t in played.reel.tracks] == ["LATE"]
    assert 0 <= played.stamps()[0] - NOW_NS < NS
    assert played.stage.now_ns < 4 * NS
    assert [s.name for s in play(source, exclude=["LATE"]).reel.tracks] == ["PMU 1"]
    assert [s.name for s in play(source, select=["1"]).reel.tracks] == ["PMU 1"]


def test_a_name_that_fits_no_stream_is_told_with_those_there_are() -> None:
    with pytest.raises(SettingsError, match=r"--select NORTH: no such stream; there are PMU 7 \(7\)"):
        play(recording(stream(), 3), select=["NORTH"])
    with pytest.raises(SourceError, match="nothing is left"):
        play(recording(stream(), 3), exclude=["7"])
    with pytest.raises(SourceError, match="no data frames"):
        play(recording(stream(), 0))
    with pytest.raises(SourceError, match="nothing is left"):
        play(recording(stream(), 3), window=Window(parse_place("60")))


def test_streams_of_one_name_are_told_apart() -> None:
    source = interleaved(recording(stream(1, name="N"), 2), recording(stream(2, name="N"), 2))
    assert [t.name for t in reel_of(source).tracks] == ["N", "N#2"]


def test_several_streams_keep_their_place_relative_to_each_other() -> None:
    first = recording(stream(1, rate=50), 100)
    second = recording(stream(2, rate=30), 60, first_slot=17)
    played = play(interleaved(first, second), clock=clock())
    assert utc(played, 0) == played.stamps(0)
    assert utc(played, 1) == played.stamps(1)


# --- starting and stopping


def test_listening_alone_begins_with_the_first_start_command() -> None:
    timing = clock()
    stage = Stage(timing, plays={7 * NS: started()})
    played = play(recording(stream(), 50), clock=timing, stage=stage, to=[], listen=[LISTEN])
    assert 7 * NS <= played.times()[0] < 8 * NS
    assert utc(played) == played.stamps()


def test_a_client_that_never_comes_leaves_the_player_waiting_until_its_duration_ends() -> None:
    played = play(recording(stream(), 50), to=[], listen=[LISTEN], duration_ns=30 * NS)
    assert (played.data, played.stage.now_ns) == ([], 30 * NS)


def test_an_address_to_send_to_makes_listening_wait_for_nobody() -> None:
    played = play(recording(stream(), 50), listen=[LISTEN])
    assert played.times()[0] < NS


def test_a_player_told_to_stop_stops_between_frames() -> None:
    timing = clock()
    stage = Stage(timing)
    played = play(recording(stream(), 5000), clock=timing, stage=stage, stop=lambda: stage.now_ns > 3 * NS)
    assert 3 * NS <= played.stage.now_ns <= 3 * NS + 120 * MS
    assert 90 <= len(played.data) <= 160
    assert stage.closed


@dataclass
class Queueing(Stage):
    """Its clients take ``takes`` bytes with each poll."""

    takes: int = 0

    def poll(self, timeout_ns: int | None) -> list[ServerEvent]:
        self.queued_bytes = max(0, self.queued_bytes - self.takes)
        return super().poll(timeout_ns)


@pytest.mark.parametrize(("takes", "waits_ns"), [(1000, 0), (100, 900 * MS), (0, 2 * NS)])
def test_at_the_end_clients_have_two_seconds_for_what_waits_for_them(takes: int, waits_ns: int) -> None:
    timing = clock()
    stage = Queueing(timing, queued_bytes=1000, takes=takes)
    played = play(recording(stream(), 5), clock=timing, stage=stage)
    assert stage.now_ns - played.times()[-1] == pytest.approx(waits_ns, abs=110 * MS)


def test_what_waits_to_be_sent_is_a_window_of_the_source() -> None:
    """Not all of it, whatever was read ahead or might have been held back."""
    source = recording(stream(), 5_000)
    cast = as_recorded(reel_of(source))
    plan = Plan(cast, StampPolicy.SHIFT, [Pipeline(faults("delay=normal(30,5)"), "PMU 7", 1)], NOW_NS)
    tracemalloc.start()
    try:
        count = 0
        while (next_ns := plan.next_ns()) is not None:
            count += len(plan.until(next_ns + 10 * MS))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert count == 5_000
    assert peak < 300_000, "all of it is 1.5 MB"


def test_a_waiting_player_told_to_stop_does_so() -> None:
    timing = clock()
    stage = Stage(timing)
    play(recording(stream(), 5), clock=timing, stage=stage, to=[], listen=[LISTEN], stop=lambda: stage.now_ns > NS)
    assert stage.now_ns <= NS + 120 * MS


def test_emulated_pmus_with_a_spread_differ_in_their_values_alone() -> None:
    source = recording(stream(rate=60, time_base=0xFFFFFF), 60)
    for message in source[1:]:
        assert message.frame.data[10] == 0
    played = play(source, clock=clock(), cast=lambda reel: emulated(reel, 3, 2, spread=Spread(mag=5, deg=20, mhz=40)))
    recorded = [message.frame.data for message in source[1:]]
    deviations = set()
    for part in range(3):
        frames = [item.frame for item in played.data if item.stream == part]
        assert [frame[10:14] for frame in frames] == [frame[10:14] for frame in recorded], "time quality and FRACSEC"
        assert {chk(frame) for frame in frames} == {0}
        assert {frame[14:16] for frame in frames} == {b"\0\0"}
        moved = {int.from_bytes(frame[20:22], "big", signed=True) - k for k, frame in enumerate(frames)}
        assert len(moved) == 1, "one offset for all of a PMU's frequencies"
        deviations |= moved
        sizes = [abs(complex(*(int.from_bytes(f[at : at + 2], "big", signed=True) for at in (16, 18)))) for f in frames]
        assert max(sizes) - min(sizes) <= 2
        assert abs(sizes[0] - 1000 * 2**0.5) > 2
    assert len(deviations) == 3


def test_a_loop_of_a_recording_with_latencies_leaves_no_gap() -> None:
    source = recording(stream(), 100, latency_ns=lambda k: (30 + k * 7 % 9) * MS)
    played = play(source, clock=clock(), loops=3)
    assert played.numbers() == [*range(100)] * 3
    assert spaced(played.stamps(), 20 * MS)
    late = [left - stamp for left, stamp in zip(utc(played), played.stamps(), strict=True)]
    assert late == [(30 + k * 7 % 9) * MS for k in range(100)] * 3


def test_frames_late_at_the_end_of_a_round_leave_amid_the_next() -> None:
    source = recording(stream(), 100, latency_ns=lambda k: 150 * MS if k >= 98 else 5 * MS)
    played = play(source, clock=clock(), loops=3)
    assert sorted(played.stamps()) == [played.stamps()[0] + k * 20 * MS for k in range(300)]
    late = {left - stamp for left, stamp in zip(utc(played), played.stamps(), strict=True)}
    assert late == {5 * MS, 150 * MS}
    assert played.numbers()[98:110] == [0, 1, 2, 3, 4, 5, 98, 6, 99, 7, 8, 9]
    assert played.numbers()[-2:] == [98, 99]


def test_emulated_phases_go_on_over_loops() -> None:
    def cast(reel: Reel) -> Cast:
        return emulated(reel, 7, seed=1)

    played = play(recording(stream(), 50), clock=clock(), loops=3, cast=cast)
    for part in range(7):
        assert spaced(played.times(part), 20 * MS)
        assert spaced(played.stamps(part), 20 * MS)
    assert len(played.data) == 7 * 150


def test_a_spread_in_frequency_follows_the_stamps_whatever_the_frames_sizes() -> None:
    """An offset turns the angle with time: the same for a stream alone and beside one of other frames."""

    def cast(reel: Reel) -> Cast:
        return emulated(reel, len(reel.tracks), 3, stagger=False, spread=Spread(mhz=500))

    wide = StreamConfig(9, (Station("WIDE", 9, Format(0), (PhasorChannel("V1", 100), PhasorChannel("V2", 100))),), 50)
    alone = play(recording(stream(7), 60), clock=clock(), cast=cast)
    beside = play(interleaved(recording(stream(7), 60), recording(wide, 60)), clock=clock(), cast=cast)
    assert [sent.frame[14:-2] for sent in beside.data if sent.stream == 0] == [s.frame[14:-2] for s in alone.data]


def test_fewer_pmus_than_streams_play_the_first_ones() -> None:
    source = interleaved(recording(stream(7), 100), recording(stream(8), 100, first_slot=5000))
    played = play(source, clock=clock(), cast=lambda reel: emulated(reel, 1, seed=1))
    assert played.numbers() == [*range(100)]
    assert played.stage.now_ns < 4 * NS, "nobody waits for the other one"
