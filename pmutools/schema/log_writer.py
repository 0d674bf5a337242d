"""An MCAP log of protobuf messages, readable to its last flush whatever happens to the process or the disk."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import IO, Any

import pmutools
from pmutools.errors import SourceError
from pmutools.schema.descriptors import file_descriptor_set, full_name
from pmutools.timebase import NS

CHUNK_NS = NS
"""A chunk, the unit of compression and of loss, spans this much of the log's own time ..."""
CHUNK_BYTES = 4 << 20
"""... and at most this many bytes before compression, which bounds the memory of writer and reader."""


class LogWriter:
    """Writes one MCAP file (zstd chunks with CRC, embedded schemas, index at the end); a context manager.

    ``target`` is a path, or a seekable binary stream, which stays open. Every method raises SourceError, one line,
    where the system refuses to write; the log then takes nothing more, and what was flushed stays readable.
    """

    def __init__(self, target: str | os.PathLike[str] | IO[bytes]) -> None:
        from mcap.writer import CompressionType, Writer

        self._closed = False
        self._failure: SourceError | None = None
        self._chunk_start_ns: int | None = None
        self._schemas: dict[str, int] = {}
        self._owned = isinstance(target, (str, os.PathLike))
        self.name = str(target) if self._owned else str(getattr(target, "name", "log"))
        self._stream: IO[bytes] | None = None
        with self._writing():
            self._stream = open(target, "wb") if isinstance(target, (str, os.PathLike)) else target  # noqa: SIM115
            self._mcap: Any = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._mcap.start(library=f"pmutools {pmutools.__version__}")

    def channel(self, topic: str, message: str, metadata: Mapping[str, str] | None = None) -> int:
        """Announce a topic that carries ``message`` (a name of the table); returns the number that `write` takes."""
        with self._writing():
            if message not in self._schemas:
                schema = self._mcap.register_schema(full_name(message), "protobuf", file_descriptor_set())
                self._schemas[message] = schema
            return int(self._mcap.register_channel(topic, "protobuf", self._schemas[message], dict(metadata or {})))

    def write(self, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add a serialised message to the open chunk. Times before 1970 become 0: MCAP has no others."""
        if self._failure is not None:
            raise self._failure
        if self._chunk_start_ns is None:
            self._chunk_start_ns = log_time_ns
        try:
            self._mcap.add_message(channel, max(log_time_ns, 0), data, max(publish_time_ns, 0))
        except OSError as error:
            raise self._failed(error) from None

    def checkpoint(self, now_ns: int) -> None:
        """Say that nothing written later belongs to what was written before; flushes once a second of log time."""
        # a clock set back must not put the flush off
        if self._chunk_start_ns is not None and abs(now_ns - self._chunk_start_ns) >= CHUNK_NS:
            self.flush()

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system: a process killed later loses none of it."""
        self._chunk_start_ns = None
        with self._writing():
            self._mcap.flush()

    def attach(self, name: str, data: bytes, time_ns: int = 0, media_type: str = "application/octet-stream") -> None:
        """Attach a file; ``time_ns`` 0 where it has none. Ends the chunk: order in the file is order in time."""
        self.flush()
        with self._writing():
            self._mcap.add_attachment(max(time_ns, 0), max(time_ns, 0), name, media_type, data)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self.flush()
        with self._writing():
            self._mcap.add_metadata(name, dict(values))

    def close(self) -> None:
        """Write the index and close; does nothing the second time, or after a failure that was already raised."""
        if self._closed:
            return
        with self._writing():
            self._mcap.finish()
            if self._stream is not None:
                self._stream.flush()
        self._release()

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except OSError as error:
            raise self._failed(error) from None

    def _failed(self, error: OSError) -> SourceError:
        self._failure = SourceError(f"{self.name}: cannot write: {error.strerror or error}")
        with contextlib.suppress(OSError):  # closing tries to write what is buffered, and fails as before
            self._release()
        return self._failure

    def _release(self) -> None:
        self._closed = True
        if self._owned and self._stream is not None:
            self._stream.close()
