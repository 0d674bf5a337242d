"""The paper's faults: that each really happens to the frames, and what the controller does about it."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from dcon.core.values import InstanceState, SystemState
from dcon.engine import Engine
from dcon.limiter import SLEW_MW_PER_S
from dcon.session.log import LoggedTick, SessionReader
from dcon.settings import parse
from dcon.sim.faults import FAULTS
from dcon.sim.plan import START_NS, Plan
from dcon.sim.simulate import Outcome, simulate
from pmutools.c37118 import Frame, decode_config
from pmutools.grid.plant import PLANTS, PlantKind
from pmutools.grid.scenarios import SCENARIOS, Scenario
from pmutools.grid.signals import Bus, Drive

MS = 1_000_000
TICK_MS = 1e3 / 60
NAMES = ("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")


class Session:
    """A simulated session, with its log read back."""

    def __init__(self, path: Path, plan: Plan) -> None:
        self.outcome: Outcome = simulate(plan, str(path))
        self.reader = SessionReader(path)
        self.ticks: list[LoggedTick] = list(self.reader.ticks())
        self.records = [tick.record for tick in self.ticks]

    def stamps_s(self, name: str) -> list[float]:
        return [(f.time_ns - START_NS) / 1e9 for tick in self.ticks for f in tick.frames if f.name == name]

    def delays_ms(self, name: str) -> list[float]:
        return [((f.arrival_ns or 0) - f.time_ns) / 1e6 for tick in self.ticks for f in tick.frames if f.name == name]

    def counts(self, name: str) -> list[int]:
        """Frames in each tick."""
        return [sum(frame.name == name for frame in tick.frames) for tick in self.ticks]

    def when(self, event: str, subject: str) -> list[float]:
        return [at for at, found in self.outcome.events if (found.name, found.subject) == (event, subject)]

    def tick_at(self, time_s: float) -> int:
        return next(k for k, at in enumerate(self.outcome.tick_s) if at >= time_s - 1e-6)

    def largest_step(self) -> float:
        return max(abs(b - a) for a, b in pairwise(self.outcome.command_mw))


Simulated = Callable[[Plan], Session]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    folder = tmp_path_factory.mktemp("faults")
    known: dict[Plan, Session] = {}

    def of(plan: Plan) -> Session:
        if plan not in known:
            known[plan] = Session(folder / f"{len(known)}.mcap", plan)
        return known[plan]

    return of


PERFECT = Plan(control=False, duration_s=10)


def per_stamp(session: Session) -> dict[str, dict[int, float]]:
    """f of every reporting instant of every PMU, from the controller's own rings."""
    settings = parse(session.reader.ini_text, "log")
    engine = Engine(settings.params, settings.sites, verified=True)
    found: dict[str, dict[int, float]] = {name: {} for name in NAMES}
    for tick in session.ticks:
        for name, config in tick.configs:
            assert engine.reconfigure(name, decode_config(config)[1]) is None
        frames: dict[str, list[Frame]] = {}
        for frame in tick.frames:
            frames.setdefault(frame.name, []).append(Frame(frame.wire, frame.arrival_ns, frame.stamp_source, 0))
        engine.tick(frames, tick.orders, tick.record.tick_ns)
        for name, pmu in zip(NAMES, engine.state.pmus, strict=True):
            for back, f_hz in enumerate(pmu.ring[:4]):
                assert pmu.slot is not None
                assert found[name].setdefault(pmu.slot - back, f_hz) == f_hz
    return found


def test_every_fault_is_there() -> None:
    assert set(FAULTS) == {
        *("stream-stop", "all-stop", "dropout", "two-zero-arrival", "south-delay-3", "south-delay-6"),
        *("table1-delays", "irregular"),
    }


def test_a_perfect_session_misses_nothing(simulated: Simulated) -> None:
    session = simulated(PERFECT)
    for name in NAMES:
        assert session.counts(name) == [1] * 600
        assert session.delays_ms(name) == pytest.approx([60.0] * 600, abs=1e-3)


