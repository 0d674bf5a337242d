"""The player's verbs, in virtual time: what is sent when, and with which stamp, after any sequence of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fractions import Fraction
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.playing import (
    MS,
    START_NS,
    Played,
    Stage,
    faults,
    interleaved,
    play,
    recording,
    reel_of,
    started,
    stream,
)

from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError
from pmutools.impair.outgoing import UNREPEATABLE
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import Profile, parse_action, parse_profile
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import NS, slot
from pmutools.tools.player.cast import Cast, as_recorded, emulated
from pmutools.tools.player.plan import Plan
from pmutools.tools.player.stamps import StampPolicy
from pmutools.tools.player.status import PlayerStatus, PlayState

PERIOD_NS = 20 * MS
SECONDS = recording(stream(), 250)
"""Five seconds at 50 frames/s."""


def plan_of(cast: Cast, policy: str = "keep", *, now_ns: int = START_NS, **options: Any) -> Plan:
    pipelines = [Pipeline(Profile(), part.name) for part in cast.parts]
    return Plan(cast, StampPolicy(policy), pipelines, now_ns, **options)


def late_by(played: Played, stream: int = 0) -> set[int]:
    """How long after their stamps frames left."""
    times, stamps = played.times(stream), played.stamps(stream)
    return {played.began_ns + time - stamp for time, stamp in zip(times, stamps, strict=True)}


# --- any sequence of verbs, against a model


@dataclass
class Model:
    """What a player does, frame by frame: a tape of ``positions`` (ns), and where it is at which time."""

    positions: list[int]
    policy: str
    period_ns: int
    at_ns: int = 0
    media_ns: int = 0
    cursor_ns: int = 0
    speed: Fraction = Fraction(1)
    running: bool = True
    stop_ns: int | None = None
    resumes_ns: int = 0

    def __post_init__(self) -> None:
        self.sent: list[tuple[int, int, int]] = []
        """(offset, position, stamp)."""
        self.shift_ns = 0
        self.go(0, 0)

    def due(self, media_ns: int) -> int:
        return floor(self.at_ns + (media_ns - self.media_ns) / self.speed)

    def until(self, time_ns: int) -> None:
        """Send what is due before ``time_ns``, and be there."""
        if not self.running:
            return
        reached = max(self.cursor_ns, self.media_ns - floor((self.at_ns - time_ns) * self.speed))
        if self.stop_ns is not None:
            reached = min(reached, self.stop_ns)
        for position in self.positions:
            if self.cursor_ns <= position < reached:
                self.sent.append((self.due(position), position, position + self.shift_ns))
        self.cursor_ns = reached
        if self.stop_ns is not None and reached >= self.stop_ns:
            self.running, self.stop_ns = False, None

    def anchor(self, time_ns: int, media_ns: int, *, running: bool = True) -> None:
        self.at_ns, self.media_ns, self.cursor_ns, self.running = time_ns, media_ns, media_ns, running

    def go(self, time_ns: int, media_ns: int) -> None:
        if self.policy == "shift":
            wait_ns = (media_ns - time_ns) % NS
            self.shift_ns = time_ns + wait_ns - media_ns
            time_ns += wait_ns
        self.anchor(time_ns, media_ns)
        self.stop_ns, self.resumes_ns = None, 0

    def act(self, time_ns: int, verb: str, value: Any) -> None:
        self.until(time_ns)
        paused = not self.running or self.stop_ns is not None
        match verb:
            case "pause" if value is None:
                self.anchor(time_ns, self.cursor_ns, running=False)
                self.stop_ns = None
            case "pause":
                self.go(time_ns + value, self.cursor_ns)
                self.resumes_ns = time_ns + value
            case "resume" if paused or time_ns < self.resumes_ns:
                self.go(time_ns, self.cursor_ns)
            case "speed":
                at_ns = self.due(self.cursor_ns) if self.running else time_ns
                self.anchor(at_ns, self.cursor_ns, running=self.running)
                self.speed = value
            case "seek":
                self.go(time_ns, min(value, self.positions[-1]))
                if paused:
                    self.anchor(time_ns, self.cursor_ns, running=False)
            case "step" if paused and self.stop_ns is not None:
                self.stop_ns += value * self.period_ns
            case "step" if paused:
                ahead = [position for position in self.positions if position >= self.cursor_ns]
                if ahead:
                    self.anchor(time_ns, ahead[0])
                    self.stop_ns = ahead[0] + value * self.period_ns - self.period_ns // 2
                    if self.policy == "shift":
                        self.shift_ns = (time_ns - ahead[0]) // NS * NS


speeds = st.sampled_from([Fraction(1), Fraction(2), Fraction(1, 4), Fraction(5, 2), Fraction(1000), Fraction(1, 1000)])
orders = st.one_of(
    st.tuples(st.just("pause"), st.none() | st.integers(MS, 2 * NS)),
    st.tuples(st.just("resume"), st.none()),
    st.tuples(st.just("speed"), speeds),
    st.tuples(st.just("seek"), st.integers(0, 6 * NS) | st.integers(0, 249).map(lambda k: k * PERIOD_NS)),
    st.tuples(st.just("step"), st.integers(1, 5)),
)
waits = st.integers(0, NS) | st.integers(0, 20).map(lambda k: k * PERIOD_NS)


def written(verb: str, value: Any) -> str:
    if value is None:
        return verb
    if verb in ("seek", "pause"):
        return f"{verb} {value // NS}.{value % NS:09d}"
    return f"{verb} {float(value)!r}" if verb == "speed" else f"{verb} {value}"


@settings(deadline=None, max_examples=300)
@given(st.sampled_from(["keep", "shift"]), st.lists(st.tuples(waits, orders), max_size=12))
@example("keep", [(7 * MS, ("speed", Fraction(1)))] * 12)
@example("keep", [(7 * MS, ("pause", None)), (7 * MS, ("resume", None))] * 6)
@example("shift", [(NS, ("pause", None)), (0, ("step", 3)), (30 * MS, ("pause", None)), (0, ("resume", None))])
def test_any_sequence_of_verbs_does_what_the_model_says(policy: str, said: list[tuple[int, Any]]) -> None:
    """Planned in pieces or at once, whole columns at a time: each frame is where the model has it, to the ns."""
    cast = _CAST
    plan, model = plan_of(cast, policy), Model(_POSITIONS, policy, PERIOD_NS)
    sheets, time_ns = [], 0
    for wait_ns, (verb, value) in [*said, (3 * NS, ("speed", Fraction(1000))), (10 * NS, ("resume", None))]:
        if wait_ns > NS // 2:
            sheets.append(plan.until(time_ns + wait_ns // 3))
        time_ns += wait_ns
        sheets.append(plan.until(time_ns))
        model.until(time_ns)
        assert plan.paused == (not model.running or model.stop_ns is not None)
        if verb != "step" or plan.paused:
            plan.act(parse_action(written(verb, value)), time_ns)
        model.act(time_ns, verb, value)
    sheets.append(plan.until(time_ns + 10 * NS))
    model.until(time_ns + 10 * NS)
    sent = [
        (int(at), int(source) - START_NS, int(stamp) - START_NS)
        for sheet in sheets
        for at, source, stamp in zip(sheet.offset_ns, sheet.source_ns, sheet.stamp_ns, strict=True)
    ]
    assert sent == [(at, position, stamp if policy == "shift" else position) for at, position, stamp in model.sent]


_CAST = as_recorded(reel_of(SECONDS))
_POSITIONS = [k * PERIOD_NS for k in range(250)]


def test_a_thousand_changes_cost_no_time() -> None:
    """Speed set to what it is, again and again, between deadlines: every frame leaves as if nothing had been said."""
    changed = play(SECONDS, orders={7 * MS + k * 4_900_001: "speed 1" for k in range(1000)})
    assert changed.times() == [k * PERIOD_NS for k in range(250)]
    assert late_by(changed) == {0}


def test_a_speed_applies_from_where_it_is_said() -> None:
    played = play(SECONDS, orders={NS + 15 * MS: "speed 2"})
    assert played.times()[:51] == [k * PERIOD_NS for k in range(51)]
    assert played.times()[51:] == [NS + 15 * MS + (5 * MS + k * PERIOD_NS) // 2 for k in range(199)]


# --- stamps


@pytest.mark.parametrize("verbs", ["pause\nresume", "pause 0.345", "seek 0.77", "seek 3.3", "loop 1 1.25"])
@pytest.mark.parametrize("latency_ns", [None, 33 * MS])
def test_after_going_on_stamps_are_within_a_second_of_now_and_keep_their_phase(verbs: str, latency_ns: int) -> None:
    source = recording(stream(rate=60, time_base=0xFFFFFF), 300, first_slot=7, latency_ns=latency_ns)
    played = play(source, orders={1_234_567_891: verbs}, duration_ns=6 * NS)
    assert late_by(played) <= {(latency_ns or 0) + slack for slack in range(-60, 61)}
    recorded = {message.frame.data[10:14] for message in source[1:]}
    assert {sent.frame[10:14] for sent in played.data} <= recorded
    assert played.stamps() == sorted(played.stamps()), "nothing goes back in time"
    assert len(set(played.stamps())) == len(played.stamps())
    gaps = np.diff(played.times())
    assert gaps.max() < NS + 400 * MS


def test_keep_goes_on_at_once() -> None:
    played = play(SECONDS, policy="keep", orders={NS + 15 * MS: "pause", NS + 500 * MS: "resume"})
    assert played.times()[51] == NS + 500 * MS + 5 * MS
    assert played.stamps() == [START_NS + k * PERIOD_NS for k in range(250)]


def test_now_stamps_with_the_time_of_sending_whatever_is_said() -> None:
    played = play(SECONDS, policy="now", orders={NS: "pause 1.2345\nspeed 3", 3 * NS: "seek 0"}, duration_ns=7 * NS)
    assert {abs(late) for late in late_by(played)} <= set(range(501))


def test_now_grid_goes_on_at_a_reporting_instant() -> None:
    config = stream(rate=60)
    source = recording(config, 120, first_slot=3)
    played = play(source, policy="now-grid", orders={NS // 3: "pause", NS * 2 // 3 + 7: "resume", NS: "seek 0.123"})
    assert all(abs(late) < 1000 for late in late_by(played))
    slots = [slot(stamp, config.rate) for stamp in played.stamps()]
    assert len(set(slots)) == len(slots)
    assert Counter(np.diff(slots).tolist()).most_common(1)[0][1] >= 115


# --- pausing


def test_a_pause_loses_nothing_and_sends_nothing_twice() -> None:
    played = play(SECONDS, orders={k * 211 * MS: "pause" if k % 2 else "resume" for k in range(1, 41)})
    assert played.numbers() == [*range(250)]
    assert late_by(played) == {0}


def test_copies_that_are_delayed_leave_during_a_pause() -> None:
    played = play(SECONDS, orders={NS: "pause", 3 * NS: "resume"}, profile=faults("delay=constant(300)"))
    before = [time for time in played.times() if time < 3 * NS]
    assert before == [k * PERIOD_NS + 300 * MS for k in range(len(before))]
    assert len(before) in (50, 51), "at most a sheet was planned"
    assert played.numbers() == [*range(250)]


def test_a_pause_in_the_last_frame_lasts_until_it_is_ended() -> None:
    last_ns = 249 * PERIOD_NS
    assert play(SECONDS, orders={last_ns - 10 * MS: "pause", 60 * NS: "resume"}).stage.now_ns >= 60 * NS
    played = play(SECONDS, orders={last_ns - 15 * MS: "pause", 60 * NS: "resume"})
    assert played.numbers() == [*range(250)]


def test_resuming_ends_a_timed_pause_early() -> None:
    played = play(SECONDS, orders={NS: "pause 100", 2 * NS + 5: "resume"})
    assert played.numbers() == [*range(250)]
    assert played.times()[-1] < 8 * NS


def test_resume_while_playing_is_nothing() -> None:
    played = play(SECONDS, orders={k * 33 * MS: "resume" for k in range(1, 100)}, speed="3")
    assert played.times() == [k * PERIOD_NS // 3 for k in range(250)]
    assert played.stamps() == [played.stamps()[0] + k * PERIOD_NS for k in range(250)]


# --- stepping


def steps(source: list[Any], count: int, verb: str = "step", **options: Any) -> Played:
    """A player that begins paused, and makes a step a second."""
    said = {k * NS + 1_000_001: verb for k in range(1, count + 1)} | {10: "pause"}
    return play(source, orders=said, duration_ns=(count + 3) * NS, **options)


def numbers_by_second(played: Played, stream: int = 0) -> list[list[int]]:
    seconds: dict[int, list[int]] = {}
    for time, number in zip(played.times(stream), played.numbers(stream), strict=True):
        seconds.setdefault(time // NS, []).append(number)
    return list(seconds.values())


def test_a_step_is_the_next_frame_of_all_streams() -> None:
    source = interleaved(recording(stream(1), 100), recording(stream(2), 100))
    played = steps(source, 4, policy="keep")
    for place in (0, 1):
        (*_, first), *others = numbers_by_second(played, place)
        assert others == [[first + 1], [first + 2], [first + 3], [first + 4]]
    played = steps(source, 3, "step 5")
    assert [len(numbers) for numbers in numbers_by_second(played, 1)[1:]] == [5, 5, 5]


def test_stamps_of_steps_are_of_the_second_before() -> None:
    played = steps(SECONDS, 5)
    late = [played.began_ns + t - s for t, s in zip(played.times(), played.stamps(), strict=True)]
    assert all(0 <= value < NS for value in late)
    assert played.stamps() == sorted(played.stamps())


@pytest.mark.parametrize("count", [1, 3, 8, 50])
def test_a_step_of_emulated_pmus_is_one_frame_of_each(count: int) -> None:
    played = steps(SECONDS, 3, cast=lambda reel: emulated(reel, count, 1), policy="keep")
    by_second = Counter((sent.at_ns // NS, sent.stream) for sent in played.data if sent.at_ns > NS)
    assert by_second == {(second, part): 1 for second in (1, 2, 3) for part in range(count)}


def test_a_step_over_a_gap_goes_to_the_frame_after_it() -> None:
    source = recording(stream(), 4, slots=[0, 1, 200, 201])
    assert numbers_by_second(steps(source, 4)) == [[0], [1], [2], [3]]


def test_steps_go_round_a_loop_and_end_with_the_last_frame() -> None:
    source = recording(stream(), 3)
    assert numbers_by_second(steps(source, 5, loops=2)) == [[0], [1], [2], [0], [1], [2]][:6]
    played = steps(source, 5, loops=1)
    assert played.numbers() == [0, 1, 2]
    assert played.player.status().state is PlayState.PAUSED or played.player.status().state is PlayState.ENDED


def test_steps_go_round_an_a_b_loop() -> None:
    said = {10: "pause\nloop 1 1.06"} | {k * NS + 1_000_001: "step" for k in range(1, 9)}
    played = play(SECONDS, orders=said, duration_ns=12 * NS)
    assert played.numbers()[-8:] == [50, 51, 52, 50, 51, 52, 50, 51]
    played = play(SECONDS, orders={10: "pause\nloop 1 1.06", NS: "step 5"}, duration_ns=12 * NS)
    assert played.numbers()[-5:] == [50, 51, 52, 50, 51]


def test_a_step_is_refused_while_playing() -> None:
    with pytest.raises(SettingsError, match="pause first"):
        play(SECONDS, orders={NS: "step"})


def test_going_on_ends_a_step_and_so_does_a_pause() -> None:
    played = play(SECONDS, orders={NS: "pause\nstep 100", NS + 500 * MS: "resume"})
    assert played.numbers() == [*range(250)]
    assert played.stage.now_ns < 8 * NS, "it did not stop where the step would have"
    said = {NS: "pause\nstep 100", NS + 500 * MS: "pause", 9 * NS: "resume"}
    played = play(SECONDS, orders=said)
    assert played.numbers() == [*range(250)]
    assert played.stage.now_ns < 9 * NS + 5 * NS


def test_a_seek_within_a_step_leaves_the_player_paused_there() -> None:
    played = play(SECONDS, orders={NS: "pause\nstep 100", NS + 500 * MS: "seek 4", 20 * NS: "resume"})
    assert played.numbers()[-50:] == [*range(200, 250)]
    assert played.times()[-50] >= 20 * NS
    assert len(played.data) < 50 + 30 + 50


# --- seeking


def test_a_seek_jumps_over_frames_and_repeats_others() -> None:
    played = play(SECONDS, orders={NS + 5 * MS: "seek 3.01"})
    assert played.numbers() == [*range(51), *range(151, 250)]
    played = play(SECONDS, orders={NS + 5 * MS: "seek 0.5"})
    assert played.numbers() == [*range(51), *range(25, 250)]
    assert late_by(played) == {0}


@pytest.mark.parametrize(
    ("place", "first"),
    [
        ("1e9", 249),
        ("4.98", 249),
        ("2016-09-08T17:05:13Z", 100),
        ("1999-01-01T00:00:00Z", 0),
        ("2100-01-01T00:00:00Z", 249),
        ("0", 0),
    ],
)
def test_a_seek_is_to_a_frame_of_the_recording(place: str, first: int) -> None:
    played = play(SECONDS, orders={NS + 5 * MS: f"seek {place}"})
    assert played.numbers()[51:] == [*range(first, 250)]


def test_a_seek_into_a_gap_goes_to_its_place_in_time() -> None:
    source = recording(stream(), 100, slots=[*range(50), *range(150, 200)])
    played = play(source, policy="keep", orders={515 * MS: "seek 2"})
    assert played.numbers()[26:] == [*range(50, 100)]
    assert played.times()[26] == 515 * MS + NS


def test_a_seek_by_utc_is_by_the_recorded_stamps_whatever_the_timing() -> None:
    source = recording(stream(), 100, slots=[*range(50), *range(1000, 1050)])
    said = {500 * MS: "seek 2016-09-08T17:05:31.2Z"}  # slot 1010
    for options in ({}, {"skip_gaps_ns": NS}, {"fps": 10}, {"interval_ns": 5 * MS}):
        played = play(source, policy="now", orders=said, **options)
        jumped = played.numbers()
        assert jumped[-40:] == [*range(60, 100)], options
        assert jumped[-41] < 50 or options == {"interval_ns": 5 * MS}


def test_a_paused_player_stays_paused_where_it_is_sent() -> None:
    played = play(SECONDS, orders={NS: "pause", 2 * NS: "seek 4", 3 * NS: "step", 5 * NS: "resume"})
    assert played.numbers()[50:] == [*range(200, 250)] or played.numbers()[51:] == [*range(200, 250)]
    assert [time // NS for time in played.times() if NS + PERIOD_NS < time < 5 * NS] == [3]


def test_a_seek_counts_in_the_present_round(tmp_path: Path) -> None:
    source = recording(stream(), 50)
    rows = ledger_of(tmp_path, source, orders={1_500_000_001: "seek 0.1"}, loops=2)
    assert [row["index"] for row in rows] == [*range(76), *range(55, 100)]


# --- speed


@pytest.mark.parametrize(("speed", "frames"), [("1000", 250), ("0.001", 2)])
def test_extreme_speeds(speed: str, frames: int) -> None:
    played = play(SECONDS[: frames + 1], orders={15 * MS: f"speed {speed}"})
    assert played.times() == [
        0,
        *(floor(15 * MS + (k * PERIOD_NS - 15 * MS) / Fraction(speed)) for k in range(1, frames)),
    ]


@pytest.mark.parametrize("speed", ["0.333333333333333333333333", "1.23456789012345678", "999.99999999999999"])
def test_a_speed_of_many_digits(speed: str) -> None:
    played = play(SECONDS, orders={15 * MS: f"speed {speed}"})
    assert played.numbers() == [*range(250)]
    assert played.times()[-1] == pytest.approx(15 * MS + (249 * PERIOD_NS - 15 * MS) / float(speed), rel=1e-6)


# --- loops


def test_a_to_b_plays_that_over_and_over_until_it_is_off() -> None:
    played = play(SECONDS, policy="keep", orders={NS + 5 * MS: "loop 0.5 1.5", 4 * NS + 5 * MS: "loop off"})
    assert played.numbers() == [*range(75), *range(25, 75), *range(25, 75), *range(25, 250)]
    assert played.times() == [k * PERIOD_NS for k in range(len(played.data))]


def test_a_to_b_goes_to_a_where_it_is_elsewhere() -> None:
    played = play(SECONDS, policy="keep", orders={NS + 5 * MS: "loop 3 4"}, duration_ns=3 * NS)
    assert played.numbers() == [*range(51), *range(150, 200), *range(150, 200)][: len(played.data)]


def test_each_round_from_a_to_b_has_draws_of_its_own(tmp_path: Path) -> None:
    said = {0: "loop 0 1"}
    rows = ledger_of(tmp_path, SECONDS, orders=said, profile=faults("loss=50%"), duration_ns=4 * NS, policy="keep")
    rounds = [[row["fate"] for row in rows if row["index"] // 250 == loop] for loop in range(3)]
    assert [len(fates) for fates in rounds] == [50, 50, 50]
    assert len({tuple(fates) for fates in rounds}) == 3


def test_an_end_beyond_the_recording_is_its_end() -> None:
    played = play(SECONDS, policy="keep", orders={0: "loop 4 99"}, duration_ns=4 * NS)
    assert played.numbers()[1:] == ([*range(200, 250)] * 4)[: len(played.data) - 1]
    assert 190 <= len(played.data) <= 201


@pytest.mark.parametrize(
    ("loop", "why"),
    [
        ("10 20", "its end, or the recording's, is before it"),
        ("3 2016-09-08T17:05:12Z", "its end, or the recording's, is before it"),
        ("1 1.001", "shorter than a reporting interval"),
        ("1 1.000000001", "shorter than a reporting interval"),
    ],
)
def test_a_loop_that_cannot_be_is_refused(loop: str, why: str) -> None:
    with pytest.raises(SettingsError, match=why):
        play(SECONDS, orders={NS: f"loop {loop}"}, policy="keep")


def test_a_loop_without_frames_is_refused() -> None:
    source = recording(stream(), 4, slots=[0, 1, 200, 201])
    with pytest.raises(SettingsError, match="no frame is due between 1 s and 2 s"):
        play(source, orders={0: "loop 1 2"})


# --- before and after


def test_what_is_said_before_the_start_is_done_at_the_start() -> None:
    clock = VirtualClock()
    stage = Stage(clock, plays={7 * NS: started()})
    played = play(
        SECONDS,
        clock=clock,
        stage=stage,
        to=[],
        listen=[parse_endpoint("tcp://127.0.0.1:4712")],
        orders={NS: "pause\nseek 4\nspeed 2\nfault * drop=249", 20 * NS + 1: "resume"},
    )
    assert played.numbers() == [*range(200, 249)]
    assert played.times()[0] == 21 * NS
    assert played.times()[-1] == 21 * NS + 48 * PERIOD_NS // 2


def test_what_cannot_be_is_refused_before_the_start_too() -> None:
    listen = [parse_endpoint("tcp://127.0.0.1:4712")]
    for order, why in (
        ("disable N9", "no such stream; there are PMU 7"),
        ("fault * corrupt=bits(1) field=analogs", "PMU 7: corrupt"),
        ("step", "pause first"),
    ):
        with pytest.raises(SettingsError, match=why):
            play(SECONDS, to=[], listen=listen, orders={NS: order}, duration_ns=9 * NS)


def test_a_loop_that_turns_out_impossible_at_the_start_is_a_warning() -> None:
    clock = VirtualClock()
    stage = Stage(clock, plays={7 * NS: started()})
    listen = [parse_endpoint("tcp://127.0.0.1:4712")]
    played = play(SECONDS, clock=clock, stage=stage, to=[], listen=listen, orders={NS: "loop 50 60"})
    assert played.numbers() == [*range(250)]
    assert played.warnings == ["loop 50 60: a loop from 50 s on: its end, or the recording's, is before it"]


def test_after_the_end_there_is_nothing_to_do() -> None:
    played = play(SECONDS)
    for order in ("pause", "seek 1", "disable *"):
        with pytest.raises(SettingsError, match="the play has ended"):
            played.player.act(parse_action(order))


# --- by the timeline


def ledger_of(tmp_path: Path, source: list[Any], **options: Any) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    path = tmp_path / "ledger.parquet"
    play(source, ledger=path, **options)
    return list(pq.read_table(path).to_pylist())


def profile_of(*at: tuple[float, str]) -> Profile:
    return parse_profile("\n".join(f"[at {time}]\ndo = {do}" for time, do in at), "x.ini")


def test_a_timeline_pauses_seeks_and_changes_speed_at_stream_times() -> None:
    profile = profile_of((1, "pause 2.5"), (2, "speed 2"), (3, "seek 1.5"), (3.5, "speed 1"))
    played = play(SECONDS, policy="keep", profile=profile)
    expected = [(k, k * PERIOD_NS) for k in range(50)]
    expected += [(50 + k, 3_500 * MS + k * PERIOD_NS) for k in range(50)]
    expected += [(100 + k, 4_500 * MS + k * PERIOD_NS // 2) for k in range(50)]
    expected += [(75 + k, 5_000 * MS + k * PERIOD_NS // 2) for k in range(100)]
    expected += [(175 + k, 6_000 * MS + k * PERIOD_NS) for k in range(75)]
    assert list(zip(played.numbers(), played.times(), strict=True)) == expected


def test_a_timeline_loops_and_ends_the_loop() -> None:
    round_ns = 5 * NS
    profile = profile_of((1, "loop 0 1"), ((3 * round_ns + NS // 2) / NS, "loop off"))
    played = play(SECONDS, policy="keep", profile=profile)
    assert played.numbers() == [*range(50)] * 4 + [*range(250)]


def test_several_things_of_one_time_are_done_in_order() -> None:
    profile = profile_of((1, "seek 3\n  speed 2\n  pause 1"))
    played = play(SECONDS, policy="keep", profile=profile)
    assert played.numbers() == [*range(50), *range(150, 250)]
    assert played.times()[50:] == [2 * NS + k * PERIOD_NS // 2 for k in range(100)]


def test_a_timeline_action_that_cannot_be_done_is_a_warning() -> None:
    played = play(SECONDS, profile=profile_of((1, "loop 60 70")))
    assert played.numbers() == [*range(250)]
    assert played.warnings == ["[at 1] loop 60 70: a loop from 60 s on: its end, or the recording's, is before it"]


def test_seconds_of_a_timeline_count_over_loops() -> None:
    played = play(recording(stream(), 50), policy="keep", loops=3, profile=profile_of((1.5, "pause 1")))
    assert np.flatnonzero(np.diff(played.times()) > PERIOD_NS).tolist() == [74]


@pytest.mark.parametrize("policy", ["shift", "keep", "now-grid", "now"])
@pytest.mark.parametrize("rate", [50, 60])
def test_a_timeline_repeats_every_column_but_the_clocks(tmp_path: Path, policy: str, rate: int) -> None:
    profile = parse_profile(
        "[stream *]\nloss = 10%\ndelay = normal(30,8)\n[at 1]\ndo = pause 1.23\n[at 2]\ndo = seek 1\n   speed 3\n"
        "[at 3.3]\ndo = loop 1 2.2\n[at 23.1]\ndo = loop off\n   disable *\n[at 24]\ndo = enable *",
        "x.ini",
    )
    source = recording(stream(rate=rate), 5 * rate, first_slot=7, latency_ns=lambda k: (20 + k % 7) * MS)

    def run(clock: VirtualClock, **options: Any) -> list[dict[str, Any]]:
        rows = ledger_of(
            tmp_path, source, policy=policy, profile=profile, seed=4, clock=clock, stage=Stage(clock, **options)
        )
        return [{name: value for name, value in row.items() if name not in UNREPEATABLE} for row in rows]

    first = run(VirtualClock())
    second = run(VirtualClock(1_800_000_000_987_654_321, 5), cost_ns=33 * MS)
    assert len(first) > 6 * rate
    assert [row for row in first if row not in second] == []
    assert first == second


# --- what is told of it


def test_the_status_follows_the_verbs() -> None:
    seen: list[PlayerStatus] = []
    said = {NS: "pause\nloop 0.5 3\nspeed 2", 3 * NS: "seek 2", 4 * NS: "resume"}
    looks = {at: lambda player: seen.append(player.status()) for at in (NS // 2, 2 * NS, 3 * NS + NS // 2)}
    played = play(SECONDS, orders=said | looks, duration_ns=6 * NS)
    states = {status.elapsed_s: status for status in seen}
    assert states[0.5].state is PlayState.PLAYING
    assert states[0.5].position_s == pytest.approx(0.5, abs=0.03)
    assert states[2.0].state is PlayState.PAUSED
    assert (states[2.0].between, states[2.0].speed) == ((0.5, 3.0), 2.0)
    assert states[2.0].position_s == pytest.approx(1.0, abs=0.03)
    assert states[3.5].position_s == 2.0
    assert states[2.0].sent == states[3.5].sent == 51
    assert states[0.5].length_s == 4.98
    assert played.player.status().state is PlayState.ENDED
