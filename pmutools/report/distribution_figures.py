"""How the delays of a stream are distributed: histogram, distribution function, tail; and inter-arrival times."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pmutools.measure.fits import POOR
from pmutools.measure.histogram import NS_PER_MS, Histogram, error_ns
from pmutools.measure.likeness import quantile_table
from pmutools.report import theme
from pmutools.report.figures import Axis, Band, Bars, Dash, Dots, Figure, Floats, Line, Mark, Panel, Rule, Scale
from pmutools.report.text import count, milliseconds, percent
from pmutools.report.view import Stream

BINS, LEAST_BINS = 90, 15
TAIL_POINTS = 400
_LOG_FROM = 20.0
"""Delays that reach so many times their least are drawn on a logarithmic axis."""
_TAIL_CAPTION = "CCDF: what share of frames comes later than x. Where the lost never come, the curve ends on the loss."
_NAMES = {"delay": "stamp-to-arrival delay (ms)", "pdv": "delay above its floor, PDV (ms)"}


def bin_edges(found: Histogram, most_bins: int = BINS) -> Floats:
    """Edges (B + 1,) in ns that show where most values lie: all, unless a few lie far out. No finer than is known."""
    low, high = float(found.min_ns or 0), float(found.max_ns or 0)
    few = min(0.05, max(0.001, 2 / max(found.count, 1)))  # of some hundred, the last thousandth is the largest itself
    inner_low, inner_high = (value or 0.0 for value in found.quantiles_ns((few, 1 - few)))
    if high - low > 3 * (inner_high - inner_low) + 10 * error_ns(high):
        spare = 0.1 * (inner_high - inner_low)
        low, high = max(low, inner_low - spare), min(high, inner_high + spare)
    step = max((high - low) / most_bins, 4 * error_ns(max(abs(low), abs(high))))
    bins = max(1, math.ceil((high - low) / step - 1e-9))
    spare_bins = max(0, (LEAST_BINS - bins + 1) // 2)
    start = low - (bins * step - (high - low)) / 2 - spare_bins * step
    edges: Floats = start + step * np.arange(bins + 2 * spare_bins + 1, dtype=np.float64)
    return edges


def _below(found: Histogram, edges_ns: Floats) -> Floats:
    """(E,) how many values are at most each edge; all of those at the first edge lie in the first bin."""
    below = found.at_most_array(edges_ns)
    if found.min_ns is not None and edges_ns[0] <= found.min_ns:
        below[0] = 0.0
    return below


class Model:
    """A fitted distribution to draw: its name, its distribution function, and words about its tail.

    ``told`` is the fit as the summary tells it, or the nearest family where the histogram ``stands_in``.
    """

    def __init__(self, told: Mapping[str, Any], stands_in: bool) -> None:
        self._draws, self._values = quantile_table(told["text"])
        name, ks, holds = told["name"], told["ks"], told["tail_holds"]
        fault = f"is no likeness: KS {ks:.2f}" if holds or ks > POOR else "does not hold the tail"
        self.name = f"{name}, the nearest, {fault}" if stands_in else f"{name} fit, KS {ks:.3f}"
        off = f"{told['tail_error_at']} is {abs(told['tail_error_ms']):.3g} ms too {_side(told['tail_error_ms'])}"
        self.tail_words = "" if holds else f"Of the {name} distribution {off}: the tail does not hold."

    def below(self, x_ms: Floats) -> Floats:
        """(N,) share of the values at most each x."""
        return np.interp(x_ms, self._values, self._draws, left=0.0, right=1.0)


def _side(error_ms: float) -> str:
    return "large" if error_ms > 0 else "small"


def model(stream: Stream) -> Model | None:
    """What is told as the fit; where the histogram itself stands in, the nearest family, and that it is none."""
    told = stream.told["fit"]
    if told is None or told["name"] == "constant":
        return None
    if told["nearest"] is not None:
        return Model(told["nearest"], True)
    return Model(told, False) if told["name"] != "histogram" else None


def distribution_figure(stream: Stream) -> Figure:
    """Histogram above distribution function, with the fit."""
    found, kind = stream.typical
    edges = bin_edges(found)
    below = _below(found, edges)
    x, fitted = edges / NS_PER_MS, model(stream)
    share = 100 * np.diff(below) / found.count
    return Figure(
        f"{stream.stem}-distribution",
        f"{stream.label}: distribution of delays" if kind == "delay" else f"{stream.label}: distribution of PDV",
        f"Histogram and distribution function of {stream.label}: {_percentile_words(found)}",
        Axis(_NAMES[kind], range=(float(x[0]), float(x[-1]))),
        [
            Panel(Axis("frames (%)", range=(0, 1.08 * float(share.max()))), _histogram(x, share, fitted)),
            Panel(Axis("not later (%)", range=(0, 103)), _distribution(stream, x, fitted)),
        ],
        f"Bins of {x[1] - x[0]:.3g} ms. {_outside(found, float(below[-1] - below[0]), ' (see the tail)')}",
        430,
    )


def _histogram(x: Floats, share: Floats, fitted: Model | None) -> list[Mark]:
    """Bars between edges, in % of the frames, and what the fit would have there."""
    middle = (x[:-1] + x[1:]) / 2
    words = [
        f"{milliseconds(low)} to {milliseconds(high)} ms: {part:.3g} %"
        for low, high, part in zip(x[:-1].tolist(), x[1:].tolist(), share.tolist(), strict=True)
    ]
    marks: list[Mark] = [Bars("measured", middle, share, float(x[1] - x[0]), theme.SKY, hover=words)]
    if fitted is not None:
        marks.append(Line(fitted.name, middle, 100 * np.diff(fitted.below(x)), theme.INK, Dash.DOTTED))
    return marks


def _distribution(stream: Stream, x: Floats, fitted: Model | None) -> list[Mark]:
    """Distribution functions in %: of received frames with their uncertainty, of expected ones, of the fit."""
    found, kind = stream.typical
    at = np.unique(np.concatenate((x, np.linspace(x[0], x[-1], 240))))

    def below(off_ms: float = 0.0) -> Floats:
        shares: Floats = 100 * found.at_most_array((at + off_ms) * NS_PER_MS) / found.count
        return shares

    marks: list[Mark] = []
    bound, lost = stream.bound_ms, stream.told["lost"]
    if kind == "delay" and bound is not None and bound > 0.003 * (x[-1] - x[0]):
        marks.append(Band(f"± {bound:.2g} ms", at, below(-bound), below(bound), theme.INK, opacity=0.15))
    marks.append(Line("of received frames", at, below(), theme.BLUE, width=2))
    if lost:
        of_all = below() * found.count / (found.count + lost)
        marks.append(Line("of expected frames: the lost never come", at, of_all, theme.VERMILION, Dash.DASHED))
    if fitted is not None:
        marks.append(Line(fitted.name, at, 100 * fitted.below(at), theme.INK, Dash.DOTTED, listed=False))
    return [*marks, _marked(found)]


def _outside(found: Histogram, inside: float, more: str = "") -> str:
    outside = found.count - inside
    if outside < 0.5:
        return ""
    low, high = ((end or 0) / NS_PER_MS for end in (found.min_ns, found.max_ns))
    return (
        f"Outside of what is shown: {count(outside)} of {count(found.count)} ({percent(outside / found.count)}); "
        f"all lie from {milliseconds(low)} to {milliseconds(high)} ms{more}."
    )


_MARKED = {"p50": 0.5, "p95": 0.95, "p99": 0.99}


def _marked(found: Histogram) -> Dots:
    values = [value / NS_PER_MS for value in found.quantiles_ns(tuple(_MARKED.values())) if value is not None]
    words = [f"{name}: {milliseconds(value)} ms" for name, value in zip(_MARKED, values, strict=True)]
    shares = np.array([100 * share for share in _MARKED.values()])
    return Dots("p50, p95, p99", np.array(values), shares, theme.INK, hover=words)


def _percentile_words(found: Histogram) -> str:
    return ", ".join(_marked(found).hover) + f", largest {milliseconds((found.max_ns or 0) / NS_PER_MS)} ms"


def tail_points(found: Histogram) -> tuple[Floats, Floats]:
    """x in ms and the share of values above it, down to the last value; few points where they lie close."""
    bins = found.bins()
    above = 1 - np.cumsum(bins.count) / found.count
    x = np.minimum(bins.high_ns, found.max_ns or 0) / NS_PER_MS
    x, above = np.concatenate(([(found.min_ns or 0) / NS_PER_MS], x)), np.concatenate(([1.0], above))
    above = np.maximum(above, 0.0)
    if len(x) > TAIL_POINTS:  # evenly by decades of the share, and along x
        steps = np.floor(-np.log10(np.maximum(above, 0.1 / found.count)) * 24)
        across = np.floor((x - x[0]) / max(x[-1] - x[0], 1e-9) * 100)
        kept = np.flatnonzero((np.diff(steps, prepend=-1) != 0) | (np.diff(across, prepend=-1) != 0))
        x, above = x[np.union1d(kept, [len(x) - 1])], above[np.union1d(kept, [len(above) - 1])]
    return x, above


def tail_figure(stream: Stream) -> Figure:
    """How rare the late ones are: the complement of the distribution function, on a logarithmic axis."""
    found, kind = stream.typical
    x, above = tail_points(found)
    lost, least = stream.told["lost"], 0.5 / found.count
    drawn = np.maximum(above, least)
    words = [
        f"{share:.3g} of the received are later than {milliseconds(at)} ms" for at, share in zip(x, above, strict=True)
    ]
    marks: list[Mark] = [Line("of received frames", x, drawn, theme.BLUE, width=2, hover=words)]
    if lost:
        of_all = (above * found.count + lost) / (found.count + lost)
        marks.append(Line("of expected frames: the lost never come", x, of_all, theme.VERMILION, Dash.DASHED))
    if (fitted := model(stream)) is not None:
        at = np.linspace(x[0], x[-1], 300)
        tail = 1 - fitted.below(at)
        marks.append(Line(fitted.name, at, np.where(tail >= least, tail, np.nan), theme.INK, Dash.DOTTED))
    log = x[0] > 0 and x[-1] > _LOG_FROM * x[0]
    spare = 0.02 * (x[-1] - x[0]) + 0.01
    shown = (float(x[0]), 1.1 * float(x[-1])) if log else (float(x[0] - spare), float(x[-1] + spare))
    return Figure(
        f"{stream.stem}-tail",
        f"{stream.label}: tail of the delays" if kind == "delay" else f"{stream.label}: tail of PDV",
        f"Complementary distribution function of {stream.label}: {_percentile_words(found)}",
        Axis(_NAMES[kind], Scale.LOG if log else Scale.LINEAR, shown),
        [Panel(Axis("share that is later", Scale.LOG, (least, 1.5)), marks)],
        " ".join(filter(None, (_TAIL_CAPTION, fitted.tail_words if fitted else ""))),
        430,
    )


def interarrival_figure(stream: Stream) -> Figure:
    """Time between arrivals (the paper's Fig. 10): with even arrival all would lie at 1/Fs."""
    found, period_ms = stream.result.counts.delays.interarrival, stream.result.period_ns / NS_PER_MS
    edges = bin_edges(found, 2 * BINS)
    number = np.diff(_below(found, edges))
    inside = float(number.sum())
    x, step = edges / NS_PER_MS, float(edges[1] - edges[0]) / NS_PER_MS
    kept = number > 0
    middle = ((x[:-1] + x[1:]) / 2)[kept]
    number = np.maximum(number[kept], 0.5)
    words = [
        f"{milliseconds(at - step / 2)} to {milliseconds(at + step / 2)} ms: {count(many)}"
        for at, many in zip(middle, number, strict=True)
    ]
    marks: list[Mark] = [Bars("measured", middle, number, step, theme.SKY, hover=words)]
    if period_ms:
        marks.append(Rule(f"1/Fs = {period_ms:.3f} ms", period_ms, theme.VERMILION))
    told = stream.told["interarrival_ms"]
    low, high = min(float(x[0]), period_ms or math.inf), max(float(x[-1]), period_ms)
    spare = 0.03 * (high - low) + step
    caption = (
        f"Sd {milliseconds(told['sd'])} ms, p1 {milliseconds(told['p1'])}, p99 {milliseconds(told['p99'])}, largest "
        f"{milliseconds(told['max'])} ms. Bins of {step:.3g} ms. Only the receiver's clock matters here; a lost frame "
        f"makes it 2/Fs. {_outside(found, inside)}"
    ).rstrip()
    return Figure(
        f"{stream.stem}-interarrival",
        f"{stream.label}: time between arrivals",
        f"Histogram of the time between arrivals of {stream.label}: mean {milliseconds(told['mean'])} ms, "
        f"standard deviation {milliseconds(told['sd'])} ms",
        Axis("time between arrivals (ms)", range=(low - spare, high + spare)),
        [Panel(Axis("frames per bin", Scale.LOG, (0.5, 2.0 * float(number.max()))), marks)],
        caption,
        320,
    )
