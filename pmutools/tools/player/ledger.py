"""The ledger: what was done to every frame, one row a copy, as a Parquet table (columns in the order of LedgerRow)."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from pmutools.formats.files import OutputFile
from pmutools.impair.outgoing import LedgerRow

if TYPE_CHECKING:
    import pyarrow as pa

GROUP_ROWS = 65_536
_TEXT = frozenset(("stream", "fate", "faults"))
_SMALL = frozenset(("copy", "nbytes"))


class LedgerWriter:
    """Writes rows in groups of :data:`GROUP_ROWS`; the file is complete once closed. Raises SourceError."""

    def __init__(self, path: Path) -> None:
        import pyarrow.parquet as pq

        self._schema = _schema()
        self._rows: list[LedgerRow] = []
        self._file = OutputFile(path)
        self._writer = pq.ParquetWriter(self._file, self._schema, compression="zstd")

    def add(self, row: LedgerRow) -> None:
        self._rows.append(row)
        if len(self._rows) >= GROUP_ROWS:
            self._write()

    def close(self) -> None:
        try:
            self._write()
            self._writer.close()
        finally:
            self._file.close()

    def __enter__(self) -> LedgerWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self) -> None:
        import pyarrow as pa

        if not self._rows:
            return
        rows, self._rows = self._rows, []
        columns = [list(column) for column in zip(*rows, strict=True)]
        arrays: list[Any] = [pa.array(c, type=f.type) for c, f in zip(columns, self._schema, strict=True)]
        self._writer.write_table(pa.table(arrays, schema=self._schema))


def _schema() -> pa.Schema:
    import pyarrow as pa

    kinds = {True: pa.string(), False: pa.int64()}
    return pa.schema([(name, pa.int32() if name in _SMALL else kinds[name in _TEXT]) for name in LedgerRow._fields])
