"""The modal plant: exact propagation, residues, eigenvalues."""

from __future__ import annotations

import cmath
import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from pmutools.errors import SettingsError
from pmutools.grid.modal import FIVE_MODES, SEPARATED_FROM_BC, SINGLE_MODE, ModalPlant, Mode
from pmutools.grid.plant import PLANTS, build
from pmutools.grid.signals import Drive
from pmutools.grid.theory import closed_loop_eigenvalue, frequency_and_damping

A1, A2, B = 1.55725978, 0.61839943, 0.29192028


def differentiator(s: complex) -> complex:
    """The paper's filter over true frequency, written out from eq. (6) on its own."""
    z = cmath.exp(s / 60)
    return (B - B * z**-2) / (1 - A1 * z**-1 + A2 * z**-2) * 2 * math.pi / s


def by_expm(mode: Mode, x: np.ndarray, dt_s: float, push: float) -> np.ndarray:
    """The same second-order system by the matrix exponential: x1, x2, angle, and the input as a fourth state."""
    wd = 2 * math.pi * mode.f_hz
    sigma = mode.damping * wd / math.sqrt(1 - mode.damping**2)
    a = np.zeros((4, 4))
    a[0, 1] = 1
    a[1] = [-(sigma**2 + wd**2), -2 * sigma, 0, -1]
    a[2] = [2 * math.pi * mode.b0, 2 * math.pi * mode.b1, 0, 0]
    return np.asarray((expm(a * dt_s) @ np.append(x, push))[:3])


@pytest.mark.parametrize("modes", [SINGLE_MODE, FIVE_MODES, SEPARATED_FROM_BC])
def test_propagation_is_exact(modes: tuple[Mode, ...]) -> None:
    plant, draw = ModalPlant(modes), random.Random(1)
    want = [np.zeros(3) for _ in modes]
    for _ in range(50):
        dt_s = draw.choice((1 / 60, 0.0153, 1e-5, 0.7))
        drive = Drive(draw.uniform(-125, 125), draw.choice((0.0, 1400.0)))
        plant.advance(dt_s, drive)
        want = [
            by_expm(m, x, dt_s, drive.modulation_mw + m.brake * drive.brake_mw)
            for m, x in zip(modes, want, strict=True)
        ]
        seen = plant.difference(drive)
        deviation = sum(m.b1 * x[1] + m.b0 * x[0] for m, x in zip(modes, want, strict=True))
        assert seen.deviation_hz == pytest.approx(deviation, abs=1e-14)
        assert seen.angle_rad == pytest.approx(sum(x[2] for x in want), abs=1e-13)


@given(st.lists(st.floats(1e-4, 2.0), min_size=1, max_size=8), st.floats(-125, 125), st.floats(0, 1400))
def test_steps_of_any_length_lead_to_the_same_place(cuts: list[float], p: float, brake: float) -> None:
    drive = Drive(p, brake)
    pieces, whole = ModalPlant(FIVE_MODES), ModalPlant(FIVE_MODES)
    for cut in cuts:
        pieces.advance(cut, drive)
    whole.advance(sum(cuts), drive)
    assert pieces.difference(drive)[:3] == pytest.approx(whole.difference(drive)[:3], rel=1e-9, abs=1e-13)


def test_angle_frequency_and_rocof_are_derivatives() -> None:
    plant, h = ModalPlant(FIVE_MODES), 1e-4
    drive = Drive(50.0, 1400.0)
    plant.advance(0.3, drive)
    before = plant.difference(drive)
    plant.advance(h, drive)
    middle = plant.difference(drive)
    plant.advance(h, drive)
    after = plant.difference(drive)
    assert middle.deviation_hz == pytest.approx((after.angle_rad - before.angle_rad) / (4 * math.pi * h), rel=1e-6)
    assert middle.rocof_hz_s == pytest.approx((after.deviation_hz - before.deviation_hz) / (2 * h), rel=1e-6)


def test_north_and_south_swing_against_each_other() -> None:
    plant, drive = build("modal"), Drive(brake_mw=1400.0)
    plant.advance(0.5, drive)
    buses = plant.buses(drive)
    assert buses["north"][:3] == tuple(-x for x in buses["south"][:3])
    assert buses["north"].deviation_hz < 0  # load in the north


