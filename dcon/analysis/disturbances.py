"""Where the grid was disturbed: a change of Δf far above the session's own noise, and sudden."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

LAG_S: Final = 0.5
"""Δf is compared with itself this much earlier."""
FACTOR: Final = 8.0
"""How many robust standard deviations (1.4826 MAD, of a quiet part) a change must have ..."""
LEAST_MHZ: Final = 2.0
"""... and how much at least: a simulation without noise has none."""
SUDDEN: Final = 3.0
"""A change must be so many times the largest of the :data:`BEFORE_S` before: a swing that dies out begins once."""
BEFORE_S: Final = 3.0
"""More than half a period of any inter-area swing."""
KNOWN_S: Final = 1.0
"""Of it Δf must be known this long: what is there when data come back did not begin then."""
BLOCK_S: Final = 6.0
"""The noise is that of the blocks of this length, of which a quarter is quieter."""
REST_S: Final = 6.0
"""After one disturbance, none is looked for during this time."""


class Noise(NamedTuple):
    """How much Δf changes within :data:`LAG_S` when nothing happens."""

    sigma_mhz: float
    limit_mhz: float
    """What a disturbance must exceed."""


def noise_of(delta_f_mhz: Floats, rate_hz: float) -> Noise:
    """Of a session's Δf (T,), NaN where unknown."""
    change = _changes(delta_f_mhz, rate_hz)
    size = round(BLOCK_S * rate_hz)
    blocks = [block[np.isfinite(block)] for block in np.split(change, range(size, len(change), size))]
    medians = [float(np.median(block)) for block in blocks if 2 * block.size > size]
    sigma = 1.4826 * float(np.quantile(medians, 0.25, method="lower")) if medians else 0.0
    return Noise(sigma, max(FACTOR * sigma, LEAST_MHZ))


def disturbances(delta_f_mhz: Floats, rate_hz: float) -> list[int]:
    """Rows of Δf (T,) at which a disturbance shows first."""
    change = _changes(delta_f_mhz, rate_hz)
    limit = noise_of(delta_f_mhz, rate_hz).limit_mhz
    before, lag, rest, least = (round(s * rate_hz) for s in (BEFORE_S, LAG_S, REST_S, KNOWN_S))
    found: list[int] = []
    for row in np.flatnonzero(change > limit).tolist():
        if found and row < found[-1] + rest:
            continue
        past = change[max(0, row - lag - before) : max(0, row - lag)]
        past = past[np.isfinite(past)]
        if past.size >= least and np.nanmax(change[row : row + lag]) > SUDDEN * past.max():
            found.append(row)
    return found


def _changes(delta_f_mhz: Floats, rate_hz: float) -> Floats:
    """(T,) |Δf - Δf earlier|; NaN where either is unknown."""
    lag = round(LAG_S * rate_hz)
    change = np.full_like(delta_f_mhz, np.nan)
    change[lag:] = np.abs(delta_f_mhz[lag:] - delta_f_mhz[:-lag])
    return change
