"""What the demo showed, read from its session log alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dcon.core.differentiator import EMPTY, advance, coefficients
from dcon.demo.course import Course
from dcon.limiter import MW_PER_V
from dcon.session.reader import SessionReader
from pmutools import timebase
from pmutools.modal.matrix_pencil import ringdown

PAPER = {0.0: (0.425, 7.8), 9.0: (0.433, 10.3), 12.0: (0.435, 11.4)}
"""Table II, simulation rows: gain -> closed-loop frequency (Hz) and damping (%); 0 is open loop."""

Signal = npt.NDArray[np.float64]


class Swing(NamedTuple):
    """A ringdown as judged."""

    frequency_hz: float
    damping_percent: float
    r2: float


@dataclass(frozen=True)
class Traces:
    """The session as columns: one entry a reporting instant both PMUs have, and one a tick. Seconds from the start."""

    time_s: Signal
    delta_f_mhz: Signal
    tick_s: Signal
    command_mw: Signal
    output_mw: Signal
    late_us: Signal
    compute_us: Signal
    delay_ms: Signal
    """Stamp to arrival of every frame."""
    final_state: str


def read_traces(path: str, start_ns: int, north: str = "N1", south: str = "S1") -> Traces:
    """Columns of the session log at ``path``: the angles of two PMUs, aligned by stamp, through the paper's filter."""
    reader = SessionReader(path)
    angles: dict[str, dict[int, float]] = {north: {}, south: {}}
    ticks, delays = [], []
    state = ""
    for tick in reader.ticks():
        for frame in tick.frames:
            if frame.name in angles:
                angles[frame.name][frame.time_ns] = math.atan2(frame.v1.imag, frame.v1.real)
            if frame.arrival_ns is not None:
                delays.append((frame.arrival_ns - frame.time_ns) / 1e6)
        record, timing = tick.record, tick.timing
        late, compute = (timing.late_us, timing.compute_us) if timing else (math.nan, math.nan)
        seconds = (record.tick_ns - start_ns) / timebase.NS
        ticks.append((seconds, record.command_mw, record.output_v * MW_PER_V, late, compute))
        state = str(record.state)
    stamps = sorted(angles[north].keys() & angles[south].keys())
    delta = _difference([angles[north][s] - angles[south][s] for s in stamps])
    tick_s, command_mw, output_mw, late_us, compute_us = np.array(ticks, dtype=float).reshape(-1, 5).T
    time_s = (np.array(stamps, dtype=np.int64) - start_ns) / timebase.NS
    return Traces(time_s, delta, tick_s, command_mw, output_mw, late_us, compute_us, np.array(delays), state)


def _difference(angles_rad: list[float]) -> Signal:
    """The controller's own filter over the angle difference, in mHz: it scales a swing and moves no mode."""
    taps, memory, out = coefficients(60), EMPTY, []
    for angle in angles_rad:
        memory = advance(taps, memory, angle)
        out.append(memory.f_hz * 1e3 if memory.frames >= 3 else 0.0)
    return np.array(out)


def judge(traces: Traces, course: Course, brake_s: float) -> Swing | None:
    """Frequency and damping of the swing after the brake at ``brake_s``; None where it cannot be fitted."""
    start_s, stop_s = course.judged(brake_s)
    inside = (traces.time_s >= start_s) & (traces.time_s < stop_s)
    if np.count_nonzero(inside) < 60 * 4:
        return None
    fit = ringdown(traces.delta_f_mhz[inside], 60.0, 0.0, stop_s - start_s)
    mode = fit.dominant(0.2, 0.8)
    return None if mode is None else Swing(mode.frequency_hz, 100 * mode.damping, fit.r2)


def summarise(traces: Traces, course: Course, gain: float) -> dict[str, Any]:
    """``summary.json``."""
    paper_open, paper_closed = PAPER[0.0], PAPER.get(gain)
    opened, closed = judge(traces, course, course.open_loop_s), judge(traces, course, course.closed_loop_s)
    return {
        "gain_mw_per_mhz": gain,
        "open_loop": _row(opened, paper_open),
        "closed_loop": _row(closed, paper_closed),
        "peak_command_mw": float(np.abs(traces.output_mw).max(initial=0.0)),
        "final_state": traces.final_state,
        "ticks": len(traces.tick_s),
        "frames": len(traces.delay_ms),
        "delay_ms": _spread(traces.delay_ms),
        "wake_up_late_us": _spread(traces.late_us),
        "compute_us": _spread(traces.compute_us),
    }


def _row(swing: Swing | None, paper: tuple[float, float] | None) -> dict[str, Any] | None:
    if swing is None:
        return None
    row: dict[str, Any] = dict(swing._asdict())
    if paper is not None:
        row["paper_frequency_hz"], row["paper_damping_percent"] = paper
    return row


def _spread(values: Signal) -> dict[str, float] | None:
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    p50, p99 = np.percentile(values, (50, 99))
    return {"mean": float(values.mean()), "p50": float(p50), "p99": float(p99), "max": float(values.max())}
