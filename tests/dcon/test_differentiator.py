"""The differentiator against scipy, against the paper's printed numbers and against its three specifications."""

from __future__ import annotations

import cmath
import math
import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from dcon.core.differentiator import (
    EMPTY,
    PAPER_60,
    Coefficients,
    advance,
    coefficients,
    design,
    midpoint,
    response,
    wrap,
)
from dcon.core.sequence import sequences
from pmutools.errors import SettingsError

RATES = (30, 50, 60, 100, 120)


def run(c: Coefficients, theta: list[float]) -> list[float]:
    state, out = EMPTY, []
    for angle in theta:
        state = advance(c, state, wrap(math.remainder(angle, 2 * math.pi)))
        out.append(state.f_hz)
    return out


def scipy_design(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Analog Bessel low-pass, bilinear without prewarping, Tustin derivative, zero and pole at -1 cancelled."""
    b, a = signal.bilinear(*signal.bessel(2, 2 * math.pi * 2.65, analog=True, norm="phase"), fs=rate)
    numerator = np.polymul(np.polydiv(b, [1, 1])[0], [2 * rate, -2 * rate]) / (2 * math.pi)
    return numerator, a


@pytest.mark.parametrize("rate", RATES)
def test_design_is_scipys(rate: int) -> None:
    b, a = scipy_design(rate)
    c = design(rate)
    assert np.allclose(b, [c.b, 0, -c.b], atol=1e-8)
    assert np.allclose(a, [1, -c.a1, c.a2], atol=1e-8)


@given(st.floats(8, 1000))
def test_design_is_scipys_at_any_rate(rate: float) -> None:
    b, a = scipy_design(rate)
    c = design(rate)
    assert np.allclose([*b, *a], [c.b, 0, -c.b, 1, -c.a1, c.a2], atol=1e-8)


def test_the_printed_numbers() -> None:
    assert PAPER_60[:3] == (1.55725978, 0.61839943, 0.29192028)
    assert coefficients(60) is PAPER_60
    assert max(abs(x - y) for x, y in zip(design(60), PAPER_60, strict=True)) < 1e-8


@pytest.mark.parametrize(
    ("rate", "a1", "a2", "b"),
    [
        (30, 1.18509229, 0.38285040, 0.47211272),
        (50, 1.47749125, 0.56175033, 0.33525622),
        (100, 1.72538430, 0.74946826, 0.19165405),
        (120, 1.76925669, 0.78637044, 0.16342429),
    ],
)
def test_other_rates(rate: int, a1: float, a2: float, b: float) -> None:
    assert coefficients(rate)[:3] == pytest.approx((a1, a2, b), abs=6e-9)


@pytest.mark.parametrize("rate", [0, -60, 5, math.nan, math.inf])
def test_no_design_for_a_rate_too_low(rate: float) -> None:
    with pytest.raises(SettingsError, match="higher rate"):
        design(rate)


def lag_deg(c: Coefficients, hz: float) -> float:
    """Phase lag of the low-pass: that of H(z) behind an ideal derivative."""
    return 90 - math.degrees(cmath.phase(response(c, cmath.exp(2j * math.pi * hz / c.rate_hz))))


@pytest.mark.parametrize("rate", RATES)
def test_specification_1_phase_lag_below_30_degrees_at_0_8_hz(rate: int) -> None:
    assert lag_deg(coefficients(rate), 0.8) < 30
    assert lag_deg(PAPER_60, 0.8) == pytest.approx(29.93, abs=0.01)


@pytest.mark.parametrize("rate", RATES)
def test_specifications_2_and_3_overshoot_and_settling(rate: int) -> None:
    c = coefficients(rate)
    g = c.b * math.pi / c.rate_hz
    y = signal.lfilter([g, 2 * g, g], [1, -c.a1, c.a2], np.ones(10 * rate))
    y /= y[-1]
    overshoot = y.max() - 1
    settled_s = (np.flatnonzero(np.abs(y - 1) > 0.02)[-1] + 1) / rate
    assert overshoot < 0.10
    assert settled_s < 2 * y.argmax() / rate
    if rate == 60:
        assert overshoot == pytest.approx(0.0046, abs=1e-4)


def test_gain_is_one_at_rest_and_12_db_below_the_backward_difference_at_5_hz() -> None:
    z = cmath.exp(1e-6j)
    assert abs(response(PAPER_60, z)) / 1e-6 == pytest.approx(60 / (2 * math.pi), rel=1.1e-6)
    z = cmath.exp(2j * math.pi * 5 / 60)
    backward = (1 - 1 / z) * 60 / (2 * math.pi)
    assert 20 * math.log10(abs(response(PAPER_60, z) / backward)) == pytest.approx(-12.4, abs=0.05)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("deviation", [-1.0, -0.013, 0.0, 0.4, 1.0])
def test_start_up_is_exact_for_a_steady_frequency(rate: int, deviation: float) -> None:
    f = run(coefficients(rate), [2.9 + 2 * math.pi * deviation * k / rate for k in range(300)])
    assert all(map(math.isnan, f[:2]))
    assert max(abs(x - deviation) for x in f[2:]) < 2e-6


def test_equation_7_on_a_swing_that_wraps() -> None:
    t = np.arange(1200) / 60
    theta = 3.0 + 8 * np.sin(2 * math.pi * 0.4 * t) + 0.2 * t
    got = np.array(run(PAPER_60, theta.tolist()))
    c = PAPER_60
    f0 = (theta[2] - theta[0]) * 60 / (4 * math.pi)
    want = [f0, f0]
    for k in range(2, t.size):
        want.append(c.b * (theta[k] - theta[k - 2]) + c.a1 * want[-1] - c.a2 * want[-2])
    assert np.abs(got[2:] - want[2:]).max() < 1e-12


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=50), st.integers(-50, 50), st.floats(-3, 3))
def test_whole_turns_do_not_matter(steps: list[float], turns: int, theta: float) -> None:
    angles = np.cumsum([theta, *steps]).tolist()
    plain = run(PAPER_60, angles)
    turned = run(PAPER_60, [angle + 2 * math.pi * turns * k for k, angle in enumerate(angles)])
    assert np.allclose(plain[2:], turned[2:], atol=1e-10)


def error_mhz(deviation: float, disturb: float, quantum: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Errors (mHz) of the paper's filter and of the backward difference at a steady frequency."""
    noise = random.Random(7)
    theta = [2 * math.pi * deviation * k / 60 + noise.gauss(0, disturb) for k in range(3000)]
    if quantum:
        theta = [round(math.remainder(angle, 2 * math.pi) / quantum) * quantum for angle in theta]
    ours = np.array(run(PAPER_60, theta))[120:]
    increments = np.array([wrap(math.remainder(b - a, 2 * math.pi)) for a, b in pairwise(theta)])
    backward = increments[119:] * 60 / (2 * math.pi)
    return (ours - deviation) * 1e3, (backward - deviation) * 1e3


@pytest.mark.parametrize("hz", np.linspace(59, 61, 9))
def test_bias_and_noise_against_the_backward_difference(hz: float) -> None:
    deviation = hz - 60
    steady, _ = error_mhz(deviation, 0.0)
    assert np.abs(steady).max() < 2e-3  # DC gain, from eight printed digits: 1e-6
    ours, backward = error_mhz(deviation, 1.5e-3)
    assert np.std(ours) < np.std(backward) / 15
    assert np.std(ours) == pytest.approx(1.0, rel=0.1)
    # Angles as 16-bit integers carry them (1e-4 rad): the backward difference errs by up to 1 mHz.
    ours, backward = error_mhz(deviation + 0.00123, 0.0, 1e-4)
    assert np.abs(ours).max() < 0.15 < 0.5 < np.abs(backward).max()


def test_white_noise_gain() -> None:
    impulse = signal.lfilter([PAPER_60.b, 0, -PAPER_60.b], [1, -PAPER_60.a1, PAPER_60.a2], np.eye(1, 600)[0])
    ours, backward = float(np.linalg.norm(impulse)), math.sqrt(2) * 60 / (2 * math.pi)
    assert ours == pytest.approx(0.668, abs=1e-3)
    assert 20 * math.log10(ours / backward) == pytest.approx(-26.1, abs=0.05)


def test_wrapped_angles_end_at_plus_pi() -> None:
    assert wrap(math.pi) == math.pi == wrap(-math.pi)
    assert wrap(math.nextafter(math.pi, 4)) < -3.1 and wrap(-3.1) == -3.1


@given(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5))
def test_midpoint_goes_the_short_way(before: float, step: float) -> None:
    after = wrap(wrap(before) + step)
    assert abs(wrap(wrap(midpoint(wrap(before), after) - wrap(before)) - step / 2)) < 1e-12


def test_positive_sequence() -> None:
    a = cmath.rect(1, 2 * math.pi / 3)
    v1, v2, v0 = 3 + 4j, 0.5 - 0.1j, 0.2j
    phases = (v0 + v1 + v2, v0 + a * a * v1 + a * v2, v0 + a * v1 + a * a * v2)
    assert sequences(*phases)[0] == pytest.approx(v1)
