"""A session in numbers: how the loop ran, what was commanded, how good the data of each PMU were, the delay budget."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dcon.analysis.course import largest
from dcon.analysis.disturbances import Floats
from dcon.analysis.ringdowns import SATURATED
from dcon.columns.tables import STAMP_SOURCES, STATES, PmuColumns, SessionColumns
from pmutools.c37118.constants import STAT_DATA_ERROR_MASK, Stat
from pmutools.measure.budget import Row, budget
from pmutools.measure.histogram import Histogram
from pmutools.timebase import NS

SIMULATED = "scenario"
"""Metadata key that a simulated session has."""
MSG_TQ = 0x0F
"""Of the time quality byte: 0 is locked."""


class Spread(NamedTuple):
    """How a quantity is distributed; all None where nothing is known of it."""

    mean: float | None
    p50: float | None
    p99: float | None
    max: float | None


class Timing(NamedTuple):
    """How the loop ran. Without times of its own the session was simulated, or its log has lost them."""

    ticks: int
    missing_ticks: int
    compute_us: Spread
    late_us: Spread
    late_over_1ms: int


class Commands(NamedTuple):
    """The command while the controller was ACTIVE (all in MW but for shares and times)."""

    active_s: float
    driven_s: float
    """With the output off 0 V."""
    mean_mw: float
    rms_mw: float
    peak_mw: float
    saturated_s: float
    largest_slew_mw_per_s: float
    zero_crossings_per_s: float
    peak_probe_mw: float
    """Of the probing signal, in any state."""


class PmuQuality(NamedTuple):
    """A PMU's frames as ticks took them. Shares are of the frames that came."""

    name: str
    expected: int
    """Reporting instants from its first frame to its last."""
    received: int
    lost: int
    duplicated: int
    reordered: int
    longest_gap_s: float
    delay_ms: Spread
    """Stamp to arrival."""
    age_ms: Spread
    """Tick minus stamp of the newest frame, at every tick."""
    data_error: float
    """STAT bits 15-14."""
    unsynchronised: float
    """STAT bit 13, or a time quality other than locked."""
    triggered: float
    modified: float
    frequency_sd_mhz: float | None
    stamp_sources: dict[str, int]


def spread(values: npt.NDArray[Any]) -> Spread:
    known = values[np.isfinite(values)]
    if not known.size:
        return Spread(None, None, None, None)
    p50, p99 = np.quantile(known, (0.5, 0.99)).tolist()
    return Spread(float(known.mean()), p50, p99, float(known.max()))


def timing(session: SessionColumns, missing: int) -> Timing:
    tick = session.tick
    late = tick.late_us[np.isfinite(tick.late_us)]
    return Timing(len(tick.tick_ns), missing, spread(tick.compute_us), spread(tick.late_us), int((late > 1000).sum()))


def commands(session: SessionColumns, rate_hz: float, limit_mw: float) -> Commands:
    tick = session.tick
    active = tick.state == STATES.index("ACTIVE")
    command = tick.command_mw[active]
    steps = np.abs(np.diff(tick.command_mw))[active[1:] & active[:-1]]
    signs = np.sign(command)
    signs = signs[signs != 0]
    seconds = len(command) / rate_hz
    return Commands(
        active_s=seconds,
        driven_s=float((tick.output_v != 0).sum()) / rate_hz,
        mean_mw=float(command.mean()) if command.size else 0.0,
        rms_mw=float(np.sqrt((command**2).mean())) if command.size else 0.0,
        peak_mw=largest(command),
        saturated_s=float((np.abs(command) >= SATURATED * limit_mw).sum()) / rate_hz,
        largest_slew_mw_per_s=float(steps.max()) * rate_hz if steps.size else 0.0,
        zero_crossings_per_s=float((np.diff(signs) != 0).sum()) / seconds if seconds else 0.0,
        peak_probe_mw=largest(tick.probe_mw),
    )


def pmu_quality(session: SessionColumns, name: str, rate_hz: float) -> PmuQuality:
    """Of the PMU ``name``, from whose frames the log has none, perhaps."""
    frames = session.pmu.get(name)
    place = session.pmus.index(name) if name in session.pmus else -1
    age = session.tick.age_ms[:, place] if place >= 0 else np.empty(0)
    if frames is None or not len(frames.time_ns):
        nothing = Spread(None, None, None, None)
        return PmuQuality(name, 0, 0, 0, 0, 0, 0.0, nothing, spread(age), 0.0, 0.0, 0.0, 0.0, None, {})
    slots = np.round(frames.time_ns / (NS / rate_hz)).astype(np.int64)
    unique = np.unique(slots)
    expected = int(unique[-1] - unique[0]) + 1
    stat, count = frames.stat, len(slots)
    error = (stat & STAT_DATA_ERROR_MASK) != 0
    unsynchronised = ((stat & Stat.NOT_SYNCHRONISED) != 0) | ((frames.time_quality & MSG_TQ) != 0)
    frequency = frames.frequency_hz[np.isfinite(frames.frequency_hz) & ~error]
    sources = Counter(STAMP_SOURCES[code] for code in frames.stamp_source.tolist() if code < len(STAMP_SOURCES))
    return PmuQuality(
        name=name,
        expected=expected,
        received=len(unique),
        lost=expected - len(unique),
        duplicated=count - len(unique),
        reordered=int((np.diff(slots) < 0).sum()),
        longest_gap_s=float(np.diff(unique).max() - 1) / rate_hz if len(unique) > 1 else 0.0,
        delay_ms=spread(delays_ms(frames)),
        age_ms=spread(age),
        data_error=float(error.mean()),
        unsynchronised=float(unsynchronised.mean()),
        triggered=float(((stat & Stat.TRIGGER) != 0).mean()),
        modified=float(((stat & Stat.DATA_MODIFIED) != 0).mean()),
        frequency_sd_mhz=float(frequency.std()) * 1e3 if frequency.size else None,
        stamp_sources=dict(sources),
    )


def delays_ms(frames: PmuColumns) -> Floats:
    """(N,) stamp to arrival; NaN where the arrival is unknown."""
    delay = (frames.arrival_ns - frames.time_ns) / 1e6
    return np.where(frames.arrival_ns > 0, delay, np.nan)


def delay_budget(session: SessionColumns) -> tuple[Row, ...]:
    """All PMUs together, as in Table I; what a session cannot know is the paper's, and says so."""
    delay, above, wait = Histogram(), Histogram(), Histogram()
    for frames in session.pmu.values():
        known = frames.arrival_ns > 0
        late = (frames.arrival_ns - frames.time_ns)[known]
        if late.size:
            delay.add(late)
            above.add(late - late.min())
            wait.add(np.maximum(frames.tick_ns[known] - frames.arrival_ns[known], 0))
    compute = session.tick.compute_us[np.isfinite(session.tick.compute_us)]
    if not compute.size:  # in virtual time a tick takes none
        return (
            budget(delay, above, wait, compute_ms=0.0) if SIMULATED in session.metadata else budget(delay, above, wait)
        )
    return budget(delay, above, wait, compute_ms=round(float(compute.mean()) / 1e3, 3))
