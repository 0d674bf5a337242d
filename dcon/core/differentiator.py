"""The paper's frequency differentiator: a second-order Bessel low-pass in cascade with a Tustin derivative.

Equations (6) and (7) of Pierre et al., with θ in radians in and the deviation f from nominal in Hz out::

    H(z) = b (1 - z⁻²) / (1 - a1 z⁻¹ + a2 z⁻²)        f[k] = b (θ[k] - θ[k-2]) + a1 f[k-1] - a2 f[k-2]

θ[k] - θ[k-2] is taken as the sum of two wrapped increments, so that an angle may turn for ever without an
accumulator that loses precision. Scalar ``math`` only: its last bit is the same on every processor of a platform.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pmutools.errors import SettingsError

CUTOFF_HZ = 2.65
"""Phase-normalised cut-off that yields the printed coefficients; -3 dB falls at 2.08 Hz ("near 2 Hz")."""


class Coefficients(NamedTuple):
    """Coefficients of eq. (6) for ``rate_hz`` frames/s."""

    a1: float
    a2: float
    b: float
    rate_hz: float

    @property
    def low_pass(self) -> float:
        """Gain of the low-pass in H(z): (1 + z⁻¹)² times this over the same denominator."""
        return self.b * math.pi / self.rate_hz


PAPER_60 = Coefficients(a1=1.55725978, a2=0.61839943, b=0.29192028, rate_hz=60)
"""As printed in section III. :func:`design` gives the same to 1e-8."""


def design(rate_hz: float, cutoff_hz: float = CUTOFF_HZ) -> Coefficients:
    """Coefficients at any reporting rate (frames/s).

    The analog prototype w²/(s² + √3 w s + w²), w = 2π ``cutoff_hz``, is the Bessel filter whose phase asymptotes are
    those of a Butterworth filter. It is mapped by s = K (z-1)/(z+1), K = 2 ``rate_hz``, without prewarping (eq. 4) and
    multiplied by the Tustin derivative K (z-1)/(z+1) / 2π, whose pole at z = -1 cancels one of the two zeros there.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 2 * cutoff_hz > 0):
        raise SettingsError(f"a differentiator for {rate_hz} frames/s cannot pass {cutoff_hz} Hz: give a higher rate")
    w = 2 * math.pi * cutoff_hz
    k = 2 * rate_hz
    middle = math.sqrt(3) * w * k
    d = k * k + middle + w * w
    return Coefficients(
        a1=2 * (k * k - w * w) / d,
        a2=(k * k - middle + w * w) / d,
        b=w * w * k / (2 * math.pi * d),
        rate_hz=rate_hz,
    )


def coefficients(rate_hz: float) -> Coefficients:
    """The printed coefficients at 60 frames/s, designed ones elsewhere."""
    return PAPER_60 if rate_hz == 60 else design(rate_hz)


def response(c: Coefficients, z: complex) -> complex:
    """H(z) of eq. (6), in Hz per radian."""
    return c.b * (1 - z**-2) / (1 - c.a1 / z + c.a2 / z**2)


class Filter(NamedTuple):
    """Memory between frames: angle, newest wrapped increment (rad), the last two f (Hz), and frames seen (0 to 3)."""

    theta_rad: float = 0.0
    increment_rad: float = 0.0
    f_hz: float = math.nan
    f_before_hz: float = math.nan
    frames: int = 0


EMPTY = Filter()


def wrap(angle_rad: float) -> float:
    """``angle_rad``, a difference of two angles in (-π, π], brought back into (-π, π]."""
    if angle_rad > math.pi:
        return angle_rad - 2 * math.pi
    if angle_rad <= -math.pi:
        return angle_rad + 2 * math.pi
    return angle_rad


def midpoint(before_rad: float, after_rad: float) -> float:
    """The angle halfway from one to the other the short way round: the estimate for one lost frame (Algorithm 1)."""
    return wrap(before_rad + wrap(after_rad - before_rad) / 2)


def advance(c: Coefficients, last: Filter, theta_rad: float) -> Filter:
    """One frame through eq. (7).

    ``f_hz`` of the result is NaN for the first two frames. The third sets both past outputs to the mean frequency of
    the first three, which is the exact steady state for an angle that turns uniformly: no start-up ringing.
    """
    if last.frames == 0:
        return Filter(theta_rad, 0.0, math.nan, math.nan, 1)
    increment = wrap(theta_rad - last.theta_rad)
    if last.frames == 1:
        return Filter(theta_rad, increment, math.nan, math.nan, 2)
    over_two = increment + last.increment_rad
    if last.frames == 2:
        f1 = f2 = over_two * c.rate_hz / (4 * math.pi)
    else:
        f1, f2 = last.f_hz, last.f_before_hz
    return Filter(theta_rad, increment, c.b * over_two + c.a1 * f1 - c.a2 * f2, f1, 3)
