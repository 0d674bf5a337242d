"""The modal plant: a sum of second-order modes from modulated power to frequency difference, propagated exactly.

Per mode, with P the modulation and Pb the brake (MW)::

    x1' = x2        x2' = -w² x1 - 2 ζ w x2 - (P + bb Pb)
    df  = Σ (b1 x2 + b0 x1)     θ' = 2π df        (f_north - f_south, and the angle between north and south)

Half of θ goes to the north, the other half, negative, to the south. The eigenvalue of a mode is -σ ± j wd, wd = 2π f
with f its damped frequency, σ = ζ wd / sqrt(1 - ζ²), w = |λ|.

The residues of the North-South B mode are fitted so that the loop of the paper (its filter, 82 ms, 60 Hz hold) has
the damping and frequency of Table II's simulation rows. All other modes are assumptions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Final, NamedTuple

from pmutools.grid.signals import Bus, Drive


class _Rates(NamedTuple):
    sigma: float
    wd: float
    w2: float


class Mode:
    """One mode: damped frequency (Hz), damping ratio, residue b1 s + b0 (Hz/(MW s), Hz/(MW s²)), share of the brake."""

    def __init__(self, name: str, f_hz: float, damping: float, b1: float, b0: float = 0.0, brake: float = 0.0) -> None:
        self.name = name
        self.f_hz = f_hz
        self.damping = damping
        self.b1 = b1
        self.b0 = b0
        self.brake = brake

    @cached_property
    def rates(self) -> _Rates:
        wd = 2 * math.pi * self.f_hz
        sigma = self.damping * wd / math.sqrt(1 - self.damping**2)
        return _Rates(sigma, wd, sigma * sigma + wd * wd)

    @property
    def eigenvalue(self) -> complex:
        """-σ + j wd, rad/s."""
        return complex(-self.rates.sigma, self.rates.wd)

    def transfer(self, s: complex) -> complex:
        """From P (MW) to -df (Hz): (b1 s + b0) / (s² + 2 σ s + w²)."""
        return (self.b1 * s + self.b0) / (s * s + 2 * self.rates.sigma * s + self.rates.w2)


SINGLE_MODE: Final = (Mode("North-South B", 0.425, 0.078, 18.99e-6, 6.34e-6, 1.0),)
FIVE_MODES: Final = (
    Mode("North-South B", 0.425, 0.078, 19.09e-6, 5.44e-6, 1.0),
    Mode("North-South A", 0.25, 0.12, 4e-6, brake=0.5),
    Mode("BC", 0.60, 0.08, 3e-6, brake=0.4),
    Mode("Montana", 0.80, 0.07, 2e-6, brake=0.3),
    Mode("HVDC", 2.2, 0.10, 150e-6),
)
SEPARATED_FROM_BC: Final = (Mode("North-South B", 0.37, 0.0, 18.99e-6, 6.34e-6, 1.0),)
"""British Columbia islanded from the US in dual export: undamped. The paper prints neither frequency nor gain; this
gives its 4.1 % at 12 MW/mHz."""


SEPARATED_FROM_ALBERTA: Final = (Mode("North-South", 0.32, 0.08, 18.99e-6, 6.34e-6, 1.0),)
"""Alberta islanded: its mode and North-South A and B become one. Frequency, damping and residues are assumed."""


class _Motion(NamedTuple):
    x1: float = 0.0
    x2: float = 0.0
    angle_rad: float = 0.0


class ModalPlant:
    """A plant of :class:`Mode` objects, at rest until driven."""

    def __init__(self, modes: Sequence[Mode]) -> None:
        self.modes = tuple(modes)
        self._motion = [_Motion()] * len(self.modes)

    def advance(self, dt_s: float, drive: Drive) -> None:
        """Exact for power that is constant over ``dt_s``, however long."""
        self._motion = [_propagate(m, x, dt_s, _push(m, drive)) for m, x in zip(self.modes, self._motion, strict=True)]

    def difference(self, drive: Drive) -> Bus:
        """Angle, frequency difference and its rate between north and south."""
        angle = deviation = rocof = 0.0
        for mode, (x1, x2, turned) in zip(self.modes, self._motion, strict=True):
            pull = -mode.rates.w2 * x1 - 2 * mode.rates.sigma * x2 - _push(mode, drive)
            angle += turned
            deviation += mode.b1 * x2 + mode.b0 * x1
            rocof += mode.b1 * pull + mode.b0 * x2
        return Bus(angle, deviation, rocof)

    def buses(self, drive: Drive) -> dict[str, Bus]:
        angle, deviation, rocof, *_ = self.difference(drive)
        north = Bus(angle / 2, deviation / 2, rocof / 2)
        return {"north": north, "south": Bus(-north.angle_rad, -north.deviation_hz, -north.rocof_hz_s)}


def _push(mode: Mode, drive: Drive) -> float:
    return drive.modulation_mw + mode.brake * drive.brake_mw


def _propagate(mode: Mode, x: _Motion, dt_s: float, push_mw: float) -> _Motion:
    """Closed form: a decaying rotation about the rest point of ``push_mw``.

    ∫x1 dt, which the angle needs, follows from the second equation without another exponential.
    """
    sigma, wd, w2 = mode.rates
    rest = -push_mw / w2
    y1, y2 = x.x1 - rest, x.x2
    decay = math.exp(-sigma * dt_s)
    c, s = decay * math.cos(wd * dt_s), decay * math.sin(wd * dt_s) / wd
    x1 = rest + c * y1 + s * (y2 + sigma * y1)
    x2 = c * y2 - s * (w2 * y1 + sigma * y2)
    moved = x1 - x.x1
    integral = -(x2 - x.x2 + 2 * sigma * moved + push_mw * dt_s) / w2
    return _Motion(x1, x2, x.angle_rad + 2 * math.pi * (mode.b1 * moved + mode.b0 * integral))
