"""Figures as files: PNG to look at and to paste, SVG to print and to edit. Drawn by matplotlib, without a display."""

from __future__ import annotations

import math
import warnings
from functools import cache, singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pmutools.report import theme
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
    Rule,
    Scale,
    Spans,
    outline,
)
from pmutools.report.text import clean

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 110
_PX = 100
"""A figure of so many of its pixels is an inch wide."""
_MS_PER_DAY = 86_400_000
_DASHES: dict[Dash, Any] = {Dash.SOLID: "-", Dash.DASHED: (0, (5, 3)), Dash.DOTTED: (0, (1, 2))}
_SYMBOLS = {"circle": "o", "square": "s", "diamond": "D", "bar": "|", "cross": "x"}
_EASTERN = ("Noto Sans CJK JP", "Noto Sans CJK SC", "Noto Sans JP", "Source Han Sans", "WenQuanYi Zen Hei", "IPAGothic")
"""Fonts with Chinese and Japanese letters, of which many machines have one: stations may be called so."""
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.edgecolor": theme.MUTED,
    "axes.labelcolor": theme.MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": theme.GRID,
    "grid.linewidth": 0.7,
    "xtick.color": theme.MUTED,
    "ytick.color": theme.MUTED,
    "xtick.labelcolor": theme.INK,
    "ytick.labelcolor": theme.INK,
    "text.color": theme.INK,
    "text.parse_math": False,  # a name may hold dollar signs
    "lines.solid_capstyle": "butt",  # a stretch of time ends where it ends
    "svg.fonttype": "none",
    "svg.hashsalt": "pmutools",  # the same run, the same bytes
    "timezone": "UTC",
}
_ROW_IN, _LETTER_IN = 0.19, 0.073
"""Rough sizes of 9 pt text: a row of the legend, a letter."""
_MOST_NAMES = 44
_MOST_TICKS = 7
_STEPS_S = (
    *(0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600),
    *(3600 * hours for hours in (2, 3, 6, 12)),
    *(86_400 * days for days in (1, 2, 7, 14, 30, 90, 365)),
)
"""Seconds between the ticks of a time axis."""


def save(figure: Figure, folder: Path) -> list[Path]:
    """Write ``folder/NAME.png`` and ``.svg``."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Sheet

    paths = [folder / f"{figure.name}.{kind}" for kind in ("png", "svg")]
    with mpl.rc_context(_STYLE | {"font.family": _families()}):
        size = ((theme.WIDE_PX if figure.wide else theme.HALF_PX) / _PX, figure.height_px / _PX + 0.3)
        sheet = Sheet(figsize=size, facecolor=theme.PAPER)
        FigureCanvasAgg(sheet)
        _draw(figure, sheet, size)
        metadata = {"Title": clean(figure.title), "Description": clean(figure.alt)}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing")  # a name in a script that the font does not have
            sheet.savefig(paths[0], dpi=DPI, metadata=metadata, pil_kwargs={"compress_level": 3})
            sheet.savefig(paths[1], metadata=metadata | {"Date": None, "Creator": "pmutools"})
    return paths


def _families() -> list[str]:
    """The usual font, and those that stand in for letters which it lacks, as far as this machine has them."""
    from matplotlib.font_manager import fontManager

    installed = {font.name for font in fontManager.ttflist}
    return ["sans-serif", *(name for name in _EASTERN if name in installed)]


def _draw(figure: Figure, sheet: Any, size: tuple[float, float]) -> None:
    width, height = size
    names = max((len(name) for panel in figure.panels for name in panel.y.names), default=0)
    left = (0.3 + names * _LETTER_IN if names else 0.78) / width
    grid = {"height_ratios": [panel.weight for panel in figure.panels], "hspace": 0.12}
    rows = sheet.subplots(len(figure.panels), 1, sharex=True, squeeze=False, gridspec_kw=grid)[:, 0]
    handles: dict[str, Any] = {}
    unit = _MS_PER_DAY if figure.x.scale is Scale.TIME else 1
    for axes, panel in zip(rows, figure.panels, strict=True):
        _scale(axes, figure.x, panel.y, size[1] * axes.get_position().height)
        for mark in panel.marks:
            draw(mark, axes, unit)
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
        _limits(axes, figure.x, panel.y, unit)
    for axes in rows[:-1]:
        axes.tick_params(labelbottom=False, bottom=False)
    sheet.text(0.1 / width, 1 - 0.08 / height, clean(figure.title), va="top", weight="bold", size=10)
    top = max(0.4, 1 - (0.42 + _ROW_IN * _legend(sheet, handles, size)) / height)
    notes = [
        len(words) for panel in figure.panels for mark in panel.marks if isinstance(mark, Notes) for words in mark.words
    ]
    bottom, right = min(0.35, 0.52 / height), 1 - (0.3 + max(notes, default=0) * _LETTER_IN * 0.85) / width
    sheet.subplots_adjust(left=left, right=right, top=top, bottom=bottom)
    _titles(figure, rows, left * width, (right - left) * width, height)


def _legend(sheet: Any, handles: dict[str, Any], size: tuple[float, float]) -> int:
    """Names of what is drawn, row by row below the title; how many rows. Matplotlib's own costs a fifth of it all."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    width, height = size
    inches = {"transform": sheet.dpi_scale_trans, "figure": sheet}
    x, row = 0.15, 0
    for name, handle in handles.items():
        long = len(name) * _LETTER_IN + 0.36
        if x > 0.15 and x + long > width - 0.1:
            x, row = 0.15, row + 1
        y = height - 0.37 - row * _ROW_IN
        sheet.text(x + 0.36, y, name, size=8.5, va="center", transform=sheet.dpi_scale_trans)
        if isinstance(handle, Line2D):
            alone = handle.get_linestyle() == "None"
            key: Any = Line2D([x + 0.14] if alone else [x, x + 0.28], [y] if alone else [y, y])
            key.update_from(handle)  # how it looks, but what it is clipped to, too
            key.set(**inches, clip_path=None, clip_box=None)
        else:
            key = Rectangle((x, y - 0.055), 0.28, 0.11, facecolor=np.ravel(handle.get_facecolor()), lw=0, **inches)
        sheet.add_artist(key)
        x += long + 0.2
    return row + bool(handles)


