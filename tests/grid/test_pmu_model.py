"""Emulated PMUs and their noise."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from dcon.core.sequence import sequences
from pmutools.grid.pmu_model import PmuModel, fleet, measure
from pmutools.grid.signals import Bus

BUSES = {"north": Bus(0.3, 0.01, -0.02), "south": Bus(-0.3, -0.01, 0.02, 0.98)}
PLAIN = PmuModel("N1", 101, "north")


def test_a_report_is_a_balanced_three_phase_voltage() -> None:
    seen = measure(PLAIN, BUSES, 1000, 60)
    assert abs(seen.v1) == pytest.approx(500e3 / math.sqrt(3))
    assert cmath.phase(seen.v1) == pytest.approx(0.3)
    assert sequences(seen.va, seen.vb, seen.vc)[0] == pytest.approx(seen.v1)
    assert cmath.phase(seen.vb / seen.va) == pytest.approx(-2 * math.pi / 3)
    assert (seen.frequency_hz, seen.rocof_hz_s) == (60.01, -0.02)
    assert seen.time_ns == 1000


def test_place_swing_and_voltage() -> None:
    pmu = PmuModel("S2", 202, "south", angle_rad=0.1, swing=0.9)
    seen = measure(pmu, BUSES, 0, 0, nominal_hz=50.0)
    assert cmath.phase(seen.v1) == pytest.approx(0.1 - 0.27)
    assert abs(seen.v1) == pytest.approx(0.98 * 500e3 / math.sqrt(3))
    assert seen.frequency_hz == pytest.approx(50 - 0.009)


def test_noise_has_its_sizes() -> None:
    pmu = PmuModel("N1", 101, "north", noise_rad=1.5e-3, noise_pu=1e-3)
    reports = [measure(pmu, BUSES, 0, slot) for slot in range(4000)]
    angles = np.array([cmath.phase(report.v1) for report in reports]) - 0.3
    sizes = np.array([abs(report.v1) for report in reports]) / (500e3 / math.sqrt(3)) - 1
    assert angles.std() == pytest.approx(1.5e-3, rel=0.05) and abs(angles.mean()) < 1e-4
    assert sizes.std() == pytest.approx(1e-3, rel=0.05)
    assert abs(np.corrcoef(angles, sizes)[0, 1]) < 0.06
    assert abs(np.corrcoef(angles[1:], angles[:-1])[0, 1]) < 0.06


def test_noise_depends_on_seed_pmu_and_instant_only() -> None:
    noisy = [PmuModel("x", idcode, "north", noise_rad=1e-3, seed=seed) for idcode in (1, 2) for seed in (0, 1)]
    seen = {(pmu.idcode, pmu.seed, slot): measure(pmu, BUSES, 0, slot).v1 for pmu in noisy for slot in (5, 6)}
    assert len(set(seen.values())) == 8
    assert measure(noisy[0], BUSES, 99, 5).v1 == seen[1, 0, 5]


def test_the_controllers_eight_pmus() -> None:
    pmus = fleet()
    assert [pmu.name for pmu in pmus] == ["N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4"]
    assert [pmu.idcode for pmu in pmus] == [101, 102, 103, 104, 201, 202, 203, 204]
    assert pmus[0].swing == pmus[4].swing == 1.0
