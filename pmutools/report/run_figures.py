"""The figures of all streams together: delays side by side, quality over time, completeness, control windows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pmutools.measure.histogram import NS_PER_MS
from pmutools.report import theme
from pmutools.report.completeness_figures import completeness_figure, relative_figure
from pmutools.report.figures import (
    Axis,
    Bars,
    Dash,
    Dots,
    Figure,
    Floats,
    Line,
    Mark,
    Notes,
    Panel,
    Scale,
    time_axis,
)
from pmutools.report.quality_figure import quality_figure
from pmutools.report.text import listed, milliseconds, percent, plural, utc
from pmutools.report.view import Stream, View

ROWS = 40
"""More streams than this have no row of their own: they are drawn by rank."""
INTERVALS = 1024
_LOG_FROM = 20.0
_ROW_PX, _HEAD_PX = 19, 96


def run_figures(view: View) -> Iterator[Figure]:
    """What there is to draw, in the order of the page."""
    if drawn := [stream for stream in view.measured if stream.told["delay_ms"]["count"] and not stream.clock_error]:
        left_out = [stream.label for stream in view.measured if stream.clock_error]
        yield delays_by_row(drawn, left_out) if len(drawn) <= ROWS else delays_by_rank(drawn, left_out)
    if (quality := quality_figure(view)) is not None:
        yield quality
    if (complete := completeness_figure(view)) is not None:
        yield complete
    if (relative := relative_figure(view)) is not None:
        yield relative
    if drawn := [stream for stream in view.measured if sum(stream.told["per_window"].values())]:
        yield windows_by_row(drawn) if len(drawn) <= ROWS else windows_by_rank(drawn)
    if len(view.run.intervals) > 1:
        yield intervals_figure(view)


# --- delays ------------------------------------------------------------------------------------------------------


def delays_by_row(streams: Sequence[Stream], left_out: Sequence[str] = ()) -> Figure:
    """A row a stream: where its delays lie."""
    found = _percentiles(streams)
    y = np.arange(len(streams), dtype=np.float64)
    words = [
        f"{stream.label}: p50 {milliseconds(middle)}, p95 {milliseconds(high)}, p99 {milliseconds(late)}, "
        f"max {milliseconds(most)} ms{'' if stream.bound_ms is None else f', ± {stream.bound_ms:.2g}'}"
        for stream, middle, high, late, most in zip(
            streams, *(found[key].tolist() for key in ("p50", "p95", "p99", "max")), strict=True
        )
    ]
    marks: list[Mark] = [
        Line("p5 to p95", *_joined(found["p5"], found["p95"], y), theme.SKY, width=3),
        Line("p25 to p75", *_joined(found["p25"], found["p75"], y), theme.BLUE, width=8),
        Dots("median", found["p50"], y, theme.ORANGE, hover=words),
        Dots("p99", found["p99"], y, theme.INK, "bar", hover=words),
        Dots("largest", found["max"], y, theme.VERMILION, "cross", hover=words),
    ]
    return Figure(
        "delays",
        "Delay of each stream",
        f"Percentiles of the delay of {plural(len(streams), 'stream')}, a row each",
        Axis("stamp-to-arrival delay (ms)", _scale(found)),
        [Panel(Axis("", names=[stream.label for stream in streams]), marks)],
        _left_out(left_out),
        _HEAD_PX + _ROW_PX * max(2, len(streams)),
        wide=True,
    )


def delays_by_rank(streams: Sequence[Stream], left_out: Sequence[str] = ()) -> Figure:
    """Curves over all streams, sorted by p99."""
    ranked = sorted(streams, key=lambda stream: stream.told["delay_ms"]["p99"])
    found = _percentiles(ranked)
    rank = np.arange(1, len(ranked) + 1, dtype=np.float64)
    marks = [
        Line(name, rank, found[key], color, dash, hover=_ranked(ranked, found[key], name))
        for name, key, color, dash in (
            ("largest", "max", theme.VERMILION, Dash.DOTTED),
            ("p99", "p99", theme.INK, Dash.SOLID),
            ("p95", "p95", theme.SKY, Dash.SOLID),
            ("median", "p50", theme.BLUE, Dash.SOLID),
        )
    ]
    worst = listed([stream.label for stream in ranked[::-1][:5]])
    return Figure(
        "delays",
        "Delay of each stream, sorted",
        f"Percentiles of the delay of {plural(len(ranked), 'stream')}, sorted by p99; the largest have {worst}",
        Axis("streams, sorted by p99", range=(0, len(ranked) + 1)),
        [Panel(Axis("stamp-to-arrival delay (ms)", _scale(found)), marks)],
        f"Largest p99: {worst}. {_left_out(left_out)}",
        340,
        wide=True,
    )


def _percentiles(streams: Sequence[Stream]) -> dict[str, Floats]:
    keys = ("min", "p5", "p25", "p50", "p75", "p95", "p99", "max")
    return {key: np.array([stream.told["delay_ms"][key] for stream in streams], np.float64) for key in keys}


def _scale(found: dict[str, Floats]) -> Scale:
    log = found["min"].min() > 0 and found["max"].max() > _LOG_FROM * np.median(found["p50"])
    return Scale.LOG if log else Scale.LINEAR


def _joined(low: Floats, high: Floats, y: Floats) -> tuple[Floats, Floats]:
    """A stroke from low to high at each y, with gaps between."""
    gap = np.full(len(y), np.nan)
    return np.stack((low, high, gap), 1).reshape(-1), np.stack((y, y, gap), 1).reshape(-1)


def _ranked(streams: Sequence[Stream], values: Floats, name: str) -> list[str]:
    return [f"{stream.label}: {name} {milliseconds(value)} ms" for stream, value in zip(streams, values, strict=True)]


def _left_out(names: Sequence[str]) -> str:
    if not names:
        return ""
    return f"Not drawn: {listed(names)}, whose delays are a clock's error."


# --- control windows ---------------------------------------------------------------------------------------------


def windows_by_row(streams: Sequence[Stream]) -> Figure:
    """Shares of control windows with no frame, one, and two or more (the paper's Fig. 11), a row a stream."""
    shares = _window_shares(streams)
    y = np.arange(len(streams), dtype=np.float64)
    words = [
        f"none {percent(none)}, one {percent(one)}, more {percent(more)}"
        for none, one, more in zip(*(part.tolist() for part in shares), strict=True)
    ]
    hover = [f"{stream.label}: {each}" for stream, each in zip(streams, words, strict=True)]
    bars: list[Mark] = []
    base = np.zeros(len(streams))
    for name, color, share in zip(_WINDOW_NAMES, _WINDOW_COLORS, shares, strict=True):
        bars.append(Bars(name, y, 100 * share, 0.7, color, base.copy(), lying=True, hover=hover))
        base += 100 * share
    bars.append(Notes(y, words))
    return Figure(
        "windows",
        "Frames per control window",
        f"Share of control windows with no frame, one, two or more: {listed(hover, 3)}",
        Axis("share of the windows (%)", range=(0, 100)),
        [Panel(Axis("", names=[stream.label for stream in streams]), bars)],
        "A window is 1/Fs of UTC. An empty one holds the last input; two frames in one make up for it.",
        _HEAD_PX + _ROW_PX * max(2, len(streams)),
        wide=True,
    )


def windows_by_rank(streams: Sequence[Stream]) -> Figure:
    """The same of many streams, sorted by the share of empty windows."""
    ranked = sorted(streams, key=lambda stream: _window_shares([stream])[0][0])
    shares = _window_shares(ranked)
    rank = np.arange(1, len(ranked) + 1, dtype=np.float64)
    marks = [
        Line(
            name,
            rank,
            100 * share,
            color,
            hover=[
                f"{stream.label}: {name}, {percent(part)}" for stream, part in zip(ranked, share.tolist(), strict=True)
            ],
        )
        for name, color, share in zip(_WINDOW_NAMES, _WINDOW_COLORS, shares, strict=True)
        if name != "one"
    ]
    worst = listed([stream.label for stream in ranked[::-1][:5]])
    return Figure(
        "windows",
        "Frames per control window, sorted",
        f"Share of control windows without a frame, and with two or more; most empty ones have {worst}",
        Axis("streams, sorted by empty windows", range=(0, len(ranked) + 1)),
        [Panel(Axis("share of the windows (%)"), marks)],
        f"All other windows have one frame. Most empty ones: {worst}.",
        300,
        wide=True,
    )


_WINDOW_NAMES = ("none", "one", "two or more")
_WINDOW_COLORS = (theme.VERMILION, theme.SKY, theme.BLUE)


def _window_shares(streams: Sequence[Stream]) -> tuple[Floats, ...]:
    counts = np.array([[stream.told["per_window"][key] for key in ("0", "1", "2+")] for stream in streams], np.float64)
    return tuple((counts / counts.sum(1, keepdims=True)).T)


# --- intervals ---------------------------------------------------------------------------------------------------


def intervals_figure(view: View) -> Figure:
    """The run interval by interval, all streams together; where there are many, the worst of each group."""
    intervals = view.run.intervals
    every = -(-len(intervals) // INTERVALS)
    groups = [intervals[at : at + every] for at in range(0, len(intervals), every)]
    x = np.array([group[-1][0] / NS_PER_MS for group in groups])

    def worst(read: str) -> Floats:
        figures = [[told["delay_ms"][read] for _, told in group] for group in groups]
        return np.array([max((f for f in group if f is not None), default=np.nan) for group in figures], np.float64)

    loss = np.array([max(_loss(told) for _, told in group) for group in groups])
    marks = [
        Line("largest", x, worst("max"), theme.VERMILION, Dash.DOTTED),
        Line("p99", x, worst("p99"), theme.INK),
        Line("median", x, worst("p50"), theme.BLUE),
    ]
    gap = float(np.diff(x).min()) if len(x) > 1 else 1000.0
    words = [f"{utc(round(at * NS_PER_MS))}: {percent(share)} lost" for at, share in zip(x, loss, strict=True)]
    lost = Bars("lost", x, 100 * loss, 0.9 * gap, theme.VERMILION, hover=words)
    return Figure(
        "intervals",
        "Interval by interval",
        f"Delay and loss of all streams together over {plural(len(intervals), 'interval')}",
        time_axis("end of the interval", (float(x[0] - gap), float(x[-1] + gap))),
        [
            Panel(Axis("delay (ms)"), marks, 2.0),
            Panel(Axis("lost (%)", range=(0, max(1e-3, 115 * float(loss.max())))), [lost], 1.0),
        ],
        f"The worst of each {every} intervals." if every > 1 else "",
        340,
        wide=True,
    )


def _loss(told: object) -> float:
    assert isinstance(told, dict)
    return told["lost"] / told["expected"] if told["expected"] else 0.0