def _titles(figure: Figure, rows: Any, left_in: float, wide_in: float, height_in: float) -> None:
    """Titles of axes at places that are given, since to find them costs as much as to draw."""
    for axes, panel in zip(rows, figure.panels, strict=True):
        room = axes.get_position().height * height_in / max(1e-9, len(panel.y.title) * _LETTER_IN)
        axes.set_ylabel(clean(panel.y.title), size=9 * min(1.0, room))
        axes.yaxis.set_label_coords(-(left_in - 0.26) / wide_in, 0.5)
        axes.set_title("", y=1.0)
    lowest = rows[-1]
    lowest.set_xlabel(clean(figure.x.title))
    lowest.xaxis.set_label_coords(0.5, -0.3 / (lowest.get_position().height * height_in))


@cache
def _time_locator() -> Any:
    """Ticks of an axis in days, at round times; matplotlib's own gives up, aloud, between 3 and 5 minutes."""
    from matplotlib.ticker import Locator

    class TimeLocator(Locator):
        def __call__(self) -> Any:
            assert self.axis is not None
            return self.tick_values(*self.axis.get_view_interval())

        def tick_values(self, vmin: float, vmax: float) -> Any:
            begin_s, end_s = 86_400 * vmin, 86_400 * vmax
            step = next((step for step in _STEPS_S if end_s - begin_s <= _MOST_TICKS * step), None)
            step = step or 365 * 86_400 * math.ceil((end_s - begin_s) / (_MOST_TICKS * 365 * 86_400))
            return np.arange(math.ceil(begin_s / step), math.floor(end_s / step) + 1) * (step / 86_400)

    return TimeLocator


def _scale(axes: Axes, x: Axis, y: Axis, height_in: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    for axis, placed, told in (("x", axes.xaxis, x), ("y", axes.yaxis, y)):
        if told.scale is Scale.LOG:
            getattr(axes, f"set_{axis}scale")("log")
            narrow = told.range is not None and told.range[1] < 30 * told.range[0]
            placed.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if narrow else (1.0,), numticks=8))
            placed.set_minor_locator(NullLocator())
            placed.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
        elif told.scale is Scale.TIME:
            placed.set_major_locator(_time_locator()())
            placed.set_major_formatter(FuncFormatter(lambda value, _, axes=axes: _clock(value, axes.get_xlim())))
        elif told.names:
            every = math.ceil(len(told.names) / _MOST_NAMES)
            placed.set_ticks(range(0, len(told.names), every), [clean(name) for name in told.names[::every]])
            placed.set_tick_params(length=0)
        else:
            most = 6 if axis == "x" else max(2, min(5, round(4 * height_in)))
            placed.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
            placed.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.7g}".replace("-", "−")))
    axes.grid(True, axis="x" if y.names else "both")


def _limits(axes: Axes, x: Axis, y: Axis, unit: float) -> None:
    if x.range is not None:
        axes.set_xlim(x.range[0] / unit, x.range[1] / unit)
    if y.names:
        axes.set_ylim(len(y.names) - 0.5, -0.5)
    elif y.range is not None:
        axes.set_ylim(*y.range)


