"""A plant in a scenario: disturbances, late commands, any cut of time."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.errors import SettingsError
from pmutools.grid.grid import MAX_COMMANDS, Grid
from pmutools.grid.plant import build
from pmutools.grid.scenarios import SCENARIOS, Pulse, Scenario, scenario
from pmutools.grid.signals import Bus, Drive
from pmutools.timebase import NS

START = 1_700_000_000 * NS
MS = 1_000_000


class Tape:
    """A plant that only writes down what drives it, as (seconds from the start of a run, drive), equal runs joined."""

    def __init__(self) -> None:
        self.time_ns = 0
        self.runs: list[tuple[int, Drive]] = []

    def advance(self, dt_s: float, drive: Drive) -> None:
        assert dt_s > 0
        if not self.runs or self.runs[-1][1] != drive:
            self.runs.append((self.time_ns, drive))
        self.time_ns += round(dt_s * NS)

    def buses(self, drive: Drive) -> dict[str, Bus]:
        return {}


def test_brake_comes_and_goes_at_its_own_instants() -> None:
    tape = Tape()
    grid = Grid(tape, scenario("cjb"), start_ns=START)
    for k in range(1, 400):
        grid.advance(START + k * 17 * MS)
    assert tape.runs == [(0, Drive()), (5 * NS, Drive(0, 1400)), (5 * NS + NS // 2, Drive())]


def test_a_command_takes_effect_by_its_own_time() -> None:
    tape = Tape()
    grid = Grid(tape, Scenario("quiet", ""), start_ns=START, command_delay_ns=11 * MS)
    grid.command(30.0, START + 20 * MS)
    grid.command(10.0, START + 5 * MS)  # sent earlier, heard later
    grid.advance(START + 100 * MS)
    grid.command(7.0, START + 60 * MS)  # should have acted by now: at once
    grid.advance(START + 200 * MS)
    assert tape.runs == [(0, Drive()), (16 * MS, Drive(10.0)), (31 * MS, Drive(30.0)), (100 * MS, Drive(7.0))]


@settings(max_examples=50)
@given(st.integers(0, 2**32))
def test_time_may_be_cut_anywhere(seed: int) -> None:
    draw = random.Random(seed)
    scene = Scenario("mix", "", (Pulse("brake", 0.1, 0.4, 1400.0), Pulse("probe", 0.2, 0.9, -50.0)), ambient_mw=40.0)
    commands = [(draw.uniform(-125, 125), START + draw.randrange(NS)) for _ in range(20)]
    whole, cut = (Grid(build("modal-five"), scene, start_ns=START, seed=3) for _ in range(2))
    for mw, sent_ns in commands:
        whole.command(mw, sent_ns)
    whole.advance(START + 2 * NS)
    waiting = sorted(commands, key=lambda command: command[1])
    while cut.time_ns < START + 2 * NS:
        to_ns = min(START + 2 * NS, cut.time_ns + draw.randrange(1, 60 * MS))
        while waiting and waiting[0][1] <= to_ns:
            cut.command(*waiting.pop(0))
        cut.advance(to_ns)
    for a, b in zip(whole.buses().values(), cut.buses().values(), strict=True):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-12)


def test_a_past_time_changes_nothing() -> None:
    grid = Grid(build("modal"), scenario("cjb"), start_ns=START)
    grid.advance(START + 7 * NS)
    seen = grid.buses()
    grid.advance(START + 3 * NS)
    assert grid.buses() == seen and grid.time_ns == START + 7 * NS


def test_commands_under_way_are_bounded_and_never_no_number() -> None:
    grid = Grid(build("modal"), Scenario("quiet", ""), start_ns=START, command_delay_ns=NS)
    for k in range(MAX_COMMANDS + 10):
        grid.command(float(k), START + k)
    assert grid.command_mw == 9.0
    for bad in (float("nan"), float("inf")):
        grid = Grid(build("modal"), Scenario("quiet", ""), start_ns=START, command_delay_ns=0)
        grid.command(bad, START)
        grid.advance(START + NS)
        assert grid.command_mw == 0.0


def test_a_probe_is_told_apart_from_the_command() -> None:
    grid = Grid(build("modal"), scenario("square-pulse"), start_ns=START, command_delay_ns=0)
    halves = []
    for k in range(8):
        grid.advance(START + 5 * NS + k * 1250 * MS + 600 * MS)
        grid.command(10.0, grid.time_ns)
        grid.advance(grid.time_ns + 1)
        halves.append(grid.probe_mw)
        assert grid.drive.modulation_mw == grid.command_mw + grid.probe_mw
    assert halves == [125, -125, 125, -125, 125, -125, 0, 0]


def test_random_load_is_seeded() -> None:
    def swing(seed: int) -> list[float]:
        grid = Grid(build("modal"), scenario("ambient"), start_ns=START, seed=seed)
        out = []
        for k in range(600):
            grid.advance(START + k * NS // 60)
            out.append(grid.buses()["north"].deviation_hz)
        return out

    assert swing(1) == swing(1) != swing(2)
    assert 1e-5 < max(map(abs, swing(1))) < 5e-3


def test_scenarios_by_name() -> None:
    assert {"cjb", "bc-us-separation", "square-pulse", "ambient"} <= set(SCENARIOS)
    for name, scene in SCENARIOS.items():
        assert scenario(name) is scene and scene.name == name and scene.text
        assert all(0 <= pulse.start_s < pulse.stop_s <= scene.duration_s for pulse in scene.pulses)
        if scene.ringdown_s:
            first, last = scene.ringdown_s
            ends = [pulse.stop_s for pulse in scene.pulses] + ([scene.loss.start_s] if scene.loss else [])
            assert max(ends) + 1 <= first < last <= scene.duration_s
    with pytest.raises(SettingsError, match="no scenario 'quake'"):
        scenario("quake")
