"""Streams into tables: one stream goes to OUT; when a second one comes, the tables lie side by side in a folder."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.errors import SourceError
from pmutools.flow import Flow
from pmutools.formats.output import STDOUT, OutputFile
from pmutools.formats.sink import SinkOptions, Wants
from pmutools.formats.source import Block
from pmutools.formats.table import long_rows, long_schema, wide_rows, wide_schema

_Key = tuple[Flow, StreamConfig] | None
"""What tells one table from another; None for the one table in long form."""


class TableWriter(Protocol):
    """Writes Arrow record batches of one schema into an open file, which it does not close."""

    def write(self, rows: Any) -> None: ...
    def flush(self) -> None: ...
    def close(self) -> None: ...


class TableSink:
    """One table a stream and configuration, all of one format. Memory and open files: one table's for each stream.

    The first stream is written to ``path``. When a second one appears (another flow, IDCODE or configuration), a folder
    is made, named as ``path`` without its suffix (``-2``, ``-3`` ... after it where that holds something already), and
    the tables lie in it as STATION-IDCODE with the suffix. Connections between the same two endpoints are one stream.
    """

    wants: Wants = "blocks"

    def __init__(
        self, path: Path, suffix: str, writer: Callable[[OutputFile, Any], TableWriter], options: SinkOptions
    ) -> None:
        self._path, self._suffix, self._writer, self._options = path, suffix, writer, options
        self._files = [OutputFile(path)]
        self._writers: dict[_Key, TableWriter] = {}
        self._first_config: StreamConfig | None = None
        self._folder: Path | None = None
        self._closed = False

    @property
    def paths(self) -> list[Path]:
        return [file.final_path for file in self._files] if self._writers else []

    def write(self, item: Message | Block) -> None:
        if isinstance(item, Message) or not len(item.batch):
            return
        flow, batch = item
        phasors, config = self._options.phasors, batch.config
        if self._options.long:
            key, to_rows = None, long_rows
        else:
            key, to_rows = (flow._replace(connection=0), config), wide_rows
        writer = self._writers.get(key)
        if writer is None:
            schema = long_schema() if self._options.long else wide_schema(config, phasors)
            writer = self._writers[key] = self._writer(self._next_file(config), schema)
        writer.write(to_rows(batch, phasors))

    def flush(self) -> None:
        for writer, file in zip(self._writers.values(), self._files, strict=False):
            writer.flush()
            file.flush()

    def close(self) -> None:
        """Finish all tables; where there are none, the file that was opened for the first is taken away."""
        if self._closed:
            return
        self._closed = True
        failures: list[SourceError] = []
        for close in [writer.close for writer in self._writers.values()] + [file.close for file in self._files]:
            try:
                close()
            except SourceError as error:
                failures.append(error)
        if not self._writers and self._path != STDOUT and self._path.is_file():
            self._path.unlink()
        if failures:
            raise failures[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _next_file(self, config: StreamConfig) -> OutputFile:
        """The file of a new table: OUT for the first; with the second, OUT moves into the folder."""
        if self._first_config is None:
            self._first_config = config
            return self._files[0]
        if self._path == STDOUT:
            raise SourceError("several streams cannot share standard output as tables; name a file, or use --long")
        if self._folder is None:
            self._folder = _new_folder(self._path.with_name(self._path.name[: -len(self._suffix)]))
            self._files[0].move(self._folder / self._file_name(self._first_config))
        file = OutputFile(self._folder / self._file_name(config))
        self._files.append(file)
        return file

    def _file_name(self, config: StreamConfig) -> str:
        station = config.stations[0].name if config.stations else ""
        safe = re.sub(r"[^\w.+-]+", "_", station).strip("._") or "stream"
        stem = f"{safe}-{config.idcode}"
        taken = {file.final_path.name.casefold() for file in self._files}
        name, count = stem + self._suffix, 1
        while name.casefold() in taken:
            count += 1
            name = f"{stem}-{count}{self._suffix}"
        return name


def _new_folder(wanted: Path) -> Path:
    """``wanted``, made; or ``wanted-2``, ``wanted-3`` ... where that is a file, or a folder that holds something."""
    folder, count = wanted, 1
    try:
        while folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            count += 1
            folder = wanted.with_name(f"{wanted.name}-{count}")
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise SourceError(
            f"cannot make the folder {folder}: {error.strerror}; check the place and its rights"
        ) from None
    return folder
