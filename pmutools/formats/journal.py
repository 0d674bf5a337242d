"""``.journal``: frames as they came, kept beside a recording that cannot be read before it is finished.

One file for all streams, whatever the tables beside it hold: an Arrow stream whose rows are the frames of one flow that
came together (a :class:`~pmutools.flow.Train`, or a :class:`~pmutools.flow.Chunk`), configurations first. It is flushed
as it grows, and taken away when the recording is finished; so one that is there is what a killed writer has left.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, encode_batch
from pmutools.c37118.config import StreamConfig, encode_config, frames_in
from pmutools.c37118.demux import Message
from pmutools.errors import SourceError
from pmutools.flow import Chunk, Flow, Train
from pmutools.formats import JOURNAL
from pmutools.formats.output import OutputFile
from pmutools.formats.sink import Sink, Wants
from pmutools.formats.source import Block, ByteSource

_Row = tuple[str, str, str, int, int, bytes, bytes, int]


@cache
def _schema() -> Any:
    import pyarrow as pa

    return pa.schema(
        [
            ("transport", pa.string()),
            ("source", pa.string()),
            ("destination", pa.string()),
            ("connection", pa.int32()),
            ("size", pa.int32()),  # of a frame; data may hold several
            ("data", pa.binary()),
            ("arrival_ns", pa.binary()),  # int64, little-endian
            ("stamp_source", pa.int8()),
        ]
    )


class Journal:
    """Takes blocks, and writes them when it is flushed."""

    def __init__(self, path: Path) -> None:
        import pyarrow as pa

        self._file = OutputFile(path)
        self._stream: Any = pa.ipc.new_stream(self._file, _schema())
        self._shown: dict[tuple[Flow, int], tuple[Flow, StreamConfig]] = {}
        self._rows: list[_Row] = []

    @property
    def path(self) -> Path:
        return self._file.final_path

    def add(self, block: Block) -> None:
        flow, batch = block
        key = flow.ends, batch.config.idcode
        if self._shown.get(key) != (flow, batch.config):
            self._shown[key] = flow, batch.config
            arrival = batch.arrival_ns[:1].astype("<i8").tobytes()
            for frame in frames_in(encode_config(batch.config)):
                self._rows.append((*flow, len(frame), frame, arrival, int(batch.stamp_source[0])))
        size, sources = batch.config.frame_size, batch.stamp_source
        octets = (batch.wire if batch.wire is not None else encode_batch(batch)[0]).tobytes()
        arrivals = batch.arrival_ns.astype("<i8").tobytes()
        cuts = np.flatnonzero(sources[1:] != sources[:-1]) + 1
        for first, end in zip([0, *cuts.tolist()], [*cuts.tolist(), len(batch)], strict=True):
            frames = octets[first * size : end * size]
            self._rows.append((*flow, size, frames, arrivals[first * 8 : end * 8], int(sources[first])))

    def flush(self) -> None:
        import pyarrow as pa

        rows, self._rows = self._rows, []
        if rows:
            schema = _schema()
            columns = [
                pa.array(values, each.type) for each, values in zip(schema, zip(*rows, strict=True), strict=True)
            ]
            self._stream.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
        self._file.flush()

    def move(self, folder: Path) -> None:
        """Go on in another folder."""
        self._file.move(folder / self.path.name)

    def close(self) -> None:
        self._file.close()

    def discard(self) -> None:
        """The recording is finished."""
        self._file.close()
        self._file.path.unlink(missing_ok=True)


class JournalledSink:
    """A sink of blocks with a journal beside it until it is closed; where closing fails, the journal stays."""

    wants: Wants = "blocks"

    def __init__(self, sink: Sink, path: Path) -> None:
        self._sink = sink
        self._journal = Journal(path.with_name(path.name + JOURNAL))
        self._folder = path.parent
        self._closed = False

    @property
    def paths(self) -> list[Path]:
        return self._sink.paths

    def write(self, item: Message | Block) -> None:
        self._sink.write(item)
        if isinstance(item, Block) and len(item.batch):
            self._journal.add(item)

    def flush(self) -> None:
        self._journal.flush()
        self._sink.flush()
        paths = self._sink.paths
        if paths and paths[0].parent != self._folder:  # a second stream has come: the tables lie in a folder now
            self._folder = paths[0].parent
            self._journal.move(self._folder)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            self._sink.close()
        except SourceError:
            self._journal.close()
            raise
        self._journal.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read(path: Path, configs: Iterable[StreamConfig] = ()) -> ByteSource:
    """Open a journal, up to where it was cut."""
    import pyarrow as pa

    from pmutools.formats.table import reading

    with reading(path, "journal"):
        file = pa.OSFile(str(path))
        stream = pa.ipc.open_stream(file)
    if stream.schema.names != _schema().names:
        raise SourceError(f"{path} is no journal of frames; name another file")

    def pieces() -> Iterator[Chunk | Train]:
        with file:
            try:
                for part in stream:
                    yield from map(_piece, part.to_pylist())
            except (OSError, ValueError, pa.ArrowException):
                return

    def chunks() -> Iterator[Chunk]:
        for piece in pieces():
            yield from piece.chunks() if isinstance(piece, Train) else (piece,)

    return ByteSource(path, "journal", chunks(), lambda: {"recording without an end": 1}, configs, pieces())


def _piece(row: dict[str, Any]) -> Chunk | Train:
    flow = Flow(row["transport"], row["source"], row["destination"], row["connection"])
    source = STAMP_SOURCES[row["stamp_source"]]
    arrivals = [None if each == NO_TIME else each for each in np.frombuffer(row["arrival_ns"], "<i8").tolist()]
    if len(arrivals) == 1:
        return Chunk(row["data"], arrivals[0], flow, source)
    return Train(row["data"], row["size"], arrivals, flow, source)
