"""Section V of the paper, case by case, through the whole chain: grid, frames as bytes, faults, decoder, controller.

Two frames and then none (Figs. 10, 11, 15), a lost frame (Fig. 12, Algorithm 1), a south that comes late (Figs. 13 to
15), 50 ms without a frame, a stream that stops and returns, all of them lost, and generation lost in the south.
"""

from __future__ import annotations

import cmath
import math
from itertools import pairwise

import pytest
from support.logged import ramps_down
from support.simulated import NAMES, Session, Simulated, simulations

from dcon.core.values import InstanceState, SystemState
from dcon.limiter import SLEW_MW_PER_S
from dcon.sim.plan import START_NS, Plan
from dcon.sim.simulate import simulate
from pmutools.grid.scenarios import SOUTH_LOSS
from pmutools.impair.profile import parse_profile

TICK_S = 1 / 60
SLEW_STEP_MW = SLEW_MW_PER_S / 60 + 1e-9


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    return simulations(tmp_path_factory.mktemp("paper"))


# --- Figs. 10, 11: two frames in one window, none in the next -----------------------------------------------------

PERFECT = Plan(control=False, duration_s=10)
TWO_ZERO = Plan(control=False, duration_s=10, faults=("two-zero-arrival",))


def test_two_then_zero_changes_not_one_bit_of_any_frequency(simulated: Simulated) -> None:
    session = simulated(TWO_ZERO)
    for name in NAMES:
        assert set(session.counts(name)[2:]) == {0, 2}
        assert {a + b for a, b in pairwise(session.counts(name)[2:])} == {2}
    perfect, uneven = simulated(PERFECT).per_stamp(), session.per_stamp()
    for name in NAMES:
        common = perfect[name].keys() & uneven[name].keys()
        assert len(common) >= 594
        assert all(perfect[name][slot].hex() == uneven[name][slot].hex() for slot in common)


def test_two_then_zero_only_holds(simulated: Simulated) -> None:
    """Every command is one that perfect arrival gives too, at most two ticks earlier."""
    session = simulated(TWO_ZERO)
    perfect, uneven = simulated(PERFECT).own_mw(), session.own_mw()
    assert max(map(abs, perfect)) > 50
    for k in range(20, 600):
        assert uneven[k] in perfect[k - 2 : k + 1], k
    held = [record.instances[0].state for record in session.records[20:]]
    assert held.count(InstanceState.HELD) == held.count(InstanceState.READY) == len(held) // 2
    assert not [event for at, event in session.outcome.events if at > 0.5]


# --- Fig. 12: a single lost frame ---------------------------------------------------------------------------------

LOST_SLOT = 600
FIG12 = {"scenario": "south-generation-loss", "gain_mw_per_mhz": 12.0, "faults": ("dropout",), "duration_s": 13.0}
"""5 s after the loss, so that N1 turns at 60 - 0.14 Hz: the spike of an unseen loss grows with the deviation."""


def test_a_lost_frame_that_nobody_sees_is_a_spike(simulated: Simulated) -> None:
    whole = simulated(Plan(**FIG12 | {"faults": ()}))  # type: ignore[arg-type]
    lossy = simulated(Plan(**FIG12))  # type: ignore[arg-type]
    true, seen = whole.unhandled("N1"), lossy.unhandled("N1")
    assert LOST_SLOT not in seen and len(seen) == len(true) - 1
    spike = max(abs(seen[slot] - true[slot]) for slot in seen if slot > 3)
    deviation = abs(true[LOST_SLOT])
    assert deviation > 0.13
    assert spike == pytest.approx(0.112 * deviation, rel=0.1)
    assert 12e3 * spike > 125, "at 12 MW/mHz that saturates the command"


