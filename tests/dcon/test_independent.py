"""Equation (7), alignment, gain law, transfer and limits, written a second time, from an exported log alone."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dcon.export.export import export
from dcon.session.reader import SessionReader
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate

Floats = npt.NDArray[np.float64]
RATE, NOMINAL_HZ = 60, 60.0
A1, A2, B = 1.55725978, 0.61839943, 0.29192028
"""As printed in the paper."""
GAIN, LIMIT_MW, SLEW_MW = 12.0, 125.0, 1000.0 / 60


def table(session: Path, out: Path, name: str) -> list[dict[str, str]]:
    export(session, out, name)
    with out.open(newline="") as file:
        return list(csv.DictReader(file))


def frequency(angle_rad: Floats) -> Floats:
    """f of every frame of an unbroken run, Hz from nominal: eq. (7) over the unwrapped angle, as one linear system.

    (1 - a1 z⁻¹ + a2 z⁻²) f = b (1 - z⁻²) θ, with f of the two frames before the third at the mean of the first three.
    """
    theta = np.unwrap(angle_rad)
    count = len(theta)
    start = (theta[2] - theta[0]) * RATE / (4 * np.pi)
    forcing = B * (theta[2:] - theta[:-2])
    f = np.full(count, np.nan)
    # impulse response of the denominator by its poles, then one convolution
    poles = np.roots([1, -A1, A2])
    n = np.arange(count - 2)
    impulse = ((poles[0] ** (n + 1) - poles[1] ** (n + 1)) / (poles[0] - poles[1])).real
    forced = np.convolve(forcing, impulse)[: count - 2]
    # f[-1] = f[-2] = start act on the first two equations
    initial = (A1 * start - A2 * start) * impulse - A2 * start * np.concatenate(([0.0], impulse[:-1]))
    f[2:] = forced + initial
    return f


class Independent:
    """What the frames of an export say, tick by tick, of one pair."""

    def __init__(self, session: Path, folder: Path) -> None:
        self.ticks = table(session, folder / "ticks.csv", "tick")
        self.instances = table(session, folder / "instances.csv", "instance")
        frames = table(session, folder / "frames.csv", "pmu")
        self.names = sorted({row["pmu"] for row in frames})
        self.stamp: dict[str, npt.NDArray[np.int64]] = {}
        self.used: dict[str, npt.NDArray[np.int64]] = {}
        self.f_hz: dict[str, Floats] = {}
        for name in self.names:
            own = sorted((row for row in frames if row["pmu"] == name), key=lambda row: int(row["time_ns"]))
            self.stamp[name] = np.array([round(int(row["time_ns"]) * RATE / 1e9) for row in own])
            self.used[name] = np.array([int(row["tick_ns"]) for row in own])
            assert np.all(np.diff(self.stamp[name]) == 1), "the run is not unbroken"
            self.f_hz[name] = frequency(np.radians([float(row["v1.deg"]) for row in own]))

    def difference_mhz(self, north: str, south: str, tick_ns: int) -> float:
        """At the newest stamp that both had by then."""
        both = [self.stamp[name][self.used[name] <= tick_ns] for name in (north, south)]
        if any(len(stamps) < 3 for stamps in both):
            return math.nan
        newest = min(stamps[-1] for stamps in both)
        at = [int(newest - self.stamp[name][0]) for name in (north, south)]
        return float((self.f_hz[north][at[0]] - self.f_hz[south][at[1]]) * 1e3) if min(at) >= 2 else math.nan


PLANS = {
    "perfect": Plan(gain_mw_per_mhz=GAIN, duration_s=9, deadband_mhz=0.25),
    "two then none, south late": Plan(
        gain_mw_per_mhz=GAIN, duration_s=9, deadband_mhz=0.25, faults=("two-zero-arrival", "south-delay-3")
    ),
}


@pytest.fixture(scope="module", params=PLANS)
def logged(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Independent]:
    folder = tmp_path_factory.mktemp("independent")
    session = folder / "session.mcap"
    simulate(PLANS[request.param], str(session))
    return session, Independent(session, folder)


def number(text: str) -> float:
    return float(text) if text else math.nan


def test_frequencies_are_those_of_equation_7(logged: tuple[Path, Independent]) -> None:
    _, made = logged
    for row in made.ticks:
        tick_ns = int(row["tick_ns"])
        for name in made.names:
            there = int(np.count_nonzero(made.used[name] <= tick_ns))
            got = number(row[f"f_{name}_hz"])
            if there < 3:
                assert math.isnan(got)
            else:
                assert got == pytest.approx(NOMINAL_HZ + made.f_hz[name][there - 1], abs=1e-12)


def test_differences_are_those_of_the_newest_common_stamp(logged: tuple[Path, Independent]) -> None:
    """Of all sixteen instances in every tick."""
    _, made = logged
    checked = 0
    for row in made.instances:
        got = number(row["delta_f_mhz"])
        if not math.isnan(got):
            expected = made.difference_mhz(*row["instance"].split("-"), int(row["tick_ns"]))
            assert got == pytest.approx(expected, abs=1e-9)
            checked += 1
    assert checked > 16 * 530


def law(delta_f_mhz: float) -> float:
    """Fig. 6: the deadband off the magnitude, gain, limit."""
    size = max(abs(delta_f_mhz) - 0.25, 0.0)
    return math.copysign(min(GAIN * size, LIMIT_MW), delta_f_mhz)


def test_commands_are_the_law_the_transfer_and_the_slew(logged: tuple[Path, Independent]) -> None:
    """From both steps of arming on: the offset at the start fades in a second; then the law alone."""
    _, made = logged
    command_mw, offset_mw, since = 0.0, 0.0, -1
    for row in made.ticks:
        if row["state"] != "ACTIVE":
            assert float(row["command_mw"]) == 0.0 == float(row["output_v"])
            continue
        own_mw = law(made.difference_mhz(*row["active_instance"].split("-"), int(row["tick_ns"])))
        since += 1
        if since == 0:
            offset_mw = command_mw - own_mw
        wanted_mw = own_mw + offset_mw * max(60 - since, 0) / 60
        wanted_mw = min(max(wanted_mw, -LIMIT_MW), LIMIT_MW)
        command_mw += min(max(wanted_mw - command_mw, -SLEW_MW), SLEW_MW)
        assert float(row["command_mw"]) == pytest.approx(command_mw, abs=1e-9)
        assert float(row["output_v"]) == pytest.approx(command_mw / 12.5, abs=1e-9)
    assert since > 500


def test_the_run_was_eventful_enough(logged: tuple[Path, Independent]) -> None:
    session, made = logged
    commands: list[Any] = [float(row["command_mw"]) for row in made.ticks]
    assert max(commands) - min(commands) > 150
    assert json.loads(SessionReader(session).metadata["flags"])[0] == "stamp_step"
