"""Symmetrical components."""

from __future__ import annotations

import math

_A = complex(-0.5, math.sqrt(3) / 2)
_A2 = _A.conjugate()


def positive_sequence(va: complex, vb: complex, vc: complex) -> complex:
    """V1 = (Va + a Vb + a² Vc) / 3, a = 1∠120°; in the unit of the phase voltages."""
    return (va + _A * vb + _A2 * vc) / 3
