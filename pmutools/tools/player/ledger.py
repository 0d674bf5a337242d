"""The ledger: what was done to every frame, one row a copy, as a Parquet table (columns in the order of LedgerRow)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pmutools.formats.output import OutputFile
from pmutools.impair.outgoing import LedgerRow
from pmutools.tools.player.reel import I64
from pmutools.tools.player.sheet import EMPTY, FATES, SENT, Sheet

if TYPE_CHECKING:
    import pyarrow as pa

GROUP_ROWS = 65_536
NO_STAMP = np.iinfo(np.int64).min
_WAIT_ROWS = 8192
"""Rows that wait for their departure stamps beyond a group."""
_TEXT = frozenset(("stream", "fate", "faults"))
_SMALL = frozenset(("copy", "nbytes"))


@dataclass(slots=True)
class _Page:
    """A sheet as it was sent: ``first`` is the number of its first row."""

    first: int
    sheet: Sheet
    fate: npt.NDArray[np.uint8]
    sent_ns: I64
    tx_stamp_ns: I64


class LedgerWriter:
    """Writes rows in groups of about :data:`GROUP_ROWS`; the file is complete once closed. Raises SourceError."""

    def __init__(self, path: Path) -> None:
        import pyarrow.parquet as pq

        self._schema = _schema()
        self._pages: list[_Page] = []
        self._names: Sequence[str] = ()
        self._start_utc_ns = 0
        self._file = OutputFile(path)
        self._writer = pq.ParquetWriter(self._file, self._schema, compression="zstd")
        self.rows = 0
        """So many were added."""

    def begin(self, names: Sequence[str], start_utc_ns: int) -> None:
        """Whose rows will come: the streams' names, and the UTC time of offset 0."""
        self._names, self._start_utc_ns = names, start_utc_ns

    def add(self, sheet: Sheet, fate: npt.NDArray[np.uint8], sent_ns: I64) -> None:
        """Copies (N,) as they were dealt with: their fates, and when those sent had left (ns from the start)."""
        tx_stamp_ns = np.full(len(sheet), NO_STAMP)
        columns = replace(sheet, wire=EMPTY.wire)  # the bytes would be most of it
        self._pages.append(_Page(self.rows, columns, fate, sent_ns, tx_stamp_ns))
        self.rows += len(sheet)
        if self.rows - self._pages[0].first >= GROUP_ROWS + _WAIT_ROWS:
            self._write(_WAIT_ROWS)

    def stamp(self, rows: I64, tx_stamps_ns: I64) -> None:
        """Departure stamps (M,) of rows by number; the first of several destinations counts."""
        firsts = np.array([page.first for page in self._pages], np.int64)
        places = np.searchsorted(firsts, rows, side="right") - 1
        for place in np.unique(places[places >= 0]):
            page, chosen = self._pages[place], places == place
            at = rows[chosen] - page.first
            old = page.tx_stamp_ns[at]
            page.tx_stamp_ns[at] = np.where(old == NO_STAMP, tx_stamps_ns[chosen], old)

    def close(self) -> None:
        try:
            self._write(0)
            self._writer.close()
        finally:
            self._file.close()

    def __enter__(self) -> LedgerWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, keep: int) -> None:
        """Write all but about the last ``keep`` rows."""
        count = sum(page.first + len(page.sheet) <= self.rows - keep for page in self._pages)
        pages, self._pages = self._pages[:count], self._pages[count:]
        if pages:
            self._writer.write_table(self._table(pages))

    def _table(self, pages: Sequence[_Page]) -> pa.Table:
        import pyarrow as pa

        def column(name: str) -> npt.NDArray[Any]:
            return np.concatenate([getattr(page.sheet, name) for page in pages])

        def words(codes: npt.NDArray[Any], known: Sequence[str]) -> pa.Array:
            return pa.array(known, pa.string()).take(pa.array(codes))

        def times(values: I64, known: npt.NDArray[np.bool_]) -> pa.Array:
            return pa.array(values, pa.int64(), mask=~known)

        fate = np.concatenate([page.fate for page in pages])
        sent = np.concatenate([page.sent_ns for page in pages]) + self._start_utc_ns
        stamps = np.concatenate([page.tx_stamp_ns for page in pages])
        offset = column("offset_ns")
        arrays = {
            "stream": words(column("part"), self._names),
            "index": column("index"),
            "copy": column("copy"),
            "source_time_ns": column("source_ns"),
            "time_ns": column("stamp_ns"),
            "offset_ns": offset,
            "scheduled_ns": offset + self._start_utc_ns,
            "sent_ns": times(sent, fate == SENT),
            "tx_stamp_ns": times(stamps, stamps != NO_STAMP),
            "fate": words(fate, [str(known) for known in FATES]),
            "faults": pa.array(column("faults"), pa.string()),
            "nbytes": column("nbytes").astype(np.int32),
        }
        return pa.table([pa.array(arrays[field.name], field.type) for field in self._schema], schema=self._schema)


def _schema() -> pa.Schema:
    import pyarrow as pa

    kinds = {True: pa.string(), False: pa.int64()}
    return pa.schema([(name, pa.int32() if name in _SMALL else kinds[name in _TEXT]) for name in LedgerRow._fields])
