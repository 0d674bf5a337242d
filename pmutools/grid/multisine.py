"""A probing signal: sines at once, of one common period, with phases drawn so that the sum stays low."""

from __future__ import annotations

import math
from functools import cache
from typing import Final, NamedTuple

from pmutools.draws import Draws

CANDIDATES: Final = 64
"""Sets of phases drawn, of which the one with the lowest peak is taken."""
_SAMPLES_PER_CYCLE = 32


class Tone(NamedTuple):
    """``mw · sin(2π frequency_hz t + phase_rad)``."""

    frequency_hz: float
    mw: float
    phase_rad: float


class Multisine(NamedTuple):
    """Equal tones from ``low_hz`` to ``high_hz``, a constant ratio apart, moved to whole cycles of ``period_s``.

    So a transform over whole periods shows each tone in a line of its own. ``peak_mw`` is the largest value of the
    sum, to within a percent.
    """

    start_s: float
    stop_s: float
    peak_mw: float
    low_hz: float = 0.1
    high_hz: float = 5.0
    number: int = 16
    period_s: float = 100.0
    seed: int = 1

    def mw(self, time_s: float) -> float:
        """Its value at ``time_s`` of the scenario."""
        if not self.start_s <= time_s < self.stop_s:
            return 0.0
        turn = 2 * math.pi * (time_s - self.start_s)
        return sum(mw * math.sin(turn * frequency_hz + phase) for frequency_hz, mw, phase in tones(self))


@cache
def tones(signal: Multisine) -> tuple[Tone, ...]:
    """The tones of ``signal``, lowest first."""
    ratio = (signal.high_hz / signal.low_hz) ** (1 / max(signal.number - 1, 1))
    cycles = sorted({round(signal.low_hz * ratio**k * signal.period_s) for k in range(signal.number)})
    drawn = []
    for candidate in range(CANDIDATES):
        draws = Draws(signal.seed, "multisine", str(candidate))
        phases = [2 * math.pi * draws.uniform(k) for k in range(len(cycles))]
        drawn.append((_peak(cycles, phases), phases))
    peak, phases = min(drawn)
    return tuple(
        Tone(n / signal.period_s, signal.peak_mw / peak, phase) for n, phase in zip(cycles, phases, strict=True)
    )


def _peak(cycles: list[int], phases: list[float]) -> float:
    """Largest magnitude of the sum of unit tones; rounded, for its last bits depend on the processor."""
    import numpy as np

    samples = _SAMPLES_PER_CYCLE * max(cycles)
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    spectrum[cycles] = np.exp(1j * np.array(phases)) * samples / 2  # a cosine each, a quarter turn from the sine
    return round(float(np.abs(np.fft.irfft(spectrum * -1j, samples)).max()), 9)
