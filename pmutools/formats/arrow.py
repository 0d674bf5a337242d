"""``.arrow`` tables: Arrow IPC files, which are read up to a cut; streams without the file's frame are read too."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.output import STDOUT, OutputFile
from pmutools.formats.sink import SinkOptions
from pmutools.formats.source import TableSource
from pmutools.formats.table import arrow_source, reading
from pmutools.formats.table_sink import TableSink, TableWriter

MAGIC = b"ARROW1"
_FRAME = 8
"""A file is its magic, padded to this, then a stream, then a footer that is not needed to read on."""


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a table, one record batch in memory at a time."""
    import pyarrow as pa

    defects = Counter[str]()
    with reading(path, "Arrow"):
        file = pa.OSFile(str(path))
        file.seek(_FRAME if file.read(len(MAGIC)) == MAGIC else 0)
        stream = pa.ipc.open_stream(file)

        def parts() -> Iterator[Any]:
            with file:
                try:
                    yield from stream
                except (OSError, ValueError, pa.ArrowException):
                    defects["table without an end"] = 1

        return arrow_source(path, "arrow", stream.schema, parts(), configs, defects, nominal)


class ArrowRows(TableWriter):
    """Writes each record batch at once: an IPC file, or a stream where it goes to standard output."""

    def __init__(self, file: OutputFile, schema: Any, options: SinkOptions) -> None:
        import pyarrow as pa

        self._file: Any = (pa.ipc.new_stream if file.path == STDOUT else pa.ipc.new_file)(file, schema)

    def write(self, rows: Any) -> None:
        self._file.write_batch(rows)

    def close(self) -> None:
        self._file.close()


def create(path: Path, options: SinkOptions) -> TableSink:
    """Begin an Arrow table."""
    return TableSink(path, ".arrow", ArrowRows, options)
