"""An MCAP log of protobuf messages, readable to its last flush whatever happens to the process or the disk."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import IO

import pmutools
from pmutools.errors import SourceError
from pmutools.schema.descriptors import file_descriptor_set, full_name
from pmutools.schema.mcap_parts import OpenChunk, Summary, serialised
from pmutools.schema.mcap_records import FOOTER, MAGIC, RECORD_HEAD, Op
from pmutools.timebase import NS

CHUNK_NS = NS
"""A chunk, the unit of compression and of loss, spans this much of the log's own time ..."""
CHUNK_BYTES = 4 << 20
"""... and at most this many bytes before compression, which bounds the memory of writer and reader."""

DEFINED_EVERY = 10
"""The second chunk and every chunk of this number repeat all schemas and channels (about 1.5 kB), as MCAP allows: what
is left of a log without its end can be read, whichever chunk is lost."""


class LogWriter:
    """Writes one MCAP file (zstd chunks with CRC, embedded schemas, index at the end); a context manager.

    ``target`` is a path, or a seekable binary stream, which stays open. Every method raises SourceError, one line,
    where the system refuses to write; the log then ends with its last whole record, takes nothing more, and what was
    flushed stays readable.
    """

    def __init__(self, target: str | os.PathLike[str] | IO[bytes]) -> None:
        from mcap.records import Header

        self._closed = False
        self._failure: SourceError | None = None
        self._chunk_start_ns: int | None = None
        self._chunk = OpenChunk()
        self._summary = Summary()
        self._owned = isinstance(target, (str, os.PathLike))
        self.name = str(target) if self._owned else str(getattr(target, "name", "log"))
        self.size = 0
        """Bytes written so far; the open chunk is not among them."""
        self._stream: IO[bytes] | None = None
        with self._writing():
            # unbuffered: what a full disk refuses is refused here and now
            self._stream = (
                open(target, "wb", buffering=0) if isinstance(target, (str, os.PathLike)) else target  # noqa: SIM115
            )
            self._put(MAGIC + serialised(Header("", f"pmutools {pmutools.__version__}")))

    def channel(self, topic: str, message: str, metadata: Mapping[str, str] | None = None) -> int:
        """Announce a topic that carries ``message`` (a name of the table); returns the number that `write` takes."""
        if self._failure is not None:
            raise self._failure
        schema, announced = self._summary.schema(full_name(message), file_descriptor_set())
        number, described = self._summary.channel(topic, schema, dict(metadata or {}))
        self._chunk.define(announced + described)
        return number

    def write(self, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add a serialised message to the open chunk. Times before 1970 become 0: MCAP has no others."""
        if self._failure is not None:
            raise self._failure
        if self._chunk_start_ns is None:
            self._chunk_start_ns = log_time_ns
        self._chunk.add(channel, max(log_time_ns, 0), max(publish_time_ns, 0), data)
        if self._chunk.size > CHUNK_BYTES:
            self._end_chunk()

    def boundary(self, now_ns: int) -> None:
        """Say that nothing written later belongs to what was written before; flushes once a second of log time."""
        # a clock set back must not put the flush off
        if self._chunk_start_ns is not None and abs(now_ns - self._chunk_start_ns) >= CHUNK_NS:
            self.flush()

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system: a process killed later loses none of it."""
        self._chunk_start_ns = None
        self._end_chunk()
        with self._writing() as stream:
            stream.flush()

    def attach(self, name: str, data: bytes, time_ns: int = 0, media_type: str = "application/octet-stream") -> None:
        """Attach a file; ``time_ns`` 0 where it has none. Ends the chunk: order in the file is order in time."""
        self.flush()
        record = self._summary.attachment(self.size, name, media_type, max(time_ns, 0), data)
        with self._writing():
            self._put(record)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self.flush()
        record = self._summary.metadata(self.size, name, dict(values))
        with self._writing():
            self._put(record)

    def close(self) -> None:
        """Write the index and close; does nothing the second time, or after a failure that was already raised."""
        if self._closed:
            return
        self.flush()
        with self._writing() as stream:
            self._put(self._summary.end(self.size) + MAGIC)
            stream.flush()
        self._release()

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _end_chunk(self) -> None:
        if not self._chunk.messages:
            return
        chunk, self._chunk = self._chunk, OpenChunk()
        record, index = self._summary.chunk(self.size, chunk)
        if self._summary.chunks == 1 or self._summary.chunks % DEFINED_EVERY == 0:
            self._chunk.define(self._summary.definitions())
        with self._writing():
            self._put(record + index)  # both or neither: what is counted as lost is not in the file

    def _put(self, record: bytes) -> None:
        """Write all of ``record``, or leave the file as it was."""
        assert self._stream is not None
        left = memoryview(record)
        try:
            while left:
                left = left[self._stream.write(left) :]
        except OSError:
            with contextlib.suppress(OSError):
                self._stream.seek(self.size)
                self._stream.truncate()
            raise
        self.size += len(record)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[IO[bytes]]:
        if self._failure is not None:
            raise self._failure
        try:
            yield self._stream  # type: ignore[misc]  # only before it is open is it None
        except OSError as error:
            raise self._failed(error) from None

    def _failed(self, error: OSError) -> SourceError:
        self._failure = SourceError(f"{self.name}: cannot write: {error.strerror or error}")
        with contextlib.suppress(OSError):
            self._release()
        return self._failure

    def _release(self) -> None:
        self._closed = True
        if self._owned and self._stream is not None:
            self._stream.close()


def seal(path: str | os.PathLike[str], size: int) -> None:
    """End a log whose writer died after its first ``size`` bytes, without an index; what follows them is cut off.

    Raises OSError where that cannot be done, ValueError where the file is shorter.
    """
    from mcap.records import DataEnd

    end = serialised(DataEnd(0)) + FOOTER.pack(Op.FOOTER, FOOTER.size - RECORD_HEAD.size, 0, 0, 0) + MAGIC
    with open(path, "r+b") as file:
        if file.seek(0, os.SEEK_END) < size:
            raise ValueError(f"{path}: shorter than {size} bytes")
        file.truncate(size)
        file.seek(size)
        file.write(end)
