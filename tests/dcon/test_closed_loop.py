"""Controller and grid together: Table II, delays, lost streams."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from support.logged import ramps_down
from support.loop import MS, START_NS, Arrival, Session, on_time, params, run

from dcon.core.differentiator import PAPER_60, response
from dcon.core.values import InstanceState, SystemState
from pmutools.grid.modal import SINGLE_MODE
from pmutools.grid.pmu_model import fleet
from pmutools.grid.theory import closed_loop_eigenvalue, frequency_and_damping
from pmutools.modal.matrix_pencil import ringdown


def feedback(s: complex) -> complex:
    """The differentiator, over true frequency."""
    return response(PAPER_60, cmath.exp(s / 60)) * 2 * math.pi / s


def fitted(session: Session, start_s: float = 6.5, stop_s: float = 18.5) -> tuple[float, float]:
    mode = ringdown(np.array(session.difference_hz) * 1e3, 60.0, start_s, stop_s).dominant()
    assert mode is not None
    return mode.frequency_hz, 100 * mode.damping


def exact(gain: float, delay_s: float = 0.082) -> tuple[float, float]:
    root = closed_loop_eigenvalue(SINGLE_MODE, SINGLE_MODE[0], gain, delay_s=delay_s, feedback=feedback)
    hz, ratio = frequency_and_damping(root)
    return hz, 100 * ratio


@pytest.mark.parametrize(("gain", "hz", "percent"), [(0, 0.425, 7.8), (9, 0.433, 10.3), (12, 0.435, 11.4)])
def test_simulation_rows_of_table_2(gain: float, hz: float, percent: float) -> None:
    session = run(params(gain_mw_per_mhz=gain), duration_s=19)
    got = fitted(session)
    assert got[0] == pytest.approx(hz, abs=1.5e-3)
    assert got[1] == pytest.approx(percent, abs=0.15)
    assert got == pytest.approx(exact(gain), abs=0.01)
    assert session.records[-1].state is SystemState.ACTIVE
    assert session.records[-1].flags == 0
    assert max(abs(record.command_mw) for record in session.records) < 125


def on_the_spot(_pmu: str, _index: int, time_ns: int) -> tuple[int, ...]:
    return (time_ns,)


@pytest.mark.parametrize(("delay_ms", "percent"), [(0, 11.73), (113, 11.09), (300, 9.16), (500, 6.57)])
def test_damping_falls_with_delay(delay_ms: float, percent: float) -> None:
    session = run(params(gain_mw_per_mhz=12), duration_s=19, arrivals=on_the_spot, tick_age_ms=0.0, command_ms=delay_ms)
    got = fitted(session)
    assert got[1] == pytest.approx(percent, abs=0.02)
    assert got == pytest.approx(exact(12, delay_ms / 1e3), abs=0.01)


def test_an_undamped_mode_is_damped_by_the_controller() -> None:
    with_control = fitted(run(params(gain_mw_per_mhz=12), scene="bc-us-separation", duration_s=27), 6.5, 26.5)
    without = fitted(run(params(gain_mw_per_mhz=0), scene="bc-us-separation", duration_s=20))
    assert without == pytest.approx((0.37, 0.0), abs=1e-3)
    assert with_control[1] == pytest.approx(4.1, abs=0.1)


def test_open_loop_drives_nothing() -> None:
    session = run(params(gain_mw_per_mhz=12), duration_s=19, closed=False)
    assert fitted(session) == pytest.approx((0.425, 7.8), abs=0.01)
    assert max(abs(record.command_mw) for record in session.records) > 100
    assert {record.output_v for record in session.records} == {0.0}


def steps(session: Session) -> list[float]:
    commands = [record.command_mw for record in session.records]
    return [abs(b - a) for a, b in pairwise(commands)]


def without(names: Sequence[str], from_s: float, to_s: float = math.inf) -> Arrival:
    """Frames of some PMUs, stamped within a time, are lost."""

    def arrivals(pmu: str, index: int, time_ns: int) -> tuple[int, ...]:
        lost = pmu in names and from_s <= (time_ns - START_NS) / 1e9 < to_s
        return () if lost else on_time(pmu, index, time_ns)

    return arrivals


def test_a_stopped_stream_is_left_within_50_ms_and_a_tick_without_a_step() -> None:
    session = run(params(), duration_s=14, arrivals=without(["N1"], 10.0))
    (gap_s,) = session.times("arrival_gap")
    last_arrival_s = 10.0 - 1 / 60 + 0.060
    assert 0.050 < gap_s - last_arrival_s <= 0.050 + 1 / 60 + 1e-6
    assert session.times("selected") == [pytest.approx(0.104, abs=1e-3), gap_s]
    names = session.params.instance_names
    before, after = session.at(gap_s - 0.01), session.at(gap_s)
    assert names[session.at(gap_s - 0.1).active or 0] == "N1-S1" and names[after.active or 0] == "N2-S1"
    assert after.instances[4].command_mw != pytest.approx(before.command_mw, abs=0.1)  # there was a step to hide
    k = session.records.index(after)
    assert after.command_mw == pytest.approx(session.records[k - 1].command_mw, abs=1e-9)
    assert max(steps(session)[600:]) < 8.0
    # A second later it follows the new instance alone.
    late = session.at(gap_s + 1.05)
    assert late.command_mw == pytest.approx(late.instances[4].command_mw)
    assert late.state is SystemState.ACTIVE


def test_a_stream_that_returns_is_ready_after_20_s_and_active_after_60_more() -> None:
    settings = params(return_s=3.0)
    session = run(settings, duration_s=40, arrivals=without(["N1"], 10.0, 12.0))
    (ready_s,) = [at for at in session.times("instance_ready", "N1-S1") if at > 10]
    assert ready_s == pytest.approx(12.0 + 20.0 + 0.1, abs=0.05)
    assert session.times("selected", "N1-S1")[-1] == pytest.approx(ready_s + 3.0, abs=0.02)
    assert max(steps(session)[600:]) < 8.0


def test_all_streams_stopped_ramp_to_zero_and_disarm() -> None:
    everyone = [pmu.name for pmu in fleet()]
    session = run(params(), duration_s=14, arrivals=without(everyone, 7.0))
    (fell_s,) = session.times("rampdown")
    assert fell_s - (7.0 - 1 / 60 + 0.060) <= 0.050 + 1 / 60 + 1e-6
    assert abs(ramps_down(session.records, session.records.index(session.at(fell_s)))) > 10
    assert session.records[-1].active is None and session.records[-1].output_v == 0.0
    assert {instance.state for instance in session.records[-1].instances} == {InstanceState.DISABLED}


@pytest.mark.parametrize("bridge", [False, True])
def test_a_single_lost_frame(bridge: bool) -> None:
    def arrivals(pmu: str, index: int, time_ns: int) -> tuple[int, ...]:
        return () if (pmu, index) == ("S1", 450) else on_time(pmu, index, time_ns)

    session = run(params(interpolate_single_loss=bridge), duration_s=10, arrivals=arrivals)
    whole = run(params(), duration_s=10)
    switches = [at for at in session.times("selected") if at > 1]
    at_s = 451 / 60 + 0.0710  # seen with the next frame
    if bridge:
        assert switches == [] and session.times("interpolated") == [pytest.approx(at_s, abs=1e-3)]
        difference = [abs(a.command_mw - b.command_mw) for a, b in zip(session.records, whole.records, strict=True)]
        assert max(difference[:454]) == 0.0
        assert max(difference[456:]) < 0.2
        assert sorted(difference)[-1] < 4.0  # one tick without news
    else:
        assert switches == [pytest.approx(at_s, abs=1e-3)] == session.times("stamp_step", "S1")
        assert session.at(8.0).active == 1  # N1-S2
        assert {
            i.state
            for i, pair in zip(session.at(8.0).instances, session.params.instances, strict=True)
            if pair.south == 4
        } == {InstanceState.INITIALISING}
    assert max(steps(session)) < 8.0


def test_noise_of_1_5_mrad_is_1_4_mhz_of_difference() -> None:
    session = run(params(gain_mw_per_mhz=0), duration_s=15, scene="ambient", pmus=fleet(noise_rad=1.5e-3))
    truth = np.array([d * 1e3 for d in session.difference_hz])
    seen = np.array([record.delta_f_mhz for record in session.records])
    lag = 4 + 6  # ticks of arrival and of filter (104 ms)
    assert np.std(seen[60:880] - truth[60 - lag : 880 - lag]) == pytest.approx(1.41, abs=0.25)
    assert session.records[-1].state is SystemState.ACTIVE


def test_jitter_and_table_1_delays_cost_no_instance() -> None:
    def arrivals(pmu: str, index: int, time_ns: int) -> tuple[int, ...]:
        return (time_ns + 60 * MS + (index * 7919 + len(pmu)) % 23 * MS,)

    session = run(params(), duration_s=10, arrivals=arrivals)
    assert not [at for at in session.times("instance_disabled") if at > 1]
    assert session.records[-1].state is SystemState.ACTIVE