def test_power_from_north_to_south_slows_the_north() -> None:
    plant = build("modal")
    plant.advance(0.1, Drive(modulation_mw=100.0))
    assert plant.buses(Drive())["north"].deviation_hz < 0


def test_brake_swings_about_10_mhz() -> None:
    plant, peak = ModalPlant(SINGLE_MODE), 0.0
    for k in range(240):
        drive = Drive(brake_mw=1400.0 if k < 30 else 0.0)
        plant.advance(1 / 60, drive)
        peak = max(peak, abs(plant.difference(drive).deviation_hz))
    assert 9.5e-3 < peak < 11e-3


@pytest.mark.parametrize("mode", FIVE_MODES)
def test_eigenvalue_has_the_damping_and_the_damped_frequency(mode: Mode) -> None:
    hz, ratio = frequency_and_damping(mode.eigenvalue)
    assert (hz, ratio) == pytest.approx((mode.f_hz, mode.damping))
    assert abs(1 / mode.transfer(mode.eigenvalue * (1 + 1e-9))) < 0.1


@pytest.mark.parametrize(
    ("gain", "hz", "percent"),
    [
        (0, 0.4250, 7.80),
        (3, 0.4275, 8.67),
        (6, 0.4301, 9.55),
        (9, 0.4326, 10.43),
        (12, 0.4352, 11.31),
        (15, 0.4379, 12.19),
        (18, 0.4405, 13.07),
        (24, 0.4460, 14.85),
    ],
)
def test_closed_loop_of_the_single_mode(gain: float, hz: float, percent: float) -> None:
    root = closed_loop_eigenvalue(SINGLE_MODE, SINGLE_MODE[0], gain, feedback=differentiator)
    got = frequency_and_damping(root)
    assert (got[0], 100 * got[1]) == pytest.approx((hz, percent), abs=6e-3)
    assert got[0] == pytest.approx(hz, abs=6e-5)


@pytest.mark.parametrize(
    ("gain", "rows"),
    [
        (9, ((0.433, 10.44), (0.251, 13.1), (0.601, 8.30), (0.801, 7.11), (2.24, 6.5))),
        (12, ((0.435, 11.30), (0.251, 13.4), (0.602, 8.41), (0.802, 7.14), (2.25, 5.5))),
        (30, ((0.454, 16.2), (0.254, 15.1), (0.604, 9.26), (0.804, 7.39), (2.30, 0.0))),
    ],
)
def test_closed_loop_of_five_modes(gain: float, rows: tuple[tuple[float, float], ...]) -> None:
    for mode, (hz, percent) in zip(FIVE_MODES, rows, strict=True):
        got = frequency_and_damping(closed_loop_eigenvalue(FIVE_MODES, mode, gain, feedback=differentiator))
        assert got[0] == pytest.approx(hz, abs=6e-3 if hz > 2 else 6e-4)
        assert 100 * got[1] == pytest.approx(percent, abs=0.06)


@pytest.mark.parametrize(
    ("delay_ms", "percent"),
    [(0, 11.73), (82, 11.31), (113, 11.09), (200, 10.31), (300, 9.16), (400, 7.86), (500, 6.57)],
)
def test_delay_costs_damping(delay_ms: float, percent: float) -> None:
    root = closed_loop_eigenvalue(SINGLE_MODE, SINGLE_MODE[0], 12, delay_s=delay_ms / 1e3, feedback=differentiator)
    assert 100 * frequency_and_damping(root)[1] == pytest.approx(percent, abs=6e-3)


def test_plants_by_name() -> None:
    for name, kind in PLANTS.items():
        for condition in kind.conditions:
            assert set(build(name, condition).buses(Drive())) >= {"north", "south"}
    with pytest.raises(SettingsError, match="no plant 'mini-wecc': one of modal, modal-five"):
        build("mini-wecc")
    with pytest.raises(SettingsError, match="no condition 'bc-us-separated'"):
        build("modal-five", "bc-us-separated")
