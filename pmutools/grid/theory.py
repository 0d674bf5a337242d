"""Exact eigenvalues of a modal plant under delayed, sampled feedback of its frequency difference."""

from __future__ import annotations

import cmath
from collections.abc import Callable, Sequence

from pmutools.grid.modal import Mode


def loop_gain(
    modes: Sequence[Mode],
    s: complex,
    gain_mw_per_mhz: float,
    delay_s: float,
    feedback: Callable[[complex], complex],
    hold_s: float,
) -> complex:
    """L(s) of the loop: gain × plant × feedback × pure delay × zero-order hold of ``hold_s``."""
    plant = sum(mode.transfer(s) for mode in modes)
    hold = (1 - cmath.exp(-s * hold_s)) / (s * hold_s)
    return 1000 * gain_mw_per_mhz * plant * feedback(s) * cmath.exp(-s * delay_s) * hold


def closed_loop_eigenvalue(
    modes: Sequence[Mode],
    mode: Mode,
    gain_mw_per_mhz: float,
    *,
    delay_s: float = 0.082,
    feedback: Callable[[complex], complex],
    hold_s: float = 1 / 60,
    steps: int = 40,
) -> complex:
    """Where ``mode`` of ``modes`` moves when the loop is closed: root of 1 + L(s), rad/s.

    ``feedback(s)`` is measured over true frequency. The root is followed from the open-loop pole in ``steps`` of gain,
    by Newton on (s - pole)(1 + L(s)), which is regular at the pole.
    """
    pole = mode.eigenvalue
    if gain_mw_per_mhz == 0:
        return pole

    def regular(z: complex, gain: float) -> complex:
        return (z - pole) * (1 + loop_gain(modes, z, gain, delay_s, feedback, hold_s))

    s = pole + complex(3e-4, 2e-4)  # beside the pole, where L(s) is finite
    for k in range(1, steps + 1):
        gain = gain_mw_per_mhz * k / steps
        for _ in range(30):
            step = _newton_step(regular, s, gain)
            s -= step
            if abs(step) < 1e-13 * abs(s):
                break
    return s


def _newton_step(function: Callable[[complex, float], complex], s: complex, gain: float) -> complex:
    h = 1e-6
    slope = (function(s + h, gain) - function(s - h, gain)) / (2 * h)
    return function(s, gain) / slope


def frequency_and_damping(eigenvalue: complex) -> tuple[float, float]:
    """(Hz, damping ratio) of an eigenvalue: eq. (8)."""
    return eigenvalue.imag / (2 * cmath.pi), -eigenvalue.real / abs(eigenvalue)
