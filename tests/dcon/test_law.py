from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.core.law import Transfer, approach, command_mw, saturate


@pytest.mark.parametrize(
    ("delta_f_mhz", "want"),
    [
        (0.0, 0.0),
        (0.25, 0.0),
        (-0.25, 0.0),
        (0.35, 1.2),
        (-0.35, -1.2),
        (1.25, 12.0),
        (10.4, 121.8),
        (11, 125),
        (-99, -125),
    ],
)
def test_deadband_gain_saturation(delta_f_mhz: float, want: float) -> None:
    assert command_mw(delta_f_mhz, 12.0, 0.25, 125.0) == pytest.approx(want)


def test_saturation_points_of_the_paper_gains() -> None:
    for gain, mhz in ((6, 20.8), (9, 13.9), (12, 10.4), (15, 8.3)):
        assert command_mw(mhz - 0.1, gain, 0.0, 125.0) < 125 == command_mw(mhz + 0.1, gain, 0.0, 125.0)


@given(st.floats(-500, 500), st.floats(0, 1e-6), st.floats(0, 30), st.floats(0, 5))
def test_the_law_is_odd_continuous_and_bounded(delta: float, step: float, gain: float, deadband: float) -> None:
    p = command_mw(delta, gain, deadband, 125.0)
    assert abs(p) <= 125 and p * delta >= 0
    assert command_mw(-delta, gain, deadband, 125.0) == -p
    assert abs(command_mw(delta + step, gain, deadband, 125.0) - p) <= gain * step + 1e-9


def test_nan_is_left_for_the_limiter_to_refuse() -> None:
    assert math.isnan(command_mw(math.nan, 9.0, 0.25, 125.0))
    assert math.isnan(command_mw(5.0, math.nan, 0.25, 125.0))
    assert math.isnan(saturate(math.nan, 125.0))


def test_a_transfer_falls_linearly_to_nothing_and_stays_there() -> None:
    transfer = Transfer(60.0, 60, 60)
    seen = []
    for _ in range(70):
        seen.append(transfer.residual_mw)
        transfer = transfer.tick()
    assert seen[:61] == pytest.approx([60.0 - k for k in range(61)])
    assert seen[60:] == [0.0] * 10


def test_small_steps() -> None:
    assert approach(9.0, 12.0, 0.05) == 9.05
    assert approach(9.0, 8.99, 0.05) == 8.99
    assert saturate(-130.0, 125.0) == -125.0
