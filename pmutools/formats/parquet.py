"""``.parquet`` tables: zstd, floats split by byte (BYTE_STREAM_SPLIT), row groups bounded in rows and in time.

A Parquet file can be read only when its footer is there: one whose writer was killed is lost. Choose ``.arrow``,
``.csv`` or ``.mcap`` where that matters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.output import OutputFile
from pmutools.formats.sink import SinkOptions
from pmutools.formats.source import BLOCK_FRAMES, TableSource
from pmutools.formats.table import arrow_source, reading
from pmutools.formats.table_sink import TableSink
from pmutools.timebase import NS

ROW_GROUP_ROWS = 1 << 16
ROW_GROUP_NS = 60 * NS
"""A row group ends when its stamps span this much: it is what a writer holds in memory."""
_MIN_ROWS = 1 << 12
"""Row groups smaller than this cost more than they hold: their time does not count."""


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a table; memory is bounded by one of its row groups."""
    from pyarrow import parquet

    with reading(path, "Parquet"):
        file = parquet.ParquetFile(path)

        def parts() -> Iterator[Any]:
            with reading(path, "Parquet"), file:
                yield from file.iter_batches(BLOCK_FRAMES)

        return arrow_source(path, "parquet", file.schema_arrow, parts(), configs, nominal=nominal)


class ParquetRows:
    """Gathers record batches into row groups."""

    def __init__(self, file: OutputFile, schema: Any) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        floats = [field.name for field in schema if pa.types.is_floating(field.type)]
        texts = [f.name for f in schema if pa.types.is_dictionary(f.type) or pa.types.is_string(f.type)]
        self._schema = schema
        self._file: Any = parquet.ParquetWriter(
            file, schema, compression="zstd", use_dictionary=texts, use_byte_stream_split=floats
        )
        self._waiting: list[Any] = []
        self._rows = 0
        self._first_ns = 0

    def write(self, rows: Any) -> None:
        stamps = rows.column(0)
        if not self._waiting:
            self._first_ns = stamps[0].as_py()
        self._waiting.append(rows)
        self._rows += rows.num_rows
        long = stamps[-1].as_py() - self._first_ns >= ROW_GROUP_NS
        if self._rows >= ROW_GROUP_ROWS or (long and self._rows >= _MIN_ROWS):
            self._end_group()

    def flush(self) -> None:
        """Nothing: without its footer the file cannot be read."""

    def close(self) -> None:
        self._end_group()
        self._file.close()

    def _end_group(self) -> None:
        import pyarrow as pa

        waiting, self._waiting, self._rows = self._waiting, [], 0
        if waiting:
            self._file.write_table(pa.Table.from_batches(waiting, self._schema), row_group_size=ROW_GROUP_ROWS)


def create(path: Path, options: SinkOptions) -> TableSink:
    """Begin a Parquet table."""
    return TableSink(path, ".parquet", ParquetRows, options)
