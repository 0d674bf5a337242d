"""How many frames, and how many stamps of all streams, are there after a wait."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmutools.measure.completeness import curve
from pmutools.measure.histogram import NS_PER_MS, Histogram
from pmutools.report import theme
from pmutools.report.figures import Axis, Dash, Figure, Line, Mark, Panel, Rule, Scale
from pmutools.report.text import listed, milliseconds, percent
from pmutools.report.view import View

WAITS = 240


def completeness_figure(view: View) -> Figure | None:
    """Share of frames, and of stamps that all streams have, that are there after a wait from the stamp."""
    streams = [each for each in view.detailed if each.told["delay_ms"]["count"] and not each.clock_error]
    curves: list[tuple[str, Histogram, int]] = [
        (stream.label, stream.result.counts.delays.delay, stream.told["expected"]) for stream in streams
    ]
    together = [
        (_all_name(view, float(alignment.rate)), alignment.counts.absolute, alignment.counts.stamps)
        for alignment in view.run.alignments
        if len(alignment.names) > 1 and alignment.counts.complete and _plausible(alignment.counts.absolute)
    ]
    if not curves:
        return None
    wait_ms = view.streams[0].told["wait_ms"]
    return _waits(
        "completeness",
        "Completeness against wait",
        "wait after the stamp (ms)",
        curves,
        together,
        wait_ms,
        "How many of the expected frames are there if a concentrator waits so long after the stamp (absolute wait)."
        + (" Streams that have plots of their own are drawn." if len(view.measured) > len(view.detailed) else ""),
    )


def relative_figure(view: View) -> Figure | None:
    """The same by the wait after the first frame of a stamp."""
    together = [
        (_all_name(view, float(alignment.rate)), alignment.counts.relative, alignment.counts.stamps)
        for alignment in view.run.alignments
        if len(alignment.names) > 1 and alignment.counts.complete and _plausible(alignment.counts.relative)
    ]
    if not together:
        return None
    return _waits(
        "completeness-relative",
        "Complete stamps against relative wait",
        "wait after the first frame of the stamp (ms)",
        [],
        together,
        None,
        "How many stamps have the frames of all streams if a concentrator waits so long after the first of them "
        "(relative wait). The receiver's clock does not matter here, the senders' do.",
    )


def _all_name(view: View, rate_hz: float) -> str:
    rates = {alignment.rate for alignment in view.run.alignments}
    return f"all streams together{f', {rate_hz:g}/s' if len(rates) > 1 else ''}"


def _plausible(found: Histogram) -> bool:
    middle = found.quantile_ns(0.5)
    return middle is not None and 0 <= middle < 10_000 * NS_PER_MS


def _waits(
    name: str,
    title: str,
    axis: str,
    streams: Sequence[tuple[str, Histogram, int]],
    together: Sequence[tuple[str, Histogram, int]],
    wait_ms: float | None,
    caption: str,
) -> Figure:
    """Completeness above, what is missing below; ``streams`` and ``together`` are (name, delays, expected)."""
    found = [delays for _, delays, _ in (*streams, *together)]
    low = min((each.min_ns or 0) for each in found) / NS_PER_MS
    high = max(each.quantile_ns(0.999) or 0.0 for each in found) / NS_PER_MS
    spare = 0.05 * (high - low) + 0.05
    shown = (low - spare, high + spare)
    waits = np.linspace(*shown, WAITS).tolist()
    above: list[Mark] = []
    below: list[Mark] = []
    for number, (label, delays, expected) in enumerate((*streams, *together)):
        of_all = number >= len(streams)
        color = theme.INK if of_all else theme.CYCLE[number % (len(theme.CYCLE) - 1)]
        dash = Dash.DASHED if of_all or number >= len(theme.CYCLE) - 1 else Dash.SOLID
        share = np.array([part for _, part in curve(delays, expected, waits)])
        x, width = np.array(waits), 2.6 if of_all else 1.5
        words = [
            f"{label}: {percent(part)} by {milliseconds(wait)} ms" for wait, part in zip(waits, share, strict=True)
        ]
        above.append(Line(label, x, 100 * share, color, dash, width, words))
        missing = np.where(share < 1, 1 - share, np.nan)
        below.append(Line(label, x, missing, color, dash, width, words, listed=False))
    if wait_ms is not None and shown[0] <= wait_ms <= shown[1]:
        above.append(Rule(f"wait, {milliseconds(wait_ms)} ms", wait_ms, theme.VERMILION))
    least = 0.5 / max(expected for _, _, expected in (*streams, *together))
    return Figure(
        name,
        title,
        f"{title}: 99 % are there after " + _reached(streams, together),
        Axis(axis, range=shown),
        [
            Panel(Axis("there (%)", range=(0, 103)), above, 1.2),
            Panel(Axis("share missing", Scale.LOG, (max(least, 1e-7), 1.5)), below, 1.0),
        ],
        caption,
        440 if streams else 340,
        wide=True,
    )


def _reached(streams: Sequence[tuple[str, Histogram, int]], together: Sequence[tuple[str, Histogram, int]]) -> str:
    told = []
    for label, delays, expected in (*together, *streams):
        value = delays.quantile_ns(0.99, max(0, expected - delays.count))
        told.append(f"{milliseconds(None if value is None else value / NS_PER_MS)} ms ({label})")
    return listed(told, 3)
