"""Streams into tables: one stream goes to OUT; when a second one comes, the tables lie side by side in a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from pmutools.c37118.batch import Batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.errors import SourceError
from pmutools.flow import Flow
from pmutools.formats.naming import FileNames, folder_for
from pmutools.formats.output import STDOUT, OutputFile
from pmutools.formats.sink import SinkOptions, Wants
from pmutools.formats.source import BLOCK_FRAMES, Block
from pmutools.formats.table_rows import LongRows, has_columns, wide_rows, wide_schema

HELD_BYTES = 256 << 20
"""What all tables together hold in memory between two flushes, before it is written though it makes small groups."""


class TableWriter:
    """Writes Arrow record batches of one schema into an open file, which it does not close."""

    packed = False
    """Whether names may come dictionary-encoded, by dictionaries that grow."""
    held_bytes = 0
    """What is in memory only."""

    def __init__(self, file: OutputFile, schema: Any, options: SinkOptions) -> None:
        raise NotImplementedError

    def write(self, rows: Any) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def flush(self) -> None:
        """Make readable what the file itself does not; it is flushed by then."""

    def spill(self) -> None:
        """Write what is held in memory."""

    def moved(self) -> None:
        """The file has another name now."""


class _Table(NamedTuple):
    file: OutputFile
    writer: TableWriter


class TableSink:
    """One table a stream and configuration, all of one format. Memory and open files: one table's for each stream.

    The first stream is written to ``path``. When a second one appears (another flow, IDCODE or configuration), a folder
    is made, named as ``path`` without its suffix (``-2``, ``-3`` ... after it where that holds something already), and
    the tables lie in it as STATION-IDCODE with the suffix; with ``per_stream`` from the first on. Connections between
    the same two endpoints are one stream. A stream that has none of the fields wanted is left out.
    """

    wants: Wants = "blocks"

    def __init__(self, path: Path, suffix: str, writer: type[TableWriter], options: SinkOptions) -> None:
        self._path, self._writer, self._options = path, writer, options
        self._names = FileNames(suffix)
        self._tables: list[_Table] = []
        self._by_stream: dict[tuple[Flow, StreamConfig], TableWriter] = {}
        self._first_name = ""
        self._folder = folder_for(path, suffix) if options.per_stream else None
        self._first_file = OutputFile(path) if self._folder is None else None
        self._long = LongRows(options.phasors, options.fields, packed=writer.packed) if options.long else None
        self._gathered: list[Batch] = []
        self._gathered_frames = 0
        self._closed = False

    @property
    def paths(self) -> list[Path]:
        return [table.file.final_path for table in self._tables]

    def write(self, item: Message | Block) -> None:
        if isinstance(item, Message) or not len(item.batch):
            return
        flow, batch = item
        options = self._options
        if options.fields is not None and not has_columns(batch.config, options.phasors, options.fields):
            return
        if self._long is not None:
            self._gathered.append(batch)
            self._gathered_frames += len(batch)
            if self._gathered_frames >= BLOCK_FRAMES:
                self._write_gathered()
            return
        key = flow._replace(connection=0), batch.config
        writer = self._by_stream.get(key)
        if writer is None:
            schema = wide_schema(batch.config, options.phasors, options.fields)
            writer = self._by_stream[key] = self._begin(self._next_file(flow, batch.config), schema)
        writer.write(wide_rows(batch, options.phasors, options.fields))

    def flush(self) -> None:
        self._write_gathered()
        if sum(table.writer.held_bytes for table in self._tables) > HELD_BYTES:
            for table in self._tables:
                table.writer.spill()
        for file, writer in self._tables:
            file.flush()
            writer.flush()

    def close(self) -> None:
        """Finish all tables; where there are none, the file or folder that was made for the first is taken away."""
        if self._closed:
            return
        self._closed = True
        failures: list[SourceError] = []
        for step in self._last_steps():
            try:
                step()
            except SourceError as error:
                failures.append(error)
        if not self._tables:
            self._take_away()
        if failures:
            raise failures[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _last_steps(self) -> Iterator[Callable[[], None]]:
        yield self._write_gathered
        yield from (table.writer.close for table in self._tables)
        yield from (table.file.close for table in self._tables)

    def _write_gathered(self) -> None:
        batches, self._gathered, self._gathered_frames = self._gathered, [], 0
        if not batches or self._long is None:
            return
        if not self._tables:
            assert self._first_file is not None
            self._begin(self._first_file, self._long.schema)
        self._tables[0].writer.write(self._long.rows(batches))

    def _begin(self, file: OutputFile, schema: Any) -> TableWriter:
        table = _Table(file, self._writer(file, schema, self._options))
        self._tables.append(table)
        return table.writer

    def _next_file(self, flow: Flow, config: StreamConfig) -> OutputFile:
        """The file of a new table: OUT for the first; with the second, OUT moves into the folder."""
        name = self._names.unique(self._options.name(flow, config))
        if not self._tables and self._first_file is not None:
            self._first_name = name
            return self._first_file
        if self._path == STDOUT:
            raise SourceError("several streams cannot share standard output as tables; name a file, or use --long")
        if self._folder is None:
            self._folder = folder_for(self._path, self._names.suffix)
            first = self._tables[0]
            first.file.move(self._folder / self._first_name)
            first.writer.moved()
        return OutputFile(self._folder / name)

    def _take_away(self) -> None:
        if self._first_file is not None:
            self._first_file.close()
            if self._path != STDOUT and self._path.is_file():
                self._path.unlink()
        elif self._folder is not None and not any(self._folder.iterdir()):
            self._folder.rmdir()
