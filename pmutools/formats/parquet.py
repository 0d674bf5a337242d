"""``.parquet`` tables: zstd, floats split by byte (BYTE_STREAM_SPLIT), row groups bounded in rows and in time.

A Parquet file can be read only when its footer is there, which comes last. So a log keeps a journal beside it: the same
rows as an Arrow stream, flushed as they come, and taken away when the footer is written. A file whose writer was killed
is read from its journal. It takes about as much space again, or some times that, while the file is being written.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.errors import SourceError
from pmutools.formats import UNSAID, Nominal, arrow
from pmutools.formats.output import OutputFile
from pmutools.formats.sink import PLAIN, SinkOptions
from pmutools.formats.source import BLOCK_FRAMES, TableSource
from pmutools.formats.table import arrow_source, reading
from pmutools.formats.table_rows import LONG_COLUMNS
from pmutools.formats.table_sink import TableSink, TableWriter
from pmutools.timebase import NS

JOURNAL = ".journal"
"""What follows the name of a file that is not finished."""
ROW_GROUP_ROWS = 1 << 16
ROW_GROUP_NS = 60 * NS
"""A row group ends when its stamps span this much: it is what a writer holds in memory."""
_MIN_ROWS = 1 << 12
"""Row groups smaller than this cost more than they hold: their time does not count."""


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a table, or the journal of one that was never finished; memory is bounded by one of its row groups."""
    from pyarrow import parquet

    journal = journal_of(path)
    try:
        with reading(path, "Parquet"):
            file = parquet.ParquetFile(path)
    except SourceError:
        if not journal.exists():
            raise
        defects = Counter({f"file without an end, read from {journal.name}": 1})
        return arrow.read_rows(journal, "parquet", configs, nominal, defects)

    def parts() -> Iterator[Any]:
        with reading(path, "Parquet"), file:
            yield from file.iter_batches(BLOCK_FRAMES)

    with reading(path, "Parquet"):
        return arrow_source(path, "parquet", file.schema_arrow, parts(), configs, nominal=nominal)


def journal_of(path: Path) -> Path:
    """Where the rows of an unfinished file are."""
    return path.with_name(path.name + JOURNAL)


class ParquetRows(TableWriter):
    """Gathers record batches into row groups; with ``journal`` they are kept beside the file until it is finished."""

    packed = True

    def __init__(self, file: OutputFile, schema: Any, options: SinkOptions = PLAIN) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        floats = [field.name for field in schema if pa.types.is_floating(field.type)]
        texts = [f.name for f in schema if pa.types.is_dictionary(f.type) or pa.types.is_string(f.type)]
        self._out, self._schema = file, schema
        self._file: Any = parquet.ParquetWriter(
            file, schema, compression="zstd", use_dictionary=texts, use_byte_stream_split=floats
        )
        self._grows = set(LONG_COLUMNS) <= set(schema.names)
        self._stamps = schema.get_field_index("time_ns")
        self._row_bytes = sum(_width(field.type) for field in schema)
        self._waiting: list[Any] = []
        self._rows = 0
        self._first_ns = 0
        self._journal = _Journal(journal_of(file.path), schema) if options.journal else None

    def write(self, rows: Any) -> None:
        if self._journal is not None:
            self._journal.write(rows)
        self._waiting.append(rows)
        self._rows += rows.num_rows
        self.held_bytes += rows.num_rows * self._row_bytes
        if self._rows >= ROW_GROUP_ROWS or (self._rows >= _MIN_ROWS and self._span_ns() >= ROW_GROUP_NS):
            self.spill()

    def flush(self) -> None:
        if self._journal is not None:
            self._journal.flush()

    def moved(self) -> None:
        if self._journal is not None:
            self._journal.move(journal_of(self._out.final_path))

    def close(self) -> None:
        """Write the footer; then the journal goes. Where that fails it stays."""
        try:
            self.spill()
            self._file.close()
            self._out.flush()
        except SourceError:
            if self._journal is not None:
                self._journal.close()
            raise
        if self._journal is not None:
            self._journal.discard()

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


class _Journal:
    """An Arrow stream that is thrown away in the end."""

    def __init__(self, path: Path, schema: Any) -> None:
        import pyarrow as pa

        self._file = OutputFile(path)
        self._stream: Any = pa.ipc.new_stream(self._file, schema)
        self.write, self.flush, self.move = self._stream.write_batch, self._file.flush, self._file.move

    def close(self) -> None:
        self._file.close()

    def discard(self) -> None:
        self._file.close()
        self._file.path.unlink(missing_ok=True)


def create(path: Path, options: SinkOptions) -> TableSink:
    """Begin a Parquet table."""
    return TableSink(path, ".parquet", ParquetRows, options)
