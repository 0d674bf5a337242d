"""Figures for the page: plotly's own JSON, which its JavaScript draws. Python's plotly is not needed for that.

Every text is escaped: plotly reads a little HTML in names and labels, and names come from the wire.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence
from functools import singledispatch
from typing import Any

import numpy as np

from pmutools.report import theme
from pmutools.report.figures import (
    Axis,
    Band,
    Bars,
    Dots,
    Figure,
    Floats,
    Heat,
    Line,
    Mark,
    Notes,
    Panel,
    Rule,
    Scale,
    Spans,
    outline,
)
from pmutools.report.text import clean

GAP = 0.06
"""Of the height, between panels."""
_SYMBOLS = {"circle": "circle", "square": "square", "diamond": "diamond", "bar": "line-ns-open", "cross": "x-thin-open"}
_LEGEND_PX, _AXIS_PX, _SIDE_PX = 26, 48, 66
Json = dict[str, Any]


def spec(figure: Figure) -> Json:
    """What ``Plotly.newPlot`` takes: ``data`` and ``layout``."""
    data: list[Json] = []
    layout: Json = {
        "height": figure.height_px,
        "margin": {"l": _SIDE_PX, "r": 34, "t": _LEGEND_PX, "b": _AXIS_PX, "pad": 0},
        "font": {"family": theme.SANS, "size": 12, "color": theme.INK},
        "paper_bgcolor": theme.PAPER,
        "plot_bgcolor": theme.PAPER,
        "hovermode": "closest",
        "hoverlabel": {"font": {"family": theme.SANS, "size": 12}, "align": "left"},
        "legend": {"orientation": "h", "x": 0, "y": 1, "xanchor": "left", "yanchor": "bottom", "font": {"size": 12}},
        "showlegend": True,
        "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)"},
        "barmode": "overlay",
        "shapes": [],
        "annotations": [],
        "xaxis": _axis(figure.x) | {"anchor": _y(len(figure.panels) - 1)},
    }
    for number, (panel, domain) in enumerate(zip(figure.panels, _domains(figure.panels), strict=True)):
        rows = any(isinstance(mark, Heat) for mark in panel.marks)
        key = f"yaxis{number + 1 if number else ''}"
        layout[key] = _axis(panel.y, rows=rows, upright=True) | {"domain": domain, "anchor": "x"}
        for mark in panel.marks:
            data += [trace | {"yaxis": _y(number)} for trace in traces(mark, panel.y)]
            layout["shapes"] += shapes(mark, number)
            if isinstance(mark, Notes):
                layout["annotations"] += _annotations(mark, number)
                layout["margin"]["r"] = max(6 * len(words) for words in mark.words) + 40
    if any(panel.y.names for panel in figure.panels):
        layout["margin"]["l"] = 8  # plotly makes room for names
    return {"data": data, "layout": layout}


def _y(number: int) -> str:
    return f"y{number + 1 if number else ''}"


def _domains(panels: Sequence[Panel]) -> list[list[float]]:
    """Where each panel lies, from the bottom up, in shares of the height; the first is on top."""
    total = sum(panel.weight for panel in panels)
    room, top, found = 1 - GAP * (len(panels) - 1), 1.0, []
    for panel in panels:
        bottom = top - room * panel.weight / total
        found.append([round(max(0.0, bottom), 4), round(top, 4)])
        top = bottom - GAP
    return found


def _axis(axis: Axis, *, rows: bool = False, upright: bool = False) -> Json:
    told: Json = {
        "title": {"text": _text(axis.title), "standoff": 8, "font": {"size": 12, "color": theme.MUTED}},
        "type": {Scale.LINEAR: "linear", Scale.LOG: "log", Scale.TIME: "date"}[axis.scale],
        "gridcolor": theme.GRID,
        "linecolor": theme.MUTED,
        "showline": True,
        "zeroline": False,
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": theme.MUTED,
        "nticks": 6,
    }
    if axis.scale is Scale.LOG:
        told |= {"dtick": 1, "exponentformat": "power"} if _decades(axis) > 1.5 else {"dtick": "D1"}
    elif axis.scale is Scale.LINEAR:
        told |= {"separatethousands": True, "exponentformat": "none"}
    if axis.names:
        told |= {"showgrid": False, "automargin": True, "ticks": ""}
        if rows:
            told |= {"type": "category", "autorange": "reversed"}
            del told["nticks"]
        else:
            told |= {"tickvals": list(range(len(axis.names))), "ticktext": [_text(name) for name in axis.names]}
            told["range"] = [len(axis.names) - 0.5, -0.5]
    elif upright:
        told["automargin"] = "left"
    if axis.range is not None:
        log = axis.scale is Scale.LOG
        told["range"] = [math.log10(end) if log else end for end in axis.range]
    return told


def _decades(axis: Axis) -> float:
    return math.log10(axis.range[1] / axis.range[0]) if axis.range else 9.0


@singledispatch
def traces(mark: Mark, axis: Axis) -> Iterator[Json]:
    """The traces of a mark, whose panel has this y axis."""
    yield from ()


@traces.register
def _line(mark: Line, axis: Axis) -> Iterator[Json]:
    yield {
        "type": "scatter",
        "mode": "lines",
        "name": _text(mark.name),
        "showlegend": mark.listed,
        "x": numbers(mark.x),
        "y": numbers(mark.y),
        "line": {"color": mark.color, "width": mark.width, "dash": mark.dash.value},
        "connectgaps": False,
        **_hover(mark.hover),
    }


@traces.register
def _band(mark: Band, axis: Axis) -> Iterator[Json]:
    x: list[float | None] = []
    y: list[float | None] = []
    for across, up in outline(mark):
        x += [*numbers(across), None]
        y += [*numbers(up), None]
    yield {
        "type": "scatter",
        "mode": "lines",
        "fill": "toself",
        "name": _text(mark.name),
        "x": x[:-1],
        "y": y[:-1],
        "line": {"width": 0, "color": mark.color},
        "fillcolor": _faded(mark.color, mark.opacity),
        "hoverinfo": "skip",
    }


@traces.register
def _bars(mark: Bars, axis: Axis) -> Iterator[Json]:
    across, up = numbers(mark.x), numbers(mark.height)
    yield {
        "type": "bar",
        "name": _text(mark.name),
        "x": up if mark.lying else across,
        "y": across if mark.lying else up,
        "orientation": "h" if mark.lying else "v",
        "width": mark.width,
        "marker": {"color": mark.color, "line": {"width": 0}},
        **({} if mark.base is None else {"base": numbers(mark.base)}),
        **_hover(mark.hover),
    }


@traces.register
def _dots(mark: Dots, axis: Axis) -> Iterator[Json]:
    thin = mark.symbol in ("bar", "cross")
    yield {
        "type": "scatter",
        "mode": "markers",
        "name": _text(mark.name),
        "x": numbers(mark.x),
        "y": numbers(mark.y),
        "marker": {
            "color": mark.color,
            "symbol": _SYMBOLS[mark.symbol],
            "size": 9 if thin else 7,
            "line": {"width": 2 if thin else 0, "color": mark.color},
        },
        **_hover(mark.hover),
    }


@traces.register
def _heat(mark: Heat, axis: Axis) -> Iterator[Json]:
    last = len(mark.classes) - 1
    scale = [
        [edge, color] for at, (_, color) in enumerate(mark.classes) for edge in (at / (last + 1), (at + 1) / (last + 1))
    ]
    yield {
        "type": "heatmap",
        "x": numbers(mark.x),
        "y": [_text(name) for name in axis.names],
        "z": [[None if level < 0 else level for level in row] for row in mark.level.tolist()],
        "customdata": [numbers(row) for row in mark.value],
        "zmin": -0.5,
        "zmax": last + 0.5,
        "ygap": 1 if len(axis.names) <= 60 else 0,
        "colorscale": scale,
        "showscale": False,
        "hovertemplate": f"%{{y}}<br>%{{x|%Y-%m-%d %H:%M:%S}} UTC<br>%{{customdata}} {_text(mark.unit)}<extra></extra>",
        "hoverongaps": False,
    }
    for name, color in mark.classes:  # the legend
        square = {"symbol": "square", "size": 11, "color": color, "line": {"width": 0.6, "color": theme.MUTED}}
        yield {"type": "scatter", "mode": "markers", "x": [None], "y": [None], "name": _text(name), "marker": square}


@singledispatch
def shapes(mark: Mark, panel: int) -> list[Json]:
    """The shapes of a mark, in the panel of this number."""
    return []


@shapes.register
def _rule(mark: Rule, panel: int) -> list[Json]:
    ends = (
        {"x0": mark.at, "x1": mark.at, "y0": 0, "y1": 1, "yref": f"{_y(panel)} domain", "xref": "x"}
        if mark.upright
        else {"y0": mark.at, "y1": mark.at, "x0": 0, "x1": 1, "xref": "x domain", "yref": _y(panel)}
    )
    line = {"color": mark.color, "width": 1.4, "dash": mark.dash.value}
    return [{"type": "line", **ends, "line": line, "name": _text(mark.name), "showlegend": True}]


@shapes.register
def _spans(mark: Spans, panel: int) -> list[Json]:
    name = _text(mark.name)
    place = {"y0": 0, "y1": 1, "yref": f"{_y(panel)} domain", "xref": "x"}
    return [
        {
            "type": "rect",
            "x0": low,
            "x1": high,
            **place,
            "fillcolor": mark.color,
            "opacity": 0.6,
            "line": {"width": 0},
            "layer": "below",
            "name": name,
            "legendgroup": name,
            "showlegend": not (number or panel),
        }
        for number, (low, high) in enumerate(mark.ranges)
    ]


def _annotations(mark: Notes, panel: int) -> list[Json]:
    place = {"xref": "paper", "x": 1, "xshift": 6, "yref": _y(panel), "xanchor": "left", "showarrow": False}
    return [
        {"y": y, "text": _text(words), "font": {"size": 11}, **place}
        for y, words in zip(mark.y.tolist(), mark.words, strict=True)
    ]


def _hover(words: Sequence[str]) -> Json:
    return {"text": [_text(each) for each in words], "hoverinfo": "text", "textposition": "none"} if words else {}


def _text(text: str) -> str:
    return html.escape(clean(text), quote=False)


def _faded(color: str, opacity: float) -> str:
    red, green, blue = (int(color[at : at + 2], 16) for at in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


def numbers(values: Floats) -> list[float | None]:
    """Seven digits of each, all digits of times; None for NaN."""
    if values.size and np.nanmax(np.abs(values), initial=0.0) > 1e11:
        return [None if value != value else round(value) for value in values.tolist()]
    return [None if value != value else float(f"{value:.7g}") for value in values.tolist()]