def test_a_lost_frame_disables_and_its_spike_goes_nowhere(simulated: Simulated) -> None:
    session = simulated(Plan(**FIG12))  # type: ignore[arg-type]
    stamps = session.stamps_s("N1")
    assert [round(b * 60) for a, b in pairwise(stamps) if round((b - a) * 60) != 1] == [LOST_SLOT + 1]
    (seen_s,) = session.when("stamp_step", "N1")
    assert seen_s == pytest.approx((LOST_SLOT + 1) * TICK_S + 0.071, abs=1e-4)  # with the next frame
    assert session.when("selected", "N2-S1") == [seen_s]
    k = session.tick_at(seen_s)
    command = session.outcome.command_mw
    assert command[k] == pytest.approx(command[k - 1], abs=1e-9)
    assert session.largest_step() < 8
    after = {instance.state for instance in session.records[k + 3].instances[:4]}
    assert after == {InstanceState.INITIALISING}, "20 s to go for all four of N1"
    assert session.outcome.final_state == "ACTIVE"


def test_a_lost_frame_bridged_by_its_midpoint(simulated: Simulated) -> None:
    """Algorithm 1: no instance is lost, and the error is a hundredth of the spike's."""
    bridged = simulated(Plan(**FIG12, interpolate_single_loss=True))  # type: ignore[arg-type]
    whole = simulated(Plan(**FIG12 | {"faults": ()}))  # type: ignore[arg-type]
    assert len(bridged.when("interpolated", "N1")) == 1 and len(bridged.when("selected", "N1-S1")) == 1
    assert not [event for at, event in bridged.outcome.events if at > 1 and event.name != "interpolated"]
    true, seen = whole.per_stamp()["N1"], bridged.per_stamp()["N1"]
    assert LOST_SLOT in seen, "the estimate stands for the lost frame"
    # the loop is closed: what the command did differently comes back, so look at the next frames alone
    assert max(abs(seen[slot] - true[slot]) for slot in range(LOST_SLOT, LOST_SLOT + 8)) < 0.15e-3


# --- Figs. 13, 14: the south comes later --------------------------------------------------------------------------


def south_loss(samples: int, align: bool, **given: object) -> Plan:
    faults = (f"south-delay-{samples}",) if samples else ()
    plan = {"gain_mw_per_mhz": 10.0, "duration_s": 7.0, "faults": faults, "align": align, **given}
    return Plan("south-generation-loss", **plan)  # type: ignore[arg-type]


def first_mw(session: Session) -> float:
    return next(mw for mw in session.outcome.command_mw if abs(mw) > 0.05)


def test_frequency_falls_in_the_south_first(simulated: Simulated) -> None:
    """As the PMUs report it: angle and FREQ fall at both ends, in the south 30 ms earlier and further."""
    session = simulated(south_loss(0, align=True, control=False))
    frames = {
        name: {round((f.time_ns - START_NS) * 60 / 1e9): f for t in session.ticks for f in t.frames if f.name == name}
        for name in ("N1", "N2", "S1")
    }
    fell = {name: next(slot for slot, f in of.items() if f.frequency_hz < 59.999) for name, of in frames.items()}
    assert fell["S1"] < fell["N1"] and fell["N1"] - fell["S1"] <= 4
    for name, of in frames.items():
        before, after = of[299], of[410]
        assert before.frequency_hz == 60.0 and after.frequency_hz == pytest.approx(59.92, abs=0.01), name
        # the angle turns with it: 2π times the integral of the deviation
        turned = 2 * math.pi * sum(of[slot].frequency_hz - 60 for slot in range(300, 411)) / 60
        found = cmath.phase(after.v1 / before.v1)
        assert abs(math.remainder(found - turned, 2 * math.pi)) < 0.01, name
    f = session.per_stamp()
    assert all(f["N1"][slot] > f["S1"][slot] for slot in range(304, 360))


@pytest.mark.parametrize("samples", [0, 3, 6])
def test_aligned_the_first_command_helps_the_south(samples: int, simulated: Simulated) -> None:
    session = simulated(south_loss(samples, align=True))
    late_ms = samples * TICK_S * 1e3
    for name, delay_ms in (("N1", 60.0), ("S3", 60.0 + late_ms)):
        assert session.delays_ms(name) == pytest.approx([delay_ms] * len(session.stamps_s(name)), abs=1e-3)
    assert first_mw(session) > 0
    # nothing but delay: until the grid has answered, the commands are those of no asymmetry, so many ticks later
    none, now = simulated(south_loss(0, align=True)).outcome.command_mw, session.outcome.command_mw
    assert now[300 + samples : 306 + samples] == none[300:306] and none[305] > 5