def _clock(day: float, shown: tuple[float, float]) -> str:
    """A time of day, or with its date where days are shown; as precise as what is shown."""
    from matplotlib.dates import num2date

    length = shown[1] - shown[0]
    form = "%H:%M:%S" if length < 0.1 else "%H:%M" if length < 1.5 else "%m-%d %H:%M" if length < 20 else "%Y-%m-%d"
    moment = num2date(day)  # type: ignore[no-untyped-call]
    fraction = f".{moment.microsecond // 100_000}" if length * 86_400 < 8 else ""
    return f"{moment:{form}}{fraction}"


def _power(value: float) -> str:
    """1000 as it is, 0.0001 as 10⁻⁴."""
    exponent = round(math.log10(value)) if value > 0 else 0
    if -3 <= exponent <= 5:
        return f"{value:,.4g}"
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


@singledispatch
def draw(mark: Mark, axes: Axes, unit: float) -> None:
    """Draw one mark; an x is so many units of the axis, which are days where it is time."""
    raise TypeError(f"no way to draw {type(mark).__name__}")


@draw.register(Line)
def _line(mark: Line, axes: Axes, unit: float) -> None:
    label = clean(mark.name) if mark.listed else "_"
    axes.plot(mark.x / unit, mark.y, color=mark.color, ls=_DASHES[mark.dash], lw=mark.width * 0.8, label=label)


@draw.register(Band)
def _band(mark: Band, axes: Axes, unit: float) -> None:
    corners = [np.column_stack((x / unit, y)) for x, y in outline(mark)]
    _areas(axes, corners, mark.name, mark.color, mark.opacity)


@draw.register(Bars)
def _bars(mark: Bars, axes: Axes, unit: float) -> None:
    base = np.zeros(len(mark.x)) if mark.base is None else mark.base
    low, high, top = (mark.x - mark.width / 2) / unit, (mark.x + mark.width / 2) / unit, base + mark.height
    if not mark.lying and axes.get_yscale() == "log":
        base = np.full(len(mark.x), 1e-12)
    across, up = np.stack((low, high, high, low), 1), np.stack((base, base, top, top), 1)
    _areas(axes, list(np.stack((up, across) if mark.lying else (across, up), 2)), mark.name, mark.color)


def _areas(axes: Axes, corners: list[Any], name: str, color: str, opacity: float = 1.0) -> None:
    from matplotlib.collections import PolyCollection

    areas = PolyCollection(corners, facecolors=color, alpha=opacity, linewidths=0, label=clean(name))
    areas.set_antialiased(opacity < 1)  # seams would show between bars that touch
    axes.add_collection(areas, autolim=axes.get_yscale() != "log")
    axes.autoscale_view()


@draw.register(Dots)
def _dots(mark: Dots, axes: Axes, unit: float) -> None:
    symbol = _SYMBOLS[mark.symbol]
    size, edge = (8, 1.6) if symbol == "|" else (5, 1.6 if symbol == "x" else 0)
    kept: dict[str, Any] = {"ls": "", "marker": symbol, "ms": size, "mew": edge}
    axes.plot(mark.x / unit, mark.y, color=mark.color, label=clean(mark.name), **kept)


@draw.register(Notes)
def _notes(mark: Notes, axes: Axes, unit: float) -> None:
    place: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "size": 8, "va": "center", "clip_on": False}
    for y, words in zip(mark.y.tolist(), mark.words, strict=True):
        axes.text(1.01, y, clean(words), **place)


@draw.register(Rule)
def _rule(mark: Rule, axes: Axes, unit: float) -> None:
    kept = {"color": mark.color, "ls": _DASHES[mark.dash], "lw": 1.1, "label": clean(mark.name)}
    if mark.upright:
        axes.axvline(mark.at / unit, **kept)
    else:
        axes.axhline(mark.at, **kept)


@draw.register(Spans)
def _spans(mark: Spans, axes: Axes, unit: float) -> None:
    for low, high in mark.ranges:
        axes.axvspan(low / unit, high / unit, color=mark.color, alpha=0.6, lw=0, zorder=0, label=clean(mark.name))


@draw.register(Heat)
def _heat(mark: Heat, axes: Axes, unit: float) -> None:
    from matplotlib.colors import to_rgba

    colors = np.array([to_rgba(color) for _, color in mark.classes] + [to_rgba(theme.PAPER)])
    x = mark.x / unit
    half = (x[1] - x[0]) / 2 if len(x) > 1 else 0.5 / unit
    rows = len(mark.level)
    axes.imshow(
        colors[mark.level], extent=(x[0] - half, x[-1] + half, rows - 0.5, -0.5), aspect="auto", interpolation="nearest"
    )
    for at in np.arange(0.5, rows - 1) if rows <= 60 else ():
        axes.axhline(at, color=theme.PAPER, lw=0.8)
    for name, color in mark.classes:
        axes.plot([], [], ls="", marker="s", ms=7, mfc=color, mec=theme.MUTED, mew=0.4, label=clean(name))
