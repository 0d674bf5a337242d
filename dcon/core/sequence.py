"""Symmetrical components."""

from __future__ import annotations

import math

_TURN = complex(0.0, math.sqrt(3) / 2)


def sequences(va: complex, vb: complex, vc: complex) -> tuple[complex, complex]:
    """Positive and negative sequence of three phases, in their unit.

    V1 = (Va + a Vb + a² Vc) / 3 and V2 = (Va + a² Vb + a Vc) / 3 with a = 1∠120° = -1/2 + j √3/2: the sums differ in
    the sign of the second part.
    """
    middle = va - (vb + vc) / 2
    turned = _TURN * (vb - vc)
    return (middle + turned) / 3, (middle - turned) / 3