@pytest.mark.parametrize("samples", [3, 6])
def test_not_aligned_the_first_command_hurts_the_south(samples: int, simulated: Simulated) -> None:
    """The false difference is the rate of change of frequency times the delay."""
    session = simulated(south_loss(samples, align=False))
    assert first_mw(session) < 0
    open_loop = simulated(south_loss(samples, align=False, control=False))
    aligned = simulated(south_loss(samples, align=True, control=False))
    k = 330  # half a second after the loss, less the filter
    false_mhz = open_loop.outcome.delta_f_mhz[k] - aligned.outcome.delta_f_mhz[k]
    rocof_mhz_s = SOUTH_LOSS.rocof_hz_s * 1e3 * math.exp(-0.3 * SOUTH_LOSS.rocof_hz_s / SOUTH_LOSS.settles_hz)
    assert false_mhz == pytest.approx(rocof_mhz_s * samples / 60, rel=0.2)
    assert min(session.outcome.command_mw) < -15 * samples / 3


# --- Fig. 15: late and uneven at once -----------------------------------------------------------------------------


@pytest.mark.parametrize("arrival", ["irregular", "two-zero-arrival"])
def test_uneven_and_late_arrival_needs_alignment_all_the_more(arrival: str, simulated: Simulated) -> None:
    faults = (arrival, "south-delay-6")
    perfect = simulated(south_loss(0, align=True, control=False))
    aligned = simulated(south_loss(0, align=True, control=False, faults=faults))
    loose = simulated(south_loss(0, align=False, control=False, faults=faults))
    expected = set(perfect.own_mw())
    assert set(aligned.own_mw()[20:]) <= expected, "held and late, and else what perfect arrival gives"
    wrong = [mw for mw in loose.own_mw()[20:370] if mw not in expected]
    assert len(wrong) > 30 and min(wrong) < -30
    assert min(aligned.own_mw()[20:370]) == 0.0, "the first half swing is the right way throughout"


def test_alignment_only_delays_the_loop() -> None:
    """With a south 100 ms late the aligned loop damps as one that is longer by 100 ms."""
    late = simulate(Plan(gain_mw_per_mhz=12, faults=("south-delay-6",), duration_s=18.5))
    longer = simulate(Plan(gain_mw_per_mhz=12, delay_ms=182, duration_s=18.5))
    assert late.mode is not None and longer.mode is not None
    assert late.mode.damping_percent == pytest.approx(longer.mode.damping_percent, abs=0.02)
    assert late.final_state == "ACTIVE"


# --- section IV b: 50 ms ------------------------------------------------------------------------------------------


def silence(frames: int) -> Plan:
    """So many frames of N1 come with the one after them."""
    until_s = 10 + frames * TICK_S - 1e-3
    profile = parse_profile(f"[stream N1]\ndisable = 10..{until_s:.6f} release=burst\n", "silence")
    return Plan(gain_mw_per_mhz=12, profile=profile, duration_s=11)


def test_two_windows_without_a_frame_are_held(simulated: Simulated) -> None:
    session = simulated(silence(2))
    k = session.tick_at(10.071)
    assert session.counts("N1")[k - 1 : k + 4] == [1, 0, 0, 3, 1]
    assert [session.records[j].instances[0].state for j in range(k - 1, k + 3)] == ["READY", "HELD", "HELD", "READY"]
    own = session.own_mw()
    assert own[k - 1] == own[k] == own[k + 1] != own[k + 2]
    assert session.when("arrival_gap", "N1") == [] and len(session.when("selected", "N1-S1")) == 1
    reference = simulated(Plan(gain_mw_per_mhz=12, duration_s=11))
    assert session.per_stamp()["N1"].keys() == reference.per_stamp()["N1"].keys(), "all frames were filtered"


