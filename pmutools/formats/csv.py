"""``.csv`` tables: ``time`` in ISO-8601 UTC first, then the columns of the other tables; blank where nothing is known.

Floats have as many digits as bring them back exactly. A CSV has no metadata: reading infers the configuration
(:mod:`pmutools.formats.infer`), so frames made from it are all float. Files with the four header rows of the test-case
library (``T`` first in the second row) are handed to :mod:`pmutools.formats.ieee_csv`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import StreamConfig
from pmutools.errors import SourceError
from pmutools.formats import UNSAID, Nominal, ieee_csv
from pmutools.formats.columns import FrameValues, unique
from pmutools.formats.files import TextTable, without_blank_end
from pmutools.formats.output import OutputFile
from pmutools.formats.rows import Rows, idcodes_of, qualities_of, stamp_code, table_source
from pmutools.formats.sink import SinkOptions
from pmutools.formats.source import TableSource
from pmutools.formats.table_rows import LONG_COLUMNS
from pmutools.formats.table_sink import TableSink, TableWriter


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a CSV of either layout. Raises SourceError where its header or first rows say that it is neither."""
    text = TextTable(path)
    header, second = text.row(), text.row()
    if header is None:
        raise SourceError(f"{path} is empty; name another file")
    if second is not None:
        if ieee_csv.is_kinds(second):
            return ieee_csv.read_rows(text, header, second, nominal)
        text.put_back(second)
    names = unique(without_blank_end(header))
    if set(LONG_COLUMNS) <= set(names):
        raise SourceError(f"{path} is a table in long form, which cannot be played back; write it without --long")
    if "time" not in names and "time_ns" not in names:
        raise SourceError(f"{path}:1: no column time or time_ns; name the columns in the first row")
    return table_source(path, "csv", names, _rows(text, names), configs=configs, defects=text.defects, nominal=nominal)


def _rows(text: TextTable, names: list[str]) -> Iterator[Rows]:
    place = {name: number for number, name in enumerate(names)}
    times, time_column = (text.times, "time") if "time" in place else (text.nanoseconds, "time_ns")
    for columns in text.blocks(len(names), fill=False):
        time_ns = times(columns[place[time_column]])
        good = time_ns != NO_TIME
        if not good.all():
            text.defects["rows without a time"] += int(np.count_nonzero(~good))
            columns = [tuple(compress(column, good)) for column in columns]
            time_ns = time_ns[good]
        if len(time_ns):
            yield _block(text, place, columns, time_ns)


def _block(
    text: TextTable, place: dict[str, int], columns: list[tuple[str, ...]], time_ns: npt.NDArray[np.int64]
) -> Rows:
    count = len(time_ns)

    @cache
    def values(name: str) -> npt.NDArray[np.float64] | None:
        return text.numbers(columns[place[name]]) if name in place else None

    arrivals = text.nanoseconds(columns[place["arrival_ns"]]) if "arrival_ns" in place else np.full(count, NO_TIME)
    sources = columns[place["stamp_source"]] if "stamp_source" in place else ("",) * count
    codes = {name: stamp_code(name) for name in set(sources)}
    stamps = np.array([codes[name] for name in sources], np.uint8)
    frames = FrameValues(time_ns, arrivals, stamps, qualities_of(values("time_quality"), count))
    return Rows(frames, idcodes_of(values("idcode"), count), values)


class CsvRows(TableWriter):
    """Writes each record batch at once, its header before the first."""

    restarts = True  # with another header

    def __init__(self, file: OutputFile, schema: Any, options: SinkOptions) -> None:
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        self._schema = pa.schema([_plain(field) for field in schema])
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(self._schema.names)
        file.write(header.getvalue().encode())
        quoting = "needed" if "station" in self._schema.names else "none"  # names may hold commas
        settings = arrow_csv.WriteOptions(include_header=False, quoting_style=quoting)
        self._file: Any = arrow_csv.CSVWriter(file, self._schema, write_options=settings)

    def write(self, rows: Any) -> None:
        import pyarrow as pa

        columns = [_cells(name, column) for name, column in zip(rows.schema.names, rows.columns, strict=True)]
        self._file.write_batch(pa.RecordBatch.from_arrays(columns, schema=self._schema))

    def close(self) -> None:
        self._file.close()


def _cells(name: str, column: Any) -> Any:
    """A column as it is printed: ISO-8601, texts, nothing for NaN."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if name == "time_ns":
        return pa.array(np.datetime_as_string(column.to_numpy().view("datetime64[ns]"), timezone="UTC"))
    if pa.types.is_floating(column.type):
        absent = np.isnan(column.to_numpy(zero_copy_only=False))
        return pc.if_else(pa.array(absent), pa.scalar(None, column.type), column) if absent.any() else column
    return column.dictionary_decode() if pa.types.is_dictionary(column.type) else column


def _plain(field: Any) -> Any:
    import pyarrow as pa

    if field.name == "time_ns":
        return pa.field("time", pa.string())
    return pa.field(field.name, pa.string() if pa.types.is_dictionary(field.type) else field.type)


def create(path: Path, options: SinkOptions) -> TableSink:
    """Begin a CSV table."""
    compression = path.suffix if path.suffix.lower() in (".gz", ".zst") else ""
    return TableSink(path, f".csv{compression}", CsvRows, options)
