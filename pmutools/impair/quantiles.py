"""Inverse distribution functions, written out here so that no library upgrade changes a run.

Arrays go through plain arithmetic, which IEEE 754 fixes to the last bit, and through scalar ``math`` for logarithms
and exponentials, whose last bit in numpy depends on the processor's vector unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_SQRT2 = math.sqrt(2.0)
_LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
LEAST, MOST = 2.0**-53, 1.0 - 2.0**-53
"""The outermost draws; what is computed from draws and used as one is held within them."""


def each(function: Callable[[float], float], values: Array) -> Array:
    """A scalar function of every value."""
    return np.fromiter(map(function, values.tolist()), np.float64, values.size)


def normal_cdf(z: float) -> float:
    """Φ(z), the standard normal distribution function."""
    return 0.5 * math.erfc(-z / _SQRT2)


def _ratio(above: tuple[float, ...], below: tuple[float, ...], r: Array) -> Array:
    """A quotient of polynomials, coefficients of the highest power first."""
    top, bottom = np.full_like(r, above[0]), np.full_like(r, below[0])
    for a, b in zip(above[1:], below[1:], strict=True):
        top, bottom = top * r + a, bottom * r + b
    return top / bottom


# fmt: off
_CENTRE = (
    (2509.0809287301226727, 33430.575583588128105, 67265.770927008700853, 45921.953931549871457,
     13731.693765509461125, 1971.5909503065514427, 133.14166789178437745, 3.387132872796366608),
    (5226.495278852545925, 28729.085735721942674, 39307.89580009271061, 21213.794301586595867,
     5394.1960214247511077, 687.1870074920579083, 42.313330701600911252, 1.0),
)
_TAIL = (
    (7.7454501427834140764e-4, 0.0227238449892691845833, 0.24178072517745061177, 1.27045825245236838258,
     3.64784832476320460504, 5.7694972214606914055, 4.6303378461565452959, 1.42343711074968357734),
    (1.05075007164441684324e-9, 5.475938084995344946e-4, 0.0151986665636164571966, 0.14810397642748007459,
     0.68976733498510000455, 1.6763848301838038494, 2.05319162663775882187, 1.0),
)
_FAR_TAIL = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3, 0.026532189526576123093,
     0.29656057182850489123, 1.7848265399172913358, 5.4637849111641143699, 6.6579046435011037772),
    (2.04426310338993978564e-15, 1.4215117583164458887e-7, 1.8463183175100546818e-5, 7.868691311456132591e-4,
     0.0148753612908506148525, 0.13692988092273580531, 0.59983220655588793769, 1.0),
)
# fmt: on


def normal_quantile(u: Array) -> Array:
    """Φ⁻¹(u) for 0 < u < 1, relative error below 1e-14.

    The rational approximations of Wichura, "Algorithm AS 241", Applied Statistics 37 (1988), routine PPND16.
    """
    q = u - 0.5
    z = np.empty_like(q)
    centre = np.abs(q) <= 0.425
    inner = q[centre]
    z[centre] = inner * _ratio(*_CENTRE, 0.180625 - inner * inner)
    outer = ~centre
    share = u[outer]
    if share.size:
        r = np.sqrt(-each(math.log, np.minimum(share, 1.0 - share)))
        tail = _ratio(*_TAIL, np.minimum(r, 5.0) - 1.6)
        if (far := r > 5.0).any():
            tail[far] = _ratio(*_FAR_TAIL, r[far] - 5.0)
        z[outer] = np.where(share < 0.5, -tail, tail)
    return z


_REACH, _PER_UNIT = 8.25, 32
"""The table of :func:`gamma_quantile` covers every draw (|Φ⁻¹(2**-53)| < 8.21) at this many knots a unit of z."""


@lru_cache(maxsize=64)
def gamma_quantile(shape: float) -> Callable[[Array], Array]:
    """The quantile function of the gamma distribution of scale 1, relative error below 1e-7 (1e-9 for shapes >= 0.5).

    ln x is smooth in z = Φ⁻¹(u), so it is solved once at knots in z and read back by cubic Hermite interpolation.
    """
    count = round(2 * _REACH * _PER_UNIT) + 1
    knots = np.array([_gamma_knot(shape, at / _PER_UNIT - _REACH) for at in range(count)])
    heights, slopes = knots[:, 0], knots[:, 1]

    def quantile(u: Array) -> Array:
        place = (normal_quantile(u) + _REACH) * _PER_UNIT
        at = place.astype(np.int64)
        t = place - at
        d0, d1, rise = slopes[at], slopes[at + 1], heights[at + 1] - heights[at]
        log_x = heights[at] + t * (d0 + t * (3 * rise - 2 * d0 - d1 + t * (d0 + d1 - 2 * rise)))
        return each(math.exp, log_x)

    return quantile


def _gamma_knot(shape: float, z: float) -> tuple[float, float]:
    """(ln x, d ln x/dz a knot) at Φ(z), by Newton's method on the logarithm of the nearer tail.

    That logarithm is concave in ln x (the density of ln x is log-concave), so the iteration converges from anywhere.
    """
    target = math.log(normal_cdf(-abs(z)))
    spread = 1 / (9 * shape)
    cube = 1 - spread + z * math.sqrt(spread)  # Wilson and Hilferty's approximation
    y = math.log(shape) + 3 * math.log(cube) if cube > 0.1 else (target + math.lgamma(shape + 1)) / shape
    for _ in range(200):
        log_tail = _log_lower(shape, y) if z < 0 else _log_upper(shape, y)
        slope = math.exp(shape * y - math.exp(y) - math.lgamma(shape) - log_tail)
        step = (target - log_tail) / (slope if z < 0 else -slope)
        y += max(-2.0, min(2.0, step))
        if abs(step) < 1e-13:
            break
    density = shape * y - math.exp(y) - math.lgamma(shape)
    return y, math.exp(-0.5 * z * z - _LOG_SQRT_2PI - density) / _PER_UNIT


def _log_lower(shape: float, y: float) -> float:
    """ln P(shape, e**y), the regularised lower incomplete gamma function: its power series where that converges."""
    x = math.exp(y)
    if x > shape + 1:
        return math.log1p(-math.exp(_log_upper(shape, y)))
    term = total = 1.0
    n = shape
    while term > total * 1e-17:
        n += 1
        term *= x / n
        total += term
    return shape * y - x - math.lgamma(shape + 1) + math.log(total)


def _log_upper(shape: float, y: float) -> float:
    """ln Q(shape, e**y): Lentz's evaluation of the continued fraction where that converges."""
    x = math.exp(y)
    if x <= shape + 1:
        return math.log1p(-math.exp(_log_lower(shape, y)))
    b = x + 1 - shape
    c, d = 1e300, 1 / b
    h = d
    for i in range(1, 100_000):
        a = -i * (i - shape)
        b += 2
        d = 1 / (a * d + b)
        c = b + a / c
        h *= c * d
        if abs(c * d - 1) < 1e-16:
            break
    return shape * y - x - math.lgamma(shape) + math.log(h)