def test_more_than_50_ms_without_a_frame_disable(simulated: Simulated) -> None:
    session = simulated(silence(4))
    last_arrival_s = 10 - TICK_S + 0.060
    (gap_s,) = session.when("arrival_gap", "N1")
    assert 0.050 < gap_s - last_arrival_s <= 0.050 + TICK_S
    k = session.tick_at(gap_s)
    assert [session.records[j].instances[0].state for j in range(k - 3, k + 1)] == ["READY", "HELD", "HELD", "DISABLED"]
    assert {instance.state for instance in session.records[k].instances[:4]} == {InstanceState.DISABLED}
    assert session.when("selected", "N2-S1") == [gap_s]
    assert session.largest_step() <= SLEW_STEP_MW


# --- streams that stop, and return --------------------------------------------------------------------------------

STOP = Plan(gain_mw_per_mhz=12, faults=("stream-stop",))


def test_a_stopped_stream_is_left_without_a_step(simulated: Simulated) -> None:
    session = simulated(STOP)
    stamps = session.stamps_s("N1")
    before, after = [s for s in stamps if s < 10], [s for s in stamps if s >= 10]
    assert before[-1] == pytest.approx(10 - TICK_S, abs=1e-5) and after[0] == pytest.approx(40, abs=1e-5)
    last_arrival_s = before[-1] + 0.060
    (gap_s,) = session.when("arrival_gap", "N1")
    assert 0.050 < gap_s - last_arrival_s <= 0.050 + TICK_S + 1e-6
    assert session.when("selected", "N2-S1") == [gap_s]
    assert session.largest_step() <= SLEW_STEP_MW
    k = session.tick_at(gap_s)
    command, own = session.outcome.command_mw, session.own_mw(4)
    assert abs(own[k] - command[k - 1]) > 0.01, "what a plain switch would have jumped by"
    assert command[k] == pytest.approx(command[k - 1], abs=1e-9)
    assert command[k + 61] == pytest.approx(own[k + 61], abs=1e-9), "a second later the new one is followed alone"


def test_a_stream_that_returns_is_verified_for_20_s(simulated: Simulated) -> None:
    session = simulated(STOP)
    (ready_s,) = [at for at in session.when("instance_ready", "N1-S1") if at > 1]
    assert ready_s == pytest.approx(40 + 20 + 0.1, abs=0.05)
    assert session.outcome.plan.length_s == 65  # as long as it takes to see that
    assert session.outcome.final_state == "ACTIVE"
    assert session.when("selected", "N1-S1")[1:] == []  # no haste to go back


def test_the_better_instance_takes_over_again_after_60_s_more() -> None:
    profile = parse_profile("[stream N1]\ndisable = 1..2\n", "stop")
    outcome = simulate(Plan("ambient", gain_mw_per_mhz=12, profile=profile, duration_s=83.5))
    selected = [(at, event.subject) for at, event in outcome.events if event.name == "selected"]
    assert [subject for _, subject in selected] == ["N1-S1", "N2-S1", "N1-S1"]
    back_s = selected[2][0]
    assert back_s == pytest.approx(2 + 20 + 60 + 0.1, abs=0.05)
    k = next(k for k, at in enumerate(outcome.tick_s) if at >= back_s - 1e-6)
    steps = [abs(b - a) for a, b in pairwise(outcome.command_mw)]
    assert steps[k - 1] < 1e-9 and max(steps) <= SLEW_STEP_MW


def test_all_sixteen_lost(simulated: Simulated) -> None:
    """Every stream stops while the command is far from 0: it ramps down in a second, and the controller disarms."""
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("all-stop",), duration_s=13))
    for name in NAMES:
        assert session.stamps_s(name)[-1] == pytest.approx(10 - TICK_S, abs=1e-5)
    (fell_s,) = session.when("rampdown", "system")
    assert 0.050 < fell_s - (10 - TICK_S + 0.060) <= 0.050 + TICK_S + 1e-6
    k, command = session.tick_at(fell_s), session.outcome.command_mw
    assert abs(ramps_down(session.records, k)) > 1
    last = session.records[-1]
    assert (last.state, last.command_mw, last.output_v, last.active) == (SystemState.STANDBY, 0.0, 0.0, None)
    assert {instance.state for instance in last.instances} == {InstanceState.DISABLED}
    assert all(math.isfinite(mw) for mw in command)
