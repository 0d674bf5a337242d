"""Figures: what they hold agrees with what was measured, and both back ends draw all of it."""

from __future__ import annotations

import json
import re
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.measured import START_NS
from support.reported import Made, clock, run_of

from pmutools.measure.histogram import Histogram
from pmutools.measure.run import Run
from pmutools.report import matplotlib_figures, plotly_figures, theme
from pmutools.report.characterizer import compose, write_report
from pmutools.report.distribution_figures import TAIL_POINTS, bin_edges, tail_points
from pmutools.report.figures import (
    Axis,
    Band,
    Bars,
    Dash,
    Dots,
    Figure,
    Heat,
    Line,
    Mark,
    Notes,
    Panel,
    Rule,
    Scale,
    Spans,
    outline,
    time_axis,
)
from pmutools.report.quality_figure import CLASSES
from pmutools.timebase import NS

X = np.arange(6.0)
MARKS: dict[type, Any] = {
    Line: Line("a $line", X, np.array([1, 2, np.nan, 4, 5, 6]), theme.BLUE, hover=["<b>"] * 6),
    Band: Band("a band", X, X, X + 1, theme.SKY),
    Bars: Bars("a bar", X, X, 0.8, theme.GREEN),
    Dots: Dots("a dot", X, X, theme.ORANGE, "bar"),
    Notes: Notes(X[:2], ["said beside", "too"]),
    Rule: Rule("a rule", 3.0, theme.VERMILION),
    Spans: Spans("a span", [(1.0, 2.0), (4.0, 5.0)], theme.SILENT),
    Heat: Heat(X, np.array([[0, 1, 2, -1, 0, 0]], np.int8), np.ones((1, 6)), "%", CLASSES[:3]),
}


def figure(mark: Mark) -> Figure:
    names = ["<row>"] if isinstance(mark, Heat) else []
    panel = Panel(Axis("y (ms)", names=names), [mark])
    return Figure("drawn", "A <b>title</b> & $x", "in <words>", Axis("x (ms)"), [panel])


@pytest.mark.parametrize("kind", MARKS, ids=lambda kind: kind.__name__)
def test_both_back_ends_draw_every_mark(kind: type, tmp_path: Path) -> None:
    assert set(MARKS) == set(get_args(Mark))
    drawn = figure(MARKS[kind])
    png, svg = matplotlib_figures.save(drawn, tmp_path)
    written = " ".join("".join(node.itertext()) for node in ET.parse(svg).iter() if node.tag.endswith("}text"))
    spec = plotly_figures.spec(drawn)
    assert json.loads(json.dumps(spec, allow_nan=False)) == spec
    shown = json.dumps(spec, ensure_ascii=False).replace("&lt;", "<").replace("&gt;", ">").replace("\\u0024", "$")
    name = getattr(MARKS[kind], "name", None) or (CLASSES[0][0] if kind is Heat else "said beside")
    assert "A <b>title</b> & $x" in written
    for text in (name, "x (ms)", "y (ms)", *drawn.panels[0].y.names):
        assert text in shown and text in written, text
    empty = matplotlib_figures.save(figure(Rule("none", -1e9, theme.PAPER)), tmp_path / "..")[0]
    assert different(png, empty) > 200


def different(one: Path, other: Path) -> int:
    """Pixels of two pictures of one size that differ."""
    from matplotlib.image import imread

    return int((np.abs(imread(one)[..., :3] - imread(other)[..., :3]).max(2) > 0.1).sum())


@cache
def run() -> Run:
    streams = [
        Made("N1", 40, outage_s=(10, 25), loss=0.05, copies=0.02),
        Made("N2", 40, delay_ms=-15.0, spread_ms=20.0),
    ]
    return run_of(streams, begin_ns=START_NS, end_ns=START_NS + 42 * NS, clock_log=clock(None))


@cache
def figures() -> dict[str, Figure]:
    return {each.name: each for each in compose(run())[1]}


def marks(name: str, kind: type, panel: int = 0) -> list[Any]:
    return [mark for mark in figures()[name].panels[panel].marks if isinstance(mark, kind)]


def test_all_is_written_and_nothing_is_blank(tmp_path: Path) -> None:
    paths = write_report(run(), tmp_path)
    assert paths[0] == tmp_path / "report.html" and all(path.stat().st_size > 1000 for path in paths)
    assert {path.relative_to(tmp_path).as_posix() for path in paths[1:]} == {
        f"figures/{name}.{kind}" for name in figures() for kind in ("png", "svg")
    }
    assert not list(tmp_path.glob("*.part"))
    from matplotlib.image import imread

    for path in paths[1:]:
        if path.suffix == ".png":
            picture = imread(path)
            colours = np.unique((picture[..., :3] * 255).astype(np.int64) @ np.array([1 << 16, 1 << 8, 1]))
            assert picture.shape[0] > 100 and len(colours) > 20, path
        else:
            ET.parse(path)