def test_stream_stop(simulated: Simulated) -> None:
    """Left within 50 ms and a tick of the last arrival without a step; READY again 20 s after it came back."""
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("stream-stop",)))
    stamps = session.stamps_s("N1")
    before, after = [s for s in stamps if s < 10], [s for s in stamps if s >= 10]
    assert before[-1] == pytest.approx(10 - 1 / 60, abs=1e-5) and after[0] == pytest.approx(40, abs=1e-5)
    assert len(before) == 600 and len(session.stamps_s("N2")) == pytest.approx(65 * 60, abs=5)

    last_arrival_s = before[-1] + 0.060
    (gap_s,) = session.when("arrival_gap", "N1")
    assert 0.050 < gap_s - last_arrival_s <= 0.050 + 1 / 60 + 1e-6
    assert session.when("selected", "N2-S1") == [gap_s]
    assert session.largest_step() <= SLEW_MW_PER_S / 60 + 1e-9
    k = session.tick_at(gap_s)
    command = session.outcome.command_mw
    own = [record.instances[4].command_mw for record in session.records]
    assert abs(own[k] - command[k - 1]) > 0.01  # what a plain switch would have jumped by
    assert command[k] == pytest.approx(command[k - 1], abs=1e-9)
    assert command[k + 61] == pytest.approx(own[k + 61], abs=1e-9)

    (ready_s,) = [at for at in session.when("instance_ready", "N1-S1") if at > 1]
    assert ready_s == pytest.approx(40 + 20 + 0.1, abs=0.05)
    assert session.outcome.plan.length_s == 65  # as long as it takes to see that
    assert session.outcome.final_state == "ACTIVE"
    assert session.when("selected", "N1-S1")[1:] == []  # no haste to go back


def test_all_stop(simulated: Simulated) -> None:
    """Every stream stops while the command is far from 0: it ramps down in a second, and the controller disarms."""
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("all-stop",), duration_s=13))
    for name in NAMES:
        assert session.stamps_s(name)[-1] == pytest.approx(10 - 1 / 60, abs=1e-5)
    (fell_s,) = session.when("rampdown", "system")
    assert 0.050 < fell_s - (10 - 1 / 60 + 0.060) <= 0.050 + 1 / 60 + 1e-6
    k, command = session.tick_at(fell_s), session.outcome.command_mw
    start = command[k - 1]
    assert abs(start) > 1
    assert command[k : k + 61] == pytest.approx([start * (60 - j) / 60 for j in range(61)], abs=1e-9)
    assert session.records[k + 60].state is SystemState.STANDBY
    last = session.records[-1]
    assert (last.state, last.command_mw, last.output_v, last.active) == (SystemState.STANDBY, 0.0, 0.0, None)
    assert {instance.state for instance in last.instances} == {InstanceState.DISABLED}
    assert all(math.isfinite(mw) for mw in command)


def test_dropout(simulated: Simulated) -> None:
    """One frame of N1 is missing, and seen to be with the next: the controller goes on with N2."""
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("dropout",), duration_s=13))
    stamps = session.stamps_s("N1")
    assert [round(b * 60) for a, b in pairwise(stamps) if round((b - a) * 60) != 1] == [601]
    assert len(session.stamps_s("S1")) == len(stamps) + 1
    (seen_s,) = session.when("stamp_step", "N1")
    assert seen_s == pytest.approx(601 / 60 + 0.071, abs=1e-4)
    assert session.when("selected", "N2-S1") == [seen_s]
    assert session.largest_step() <= SLEW_MW_PER_S / 60 + 1e-9
    assert session.records[-1].instances[0].state is InstanceState.INITIALISING


def test_dropout_bridged(simulated: Simulated) -> None:
    session = simulated(Plan(gain_mw_per_mhz=12, faults=("dropout",), duration_s=13, interpolate_single_loss=True))
    assert len(session.when("interpolated", "N1")) == 1
    assert session.when("selected", "N2-S1") == []


