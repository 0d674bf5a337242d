"""A plant in a scenario: disturbances, late commands, any cut of time."""

from __future__ import annotations

import cmath
import math
import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.errors import SettingsError
from pmutools.grid.grid import MAX_COMMANDS, Grid
from pmutools.grid.modal import FIVE_MODES
from pmutools.grid.multisine import Multisine, tones
from pmutools.grid.plant import build
from pmutools.grid.pmu_model import PmuModel, measure, measured_columns
from pmutools.grid.scenarios import SCENARIOS, GenerationLoss, Pulse, Scenario, scenario
from pmutools.grid.signals import Bus, Common, Drive
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


def test_a_multisine_is_low_and_has_its_tones_in_whole_periods() -> None:
    signal = Multisine(5.0, 205.0, 20.0)
    found = tones(signal)
    assert len(found) == 16 and found[0].frequency_hz == 0.1 and found[-1].frequency_hz == 5.0
    cycles = [tone.frequency_hz * signal.period_s for tone in found]
    assert cycles == pytest.approx([round(count) for count in cycles])
    assert all(1.1 < b.frequency_hz / a.frequency_hz < 1.5 for a, b in pairwise(found))
    course = [signal.mw(5 + k / 1000) for k in range(100_000)]
    assert max(map(abs, course)) == pytest.approx(20.0, rel=0.01)
    assert max(map(abs, course)) / math.sqrt(sum(mw * mw for mw in course) / len(course)) < 3  # 5.7 if all peaks met
    assert signal.mw(4.999) == signal.mw(205.0) == 0.0 and signal.mw(5.25) == pytest.approx(signal.mw(105.25))
    assert tones(signal._replace(seed=2)) != found


def test_probing_shows_the_plant() -> None:
    """Tone by tone, over two periods after the start has died away: the plant's own transfer, held for 1/60 s."""
    scene = scenario("probing")
    assert scene.multisine is not None
    grid = Grid(build("modal-five"), scene, start_ns=START)
    swing = np.zeros(12_000)
    for k in range(105 * 60, 305 * 60):
        grid.advance(START + k * NS // 60)
        swing[k - 105 * 60] = grid.plant.buses(grid.drive)["north"].deviation_hz * 2
    for tone in tones(scene.multisine):
        s = 2j * math.pi * tone.frequency_hz
        line = 2 * np.mean(swing * np.exp(-s * np.arange(12_000) / 60))
        given = tone.mw * cmath.exp(1j * (tone.phase_rad - math.pi / 2))  # 105 s are a whole period after the start
        hold = (1 - cmath.exp(-s / 60)) / (s / 60)
        expected = -sum(mode.transfer(s) for mode in FIVE_MODES) * hold
        assert line / given == pytest.approx(expected, rel=0.03), tone.frequency_hz


def test_a_loss_in_the_south_is_felt_everywhere_and_there_first() -> None:
    loss = GenerationLoss(5.0, 1400.0, rocof_hz_s=-0.069, settles_hz=-0.155, lag_s=0.03, swing_share=0.3)
    for bus, from_s in (("south", 5.0), ("north", 5.03)):
        assert loss.common(from_s - 1e-9, bus) == Common()
        assert loss.common(from_s + 1e-9, bus).rocof_hz_s == pytest.approx(-0.069)
        assert loss.common(60.0, bus).deviation_hz == pytest.approx(-0.155)
        step_s, at = 1e-4, [loss.common(from_s + 1 + k * 1e-4, bus) for k in (-1, 0, 1)]
        assert (at[2].angle_rad - at[0].angle_rad) / (2 * step_s) == pytest.approx(2 * math.pi * at[1].deviation_hz)
        assert (at[2].deviation_hz - at[0].deviation_hz) / (2 * step_s) == pytest.approx(at[1].rocof_hz_s)


def test_a_place_that_swings_less_has_the_common_frequency_whole() -> None:
    """Else the difference of two places would hold a share of it."""
    grid = Grid(build("modal"), scenario("south-generation-loss"), start_ns=START)
    grid.advance(START + 30 * NS)
    buses = grid.buses()
    assert abs(buses["north"].deviation_hz) < 1e-3 and buses["north"].common_hz == pytest.approx(-0.155, abs=1e-4)
    near, far = (PmuModel("x", 1, "north", swing=swing) for swing in (1.0, 0.5))
    difference = measure(near, buses, 0, 0).frequency_hz - measure(far, buses, 0, 0).frequency_hz
    assert difference == pytest.approx(0.5 * buses["north"].deviation_hz, abs=1e-12)
    course = np.array([buses["north"]])
    *_, frequency_hz, rocof_hz_s = measured_columns(far, course, range(1))
    report = measure(far, buses, 0, 0)
    assert (frequency_hz[0], rocof_hz_s[0]) == pytest.approx((report.frequency_hz, report.rocof_hz_s), abs=1e-12)


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
    contract = "cjb bc-us-separation bc-alberta-separation square-pulse probing south-generation-loss ambient"
    assert set(contract.split()) == set(SCENARIOS)
    for name, scene in SCENARIOS.items():
        assert scenario(name) is scene and scene.name == name and scene.text
        assert all(0 <= pulse.start_s < pulse.stop_s <= scene.duration_s for pulse in scene.pulses)
        if scene.ringdown_s:
            first, last = scene.ringdown_s
            ends = [pulse.stop_s for pulse in scene.pulses] + ([scene.loss.start_s] if scene.loss else [])
            assert max(ends) + 1 <= first < last <= scene.duration_s
    with pytest.raises(SettingsError, match="no scenario 'quake'"):
        scenario("quake")
