"""Numbers that the code itself computes: the filter, the closed loop's eigenvalues, Table II by simulation."""

from __future__ import annotations

import cmath
import math
from functools import cache

from dcon.core.differentiator import EMPTY, Coefficients, advance, coefficients, response
from dcon.demo.judge import PAPER
from dcon.sim.delays import COMMAND_MS, CONTROL_MS, NETWORK_MS, PMU_MS
from dcon.sim.faults import FAULTS
from dcon.sim.plan import Plan
from dcon.sim.simulate import Outcome, simulate
from generate.markdown import code, table
from pmutools.grid.modal import FIVE_MODES, SINGLE_MODE
from pmutools.grid.theory import closed_loop_eigenvalue, frequency_and_damping

RATES = (30, 50, 60, 100, 120)
DELAYS_MS = (0, 82, 113, 200, 300, 400, 500)
GAINS = (0, 3, 6, 9, 12, 15)


def _z(frequency_hz: float, rate_hz: float) -> complex:
    return cmath.exp(2j * math.pi * frequency_hz / rate_hz)


def phase_lag_deg(c: Coefficients, frequency_hz: float) -> float:
    """Of the filter alone: the ideal derivative's +90° taken off."""
    return 90.0 - math.degrees(cmath.phase(response(c, _z(frequency_hz, c.rate_hz))))


def step_response(c: Coefficients, frames: int = 400) -> list[float]:
    """f (Hz) where the frequency steps from 0 to 1 Hz: the angle begins to turn."""
    memory, out = EMPTY, []
    for frame in range(-4, frames):
        angle = 2 * math.pi * max(frame, 0) / c.rate_hz
        memory = advance(c, memory, math.remainder(angle, 2 * math.pi))
        if frame >= 0:
            out.append(memory.f_hz)
    return out


def filters() -> str:
    """Coefficients at each rate and the three specifications of section III."""
    rows = []
    for rate in RATES:
        c = coefficients(rate)
        f = step_response(c)
        peak = max(f)
        settled = max(k for k, value in enumerate(f) if abs(value - 1) > 0.02) + 1
        rows.append(
            (
                rate,
                *(f"{value:.8f}" for value in (c.a1, c.a2, c.b)),
                f"{phase_lag_deg(c, 0.8):.2f}°",
                f"{100 * (peak - 1):.2f} %",
                f"{settled / rate / (f.index(peak) / rate):.2f}",
            )
        )
    header = ("frames/s", "a1", "a2", "b", "lag at 0.8 Hz (< 30°)", "overshoot (< 10 %)", "settling / peak time (< 2)")
    return table(header, rows)


def lags() -> str:
    """Phase lag of filter, delay and hold over frequency, at 60/s and 82 ms."""
    c, delay_s, tick_s = coefficients(60), 0.082, 1 / 60
    rows = []
    for f in (0.25, 0.4, 0.6, 0.8, 1.0, 2.0):
        gain = abs(response(c, _z(f, 60))) / f
        lag = phase_lag_deg(c, f)
        rows.append(
            (
                f"{f:g} Hz",
                f"{gain:.3f}",
                f"{lag:.1f}°",
                f"{lag + 360 * f * delay_s:.1f}°",
                f"{lag + 360 * f * (delay_s + tick_s / 2):.1f}°",
            )
        )
    return table(("frequency", "gain on true frequency", "filter", "and 82 ms", "and the 60 Hz hold"), rows)


def budget() -> str:
    """How 82 ms come about."""
    total = PMU_MS + NETWORK_MS + CONTROL_MS + COMMAND_MS
    rows = (
        ("PMU: stamp to departure", PMU_MS, "Table I mean; 40-48"),
        ("network", NETWORK_MS, "Table I mean; 15-40, heavy tail"),
        ("wait for the tick, and computing", CONTROL_MS, "Table I mean; 2-17"),
        ("command to the line's response", COMMAND_MS, "Table I, fixed"),
        ("**effective**", f"**{total}**", "Table I mean; 69-113"),
    )
    own_ms = phase_lag_deg(coefficients(60), 1e-3) / 360 / 1e-3 * 1e3
    words = f"The filter's own group delay at DC, {own_ms:.0f} ms, is not part of it."
    return table(("part", "ms", "source"), rows) + "\n\n" + words


@cache
def _run(gain: float) -> Outcome:
    return simulate(Plan(gain_mw_per_mhz=gain))


def table_two() -> str:
    """``dcon simulate cjb`` beside the simulation rows of Table II, run while the documentation is built."""
    rows = []
    for gain, (paper_hz, paper_percent) in PAPER.items():
        mode = _run(gain).mode
        assert mode is not None
        rows.append(
            (
                f"{gain:g}",
                f"{mode.frequency_hz:.4f} Hz",
                f"{paper_hz:.3f} Hz",
                f"{1e3 * (mode.frequency_hz - paper_hz):+.1f} mHz",
                f"{mode.damping_percent:.2f} %",
                f"{paper_percent:.1f} %",
                f"{mode.damping_percent - paper_percent:+.2f}",
            )
        )
    header = ("K (MW/mHz)", "frequency", "paper", "difference", "damping", "paper", "difference (points)")
    return table(header, rows)


def feedback(s: complex) -> complex:
    """The differentiator seen on true frequency: F(s) = H(e^sT) 2π / s."""
    return response(coefficients(60), cmath.exp(s / 60)) * 2 * math.pi / s


def eigenvalues() -> str:
    """Exact closed-loop eigenvalues of the single-mode plant over delay and gain."""
    rows = []
    for delay in DELAYS_MS:
        cells = []
        for gain in GAINS:
            root = closed_loop_eigenvalue(SINGLE_MODE, SINGLE_MODE[0], gain, delay_s=delay / 1e3, feedback=feedback)
            hertz, damping = frequency_and_damping(root)
            cells.append(f"{100 * damping:.2f} % ({hertz:.3f})")
        rows.append((f"{delay} ms", *cells))
    return table(("total delay", *(f"K {gain}" for gain in GAINS)), rows)


def five_modes() -> str:
    """Where each mode of the five-mode plant goes as the gain rises."""
    rows = []
    for gain in (*GAINS, 24, 30):
        cells = []
        for mode in FIVE_MODES:
            hertz, damping = frequency_and_damping(closed_loop_eigenvalue(FIVE_MODES, mode, gain, feedback=feedback))
            cells.append(f"{hertz:.3f} Hz {100 * damping:.2f} %")
        rows.append((f"K {gain}", *cells))
    return table(("gain", *(mode.name for mode in FIVE_MODES)), rows)


GENERATORS = {
    "filters": filters,
    "lags": lags,
    "delay-budget": budget,
    "table-two": table_two,
    "eigenvalues": eigenvalues,
    "five-modes": five_modes,
    "fault-names": lambda: ", ".join(map(code, FAULTS)),
}