def test_letters_that_the_usual_font_lacks_come_from_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Chinese ones where a machine has a font for them; this font comes with matplotlib, and has this letter."""
    titled = replace(figure(Rule("a rule", 3.0, theme.VERMILION)), x=Axis("\N{SCRIPT SMALL G}" * 20))
    drawn = []
    for number, names in enumerate([(), ("No Such Font", "STIXGeneral")]):
        monkeypatch.setattr(matplotlib_figures, "_EASTERN", names)
        (tmp_path / str(number)).mkdir()
        drawn.append(matplotlib_figures.save(titled, tmp_path / str(number))[0])
    assert different(*drawn) > 200


def test_a_silence_is_a_gap_and_shaded() -> None:
    course = run().courses[0]
    assert course is not None
    (line,) = marks("001-n1-delay", Line)
    (span,) = [mark for mark in marks("001-n1-delay", Spans) if mark.name == "nothing came"]
    ((low, high),) = span.ranges
    assert np.isnan(line.y).sum() == 1 and 14_000 < high - low <= 15_000
    inside = (line.x > low) & (line.x < high)
    assert np.isnan(line.y[inside]).all(), "no line is drawn across it"
    (band,) = marks("001-n1-delay", Band)
    assert len(list(outline(band))) == 2
    assert figures()["001-n1-delay"].x.range == pytest.approx((START_NS / 1e6, START_NS / 1e6 + 42_000))


def test_what_was_lost_and_doubled_is_marked_where_it_was() -> None:
    course = run().courses[0]
    assert course is not None
    lost, doubled = marks("001-n1-delay", Bars, 1)
    ((low, high),) = marks("001-n1-delay", Spans)[0].ranges
    outside = (course.time_ns / 1e6 < low) | (course.time_ns / 1e6 > high)
    assert lost.name == "lost" and lost.height.sum() == course.lost[outside].sum() > 0
    assert doubled.name == "duplicated" and doubled.height.sum() == course.duplicated.sum() > 0


def test_delays_below_zero_are_drawn() -> None:
    least = run().summary["streams"][1]["delay_ms"]["min"]
    assert least < -10
    (band,) = marks("002-n2-delay", Band)
    assert np.nanmin(band.low) == pytest.approx(least)
    low, high = figures()["002-n2-distribution"].x.range or (0, 0)
    assert low <= least < 0 < high
    assert "below zero, and shown" in figures()["002-n2-delay"].caption


def test_histogram_and_tail_count_every_frame() -> None:
    found = run().results[0].counts.delays.delay
    (bars,) = marks("001-n1-distribution", Bars)
    assert bars.height.sum() == pytest.approx(100)
    received, expected = (mark for mark in marks("001-n1-tail", Line) if mark.name.startswith("of "))
    assert received.y[0] == 1 and received.y[-1] <= 0.5 / found.count
    told = run().summary["streams"][0]
    assert expected.y[-1] == pytest.approx(told["lost"] / (told["lost"] + found.count))
    at = np.interp(told["delay_ms"]["p99"], received.x, received.y)
    assert at == pytest.approx(0.01, abs=0.003)


def test_a_fit_that_does_not_hold_the_tail_is_told_so() -> None:
    made = run_of([Made("N1", late=0.01), Made("N2")])
    tails = {found.name: found for found in compose(made)[1] if found.name.endswith("-tail")}
    late, even = tails["001-n1-tail"], tails["002-n2-tail"]
    (nearest,) = [mark for mark in late.panels[0].marks if isinstance(mark, Line) and mark.dash is Dash.DOTTED]
    told = made.summary["streams"][0]["fit"]
    assert told["name"] == "histogram"
    family = told["nearest"]["name"]
    assert nearest.name == f"{family}, the nearest, does not hold the tail"
    off = abs(told["nearest"]["tail_error_ms"])
    assert f"Of the {family} distribution p99.9 is {off:.3g} ms too small: the tail does not hold." in late.caption
    assert off > 15
    assert "does not hold" not in even.caption
    assert made.summary["streams"][1]["fit"]["tail_holds"]


def test_windows_are_the_summarys() -> None:
    for mark, key in zip(marks("windows", Bars), ("0", "1", "2+"), strict=True):
        shares = [each["per_window"][key] / sum(each["per_window"].values()) for each in run().summary["streams"]]
        assert mark.height == pytest.approx([100 * share for share in shares])


def test_the_heat_map_is_dark_where_nothing_came() -> None:
    (heat,) = marks("quality", Heat)
    seconds = heat.x / 1000 - START_NS / NS
    silent = (seconds > 11.5) & (seconds < 23.5)
    assert (heat.level[0, silent] == len(CLASSES) - 1).all() and (heat.level[1, silent] == 0).all()
    assert (heat.level[:, -1] == -1).all(), "after the last frame"
    assert (heat.value[0, ~silent & (heat.level[0] > 0)] < 100).all()


@given(st.lists(st.integers(-(10**10), 10**12), min_size=1, max_size=300))
def test_bins_hold_what_they_show_and_tails_fall(values: list[int]) -> None:
    found = Histogram(np.array(values))
    edges = bin_edges(found)
    assert (np.diff(edges) > 0).all() and len(edges) < 140
    inside = found.at_most_array(edges[-1:])[0] - found.at_most_array(edges[:1])[0]
    assert inside >= 0.9 * len(values) - 2
    x, above = tail_points(found)
    assert (np.diff(x) >= 0).all() and (np.diff(above) <= 0).all() and above[-1] < 1e-9


@pytest.mark.parametrize("seconds", [4.0, 10.0, 60.0])
def test_one_pause_does_not_widen_the_bins_of_inter_arrival_times(seconds: float) -> None:
    """It is told as outside of what is shown."""
    run = run_of([Made("N1", seconds + 3, outage_s=(seconds / 2, seconds / 2 + 3))])
    _, drawn = compose(run)
    (found,) = (each for each in drawn if each.name.endswith("-interarrival"))
    bars = next(mark for mark in found.panels[0].marks if isinstance(mark, Bars))
    assert bars.width < 1.0 and found.x.range is not None and found.x.range[1] < 100
    assert re.search(r"Outside of what is shown: [1-5] of .*; all lie from .* to 3,0\d\d", found.caption)


def test_tails_of_many_bins_are_thinned() -> None:
    x, above = tail_points(Histogram(np.random.default_rng(1).lognormal(17, 1.5, 200_000).astype(np.int64)))
    assert len(x) <= TAIL_POINTS
    assert np.diff(np.log10(above[:-1])).min() > -1


def test_times_and_logs_reach_the_page_as_they_are() -> None:
    at = np.array([1.7e12, 1.7e12 + 1])
    drawn = Figure(
        "t",
        "t",
        "t",
        Axis("UTC", Scale.TIME),
        [Panel(Axis("y", Scale.LOG, (1e-3, 1.0)), [Line("l", at, X[1:3], theme.INK)])],
    )
    spec = plotly_figures.spec(drawn)
    assert spec["data"][0]["x"] == [1_700_000_000_000, 1_700_000_000_001]
    assert spec["layout"]["yaxis"]["range"] == pytest.approx([-3, 0]) and spec["layout"]["xaxis"]["type"] == "date"


@pytest.mark.parametrize("span_s", [0.05, 1, 8, 61, 207, 3600, 5000, 86_400 * 3, 86_400 * 4000])
def test_ticks_of_time_are_few_round_and_silent(span_s: float, tmp_path: Path) -> None:
    """Between 3 and 5 minutes matplotlib's own locator gives up, aloud."""
    begin_ms = START_NS / 1e6
    ticks = matplotlib_figures._time_locator()().tick_values(begin_ms / 864e5, (begin_ms / 1e3 + span_s) / 86_400)
    assert 1 <= len(ticks) <= 8
    x = begin_ms + np.array([0.0, 1e3 * span_s])
    line = Line("a", x, np.zeros(2), theme.BLUE)
    figure = Figure("t", "t", "t", time_axis("time", (x[0], x[1])), [Panel(Axis("f (Hz)"), [line])])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        matplotlib_figures.save(figure, tmp_path)


def test_the_title_of_a_low_panel_fits_it() -> None:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Sheet

    line = Line("a", np.arange(2.0), np.array([59.995, 60.005]), theme.BLUE)
    panels = [Panel(Axis("frequency (Hz)"), [line]), Panel(Axis("gain (MW/mHz)"), [line], 0.5)]
    with mpl.rc_context(matplotlib_figures._STYLE):
        sheet = Sheet(figsize=(11, 4))
        canvas = FigureCanvasAgg(sheet)
        matplotlib_figures._draw(Figure("t", "t", "t", Axis("x", range=(0.0, 1.0)), panels), sheet, (11, 4))
        canvas.draw()
        upper, lower = sheet.axes
        title = lower.yaxis.label.get_window_extent()
        low, high = upper.get_ylim()
        above = [
            upper.yaxis.label,
            *(label for label in upper.get_yticklabels() if low <= label.get_position()[1] <= high),
        ]
        assert not any(title.overlaps(label.get_window_extent()) for label in above)
