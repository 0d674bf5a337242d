"""Synchrophasors estimated from sampled waveforms, in the manner of the P class of IEEE C37.118.1 Annex C.

The samples are demodulated with the nominal frequency in UTC and weighted with a triangle two cycles long, which is
what two averages over one cycle make: constants and all harmonics vanish at nominal frequency. With T one nominal
cycle and w the triangle about the reporting instant t::

    P(t) = sqrt(2) Σ w x exp(-j 2π f0 t_k) / Σ w           RMS, cosine reference
    f    = f0 + arg(P(t + T/2) P*(t - T/2)) / (2π T)
    rocof =     (arg(P(t + T/2) P*(t)) - arg(P(t) P*(t - T/2))) / (2π (T/2)²)

Off nominal the triangle lets through sinc²((f - f0) T) of the magnitude; P is divided by that. It is an estimate, good
to what the tests of this module state, and not a certified measurement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Complexes = npt.NDArray[np.complex128]

MIN_SAMPLES_PER_CYCLE = 8
"""Fewer tell harmonics from the fundamental no longer."""
CYCLES = 3.0
"""Of samples that an instant needs: two for the filter, half a one on either side for the frequency."""
_MAX_WEIGHTS = 1 << 20
_CORRECTED_HZ = 10.0
"""Beyond this deviation the correction of the magnitude stays what it is here."""
_TURN = np.exp(2j * np.pi / 3)


@dataclass(frozen=True, eq=False)
class Windows:
    """The samples about R reporting instants, and their weights; good for all channels sampled at the same times.

    ``times_s`` (N,) rise, are evenly spaced (in the part that is used), and count from a whole UTC second, as do
    ``instants_s`` (R,).
    """

    times_s: Floats
    instants_s: Floats
    nominal_hz: float

    @cached_property
    def _samples(self) -> tuple[npt.NDArray[np.int64], Complexes]:
        """Places (R, 3, m) in ``times_s``, and weights, about T/2 before each instant, the instant, T/2 after."""
        cycle_s = 1 / self.nominal_hz
        centres = self.instants_s[:, None] + np.array([-0.5, 0.0, 0.5]) * cycle_s
        first = np.searchsorted(self.times_s, centres - cycle_s)
        count = int((np.searchsorted(self.times_s, centres + cycle_s, side="right") - first).max(initial=1))
        places = np.minimum(first[..., None] + np.arange(count), len(self.times_s) - 1)
        times = self.times_s[places]
        weights = np.maximum(1 - np.abs(times - centres[..., None]) / cycle_s, 0.0)
        weights[..., 1:][places[..., 1:] == places[..., :-1]] = 0.0  # the last sample counts once
        turns = np.exp(-2j * np.pi * self.nominal_hz * times)
        return places, np.sqrt(2) * weights * turns / weights.sum(axis=-1, keepdims=True)

    def phasors(self, samples: Floats) -> Complexes:
        """(R, 3) RMS phasors of a channel's N samples, T/2 before each instant, at it, and T/2 after it."""
        places, weights = self._samples
        found: Complexes = np.einsum("rkm,rkm->rk", samples[places], weights)
        return found


def windows(times_s: Floats, instants_s: Floats, nominal_hz: float) -> Iterator[tuple[slice, Windows]]:
    """``instants_s`` in pieces whose weights fit into some MiB, each with its place among them."""
    if not len(instants_s):
        return
    spacing_s = float(np.median(np.diff(times_s)))
    step = max(int(_MAX_WEIGHTS * spacing_s * nominal_hz / 6), 1)
    for first in range(0, len(instants_s), step):
        piece = slice(first, first + step)
        yield piece, Windows(times_s, instants_s[piece], nominal_hz)


def frequency_of(phasors: Complexes, nominal_hz: float) -> tuple[Floats, Floats]:
    """Frequency (R,) in Hz and ROCOF (R,) in Hz/s from phasors (R, 3) as :meth:`Windows.phasors` gives them."""
    before, now, after = phasors.T
    cycle_s = 1 / nominal_hz
    early, late = np.angle(now * before.conj()), np.angle(after * now.conj())
    return nominal_hz + (early + late) / (2 * np.pi * cycle_s), (late - early) / (2 * np.pi * (cycle_s / 2) ** 2)


def corrected(phasors: Complexes, frequency_hz: Floats, nominal_hz: float) -> Complexes:
    """Phasors (R,) without the droop of the filter at ``frequency_hz`` (R,); as they are where that is NaN."""
    deviation = np.clip(np.nan_to_num(frequency_hz - nominal_hz), -_CORRECTED_HZ, _CORRECTED_HZ)
    whole: Complexes = phasors / np.sinc(deviation / nominal_hz) ** 2
    return whole


def positive_sequence(a: Complexes, b: Complexes, c: Complexes) -> Complexes:
    """Of three phases, element by element."""
    sequence: Complexes = (a + _TURN * b + _TURN.conjugate() * c) / 3
    return sequence


def whole_windows(instants_s: Floats, first_s: float, last_s: float, nominal_hz: float) -> npt.NDArray[np.bool_]:
    """(R,) whether an instant's window lies wholly within even samples from ``first_s`` to ``last_s``."""
    reach_s = CYCLES / 2 / nominal_hz
    slack_s = 1e-9  # a window may begin with the very first sample
    inside: npt.NDArray[np.bool_] = (instants_s - reach_s >= first_s - slack_s) & (
        instants_s + reach_s <= last_s + slack_s
    )
    return inside