def test_two_zero_arrival(simulated: Simulated) -> None:
    """Two frames in one window and none in the next change when f is seen, and not one bit of what it is."""
    session = simulated(Plan(control=False, duration_s=10, faults=("two-zero-arrival",)))
    for name in NAMES:
        assert session.counts(name)[2:60:2] == [2] * 29 or session.counts(name)[3:60:2] == [2] * 29
        assert set(session.counts(name)[2:]) == {0, 2}
    held = [record.instances[0].state for record in session.records[20:]]
    assert held.count(InstanceState.HELD) == held.count(InstanceState.READY)
    perfect, uneven = per_stamp(simulated(PERFECT)), per_stamp(session)
    for name in NAMES:
        common = perfect[name].keys() & uneven[name].keys()
        assert len(common) >= 594
        assert {slot: perfect[name][slot].hex() for slot in common} == {
            slot: uneven[name][slot].hex() for slot in common
        }


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


# --- Figures 13 and 14: one side later than the other ------------------------------------------------------------

LOSS_S, LAG_S, ROCOF_HZ_S = 1.5, 0.02, -0.030


class SouthLoss:
    """A generator trips in the south: frequency falls there at once, in the north LAG_S later."""

    def __init__(self) -> None:
        self.time_s = 0.0

    def advance(self, dt_s: float, drive: Drive) -> None:
        self.time_s += dt_s

    def buses(self, drive: Drive) -> dict[str, Bus]:
        return {"north": self.bus(LAG_S), "south": self.bus(0.0)}

    def bus(self, lag_s: float) -> Bus:
        since = max(self.time_s - LOSS_S - lag_s, 0.0)
        return Bus(math.pi * ROCOF_HZ_S * since**2, ROCOF_HZ_S * since, ROCOF_HZ_S if since else 0.0)


@pytest.fixture
def south_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANTS, "south-loss", PlantKind(lambda _: SouthLoss(), ("normal",), ""))
    monkeypatch.setitem(SCENARIOS, "quiet", Scenario("quiet", "nothing but what the plant does"))


@pytest.mark.usefixtures("south_loss")
@pytest.mark.parametrize("samples", [3, 6])
def test_a_late_south_turns_the_first_command_round_unless_stamps_are_aligned(samples: int, tmp_path: Path) -> None:
    """South generation loss: more power must flow south, so P > 0. The false difference is ROCOF times the delay."""
    plan = Plan("quiet", "south-loss", gain_mw_per_mhz=10, faults=(f"south-delay-{samples}",), duration_s=4)
    aligned = Session(tmp_path / "aligned.mcap", plan)
    for name, later_ms in (("N1", 0.0), ("S3", samples * 1e3 / 60)):
        delays_ms = aligned.delays_ms(name)
        assert delays_ms == pytest.approx([60.0 + later_ms] * len(delays_ms), abs=1e-3)
    unaligned = simulate(Plan("quiet", "south-loss", gain_mw_per_mhz=10, faults=plan.faults, duration_s=4, align=False))

    def first(commands: list[float]) -> float:
        return next(mw for mw in commands if abs(mw) > 0.02)

    assert first(aligned.outcome.command_mw) > 0
    assert first(unaligned.command_mw) < 0
    true_mhz = -ROCOF_HZ_S * LAG_S * 1e3
    false_mhz = ROCOF_HZ_S * samples / 60 * 1e3
    assert aligned.outcome.delta_f_mhz[-1] == pytest.approx(true_mhz, abs=0.02)
    assert unaligned.delta_f_mhz[-1] == pytest.approx(true_mhz + false_mhz, abs=0.02)


@pytest.mark.parametrize("samples", [3, 6])
def test_alignment_only_delays_the_loop(samples: int, simulated: Simulated) -> None:
    """With a late south the aligned loop damps as one that is longer by the delay."""
    late = simulated(Plan(gain_mw_per_mhz=12, faults=(f"south-delay-{samples}",), duration_s=18.5))
    longer = simulate(Plan(gain_mw_per_mhz=12, delay_ms=82 + samples * 1e3 / 60, duration_s=18.5))
    assert late.outcome.mode is not None and longer.mode is not None
    assert late.outcome.mode.damping_percent == pytest.approx(longer.mode.damping_percent, abs=0.02)
    assert len(late.when("latency_high", "S1")) >= 1
    assert late.outcome.final_state == "ACTIVE"
