"""A file being written: compressed or not, cut by nothing but its end.

What is on the disk ends where a write ended, at all times: bytes are handed on a whole flush at a time, and what a full
disk refuses is taken away again. So a reader that is killed, or runs out of space, leaves no half row.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Protocol

from pmutools.errors import SourceError

STDOUT = Path("-")
HELD_BYTES = 1 << 20
"""What is written without a flush waits in memory, up to this."""
_REMEDIES = {
    errno.EMFILE: "use --long, or allow more open files (ulimit -n)",
    errno.ENFILE: "use --long, or allow more open files",
    errno.ENOSPC: "make space, or write to another disk",
    errno.EDQUOT: "make space, or write to another disk",
}


def cannot_write(path: Path, error: OSError) -> SourceError:
    """The error of a file that the system refuses to write."""
    remedy = _REMEDIES.get(error.errno or 0, "check the folder and its rights")
    return SourceError(f"cannot write {path}: {error.strerror or error}; {remedy}")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Where to write a file that is to be there whole or not at all: beside ``path``, which it becomes at the end.

    The name has the same suffix. What is no regular file (a pipe, ``/dev/stdout``) is written as it stands, and a link
    stays one. OSErrors are the caller's to word.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    target = Path(os.path.realpath(path))
    part = target.with_name(f".part.{target.name}")
    try:
        yield part
        os.replace(part, target)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


class OutputFile(io.RawIOBase):
    """A file being written, compressed where its name ends in ``.gz`` or ``.zst``; ``-`` is standard output.

    The same content gives the same bytes. What was flushed can be read, whatever happens to the process or the disk.
    After an error it takes nothing more, and raises the same one again.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.nbytes = 0
        """Bytes in the file, as it is on the disk."""
        self._moves_to: Path | None = None
        self._given = 0
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0
        self._failure: SourceError | None = None
        self._packer = _packer(path.suffix.lower())
        with self._failing():
            self._raw: IO[bytes] = sys.stdout.buffer if path == STDOUT else path.open("wb", buffering=0)

    @property
    def final_path(self) -> Path:
        """Where the file is once it is closed."""
        return self._moves_to or self.path

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        if self._failure is not None:
            raise self._failure
        copy = bytes(data)
        self._waiting.append(copy)
        self._waiting_bytes += len(copy)
        self._given += len(copy)
        if self._waiting_bytes >= HELD_BYTES:
            self._hand_on()
        return len(copy)

    def tell(self) -> int:
        return self._given

    def flush(self) -> None:
        if self.closed or self._failure is not None:
            return
        self._hand_on()

    def close(self) -> None:
        """Hand on what is left and close the file; quiet where writing had failed before."""
        if self.closed:
            return
        failed = self._failure is not None
        try:
            super().close()  # which flushes
            if self._packer is not None and self._failure is None:
                self._put(self._packer.flush())
        finally:
            if self.path != STDOUT:
                with contextlib.nullcontext() if failed else self._failing():
                    self._raw.close()
        if self._moves_to is not None:
            with self._failing():
                os.replace(self.path, self._moves_to)
                self.path = self._moves_to

    def move(self, path: Path) -> None:
        """Give the file, which goes on being written, another name; where the system refuses that, at the end."""
        with self._failing():
            try:
                os.replace(self.path, path)
                self.path = path
            except PermissionError:  # Windows, while the file is open
                self._moves_to = path

    def _hand_on(self) -> None:
        if not self._waiting:
            return
        data = b"".join(self._waiting)
        self._waiting, self._waiting_bytes = [], 0
        self._put(data if self._packer is None else self._packer.compress(data) + self._packer.sync())

    def _put(self, data: bytes) -> None:
        """All of ``data``, or none of it."""
        try:
            with self._failing():
                rest = memoryview(data)
                while rest:
                    rest = rest[self._raw.write(rest) :]
                if self.path == STDOUT:
                    self._raw.flush()
        except SourceError:
            with contextlib.suppress(OSError):
                self._raw.truncate(self.nbytes)
            raise
        self.nbytes += len(data)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if self.path == STDOUT and isinstance(error, BrokenPipeError):  # its reader has seen enough
                raise
            self._failure = cannot_write(self.path, error)
            raise self._failure from None


class _Packer(Protocol):
    def compress(self, data: bytes) -> bytes: ...
    def sync(self) -> bytes:
        """What makes all that was given readable."""

    def flush(self) -> bytes:
        """The end."""


def _packer(suffix: str) -> _Packer | None:
    match suffix:
        case ".gz":
            return _Gzip()
        case ".zst":
            return _Zstd()
    return None


class _Gzip:
    """A gzip member without a name or a time."""

    def __init__(self) -> None:
        self._deflate = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        self.compress, self.flush = self._deflate.compress, self._deflate.flush

    def sync(self) -> bytes:
        return self._deflate.flush(zlib.Z_SYNC_FLUSH)


class _Zstd:
    """A zstd frame."""

    def __init__(self) -> None:
        import zstandard

        self._frame = zstandard.ZstdCompressor().compressobj()
        self.compress, self.flush = self._frame.compress, self._frame.flush
        self._block = zstandard.COMPRESSOBJ_FLUSH_BLOCK

    def sync(self) -> bytes:
        return self._frame.flush(self._block)
