"""A stream over time: its delay, and what was lost, late or came twice."""

from __future__ import annotations

import math

import numpy as np

from pmutools.measure.columns import Flags
from pmutools.measure.histogram import NS_PER_MS
from pmutools.measure.timeline import Course
from pmutools.report import theme
from pmutools.report.figures import Axis, Band, Bars, Figure, Floats, Line, Mark, Panel, Rule, Scale, Spans, time_axis
from pmutools.report.text import count, lasting, milliseconds, span, utc
from pmutools.report.view import Stream

SPANS = 60
"""So many stretches of time are shaded at most, the longest."""
_LOG_FROM = 20.0
"""Delays that reach so many times their median are drawn on a logarithmic axis."""


def course_figure(stream: Stream, course: Course, shown_ms: tuple[float, float] | None) -> Figure:
    """Mean, least and largest delay of each bucket of time; below it what was lost, late or came twice."""
    base_ms = _base_ms(stream)
    width_ms = course.width_ns / NS_PER_MS
    x, kept = course.time_ns / NS_PER_MS, course.delayed > 0
    least, most = course.least_ns[kept] / NS_PER_MS - base_ms, course.most_ns[kept] / NS_PER_MS - base_ms
    mean = course.total_ns[kept] / course.delayed[kept] / NS_PER_MS - base_ms
    words = _bucket_words(course, kept, least, mean, most)
    hover, columns = _parted(x[kept], (least, mean, most), words, stream.gaps_ms, width_ms)
    across, low, middle, high = columns
    marks: list[Mark] = []
    if stream.gaps_ms:
        marks.append(Spans("nothing came", _longest(stream.gaps_ms), theme.SILENT))
    if doubtful := _doubtful(course):
        marks.append(Spans("not synchronised, by STAT", _longest(doubtful), theme.DOUBTFUL))
    marks.append(Band("least to largest", across, low, high, theme.BLUE, half_width=width_ms / 2))
    marks.append(Line("mean", across, middle, theme.BLUE, hover=hover))
    if stream.told["late"] and not stream.clock_error:
        wait_ms = stream.told["wait_ms"]
        marks.append(Rule(f"wait, {milliseconds(wait_ms)} ms", wait_ms, theme.VERMILION, upright=False))
    log = least.min() > 0 and most.max() > _LOG_FROM * float(np.median(mean))
    title = "delay (ms)" if not base_ms else "delay above base (ms)"
    panels = [Panel(Axis(title, Scale.LOG if log else Scale.LINEAR), marks, 2.4)]
    if events := _events(stream, course, x, width_ms):
        top = max(float((bar.height + (0 if bar.base is None else bar.base)).max()) for bar in events)
        panels.append(Panel(Axis(f"frames per {span(course.width_ns)}", range=(0, 1.15 * top)), events, 1.0))
    return Figure(
        f"{stream.stem}-delay",
        f"{stream.label}: delay over time",
        f"Delay of {stream.label} over time: {_range_words(least, mean, most)}, {count(course.lost.sum())} frames lost",
        time_axis("time", shown_ms),
        panels,
        _course_caption(stream, course, base_ms),
        390 if len(panels) > 1 else 290,
        wide=True,
    )


def _base_ms(stream: Stream) -> float:
    """What is taken off delays so that their changes are seen: 0, but for those that are a clock's error."""
    least = stream.result.counts.delays.delay.min_ns
    return least / NS_PER_MS if stream.clock_error and least is not None else 0.0


def _course_caption(stream: Stream, course: Course, base_ms: float) -> str:
    parts = [f"By time of arrival, in buckets of {span(course.width_ns)}."]
    if base_ms:
        parts.append(
            f"Base: {milliseconds(base_ms)} ms ({lasting(base_ms)}), the least delay: a clock's error, no delay."
        )
    if stream.bound_ms is None:
        parts.append("Uncertainty unknown: all may be off by a constant.")
    else:
        parts.append(f"Every delay ± {stream.bound_ms:.2g} ms.")
    if stream.gaps_ms:
        parts.append("What was lost while nothing came is not in the bars.")
    if stream.told["negative"]:
        parts.append(f"{count(stream.told['negative'])} delays are below zero, and shown.")
    return " ".join(parts)


