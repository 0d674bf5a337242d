"""The demo as a picture: both swings over each other, and the command over the session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from dcon.demo.course import BRAKE_S, Course
from dcon.demo.judge import Traces

mpl.use("Agg")
from matplotlib import pyplot as plt

OPEN, CLOSED, COMMAND = "#8a8f98", "#0b6e99", "#b3541e"


def draw(traces: Traces, summary: dict[str, Any], course: Course, path: Path) -> Path:
    """Write a PNG to ``path`` and return it."""
    figure, (swing, command) = plt.subplots(
        2, 1, figsize=(9, 7.2), height_ratios=(3, 2), layout="constrained", facecolor="white"
    )
    for brake_s, key, color, width in (
        (course.open_loop_s, "open_loop", OPEN, 1.6),
        (course.closed_loop_s, "closed_loop", CLOSED, 2.0),
    ):
        inside = (traces.time_s >= brake_s - 1) & (traces.time_s < brake_s + course.swing_s - 0.5)
        label = f"{key.replace('_', ' ')}: {_words(summary[key])}"
        swing.plot(traces.time_s[inside] - brake_s, traces.delta_f_mhz[inside], color=color, lw=width, label=label)
    swing.axvspan(0, BRAKE_S, color="#e8c547", alpha=0.5, lw=0)
    swing.text(BRAKE_S / 2, swing.get_ylim()[0], " brake 1,400 MW", fontsize=8, rotation=90, ha="center", va="bottom")
    swing.set(xlabel="time from the brake (s)", ylabel="f north − f south (mHz)", xlim=(-1, course.swing_s - 0.5))
    swing.set_title(
        f"North-South B mode, K = {summary['gain_mw_per_mhz']:g} MW/mHz, live over UDP on one machine", loc="left"
    )
    swing.legend(loc="lower right", frameon=False)
    command.plot(traces.tick_s, traces.command_mw, color=OPEN, lw=1, label="computed")
    command.plot(traces.tick_s, traces.output_mw, color=COMMAND, lw=1.4, label="driven")
    for brake_s in (course.open_loop_s, course.closed_loop_s):
        command.axvspan(brake_s, brake_s + BRAKE_S, color="#e8c547", alpha=0.5, lw=0)
    command.axhline(0, color="black", lw=0.5)
    peak = max(20.0, float(np.abs(traces.command_mw).max(initial=0.0)) * 1.15)
    command.set(xlabel="time of the session (s)", ylabel="command (MW)", xlim=(0, course.end_s), ylim=(-peak, peak))
    command.legend(loc="upper left", frameon=False, ncols=2)
    delay = summary["delay_ms"]
    if delay is not None:
        note = f"stamp to arrival {delay['mean']:.1f} ms mean, {delay['max']:.1f} ms max"
        command.set_title(note, loc="right", fontsize=9, color="#555555")
    for axes in (swing, command):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path


def _words(row: dict[str, Any] | None) -> str:
    if row is None:
        return "not fitted"
    text = f"{row['frequency_hz']:.3f} Hz, damping {row['damping_percent']:.1f} %"
    if "paper_damping_percent" in row:
        text += f" (paper: {row['paper_frequency_hz']:.3f} Hz, {row['paper_damping_percent']:.1f} %)"
    return text
