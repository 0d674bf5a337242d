"""Columns of numbers, a row a stream, that grow together."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
FIRST_ROWS = 16


class Column(NamedTuple):
    """What a column holds: its type, what it begins with, and its width (0: one number a row)."""

    dtype: type[Any]
    fill: Any = 0
    width: int = 0


class Table:
    """Subclasses name their columns; each is an attribute (R,) or (R, width) that :meth:`grow` renews."""

    COLUMNS: ClassVar[dict[str, Column]]

    def __init__(self) -> None:
        self.rows = 0
        for name in self.COLUMNS:
            setattr(self, name, self._fresh(name, 0))

    def grow(self, rows: int) -> None:
        """Have room for so many rows; what there was stays."""
        if rows <= self.rows:
            return
        rows = max(FIRST_ROWS, 2 * self.rows, rows)
        for name in self.COLUMNS:
            grown = self._fresh(name, rows)
            grown[: self.rows] = getattr(self, name)
            setattr(self, name, grown)
        self.rows = rows

    def _fresh(self, name: str, rows: int) -> npt.NDArray[Any]:
        dtype, fill, width = self.COLUMNS[name]
        return np.full((rows, width) if width else rows, fill, dtype)


class Segments(NamedTuple):
    """Which of N frames belong to which stream: B segments, one a stream, end to end."""

    rows: Rows
    """(B,) the streams."""
    starts: Rows
    """(B,) where each begins."""
    lengths: Rows
    """(B,) > 0."""

    @classmethod
    def of(cls, rows: Rows, lengths: Rows) -> Segments:
        return cls(rows, np.cumsum(lengths) - lengths, lengths)

    @property
    def ends(self) -> Rows:
        """(B,) the last frame of each."""
        return self.starts + self.lengths - 1

    @property
    def row(self) -> Rows:
        """(N,) the stream of each frame."""
        return np.repeat(self.rows, self.lengths)

    @property
    def place(self) -> Rows:
        """(N,) the number of each frame within its segment."""
        return np.arange(int(self.lengths.sum())) - np.repeat(self.starts, self.lengths)

    def only(self, wanted: Flags) -> tuple[Segments, Flags]:
        """Those segments (B,) that are wanted, and which frames (N,) are theirs."""
        return Segments.of(self.rows[wanted], self.lengths[wanted]), np.repeat(wanted, self.lengths)

    def sums(self, values: npt.NDArray[Any]) -> Ints:
        """(B,) sums of whole numbers or flags (N,)."""
        found: Ints = np.add.reduceat(values, self.starts, dtype=np.int64)
        return found
