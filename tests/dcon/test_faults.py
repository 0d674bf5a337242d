"""Faults by name: that each happens to the frames, and costs what it may. The paper's cases: test_paper_cases."""

from __future__ import annotations

from itertools import pairwise

import pytest
from support.simulated import NAMES, Simulated, simulations

from dcon.sim.faults import FAULTS
from dcon.sim.plan import Plan

TICK_MS = 1e3 / 60


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    return simulations(tmp_path_factory.mktemp("faults"))


def test_every_fault_is_there() -> None:
    assert set(FAULTS) == {
        *("stream-stop", "all-stop", "dropout", "two-zero-arrival", "south-delay-3", "south-delay-6"),
        *("table1-delays", "irregular"),
    }


def test_a_perfect_session_misses_nothing(simulated: Simulated) -> None:
    session = simulated(Plan(control=False, duration_s=10))
    for name in NAMES:
        assert session.counts(name) == [1] * 600
        assert session.delays_ms(name) == pytest.approx([60.0] * 600, abs=1e-3)


@pytest.mark.parametrize("name", ["two-zero-arrival", "irregular", "table1-delays"])
def test_uneven_arrival_costs_no_instance_and_little_damping(name: str, simulated: Simulated) -> None:
    session = simulated(Plan(gain_mw_per_mhz=12, faults=(name,), duration_s=18.5))
    assert session.outcome.mode is not None
    assert session.outcome.mode.damping_percent == pytest.approx(11.3, abs=0.1)
    assert session.outcome.final_state == "ACTIVE"
    late = [event for at, event in session.outcome.events if at > 0.5]
    assert [event for event in late if event.name.startswith("instance_")] == []


def test_table1_delays(simulated: Simulated) -> None:
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("table1-delays",), duration_s=18.5))
    every = [delay for name in NAMES for delay in session.delays_ms(name)]
    assert 55 <= min(every) < 57 and 64 < max(every) <= 88
    assert sum(every) / len(every) == pytest.approx(60, abs=0.3)


def test_irregular(simulated: Simulated) -> None:
    """Figure 10: spacing 0.1 to 33 ms about 16.67 ms, so that a window has 0, 1 or 2 frames."""
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("irregular",), duration_s=18.5))
    arrivals = [frame.arrival_ns or 0 for tick in session.ticks for frame in tick.frames if frame.name == "N1"]
    gaps_ms = [(b - a) / 1e6 for a, b in pairwise(arrivals)]
    assert min(gaps_ms) < 5 and max(gaps_ms) > 28
    assert sum(gaps_ms) / len(gaps_ms) == pytest.approx(TICK_MS, abs=0.05)
    assert set(session.counts("N1")) == {0, 1, 2}
