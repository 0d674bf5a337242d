"""A figure as plain data: what is drawn, not by whom. Two back ends draw it, so that page and picture cannot differ.

A figure has panels, one above the other, that share an x axis; a panel has marks. NaN in a line or band is a gap.
Times are ms since 1970, UTC.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from pmutools.report.text import day_of

Floats = npt.NDArray[np.float64]


class Scale(StrEnum):
    """How an axis is divided."""

    LINEAR = "linear"
    LOG = "log"
    TIME = "time"


class Dash(StrEnum):
    """How a line is drawn."""

    SOLID = "solid"
    DASHED = "dash"
    DOTTED = "dot"


@dataclass(frozen=True, slots=True)
class Axis:
    """``title`` has the unit. ``range`` is what is shown at first: all, where it is None."""

    title: str
    scale: Scale = Scale.LINEAR
    range: tuple[float, float] | None = None
    names: Sequence[str] = ()
    """Of 0, 1, 2 ..., the first on top: a row each."""


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """Points (N,) joined; ``hover`` (N,) says each in words."""

    name: str
    x: Floats
    y: Floats
    color: str
    dash: Dash = Dash.SOLID
    width: float = 1.6
    hover: Sequence[str] = ()
    listed: bool = True
    """In the legend."""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """The area between ``low`` and ``high`` (N,); each stretch without gap reaches ``half_width`` beyond its ends."""

    name: str
    x: Floats
    low: Floats
    high: Floats
    color: str
    half_width: float = 0.0
    opacity: float = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Bars:
    """Bars (N,) of a width around ``x``, from ``base`` by ``height``; lying, ``x`` and ``height`` change places."""

    name: str
    x: Floats
    height: Floats
    width: float
    color: str
    base: Floats | None = None
    lying: bool = False
    hover: Sequence[str] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """Points (N,) by themselves; ``symbol`` is circle, square, diamond, bar or cross."""

    name: str
    x: Floats
    y: Floats
    color: str
    symbol: str = "circle"
    hover: Sequence[str] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Notes:
    """Words at the right of the panel, beside each y (N,)."""

    y: Floats
    words: Sequence[str]


@dataclass(frozen=True, slots=True)
class Rule:
    """A line across the panel, at an x or at a y."""

    name: str
    at: float
    color: str
    upright: bool = True
    dash: Dash = Dash.DASHED


@dataclass(frozen=True, slots=True)
class Spans:
    """Stretches of the x axis, shaded."""

    name: str
    ranges: Sequence[tuple[float, float]]
    color: str


@dataclass(frozen=True, slots=True, eq=False)
class Heat:
    """Cells (R, C): each the number of its class, -1 for none; row r is at y = r, ``x`` (C,) are the middles."""

    x: Floats
    level: npt.NDArray[np.int8]
    value: Floats
    """(R, C) what the class was made from."""
    unit: str
    classes: Sequence[tuple[str, str]]
    """(name, colour)."""


Mark = Line | Band | Bars | Dots | Notes | Rule | Spans | Heat


@dataclass(frozen=True, slots=True)
class Panel:
    """A y axis and what is drawn on it; ``weight`` is its share of the figure's height."""

    y: Axis
    marks: Sequence[Mark]
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class Figure:
    """``name`` is the stem of its files. ``alt`` says in words what the figure shows, for who cannot see it."""

    name: str
    title: str
    alt: str
    x: Axis
    panels: Sequence[Panel]
    caption: str = ""
    height_px: int = 300
    wide: bool = False


def time_axis(title: str, shown_ms: tuple[float, float] | None) -> Axis:
    """An axis of time; its title says the day that it begins on."""
    day = f", from {day_of(shown_ms[0])}" if shown_ms is not None else ""
    return Axis(f"{title} (UTC{day})", Scale.TIME, shown_ms)


def stretches(*columns: Floats) -> Iterator[slice]:
    """The runs of points at which no column (N,) is NaN."""
    good = ~np.isnan(np.stack(columns)).any(0)
    edges = np.flatnonzero(np.diff(good.astype(np.int8), prepend=0, append=0))
    for first, end in edges.reshape(-1, 2).tolist():
        yield slice(first, end)


def outline(band: Band) -> Iterator[tuple[Floats, Floats]]:
    """The polygons of a band: x and y of each, forth along the top and back along the bottom."""
    for run in stretches(band.x, band.low, band.high):
        x = band.x[run].copy()
        if band.half_width:
            x = np.concatenate(([x[0] - band.half_width], x, [x[-1] + band.half_width]))
        low, high = (
            np.concatenate((part[:1], part, part[-1:])) if band.half_width else part
            for part in (band.low[run], band.high[run])
        )
        yield np.concatenate((x, x[::-1])), np.concatenate((high, low[::-1]))
