"""``.arrow`` tables: Arrow IPC files, which are read up to a cut; streams without the file's frame are read too."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.errors import SourceError
from pmutools.formats.files import OutputFile
from pmutools.formats.sink import SinkOptions
from pmutools.formats.source import TableSource
from pmutools.formats.table import arrow_source
from pmutools.formats.table_sink import TableSink

MAGIC = b"ARROW1"
_FRAME = 8
"""A file is its magic, padded to this, then a stream, then a footer that is not needed to read on."""


def read(path: Path, configs: Iterable[StreamConfig] = ()) -> TableSource:
    """Open a table, one record batch in memory at a time."""
    import pyarrow as pa

    defects = Counter[str]()
    try:
        file = pa.OSFile(str(path))
        if file.read(len(MAGIC)) == MAGIC:
            file.seek(_FRAME)
        else:
            file.seek(0)
        stream = pa.ipc.open_stream(file)
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, error) from None

    def parts() -> Iterator[Any]:
        try:
            yield from stream
        except (OSError, pa.ArrowException):
            defects["table without an end"] = 1
        finally:
            file.close()

    return arrow_source(path, "arrow", stream.schema, parts(), configs, defects)


def _unreadable(path: Path, error: Exception) -> SourceError:
    reason = str(error).partition("\n")[0].rstrip(".")
    return SourceError(f"{path} is no readable Arrow file ({reason}); name another file")


class ArrowRows:
    """Writes each record batch at once."""

    def __init__(self, file: OutputFile, schema: Any) -> None:
        import pyarrow as pa

        self._file: Any = pa.ipc.new_file(file, schema)

    def write(self, rows: Any) -> None:
        self._file.write_batch(rows)

    def flush(self) -> None:
        """Nothing is held back here."""

    def close(self) -> None:
        self._file.close()


def create(path: Path, options: SinkOptions) -> TableSink:
    return TableSink(path, ".arrow", ArrowRows, options)
