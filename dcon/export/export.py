"""``dcon export``: a session log as a table, by the suffix of the file that is wanted; memory is bounded by a batch."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dcon.export.tables import TABLES, Column, Row, Table
from dcon.session.newer import Newer, newer_in
from dcon.session.parts import Paths
from dcon.session.reader import SessionReader
from pmutools.errors import SettingsError, SourceError
from pmutools.formats.output import whole
from pmutools.schema.log_reader import Damage

if TYPE_CHECKING:
    import pyarrow as pa

BATCH_ROWS = 18_000
"""Rows of a batch, which is a row group in Parquet: five minutes of ticks."""

Write = Callable[[Sequence[Row]], None]


class ExportSummary(NamedTuple):
    """``rows`` written; ``gaps``: places where the log lost something, so that neighbouring rows are not neighbours."""

    rows: int
    gaps: int
    damage: Damage
    newer: Newer = Newer()
    missing: tuple[str, ...] = ()
    """What is not there before and between the parts, in words."""


def export(session: Paths, out: str | os.PathLike[str], table: str = "tick") -> ExportSummary:
    """Write one table of a session log to ``out``: ``.csv .parquet .arrow .jsonl``, text also ``.gz`` or ``.zst``.

    Raises SettingsError for a table or suffix that is not known, SourceError where either file cannot be used or (for
    ``tick``) the log holds no tick: ``out`` is then as it was.
    """
    if table not in TABLES:
        raise SettingsError(f"no table {table!r}; there are {', '.join(TABLES)}")
    sink = _sink_of(Path(out))
    reader = SessionReader(session)
    chosen = TABLES[table]
    columns = chosen.columns(reader)
    rows = _Rows(reader, chosen)
    batches = rows.batches()
    first = next(batches, None)
    if first is None and table == "tick":
        raise SourceError(f"{reader.path}: holds no tick")
    metadata = {"table": table, "flags": json.dumps(reader.flags), "session": json.dumps(reader.metadata)}
    count = 0
    try:
        with whole(Path(out)) as path, sink(path, columns, metadata) as write:
            while first is not None:
                write(first)
                count += len(first)
                first = next(batches, None)
    except OSError as error:
        if isinstance(error, SourceError):
            raise
        reason = os.strerror(error.errno) if error.errno else error  # pyarrow's own text is long, and names the path
        raise SourceError(f"{out}: cannot write: {reason}") from None
    return ExportSummary(count, rows.gaps, reader.damage, newer_in(reader), tuple(reader.missing))


class _Rows:
    """Rows of a table in batches, and the count of gaps met."""

    def __init__(self, reader: SessionReader, table: Table) -> None:
        self._reader = reader
        self._table = table
        self.gaps = 0

    def batches(self) -> Iterator[list[Row]]:
        rows = self._rows()
        while batch := list(islice(rows, BATCH_ROWS)):
            yield batch

    def _rows(self) -> Iterator[Row]:
        rows = self._table.rows(self._reader)
        for group in self._reader.groups(self._table.messages):
            self.gaps += bool(group.lost)
            yield from rows(group)


Sink = Callable[[Path, Sequence[Column], dict[str, str]], AbstractContextManager[Write]]


@contextmanager
def _csv(path: Path, columns: Sequence[Column], metadata: dict[str, str]) -> Iterator[Write]:
    import pyarrow as pa
    import pyarrow.csv as pa_csv

    schema = _schema(columns, metadata)
    options = pa_csv.WriteOptions(quoting_style="needed")
    with (
        pa.output_stream(str(path), compression="detect") as stream,
        pa_csv.CSVWriter(stream, schema, write_options=options) as writer,
    ):
        yield lambda rows: writer.write_batch(_batch(rows, schema))


@contextmanager
def _jsonl(path: Path, columns: Sequence[Column], metadata: dict[str, str]) -> Iterator[Write]:
    import pyarrow as pa

    names = [column.name for column in columns]
    with pa.output_stream(str(path), compression="detect") as stream:

        def write(rows: Sequence[Row]) -> None:
            stream.write("".join(_json_line(names, row) for row in rows).encode())

        yield write


def _json_line(names: Sequence[str], row: Row) -> str:
    """One object; JSON has no infinity, so that is null too."""
    values = (None if isinstance(value, float) and math.isinf(value) else value for value in row)
    return json.dumps(dict(zip(names, values, strict=True)), separators=(",", ":"), ensure_ascii=False) + "\n"


@contextmanager
def _parquet(path: Path, columns: Sequence[Column], metadata: dict[str, str]) -> Iterator[Write]:
    import pyarrow.parquet as pq

    schema = _schema(columns, metadata)
    writer = pq.ParquetWriter(
        str(path),
        schema,
        compression="zstd",
        use_dictionary=[column.name for column in columns if column.type == "string"],
        use_byte_stream_split=[column.name for column in columns if column.type == "float64"],
    )
    with writer:
        yield lambda rows: writer.write_batch(_batch(rows, schema))


@contextmanager
def _arrow(path: Path, columns: Sequence[Column], metadata: dict[str, str]) -> Iterator[Write]:
    import pyarrow as pa

    schema = _schema(columns, metadata)
    with pa.OSFile(str(path), "wb") as stream, pa.ipc.new_file(stream, schema) as writer:
        yield lambda rows: writer.write_batch(_batch(rows, schema))


SINKS: dict[str, Sink] = {".csv": _csv, ".jsonl": _jsonl, ".parquet": _parquet, ".arrow": _arrow}


def _sink_of(out: Path) -> Sink:
    suffix = out.suffix.lower()
    if suffix in (".gz", ".zst"):
        suffix = Path(out.stem).suffix.lower()
        if suffix not in (".csv", ".jsonl"):
            suffix = out.suffix
    if suffix not in SINKS:
        raise SettingsError(f"{out}: unknown suffix {suffix!r}; use one of {', '.join(SINKS)}")
    return SINKS[suffix]


def _schema(columns: Sequence[Column], metadata: dict[str, str]) -> pa.Schema:
    import pyarrow as pa

    types: dict[str, Any] = {
        "int64": pa.int64(),
        "uint64": pa.uint64(),
        "float64": pa.float64(),
        "string": pa.string(),
        "bool": pa.bool_(),
    }
    fields = [pa.field(column.name, types[column.type], nullable=column.nullable) for column in columns]
    return pa.schema(fields, metadata=metadata)


def _batch(rows: Sequence[Row], schema: pa.Schema) -> pa.RecordBatch:
    import pyarrow as pa

    arrays = [pa.array(values, field.type) for values, field in zip(zip(*rows, strict=True), schema, strict=True)]
    return pa.record_batch(arrays, schema=schema)
