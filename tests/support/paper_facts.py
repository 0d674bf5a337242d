"""What has to be seen of the paper's cases, each fact judged from a session log by itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
from support import paper_course as course
from support.course_run import DEADBAND_MHZ, GAIN, CourseRun, LiveSession
from support.logged import NAMES, RATE, ramps_down

from dcon.core.values import SystemState

UNTOUCHED = ("N3", "N4", "S2", "S3", "S4")
"""PMUs to which nothing happens alone."""


@dataclass(frozen=True)
class Seen:
    """What a fact is judged from."""

    run: CourseRun
    session: LiveSession
    ticks: range
    """Those of the case."""

    def at(self, time_s: float) -> int:
        return self.session.tick_at(time_s)


def fell_in_the_south_first(seen: Seen) -> None:
    fell = {}
    for name in ("N1", "S1"):
        frames = [f for tick in seen.session.ticks for f in tick.frames if f.name == name]
        fell[name] = next(seen.session.slot(f.time_ns) for f in frames if f.frequency_hz < 59.999)
    assert course.LOSS_S[0] * RATE <= fell["S1"] < fell["N1"]


def first_command(loss: int, sign: int, seen: Seen) -> str:
    session, loss_s = seen.session, course.LOSS_S[loss]
    before, k = session.command_mw[seen.at(loss_s - 1) : seen.at(loss_s)], seen.at(loss_s)
    assert set(before) == {0.0}, "all is quiet until then"
    first = next(j for j in range(k, k + RATE) if session.command_mw[j])
    furthest = max(session.command_mw[first : first + 12], key=abs)
    assert math.copysign(1, session.command_mw[first]) == sign == math.copysign(1, furthest)
    after_ms = (session.seconds(session.records[first].tick_ns) - loss_s) * 1e3
    return f"{after_ms:.0f} ms after the loss, {furthest:+.1f} MW within 0.2 s of that"


def differences_are_of_one_stamp(seen: Seen) -> None:
    """Of every tick of the case and every instance whose PMUs are whole until then."""
    session, perfect = seen.session, seen.run.perfect
    names = UNTOUCHED if seen.ticks.stop > seen.at(course.DROPPED_S) else NAMES
    newest = session.newest
    judged = 0
    for index, pair in enumerate(session.reader.instances):
        north, south = pair.split("-")
        if north not in names or south not in names:
            continue
        for k in seen.ticks:
            slot = min(newest[north][k], newest[south][k])
            expected = (perfect[north][slot] - perfect[south][slot]) * 1e3
            found = session.records[k].instances[index]
            assert found.delta_f_mhz == expected, (k, pair)
            assert found.command_mw == pytest.approx(law(expected), abs=1e-9)
            judged += 1
    assert judged >= 6 * len(seen.ticks)


def law(delta_f_mhz: float) -> float:
    """P of a difference: gain and deadband of this course."""
    return math.copysign(GAIN * max(abs(delta_f_mhz) - DEADBAND_MHZ, 0.0), delta_f_mhz)


def differences_are_of_two_stamps(seen: Seen) -> str:
    session, k = seen.session, seen.ticks.start
    apart = {session.newest["N3"][k] - session.newest["S3"][k] for k in seen.ticks}
    assert max(apart) - min(apart) <= 1 and min(apart) >= 3
    perfect, false = seen.run.perfect, 0.0
    for k in seen.ticks:
        north, south = session.newest["N3"][k], session.newest["S3"][k]
        found = session.records[k].instances[session.reader.instances.index("N3-S3")]
        assert found.delta_f_mhz == (perfect["N3"][north] - perfect["S3"][south]) * 1e3
        false = min(false, found.delta_f_mhz - (perfect["N3"][south] - perfect["S3"][south]) * 1e3)
    return f"by up to {-false:.1f} mHz"


def no_bit_is_changed(seen: Seen) -> None:
    found, until = seen.session.frequencies, round(course.TWO_ZERO_S[1] * RATE)
    for name in NAMES:
        slots = [slot for slot in sorted(found[name]) if slot < until]
        assert slots == list(range(slots[0], until)) and slots[0] <= RATE
        assert [found[name][slot].hex() for slot in slots] == [
            f.hex() for f in seen.run.perfect[name][slots[0] : until]
        ]


def every_second_tick_is_held(seen: Seen) -> None:
    session = seen.session
    inner = range(seen.ticks.start + 6, seen.ticks.stop)
    for name in NAMES:
        counts = session.counts(name)
        assert {counts[k] for k in inner} == {0, 2} and {counts[k] + counts[k + 1] for k in inner[:-1]} == {2}
    for k in inner:
        states = {str(instance.state) for instance in session.records[k].instances}
        assert states == {"READY" if session.counts("N1")[k] else "HELD"}
        if states == {"HELD"}:
            assert session.command_mw[k] == session.command_mw[k - 1]


def lost_frame_disables(seen: Seen) -> None:
    session, lost = seen.session, round(course.DROPPED_S * RATE)
    assert lost not in {slot for _, slot, _ in session.taken("N1")}
    after = next(k for k, slot, _ in session.taken("N1") if slot == lost + 1)
    assert session.fault("stamp_step", "N1") == after
    disabled_at(session, "N1", after)


def disabled_at(session: LiveSession, name: str, tick: int) -> None:
    """Every instance of a PMU, and none before."""
    for instance in session.of(name):
        assert session.states(instance, range(tick, tick + 1)) == ["DISABLED"]
        assert "DISABLED" not in session.states(instance, range(tick - 6, tick))


def next_one_takes_over(check: str, name: str, instance: str, seen: Seen) -> str:
    """In that tick, without a step; a second later it is followed alone."""
    session, k = seen.session, seen.session.fault(check, name)
    index = session.reader.instances.index(instance)
    assert [event.subject for event in session.records[k].events if event.name == "selected"] == [instance]
    command, own = session.command_mw, session.own_mw(index)
    assert abs(command[k] - command[k - 1]) <= 1e-9
    jump = abs(own[k] - command[k - 1])
    assert jump > 0.01, "what a plain switch would have jumped by"
    assert command[k + 61] == pytest.approx(own[k + 61], abs=1e-9)
    return f"a plain switch would have jumped by {jump:.2f} MW"


def unseen_it_is_a_spike(seen: Seen) -> str:
    """What the filter alone would make of the frames that came."""
    session, lost = seen.session, round(course.DROPPED_S * RATE)
    alone = {slot: f_hz for slot, f_hz in session.unhandled("N1").items() if slot < lost + RATE}
    perfect = seen.run.perfect["N1"]
    before = max(abs(alone[slot] - perfect[slot]) for slot in alone if 600 < slot < lost)
    spike = max(abs(alone[slot] - perfect[slot]) for slot in alone if slot > lost)
    deviation = abs(perfect[lost])
    assert before == 0 and spike == pytest.approx(0.112 * deviation, rel=0.1)
    k = session.fault("stamp_step", "N1")
    around = session.command_mw[k - 6 : k + 60]
    assert GAIN * 1e3 * spike > 3 * max(map(abs, around)), "and it is not in the command"
    return f"{spike * 1e3:.1f} mHz, {GAIN * 1e3 * spike:.0f} MW"


def lost_frame_is_bridged(seen: Seen) -> None:
    session, lost = seen.session, round(course.DROPPED_S * RATE)
    after = next(k for k, slot, _ in session.taken("N1") if slot == lost + 1)
    assert session.fault("interpolated", "N1") == after
    for instance in session.of("N1"):
        assert set(session.states(instance, seen.ticks)) <= {"READY", "HELD"}


def bridged_within(seen: Seen) -> str:
    lost = round(course.DROPPED_S * RATE)
    found, perfect = seen.session.frequencies["N1"], seen.run.perfect["N1"]
    error = max(abs(found[slot] - perfect[slot]) for slot in range(lost, lost + 60))
    assert lost in found and error < 0.15e-3
    return f"by {error * 1e3:.3f} mHz at most"


def two_windows_are_held(seen: Seen) -> None:
    session, late = seen.session, round(course.HELD_S * RATE)
    came = {slot: k for k, slot, _ in session.taken("S1")}
    k = came[late]
    assert came[late - 1] == k - 3 and came[late + course.HELD_FRAMES] == k, "none in two windows, then three"
    for instance in session.of("S1"):
        assert session.states(instance, range(k - 3, k + 1)) == ["READY", "HELD", "HELD", "READY"]
    own = session.own_mw(session.reader.instances.index("N1-S1"))
    assert own[k - 3] == own[k - 2] == own[k - 1] != own[k]
    assert session.command_mw[k - 3] == session.command_mw[k - 1], "N1-S1 is followed"


def held_frames_are_filtered(seen: Seen) -> None:
    found, perfect = seen.session.frequencies["S1"], seen.run.perfect["S1"]
    slots = range(round(course.HELD_S * RATE) - 10, round(course.DROPPED_S * RATE))
    assert [found[slot].hex() for slot in slots] == [perfect[slot].hex() for slot in slots]


def silent_for_50_ms(name: str, seen: Seen) -> str:
    """Disabled in the first tick whose newest arrival is older."""
    session, k = seen.session, seen.session.fault("arrival_gap", name)
    arrivals = [arrival_ns for j, _, arrival_ns in session.taken(name) if j <= k]
    silence_ms = [(session.records[j].tick_ns - max(arrivals)) / 1e6 for j in (k - 1, k)]
    assert silence_ms[0] <= 50 < silence_ms[1]
    disabled_at(session, name, k)
    return f"{silence_ms[1]:.1f} ms, and {silence_ms[0]:.1f} ms in the tick before"


def verified_for_20_s(seen: Seen) -> str:
    """READY in the tick of the 1,200th common stamp with a frequency, which takes three frames at first."""
    session, back = seen.session, round(course.STOP_S[1] * RATE)
    first = min(slot for _, slot, _ in session.taken("N2") if slot >= round(course.STOP_S[0] * RATE))
    assert first == back
    north, south = session.newest["N2"], session.newest["S2"]
    wanted = next(k for k in range(len(north)) if min(north[k], south[k]) >= back + 2 + 20 * RATE - 1)
    index = session.reader.instances.index("N2-S2")
    k = session.tick_at(course.STOP_S[1])
    assert set(session.states(index, range(k + 12, wanted))) == {"INITIALISING"}
    assert session.states(index, range(wanted, wanted + 1)) == ["READY"]
    ready_s = session.seconds(session.records[wanted].tick_ns)
    assert session.when("instance_ready", "N2-S2")[1:] == [pytest.approx(ready_s, abs=1e-6)]
    return f"{ready_s - course.STOP_S[1]:.2f} s after its first stamp"


def not_gone_back_to(seen: Seen) -> None:
    session = seen.session
    k = session.tick_at(session.when("instance_ready", "N2-S2")[1])
    assert {session.reader.instances[session.records[j].active or 0] for j in (k - 1, k, k + 30)} == {"N3-S2"}


def comes_down_in_a_second(seen: Seen) -> str:
    session = seen.session
    (fell_s,) = session.when("rampdown", "system")
    k = session.tick_at(fell_s)
    assert {str(instance.state) for instance in session.records[k].instances} == {"DISABLED"}
    assert "DISABLED" not in {str(instance.state) for instance in session.records[k - 1].instances if instance.active}
    newest_ns = max(arrival for name in NAMES[:4] for j, _, arrival in session.taken(name) if j <= k)
    silence_ms = [(session.records[j].tick_ns - newest_ns) / 1e6 for j in (k - 1, k)]
    assert silence_ms[0] <= 50 < silence_ms[1]
    start = ramps_down(session.records, k)
    assert abs(start) > 10
    return f"{silence_ms[1]:.1f} ms after the last frame of the north, from {start:.1f} MW"


def nothing_is_driven(seen: Seen) -> None:
    session = seen.session
    end = session.tick_at(session.when("standby", "system")[-1])
    after = session.records[end:]
    assert {(r.state, r.command_mw, r.output_v, r.active) for r in after} == {(SystemState.STANDBY, 0.0, 0.0, None)}
    assert {str(instance.state) for record in after for instance in record.instances} == {"DISABLED"}
    left = [command for command in session.commands if command.time_ns > session.records[end].tick_ns]
    assert left and not any(command.output_v or command.command_mw for command in left)
