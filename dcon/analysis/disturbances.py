"""Where the grid was disturbed: a change of Δf far above the noise, and sudden.

A swing is no noise. One that does not die out fills the session from its begin to its end, so noise is not only looked
for in what is quiet of the whole session, but also in what came just before each change.
"""

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
"""The session's noise is that of the blocks of this length, of which a quarter is quieter ..."""
QUIET_S: Final = 60.0
"""... or, if less, that of so much before a change ..."""
QUIET_KNOWN_S: Final = 3.0
"""... as far as so much of it is known."""
REST_S: Final = 6.0
"""So long after a disturbance, its own swing may change Δf: only a change that itself is :data:`SUDDEN` times the most
of the :data:`BEFORE_S` before begins another ..."""
SAME_S: Final = 2.0
"""... and one before that is the same, and moves its begin: swings of several modes may hide each other at first ..."""
RISE_S: Final = 1.0
"""... unless it is so early that it is the first rise."""


class Found(NamedTuple):
    """Rows at which a disturbance shows first, and how much Δf changes within :data:`LAG_S` when nothing happens."""

    rows: list[int]
    noise_mhz: float


def disturbances(delta_f_mhz: Floats, rate_hz: float) -> Found:
    """Of a session's Δf (T,), NaN where unknown."""
    change = _changes(delta_f_mhz, rate_hz)
    rest, same, rise = (round(s * rate_hz) for s in (REST_S, SAME_S, RISE_S))
    quiet, least = (round(s * rate_hz) for s in (QUIET_S, QUIET_KNOWN_S))
    lag = round(LAG_S * rate_hz)
    session = noise = _quiet_blocks(change, round(BLOCK_S * rate_hz))
    rows: list[int] = []
    usual = _usual(change, rate_hz)
    for row in np.flatnonzero((change > LEAST_MHZ) & _sudden(change, usual, rate_hz)).tolist():
        if rows and row < rows[-1] + (rise if change[row] > SUDDEN * usual[row] else rest):
            continue
        past = change[max(0, row - lag - quiet) : max(0, row - lag)]
        past = past[np.isfinite(past)]
        before = min(session, _deviation(past)) if past.size >= least else session
        if change[row] > FACTOR * before:
            if rows and row < rows[-1] + same:
                rows.pop()
            rows.append(row)
            noise = min(noise, before)
    return Found(rows, noise)


def _quiet_blocks(change: Floats, size: int) -> float:
    blocks = [block[np.isfinite(block)] for block in np.split(change, range(size, len(change), size))]
    found = [_deviation(block) for block in blocks if 2 * block.size > size]
    return float(np.quantile(found, 0.25, method="lower")) if found else 0.0


def _deviation(change: Floats) -> float:
    """Robust standard deviation of what ``change`` (N,) are the magnitudes of."""
    return 1.4826 * float(np.median(change))


def _usual(change: Floats, rate_hz: float) -> Floats:
    """(T,) the largest change of :data:`BEFORE_S` up to :data:`LAG_S` ago; inf where too little of it is known."""
    before, lag, least = (round(s * rate_hz) for s in (BEFORE_S, LAG_S, KNOWN_S))
    past = np.concatenate((np.full(before + lag, -np.inf), _known(change)))[: len(change) + before]
    counts = np.cumsum(np.concatenate(([0], np.isfinite(past))))
    enough = (counts[before:] - counts[:-before])[: len(change)] >= least
    return np.where(enough, _windows(past, before).max(axis=1)[: len(change)], np.inf) if len(change) else change


def _sudden(change: Floats, usual: Floats, rate_hz: float) -> npt.NDArray[np.bool_]:
    """(T,) whether the largest change of the next :data:`LAG_S` is far above what was ``usual``."""
    lag = round(LAG_S * rate_hz)
    ahead = np.concatenate((_known(change), np.full(lag, -np.inf)))
    return np.asarray(_windows(ahead, lag).max(axis=1)[: len(change)] > SUDDEN * usual)


def _known(change: Floats) -> Floats:
    return np.where(np.isfinite(change), change, -np.inf)


_windows: Final = np.lib.stride_tricks.sliding_window_view


def _changes(delta_f_mhz: Floats, rate_hz: float) -> Floats:
    """(T,) |Δf - Δf earlier|; NaN where either is unknown."""
    lag = round(LAG_S * rate_hz)
    change = np.full_like(delta_f_mhz, np.nan)
    change[lag:] = np.abs(delta_f_mhz[lag:] - delta_f_mhz[:-lag])
    return change
