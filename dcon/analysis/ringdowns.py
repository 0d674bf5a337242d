"""Free swings of the grid after disturbances, fitted by the matrix pencil, open loop against closed.

A fit is one number of many: order and window are choices. So every ringdown is fitted with all of them, and what is
told is the median with the spread. The controller's filter is in Δf; it moves no mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from dcon.analysis.disturbances import REST_S, Floats, disturbances
from pmutools.modal.matrix_pencil import ringdown

ORDERS: Final = tuple(range(8, 21, 2))
WINDOWS_S: Final = (8.0, 10.0, 12.0, 14.0)
SHORT_S: Final = 6.0
"""Where there is not enough for any of these, one window of so much: two periods of a slow inter-area swing."""
SETTLE_S: Final = 2.0
"""From the first sign of a disturbance to a swing that is free: a brake of 0.5 s, and the filter."""
AFTER_S: Final = 0.5
"""From the last saturated tick."""
FORCED_S: Final = 1.0
"""From the last tick of a probing signal."""
SATURATED: Final = 0.98
"""Of the limit."""
SEARCH_S: Final = 30.0
"""A swing that is still forced so long after it began is none."""
MOST: Final = 40
"""Ringdowns that are fitted, so that the time is bounded: the first."""
BAND_HZ: Final = (0.1, 1.0)
LEAST_R2: Final = 0.8
"""A fit that explains less is left out of the median."""


class Loop(NamedTuple):
    """What a ringdown needs of each tick, (T,) each."""

    tick_ns: npt.NDArray[np.int64]
    delta_f_mhz: Floats
    command_mw: Floats
    output_v: Floats
    probe_mw: Floats
    gain_mw_per_mhz: Floats
    situation: npt.NDArray[np.int64]
    """0 in open loop; changes where one loop becomes another."""
    rate_hz: float
    limit_mw: float


class Value(NamedTuple):
    """Median of the fits, and the range that holds the middle 80 % of them."""

    median: float
    low: float
    high: float


class Mode(NamedTuple):
    """The strongest mode within :data:`BAND_HZ`."""

    frequency_hz: Value
    damping_percent: Value
    amplitude_mhz: float
    r2: float
    """Median share of the variance that is explained."""
    fits: int
    """Of ``tried``, those that found a mode and explain enough."""
    tried: int


class Ringdown(NamedTuple):
    """A disturbance, and what came of it. ``why`` says why there is no mode."""

    disturbed_ns: int
    begin_ns: int
    """Of the fit."""
    length_s: float
    """That was free and under one control: windows are no longer."""
    peak_mhz: float
    """Largest |Δf| from the disturbance on."""
    closed: bool
    gain_mw_per_mhz: float
    """In force; 0 in open loop."""
    saturated_s: float
    mode: Mode | None
    why: str

    def to_json(self) -> dict[str, Any]:
        mode = self.mode
        return self._asdict() | {
            "loop": "closed" if self.closed else "open",
            "mode": None
            if mode is None
            else mode._asdict()
            | {"frequency_hz": mode.frequency_hz._asdict(), "damping_percent": mode.damping_percent._asdict()},
        }


def ringdowns(loop: Loop, breaks: Sequence[int] = ()) -> list[Ringdown]:
    """Every ringdown of a session; ``breaks`` are rows before which something is missing."""
    starts = _starts(loop)
    ends = [*starts[1:], len(loop.tick_ns)]
    return [_ringdown(loop, start, end, breaks) for start, end in zip(starts[:MOST], ends, strict=False)]


def _starts(loop: Loop) -> list[int]:
    """Rows at which something begins to move the grid: disturbances, and probing signals, however small."""
    probing = np.diff((loop.probe_mw != 0).astype(np.int8), prepend=0) > 0
    found: list[int] = []
    disturbed = set(disturbances(loop.delta_f_mhz, loop.rate_hz).rows)
    forced = round(FORCED_S * loop.rate_hz)
    for row in sorted(disturbed.union(np.flatnonzero(probing).tolist())):
        another = row in disturbed and not loop.probe_mw[max(0, row - forced) : row + 1].any()  # no answer to the probe
        if not found or another or row >= found[-1] + round(REST_S * loop.rate_hz):
            found.append(row)
    return found


def _ringdown(loop: Loop, start: int, end: int, breaks: Sequence[int]) -> Ringdown:
    rate, total = loop.rate_hz, len(loop.tick_ns)
    end = min([end, *(row for row in breaks if row > start)])
    search = min(end, start + round(SEARCH_S * rate))
    driven = loop.output_v[start:search] != 0
    saturated = driven & (np.abs(loop.command_mw[start:search]) >= SATURATED * loop.limit_mw)
    probing = loop.probe_mw[start:search] != 0
    begin = start + max(
        round(SETTLE_S * rate),
        _after(saturated, AFTER_S * rate),
        _after(probing, FORCED_S * rate),
        _after(np.diff(loop.situation[start : start + round(SETTLE_S * rate)], prepend=loop.situation[start]) != 0, 1),
    )
    begin = min(begin, total - 1)
    end = max(begin, min(end, begin + _same(loop, begin, end)))
    gain = _gain(loop, slice(begin, end) if end > begin else slice(start, max(search, start + 1)))
    found, why = _fit(loop, begin, end)
    if probing.any() and loop.probe_mw[begin] != 0:
        why = f"a probing signal was still on {SEARCH_S:g} s later"
    return Ringdown(
        disturbed_ns=int(loop.tick_ns[start]),
        begin_ns=int(loop.tick_ns[begin]),
        length_s=(end - begin) / rate,
        peak_mhz=_peak(loop.delta_f_mhz[start : max(end, start + 1)]),
        closed=gain != 0,
        gain_mw_per_mhz=gain,
        saturated_s=float(saturated.sum()) / rate,
        mode=found,
        why=why,
    )


def _gain(loop: Loop, part: slice) -> float:
    """What closed the loop during ``part``; 0 for nothing. A probing signal drives the output of an open loop, too."""
    driven = (loop.output_v[part] != 0) & ((loop.probe_mw[part] == 0) | (loop.situation[part] != 0))
    at = np.flatnonzero(driven)
    return float(loop.gain_mw_per_mhz[part][at[0]]) if at.size else 0.0


def _after(rows: npt.NDArray[np.bool_], margin: float) -> int:
    """Rows from the first to ``margin`` after the last that is set; 0 where none is."""
    at = np.flatnonzero(rows)
    return int(at[-1]) + 1 + round(margin) if at.size else 0


def _same(loop: Loop, begin: int, end: int) -> int:
    """Rows from ``begin`` during which one control is in force, Δf is known, and no ticks are missing."""
    part = slice(begin, end)
    other = (
        (loop.situation[part] != loop.situation[begin])
        | (loop.gain_mw_per_mhz[part] != loop.gain_mw_per_mhz[begin])
        | (loop.probe_mw[part] != 0)
        | ~np.isfinite(loop.delta_f_mhz[part])
        | (np.diff(loop.tick_ns[part], prepend=loop.tick_ns[begin]) > 1.5e9 / loop.rate_hz)
    )
    return int(np.argmax(other)) if other.any() else end - begin


def _peak(delta_f_mhz: Floats) -> float:
    known = np.abs(delta_f_mhz[np.isfinite(delta_f_mhz)])
    return float(known.max()) if known.size else 0.0


def _fit(loop: Loop, begin: int, end: int) -> tuple[Mode | None, str]:
    length_s = (end - begin) / loop.rate_hz
    windows = [window for window in WINDOWS_S if window <= length_s + 1 / loop.rate_hz] or [SHORT_S]
    if length_s < SHORT_S:
        return None, f"only {length_s:.1f} s are free and under one control; {SHORT_S:g} s are needed"
    signal = loop.delta_f_mhz[begin:end]
    found = []
    for window in windows:
        for order in ORDERS:
            fit = ringdown(signal, loop.rate_hz, 0.0, window, order=order)
            mode = fit.dominant(*BAND_HZ)
            if mode is not None and fit.r2 >= LEAST_R2:
                found.append((mode.frequency_hz, 100 * mode.damping, mode.amplitude, fit.r2))
    tried = len(windows) * len(ORDERS)
    if 2 * len(found) < tried:
        return None, f"{len(found)} of {tried} fits explain {LEAST_R2:.0%} of the variance: no clear swing"
    frequency, damping, amplitude, r2 = np.array(found).T
    return Mode(
        _value(frequency), _value(damping), float(np.median(amplitude)), float(np.median(r2)), len(found), tried
    ), ""


def _value(values: Floats) -> Value:
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return Value(median, low, high)


class Comparison(NamedTuple):
    """All ringdowns with one gain in force, or (``closed`` false) with none."""

    closed: bool
    gain_mw_per_mhz: float
    ringdowns: int
    frequency_hz: float
    """Median over the ringdowns."""
    damping_percent: float
    damping_low_percent: float
    """Over all of their fits' ranges."""
    damping_high_percent: float
    gained_percent: float | None
    """Damping above that of the open loop, in points; None without any in open loop."""

    def to_json(self) -> dict[str, Any]:
        return self._asdict() | {"loop": "closed" if self.closed else "open"}


def compare(found: Sequence[Ringdown]) -> list[Comparison]:
    """Open loop first, then by gain."""
    groups: dict[tuple[bool, float], list[Mode]] = {}
    for each in found:
        if each.mode is not None:
            groups.setdefault((each.closed, round(each.gain_mw_per_mhz, 6)), []).append(each.mode)
    base = math.nan
    rows = []
    for (closed, gain), modes in sorted(groups.items()):
        damping = float(np.median([mode.damping_percent.median for mode in modes]))
        if not closed:
            base = damping
        rows.append(
            Comparison(
                closed,
                gain,
                len(modes),
                float(np.median([mode.frequency_hz.median for mode in modes])),
                damping,
                min(mode.damping_percent.low for mode in modes),
                max(mode.damping_percent.high for mode in modes),
                damping - base if closed and math.isfinite(base) else None,
            )
        )
    return rows
