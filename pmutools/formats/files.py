"""Files read as bytes and as rows of text, through gzip or zstd; a failure is a SourceError that names the file."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME
from pmutools.errors import SourceError
from pmutools.formats.capture.window import Window
from pmutools.timebase import NS, parse_utc

TEXT_ROWS = 8192
"""Rows of a text file held at one time."""
END_NS = NS << 32
"""SOC ends here, in 2106."""
_NAN = float("nan")


class WindowFile(io.RawIOBase):
    """A :class:`Window` as a file to read from."""

    def __init__(self, window: Window) -> None:
        super().__init__()
        self._window = window

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        window, room = self._window, len(buffer)
        if not window.data:
            window.advance(0, 1)
        piece = window.data[:room]
        buffer[: len(piece)] = piece
        window.data = window.data[len(piece) :]
        return len(piece)


class TextTable:
    """A comma-separated file, read row by row; what cannot be read is counted in ``defects``.

    Blank rows are passed over, a byte order mark and trailing commas too. ``line`` is that of the row last read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.defects = Counter[str]()
        self._window = Window(path)
        text = io.TextIOWrapper(
            io.BufferedReader(WindowFile(self._window), 1 << 16), "utf-8-sig", errors="replace", newline=""
        )
        self._reader = csv.reader(text)
        self._again: list[list[str]] = []

    @property
    def line(self) -> int:
        return self._reader.line_num

    def row(self) -> list[str] | None:
        """The next row that is not blank, without the blanks around its cells; None at the end."""
        if self._again:
            return self._again.pop()
        while True:
            try:
                row = next(self._reader, None)
            except csv.Error as error:
                raise SourceError(f"{self.path}:{self.line}: {error}; is this a CSV file?") from None
            if row is None:
                if self._window.failed:
                    self.defects["compression damaged"] = 1
                self._window.close()
                return None
            row = [cell.strip() for cell in row]
            if any(row):
                return row

    def put_back(self, row: list[str]) -> None:
        """Have :meth:`row` give ``row`` again."""
        self._again.append(row)

    def blocks(self, width: int, *, fill: bool) -> Iterator[list[tuple[str, ...]]]:
        """The rows left, as lists of ``width`` columns; rows of another length are counted.

        Longer rows lose what is beyond; shorter ones are filled with blanks or (``fill`` false) left out, as what a
        writer that was killed had not finished.
        """
        rows: list[list[str]] = []
        while (row := self.row()) is not None:
            if any(row[width:]) or len(row) < width:
                self.defects["ragged rows"] += 1
            if fill or len(row) >= width:
                rows.append(row[:width] + [""] * (width - len(row)))
            if len(rows) >= TEXT_ROWS:
                yield list(zip(*rows, strict=True))
                rows = []
        if rows:
            yield list(zip(*rows, strict=True))

    def numbers(self, cells: Sequence[str]) -> npt.NDArray[np.float64]:
        """(N,) numbers, NaN for blank cells and, counted, for those that are no number."""
        try:
            return np.array([float(cell) if cell else _NAN for cell in cells])
        except ValueError:
            return np.array([self._number(cell) for cell in cells])

    def _number(self, cell: str) -> float:
        try:
            return float(cell) if cell else _NAN
        except ValueError:
            self.defects["unreadable cells"] += 1
            return _NAN

    def times(self, cells: Sequence[str]) -> npt.NDArray[np.int64]:
        """(N,) ns of ISO-8601 times; NO_TIME for cells that hold none, which are not counted."""
        return np.array([_checked(parse_utc, cell) for cell in cells], np.int64)

    def nanoseconds(self, cells: Sequence[str]) -> npt.NDArray[np.int64]:
        """(N,) whole ns; NO_TIME for cells that hold none, which are not counted."""
        return np.array([_checked(int, cell) for cell in cells], np.int64)


def without_blank_end(row: Sequence[str]) -> list[str]:
    """``row`` up to its last cell that is not blank."""
    return list(row[: max((number for number, cell in enumerate(row, 1) if cell), default=0)])


def _checked(read: Callable[[str], int], cell: str) -> int:
    try:
        time_ns = read(cell)
    except ValueError:
        return NO_TIME
    return time_ns if 0 <= time_ns < END_NS else NO_TIME
