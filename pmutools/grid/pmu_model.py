"""What an emulated PMU reports of a bus: three phases, V1, a current, FREQ and ROCOF, with noise.

Plain numbers; putting them into C37.118 frames, and the delay until these arrive, are done elsewhere.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.draws import normal
from pmutools.grid.signals import Bus

_ROTATE: Final = (1 + 0j, cmath.rect(1, -2 * math.pi / 3), cmath.rect(1, 2 * math.pi / 3))


@dataclass(frozen=True, slots=True)
class PmuModel:
    """One emulated PMU."""

    name: str
    idcode: int
    bus: str
    """``north`` or ``south``, or another bus of the plant."""
    nominal_kv: float = 500.0
    angle_rad: float = 0.0
    """Of this place against its bus."""
    swing: float = 1.0
    """How far this place swings with its bus."""
    noise_rad: float = 0.0
    """Standard deviation of white angle noise; 1.5 mrad gives 1 mHz rms after the controller's differentiator."""
    noise_pu: float = 0.0
    """Standard deviation of white magnitude noise."""
    current_a: float = 800.0
    seed: int = 0


class Measurement(NamedTuple):
    """One report. Phasors are RMS, in the frame of nominal frequency."""

    time_ns: int
    va: complex
    vb: complex
    vc: complex
    v1: complex
    i1: complex
    frequency_hz: float
    rocof_hz_s: float


_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time
PHASORS: Final = (("VA", "V"), ("VB", "V"), ("VC", "V"), ("V1", "V"), ("I1", "A"))
"""Name and unit of a measurement's phasors, in order."""


def measure(
    pmu: PmuModel, buses: Mapping[str, Bus], time_ns: int, slot: int, *, nominal_hz: float = 60.0
) -> Measurement:
    """Report of ``buses`` at ``time_ns``, which is reporting instant ``slot``: all that the noise depends on."""
    bus = buses[pmu.bus]
    angle = pmu.angle_rad + pmu.swing * bus.angle_rad + bus.common_rad
    magnitude = bus.voltage_pu * pmu.nominal_kv * 1e3 / math.sqrt(3)
    if pmu.noise_rad:
        angle += pmu.noise_rad * normal(pmu.seed, str(pmu.idcode), "angle", slot)
    if pmu.noise_pu:
        magnitude *= 1 + pmu.noise_pu * normal(pmu.seed, str(pmu.idcode), "magnitude", slot)
    v1 = cmath.rect(magnitude, angle)
    va, vb, vc = v1 * _ROTATE[0], v1 * _ROTATE[1], v1 * _ROTATE[2]
    i1 = cmath.rect(pmu.current_a, angle - 0.2)
    frequency_hz = nominal_hz + pmu.swing * bus.deviation_hz + bus.common_hz
    rocof_hz_s = pmu.swing * bus.rocof_hz_s + bus.common_hz_s
    return _new(Measurement, (time_ns, va, vb, vc, v1, i1, frequency_hz, rocof_hz_s))


def measured_columns(
    pmu: PmuModel, course: npt.NDArray[np.float64], slots: range, *, nominal_hz: float = 60.0
) -> tuple[npt.NDArray[Any], ...]:
    """:func:`measure` over N reporting instants ``slots``, at which the bus shows ``course`` (N, 7): a column a value.

    The columns are those of :class:`Measurement` from ``va`` on, each (N,), but for the last bit of a float.
    """
    turned, deviation_hz, rocof_hz_s, voltage_pu, common_rad, common_hz, common_hz_s = course.T
    angle = pmu.angle_rad + pmu.swing * turned + common_rad
    magnitude = voltage_pu * pmu.nominal_kv * 1e3 / math.sqrt(3)
    if pmu.noise_rad:
        angle = angle + pmu.noise_rad * _draws(pmu, "angle", slots)
    if pmu.noise_pu:
        magnitude = magnitude * (1 + pmu.noise_pu * _draws(pmu, "magnitude", slots))
    v1 = magnitude * np.exp(1j * angle)
    i1 = pmu.current_a * np.exp(1j * (angle - 0.2))
    phases = (v1 * turn for turn in _ROTATE)
    frequency_hz = nominal_hz + pmu.swing * deviation_hz + common_hz
    return (*phases, v1, i1, frequency_hz, pmu.swing * rocof_hz_s + common_hz_s)


def _draws(pmu: PmuModel, stage: str, slots: range) -> npt.NDArray[np.float64]:
    return np.array([normal(pmu.seed, str(pmu.idcode), stage, slot) for slot in slots])


_SWINGS: Final = (1.0, 0.97, 1.03, 0.95)
_ANGLES_DEG: Final = {"north": (10.0, 14.0, 7.0, 17.0), "south": (-20.0, -24.0, -16.0, -29.0)}


def fleet(per_side: int = 4, *, noise_rad: float = 0.0, seed: int = 0) -> tuple[PmuModel, ...]:
    """The controller's PMUs: N1, N2 ... (IDCODE 101 ...) then S1, S2 ... (201 ...).

    N1 and S1 see exactly the plant's difference; the others swing a few percent more or less, as other substations do.
    """
    return tuple(
        PmuModel(
            name=f"{bus[0].upper()}{k + 1}",
            idcode=first + k,
            bus=bus,
            angle_rad=math.radians(_ANGLES_DEG[bus][k % 4]),
            swing=_SWINGS[k % 4],
            noise_rad=noise_rad,
            seed=seed,
        )
        for bus, first in (("north", 101), ("south", 201))
        for k in range(per_side)
    )
