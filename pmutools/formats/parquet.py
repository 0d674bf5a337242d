"""``.parquet`` tables: zstd, floats split by byte (BYTE_STREAM_SPLIT), row groups bounded in rows and in time.

A Parquet file can be read only when its footer is there, which comes last. One whose writer was killed is read from its
journal (:mod:`pmutools.formats.journal`), where it has one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.output import OutputFile
from pmutools.formats.sink import PLAIN, SinkOptions
from pmutools.formats.source import BLOCK_FRAMES, TableSource
from pmutools.formats.table import arrow_source, reading
from pmutools.formats.table_rows import LONG_COLUMNS
from pmutools.formats.table_sink import TableSink, TableWriter
from pmutools.timebase import NS

ROW_GROUP_ROWS = 1 << 16
ROW_GROUP_NS = 60 * NS
"""A row group ends when its stamps span this much: it is what a writer holds in memory."""
_MIN_ROWS = 1 << 12
"""Row groups smaller than this cost more than they hold: their time does not count."""


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a table; memory is bounded by one of its row groups. Raises Unfinished for a file without an end."""
    from pyarrow import parquet

    with reading(path, "Parquet"):
        file = parquet.ParquetFile(path)

        def parts() -> Iterator[Any]:
            with reading(path, "Parquet"), file:
                yield from file.iter_batches(BLOCK_FRAMES)

        return arrow_source(path, "parquet", file.schema_arrow, parts(), configs, nominal=nominal)


class ParquetRows(TableWriter):
    """Gathers record batches into row groups."""

    packed = True
    at_once = False

    def __init__(self, file: OutputFile, schema: Any, options: SinkOptions = PLAIN) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        floats = [field.name for field in schema if pa.types.is_floating(field.type)]
        texts = [f.name for f in schema if pa.types.is_dictionary(f.type) or pa.types.is_string(f.type)]
        self._schema = schema
        self._file: Any = parquet.ParquetWriter(
            file, schema, compression="zstd", use_dictionary=texts, use_byte_stream_split=floats
        )
        self._grows = set(LONG_COLUMNS) <= set(schema.names)
        self._stamps = schema.get_field_index("time_ns")
        self._row_bytes = sum(_width(field.type) for field in schema)
        self._waiting: list[Any] = []
        self._rows = 0
        self._first_ns = 0

    def write(self, rows: Any) -> None:
        self._waiting.append(rows)
        self._rows += rows.num_rows
        self.held_bytes += rows.num_rows * self._row_bytes
        if self._rows >= ROW_GROUP_ROWS or (self._rows >= _MIN_ROWS and self._span_ns() >= ROW_GROUP_NS):
            self.spill()

    def close(self) -> None:
        self.spill()
        self._file.close()

    def spill(self) -> None:
        import pyarrow as pa

        waiting, self._waiting, self._rows, self.held_bytes = self._waiting, [], 0, 0
        if waiting:
            table = pa.Table.from_batches(waiting, self._schema)
            if self._grows:
                table = table.unify_dictionaries()
            self._file.write_table(table, row_group_size=ROW_GROUP_ROWS)

    def _span_ns(self) -> int:
        """What the stamps of the rows in memory span, where there are stamps."""
        if self._stamps < 0:
            return 0
        first, last = self._waiting[0].column(self._stamps)[0], self._waiting[-1].column(self._stamps)[-1]
        return int(last.as_py() - first.as_py())


def _width(kind: Any) -> int:
    """Bytes of one value in memory."""
    import pyarrow as pa

    return int((kind.index_type if pa.types.is_dictionary(kind) else kind).bit_width) // 8


def create(path: Path, options: SinkOptions) -> TableSink:
    """Begin a Parquet table."""
    return TableSink(path, ".parquet", ParquetRows, options)