def _bucket_words(course: Course, kept: Flags, least: Floats, mean: Floats, most: Floats) -> list[str]:
    columns = zip(
        course.time_ns[kept].tolist(),
        course.frames[kept].tolist(),
        course.lost[kept].tolist(),
        least.tolist(),
        mean.tolist(),
        most.tolist(),
        strict=True,
    )
    return [
        f"{utc(at, 1)}: mean {milliseconds(middle)} ms ({milliseconds(low)} to {milliseconds(high)}), {frames} frames"
        f"{f', {lost} lost' if lost else ''}"
        for at, frames, lost, low, middle, high in columns
    ]


def _parted(
    x: Floats, columns: tuple[Floats, ...], words: list[str], gaps_ms: list[tuple[float, float]], width_ms: float
) -> tuple[list[str], list[Floats]]:
    """Points with a NaN in each gap, so that no line is drawn across it; a point between two gaps becomes a dash."""
    starts = np.searchsorted(x, [low for low, _ in gaps_ms])
    hover: list[str] = []
    rows: list[tuple[float, ...]] = []
    points = list(zip(x.tolist(), *(column.tolist() for column in columns), strict=True))
    for first, end in zip([0, *starts.tolist()], [*starts.tolist(), len(points)], strict=True):
        part = points[first:end]
        if rows and part:
            rows.append((x[first] - width_ms, *[math.nan] * len(columns)))
            hover.append("")
        if len(part) == 1:
            at, *values = part[0]
            part = [(at - width_ms / 2, *values), (at + width_ms / 2, *values)]
            hover += words[first:end]
        rows += part
        hover += words[first:end]
    table = np.array(rows, np.float64).reshape(-1, 1 + len(columns))
    return hover, list(table.T)


def _doubtful(course: Course) -> list[tuple[float, float]]:
    """Stretches in which more than half of the frames say they are not synchronised."""
    at = np.flatnonzero(course.frames)
    bad = 2 * course.unsynchronised[at] > course.frames[at]
    edges = np.flatnonzero(np.diff(bad.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    ends = np.stack((at[edges[:, 0]], at[edges[:, 1] - 1] + 1), 1)
    return [tuple(pair) for pair in ((course.start_ns + ends * course.width_ns) / NS_PER_MS).tolist()]


def _longest(ranges: list[tuple[float, float]]) -> list[tuple[float, float]]:
    return sorted(sorted(ranges, key=lambda pair: pair[0] - pair[1])[:SPANS])


def _events(stream: Stream, course: Course, x: Floats, width_ms: float) -> list[Bars]:
    """Bars on each other, of what went wrong with frames. Of gaps the course knows some losses only: they have none."""
    base = np.zeros(len(x))
    idle = np.zeros(len(x), np.bool_)
    for low, high in stream.gaps_ms:
        idle |= (x > low) & (x < high)
    found = []
    for name, color in (("lost", theme.VERMILION), ("late", theme.ORANGE), ("duplicated", theme.PURPLE)):
        if name == "late" and stream.clock_error:
            continue  # by a wrong clock all are
        height = np.where(idle, 0.0, getattr(course, name).astype(np.float64))
        if (some := height > 0).any():
            words = [
                f"{utc(round(at * NS_PER_MS), 1)}: {number:.0f} {name}"
                for at, number in zip(x[some], height[some], strict=True)
            ]
            found.append(Bars(name, x[some], height[some], width_ms, color, base[some].copy(), hover=words))
            base += height
    return found


def _range_words(least: Floats, mean: Floats, most: Floats) -> str:
    return (
        f"mean {milliseconds(float(mean.mean()))} ms, from {milliseconds(least.min())} to {milliseconds(most.max())} ms"
    )
