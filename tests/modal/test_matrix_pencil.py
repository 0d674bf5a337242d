"""The ringdown estimator: exact on exact swings, near the Cramér-Rao bound in noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.grid.grid import Grid
from pmutools.grid.plant import build
from pmutools.grid.scenarios import scenario
from pmutools.modal.matrix_pencil import Signal, decimate, matrix_pencil, ringdown
from pmutools.timebase import NS


def swing(
    hz: float, damping: float, size: float = 20.0, phase: float = 0.5, rate: float = 20.0, seconds: float = 10.0
) -> Signal:
    t = np.arange(round(seconds * rate)) / rate
    wd = 2 * math.pi * hz
    sigma = damping * wd / math.sqrt(1 - damping**2)
    return np.asarray(size * np.exp(-sigma * t) * np.cos(wd * t + phase))


@settings(max_examples=50, deadline=None)
@given(st.floats(0.2, 0.9), st.floats(-0.03, 0.25), st.floats(-3, 3), st.floats(-100, 100))
def test_a_clean_swing_is_recovered(hz: float, damping: float, phase: float, offset: float) -> None:
    fit = matrix_pencil(swing(hz, damping, phase=phase) + offset, 20.0)
    mode = fit.dominant()
    assert mode is not None and fit.r2 > 1 - 1e-9
    assert (mode.frequency_hz, mode.damping) == pytest.approx((hz, damping), abs=1e-5)
    assert mode.amplitude == pytest.approx(20.0, rel=1e-3)
    assert math.cos(mode.phase_rad - phase) == pytest.approx(1, abs=1e-5)


def test_three_modes_by_energy() -> None:
    y = swing(0.425, 0.078) + swing(0.25, 0.12, 6) + swing(0.6, 0.08, 5)
    fit = matrix_pencil(y, 20.0)
    assert [round(mode.frequency_hz, 4) for mode in fit.modes[:3]] == [0.425, 0.25, 0.6]
    near = fit.dominant(0.5, 0.7)
    assert near is not None and near.damping == pytest.approx(0.08, abs=1e-4)
    assert fit.dominant(5, 9) is None


def test_spread_in_noise_is_near_the_bound() -> None:
    """60 runs; the Cramér-Rao bound is 0.79 mHz and 0.195 %-points for one mode, 1.22 and 0.310 for three."""
    one = swing(0.425, 0.078)
    three = one + swing(0.25, 0.12, 6) + swing(0.6, 0.08, 5)
    for y, order, f_mhz, percent in ((one, None, 1.1, 0.28), (three, 6, 1.7, 0.45)):
        noise = np.random.default_rng(5)
        modes = [matrix_pencil(y + noise.normal(0, 1, y.size), 20.0, order).dominant() for _ in range(60)]
        found = np.array([(mode.frequency_hz, mode.damping) for mode in modes if mode is not None])
        assert len(found) == 60
        assert found[:, 0].std() * 1e3 < f_mhz and abs(found[:, 0].mean() - 0.425) < 0.3e-3
        assert found[:, 1].std() * 1e2 < percent and abs(found[:, 1].mean() - 0.078) < 0.0006


@pytest.mark.parametrize("plant", ["modal", "modal-five"])
@pytest.mark.parametrize("window", [(6.5, 16.5), (6.5, 18.5), (8.0, 20.0)])
def test_the_plants_own_mode_is_recovered_to_0_02_points(plant: str, window: tuple[float, float]) -> None:
    grid = Grid(build(plant), scenario("cjb"), start_ns=0)
    y = []
    for k in range(1260):
        grid.advance(k * NS // 60)
        y.append(grid.buses()["north"].deviation_hz * 2e3)
    fit = ringdown(np.array(y), 60.0, *window)
    mode = fit.dominant()
    assert mode is not None and fit.r2 > 0.9999 and fit.rate_hz == 20.0
    assert mode.frequency_hz == pytest.approx(0.425, abs=1e-4)
    assert 100 * mode.damping == pytest.approx(7.8, abs=0.02)


@pytest.mark.parametrize("rate", [30, 50, 60, 100, 120])
def test_decimation_moves_no_mode_and_folds_nothing_in(rate: int) -> None:
    y = swing(0.425, 0.078, rate=rate, seconds=12)
    ripple = 5 * np.cos(2 * math.pi * 0.49 * rate * np.arange(y.size) / rate)
    mode = ringdown(y + ripple, rate, 0, 12).dominant()
    assert mode is not None
    assert (mode.frequency_hz, 100 * mode.damping) == pytest.approx((0.425, 7.8), abs=0.01)


def test_decimation_stops_what_would_fold() -> None:
    t = np.arange(1200) / 60
    for hz, low, high in ((0.4, 0.99, 1.01), (1.0, 0.99, 1.01), (19.5, 0, 1e-3), (25.0, 0, 1e-3)):
        out = decimate(np.sin(2 * math.pi * hz * t), 3)
        assert low < out.std() * math.sqrt(2) < high


def test_a_growing_swing_has_negative_damping() -> None:
    mode = matrix_pencil(swing(0.4, -0.02), 20.0).dominant()
    assert mode is not None and mode.damping == pytest.approx(-0.02, abs=1e-5)


@pytest.mark.parametrize("bad", [np.zeros(10), np.full(50, np.nan), np.zeros((20, 20))])
def test_what_is_no_signal(bad: Signal) -> None:
    with pytest.raises(ValueError, match="16 finite samples"):
        matrix_pencil(bad, 20.0)


def test_nothing_moves() -> None:
    fit = matrix_pencil(np.full(100, 3.0), 20.0)
    assert fit.modes == () and fit.dominant() is None
