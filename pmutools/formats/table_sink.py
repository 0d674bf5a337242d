"""Streams into tables: one stream goes to OUT; when a second one comes, the tables lie side by side in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pmutools.c37118.batch import Batch, joined
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
"""What all tables together hold in memory after a flush, about, before it is written though it makes small groups."""
GATHERED_FRAMES = 256
"""Frames of a stream that become rows at once, where they need not be on the disk before."""


class TableWriter:
    """Writes Arrow record batches of one schema into an open file, which it does not close."""

    packed = False
    """Whether names may come dictionary-encoded, by dictionaries that grow."""
    at_once = True
    """Whether what is written can be read after a flush; if not, nothing is gained by small pieces."""
    restarts = False
    """Whether a file can go on with other columns."""
    held_bytes = 0
    """What is in memory only."""

    def __init__(self, file: OutputFile, schema: Any, options: SinkOptions) -> None:
        raise NotImplementedError

    def write(self, rows: Any) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def spill(self) -> None:
        """Write what is held in memory."""


class _Table:
    """One table being written; batches are gathered, to be made rows together."""

    def __init__(
        self, file: OutputFile, writer: TableWriter, to_rows: Callable[[Sequence[Batch]], Any], frames: int
    ) -> None:
        self.file, self._writer = file, writer
        self._to_rows, self._limit = to_rows, frames
        self._batches: list[Batch] = []
        self._frames = 0

    @property
    def held_bytes(self) -> int:
        """About."""
        gathered = self._frames * self._batches[0].config.frame_size * 6 if self._batches else 0
        return self._writer.held_bytes + gathered

    def add(self, batch: Batch) -> None:
        self._batches.append(batch)
        self._frames += len(batch)
        if self._frames >= self._limit:
            self._make_rows()

    def flush(self) -> None:
        if self._writer.at_once:
            self._make_rows()
        self.file.flush()

    def spill(self) -> None:
        self._make_rows()
        self._writer.spill()

    def finish(self) -> None:
        self._make_rows()
        self._writer.close()

    def _make_rows(self) -> None:
        batches, self._batches, self._frames = self._batches, [], 0
        if batches:
            self._writer.write(self._to_rows(batches))


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
        self._by_stream: dict[tuple[Flow, StreamConfig] | None, _Table] = {}
        self._first_name = ""
        self._folder = folder_for(path, suffix) if options.per_stream else None
        self._first_file = OutputFile(path) if self._folder is None else None
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
        key = None if options.long else (flow.ends, batch.config)
        table = self._by_stream.get(key)
        if table is None:
            table = self._by_stream[key] = self._begin(flow, batch.config)
            self._tables.append(table)
        table.add(batch)

    def flush(self) -> None:
        for table in self._tables:
            table.flush()
        if sum(table.held_bytes for table in self._tables) > HELD_BYTES:
            for table in self._tables:
                table.spill()

    def close(self) -> None:
        """Finish all tables; where there are none, the file or folder that was made for the first is taken away."""
        if self._closed:
            return
        self._closed = True
        failures: list[SourceError] = []
        for step in (*(table.finish for table in self._tables), *(table.file.close for table in self._tables)):
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

    def _begin(self, flow: Flow, config: StreamConfig) -> _Table:
        phasors, long, fields = self._options.phasors, self._options.long, self._options.fields
        file = self._next_file(flow, config)
        if long:
            form = LongRows(phasors, fields, packed=self._writer.packed)
            return _Table(file, self._writer(file, form.schema, self._options), form.rows, BLOCK_FRAMES)

        def to_rows(batches: Sequence[Batch]) -> Any:
            return wide_rows(joined(batches), phasors, fields)

        writer = self._writer(file, wide_schema(config, phasors, fields), self._options)
        return _Table(file, writer, to_rows, BLOCK_FRAMES if writer.at_once else GATHERED_FRAMES)

    def _next_file(self, flow: Flow, config: StreamConfig) -> OutputFile:
        """The file of a new table: OUT for the first; with the second, OUT moves into the folder."""
        name = self._names.unique(self._options.name(flow, config))
        if not self._tables and self._first_file is not None:
            self._first_name = name
            return self._first_file
        if self._path == STDOUT:
            return self._same_output(flow, config)
        if self._folder is None:
            self._folder = folder_for(self._path, self._names.suffix)
            self._tables[0].file.move(self._folder / self._first_name)
        return OutputFile(self._folder / name)

    def _same_output(self, flow: Flow, config: StreamConfig) -> OutputFile:
        """Standard output, where it can go on with what is another table: other columns of the one stream there is."""
        stream = flow._replace(connection=0), config.idcode
        if any(key is not None and (key[0], key[1].idcode) != stream for key in self._by_stream):
            raise SourceError("several streams cannot share standard output as tables; name a file, or use --long")
        if not self._writer.restarts:
            raise SourceError(
                "the columns have changed, and so cannot go on on standard output; name a file, or use --long"
            )
        self._tables[-1].flush()
        return self._tables[-1].file

    def _take_away(self) -> None:
        if self._first_file is not None:
            self._first_file.close()
            if self._path != STDOUT and self._path.is_file():
                self._path.unlink()
        elif self._folder is not None and not any(self._folder.iterdir()):
            self._folder.rmdir()
