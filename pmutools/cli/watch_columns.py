"""What the live displays tell of each stream: columns of the two views, numbers and sparklines as text."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.cli.columns import Column, number
from pmutools.cli.quality_text import stat_text, time_quality_text
from pmutools.cli.shell import visible
from pmutools.tools.watch import Row, StreamState

BARS = "▁▂▃▄▅▆▇█"
FREQUENCY_SPAN_HZ = 0.01
DELAY_SPAN_MS = 1.0
"""Least span of a sparkline, so that noise stays small."""
LEAST_SHARE = 1e-5
"""Less is a rounding error."""
MARKS = {
    StreamState.STREAMING: "●",
    StreamState.WAITING: "…",
    StreamState.SILENT: "■",
    StreamState.NO_CONFIG: "?",
    StreamState.FOREIGN: "!",
}
TROUBLE, DOWN = "▲", "✕"
SIGNS = {
    "●": "streams, and all is well",
    "▲": "streams; in the last 10 s frames were lost, late, or cannot be used",
    "■": "silent: no frame for 2 s, or for five reporting intervals if that is longer",
    "…": "waits for its first frame",
    "?": "data come, and no configuration fits them",
    "!": "comes, and nobody asked for it",
    "✕": "no connection, or nothing has come",
}
"""What the marks before the names mean."""


def troubled(row: Row) -> bool:
    """Whether a stream that comes is not as it should be, of late."""
    late = 1 - row.recent_loss - row.recent_complete
    return row.recent_loss > 0 or row.recent_good < 1 or late > LEAST_SHARE


def mark(row: Row) -> str:
    """A sign for the state."""
    if row.state is StreamState.STREAMING and troubled(row):
        return TROUBLE
    return MARKS.get(row.state, DOWN)


def sparkline(values: npt.NDArray[np.float32], width: int, span: float) -> str:
    """The last values as bars between the least and the largest, or ``span`` around their middle; a gap is a space."""
    last = np.asarray(values, np.float64)[-width:]
    there = np.isfinite(last)
    if not there.any():
        return ""
    low, high = float(last[there].min()), float(last[there].max())
    if high - low < span:
        low = (low + high - span) / 2
        high = low + span
    level = np.clip((np.where(there, last, low) - low) / (high - low) * len(BARS), 0, len(BARS) - 1).astype(int)
    return "".join(BARS[bar] if known else " " for bar, known in zip(level.tolist(), there.tolist(), strict=True))


def milliseconds(value: float, width: int = 6) -> str:
    """With three digits or so."""
    if not math.isfinite(value):
        return "-"
    digits = 2 if abs(value) < 10 else 1 if abs(value) < 1000 else 0
    text = f"{value:.{digits}f}"
    return text if len(text) <= width else number(value, width)


def percent(share: float) -> str:
    """A share; what is not quite nothing, or not quite all, never looks so."""
    if not math.isfinite(share):
        return "-"
    value = 100 * share
    if value in (0, 100):
        return f"{value:.0f}"
    return "<0.1" if value < 0.1 else ">99.9" if value > 99.9 else f"{value:.1f}"


def hertz(value: float) -> str:
    """A frequency to a tenth of a millihertz."""
    return f"{value:.4f}" if math.isfinite(value) and abs(value) < 1000 else number(value, 8)


def rate(value: float, width: int = 6) -> str:
    return f"{value:.1f}" if math.isfinite(value) and value < 10_000 else number(value, width)


def seconds(value: float) -> str:
    """A time that has passed, for people."""
    if not math.isfinite(value):
        return ""
    return f"{value:.0f} s" if value < 120 else f"{value / 60:.0f} min" if value < 7200 else f"{value / 3600:.0f} h"


def state_text(row: Row) -> str:
    """What a stream does that does not come."""
    if row.state is StreamState.SILENT:
        return f"silent {seconds(row.silent_s)}"
    return str(row.state)


class Shown(NamedTuple):
    """A column of a view; ``by``: the field of a snapshot to sort by, ``falling``: the largest first."""

    column: Column
    by: str = ""
    falling: bool = True


def _of(field: str, text: Callable[[float], str]) -> Callable[[Row], str]:
    return lambda row: text(getattr(row, field))


def _whole(field: str, width: int) -> Callable[[Row], str]:
    return lambda row: number(getattr(row, field), width)


def _quality(octet: float) -> str:
    return time_quality_text(int(octet))


_NAME = Shown(Column("stream", 0, lambda row: visible(row.name)), "name", falling=False)
_ID = Shown(Column("id", 5, lambda row: str(row.idcode) if row.idcode >= 0 else ""), "idcode", falling=False)
_TRANSPORT = Column("via", 7, lambda row: row.transport, left=True)
_P50 = Shown(Column("p50ms", 6, _of("p50_ms", milliseconds)), "p50_ms")
_P99 = Shown(Column("p99ms", 6, _of("p99_ms", milliseconds)), "p99_ms")
_LOST = Shown(Column("lost", 5, _whole("lost", 5)), "lost")
_GOOD = Shown(Column("good%", 5, _of("recent_good", percent)), "recent_good", falling=False)
_DUPLICATED = Column("dup", 4, _whole("duplicated", 4))
_RATE = Shown(Column("frm/s", 6, _of("recent_hz", rate)), "recent_hz", falling=False)

VIEWS: dict[str, tuple[Shown, ...]] = {
    "frequency": (
        _NAME,
        _ID,
        Shown(_TRANSPORT._replace(from_width=100), "transport", falling=False),
        _RATE,
        Shown(Column("of", 5, _of("configured_hz", lambda value: number(value, 5)), from_width=90), "configured_hz"),
        _LOST,
        Shown(_DUPLICATED._replace(from_width=110), "duplicated"),
        _GOOD,
        Shown(_P50.column._replace(from_width=100), "p50_ms"),
        _P99,
        Shown(Column("STAT", 16, _of("stat", lambda stat: stat_text(int(stat))), from_width=130, left=True), "stat"),
        Shown(Column("time", 8, _of("time_quality", _quality), 130, left=True), "time_quality"),
        Shown(Column("Hz", 8, _of("frequency_hz", hertz)), "frequency_hz"),
        Shown(Column("last 15 s", 0, lambda row: sparkline(row.frequencies_hz, 60, FREQUENCY_SPAN_HZ), tail=True)),
    ),
    "delay": (
        _NAME,
        _ID,
        Shown(_TRANSPORT._replace(from_width=120), "transport", falling=False),
        Shown(_RATE.column._replace(from_width=110), "recent_hz", falling=False),
        _P50,
        _P99,
        Shown(Column("maxms", 6, _of("max_ms", milliseconds)), "max_ms"),
        Shown(Column("jit", 5, _of("jitter_ms", lambda value: milliseconds(value, 5))), "jitter_ms"),
        Shown(Column("loss%", 5, _of("recent_loss", percent)), "recent_loss"),
        Shown(_LOST.column._replace(from_width=100), "lost"),
        Shown(_DUPLICATED, "duplicated"),
        Shown(Column("late", 5, _whole("late", 5)), "late"),
        Shown(Column("cmpl%", 5, _of("recent_complete", percent)), "recent_complete", falling=False),
        Shown(_GOOD.column._replace(from_width=100), "recent_good", falling=False),
        Shown(Column("p99all", 6, _of("all_p99_ms", milliseconds), from_width=130), "all_p99_ms"),
        Shown(Column("maxall", 6, _of("all_max_ms", milliseconds), from_width=130), "all_max_ms"),
        Shown(Column("last 15 s", 0, lambda row: sparkline(row.delays_ms, 60, DELAY_SPAN_MS), tail=True)),
    ),
}
"""What is told of each stream, by view. Rates, percentiles and shares are of the last 10 s, counts since the start."""
MEANINGS = {
    "stream": "names in the initialisation file, or that of its station; `PDC` and IDCODE where it has several",
    "id": "IDCODE of the stream",
    "via": "transport",
    "frm/s": "frames that came, a second",
    "of": "frames a second by the configuration",
    "lost": "reporting instants that no frame came for, since the start",
    "dup": "extra copies, since the start",
    "good%": "frames that can be used: valid, synchronised, locked, with a frequency",
    "p50ms": "median delay, arrival less stamp",
    "p99ms": "99 of 100 frames are not later",
    "maxms": "largest delay",
    "STAT": "the last one, in words",
    "time": "the last time quality: how wrong the sender's clock may be",
    "Hz": "the last frequency, of the first station",
    "last 15 s": "quarters of a second, the newest on the right: means of the frequency, or largest delays; "
    "the bars span 10 mHz, or 1 ms, at least",
    "jit": "interarrival jitter of RFC 3550, ms",
    "loss%": "share of reporting instants that no frame came for",
    "late": "frames that came after the wait, since the start",
    "cmpl%": "share of reporting instants whose frame came within the wait",
    "p99all": "since the start, to 6 %",
    "maxall": "since the start",
}
