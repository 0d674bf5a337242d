"""Tables of text in character cells: columns that fit a width, numbers that fit a column."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from rich.cells import cell_len, set_cell_size


def number(value: float, width: int = 9) -> str:
    """``value`` in at most ``width`` (>= 4) characters: whole, or in thousands (k), millions (M), ..."""
    if not math.isfinite(value):
        return "-"
    for unit in ("", "k", "M", "G", "T"):
        for digits in (1, 0) if unit else (0,):
            text = f"{value:.{digits}f}{unit}"
            if len(text) <= width:
                return text
        value /= 1000
    return "-" * width


def fit(text: str, width: int) -> str:
    """``text`` in exactly ``width`` cells; a cut is marked."""
    if len(text) <= width and text.isascii():
        return text.ljust(width)
    return set_cell_size(text, width) if cell_len(text) <= width else f"{set_cell_size(text, width - 1)}…"


class Column(NamedTuple):
    """A column, shown where the table is at least ``from_width`` wide; ``width`` 0: one of the flexible ones."""

    title: str
    width: int
    text: Callable[[Any], str]
    """What it says of a row."""
    from_width: int = 0
    left: bool = False
    """Words rather than numbers."""
    tail: bool = False
    """Of the last column: what is too long keeps its end."""


class Layout(NamedTuple):
    """Columns that fit, and how wide each is."""

    columns: tuple[Column, ...]
    widths: tuple[int, ...]

    def header(self) -> str:
        return self._line(column.title for column in self.columns)

    def row(self, row: Any) -> str:
        texts = [column.text(row) for column in self.columns]
        if self.columns[-1].tail:
            texts[-1] = texts[-1][-self.widths[-1] :]
        return self._line(texts)

    def _line(self, texts: Iterable[str]) -> str:
        cells = zip(texts, self.columns, self.widths, strict=True)
        return " ".join(
            fit(text, width) if column.left or not column.width else text.rjust(width) for text, column, width in cells
        )


NAME = (8, 12, 20)
"""Narrowest name, widest where the rest has as much room, widest where that has twice as much."""
REST = 6
"""Least width of the last column."""


def layout(columns: Sequence[Column], width: int) -> Layout:
    """A table in ``width`` cells, of whose columns two are flexible: the name, and the last, which takes the rest."""
    shown = tuple(column for column in columns if width >= column.from_width)
    left = width - sum(column.width for column in shown) - len(shown) + 1
    name = max(NAME[0], min(NAME[1], left // 2), min(NAME[2], left // 3))
    rest = max(left - name, REST)
    widths = tuple(column.width or (rest if column is shown[-1] else name) for column in shown)
    return Layout(shown, widths)
