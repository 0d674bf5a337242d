"""A file read block by block, through gzip or zstd, as one sliding window of bytes.

Memory is bounded by what the caller asks to see (:meth:`Window.advance`) plus one block of :data:`BLOCK` bytes;
a hostile .zst can blow one 1 KiB piece up to 32 MiB.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from pmutools.errors import SourceError

BLOCK = 1 << 20
_ZSTD_PIECE = 1 << 10

GZIP_MAGIC = b"\x1f\x8b"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class Window:
    """A sliding view (``data``) of the file's decompressed bytes. Use as a context manager.

    Raises :class:`SourceError` if the file cannot be opened or read. A damaged or cut compression layer ends the
    data early and sets ``failed``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = b""
        self.ended = False
        """The file has no byte beyond ``data``."""
        self.failed = False
        self.total = 0
        """Bytes that have been in ``data`` so far."""
        try:
            self._file = path.open("rb")
            self.size = path.stat().st_size
        except OSError as error:
            raise SourceError(f"cannot open {path}: {error.strerror}; check the path") from error
        self._pieces = self._decompressed()

    def __enter__(self) -> Window:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    @property
    def position(self) -> int:
        """Bytes of the (compressed) file read so far, of ``size``."""
        return self.size if self._file.closed else self._file.tell()

    def advance(self, drop: int, need: int) -> None:
        """Forget the first ``drop`` bytes of ``data``, then read until it holds ``need`` bytes or all that is left."""
        pieces = [self.data[drop:]]
        have = len(pieces[0])
        while have < need and not self.ended:
            piece = self._next_piece()
            self.ended = not piece
            have += len(piece)
            self.total += len(piece)
            pieces.append(piece)
        self.data = b"".join(pieces)

    def _next_piece(self) -> bytes:
        try:
            return next(self._pieces, b"")
        except (EOFError, zlib.error, gzip.BadGzipFile):
            self.failed = True
            return b""
        except OSError as error:
            raise SourceError(f"cannot read {self.path}: {error.strerror}; copy the file anew") from error

    def _decompressed(self) -> Iterator[bytes]:
        magic = self._file.peek(4)[:4]
        if magic[:2] == GZIP_MAGIC:
            inflated = gzip.GzipFile(fileobj=self._file)
            return iter(lambda: inflated.read1(BLOCK), b"")
        if magic == ZSTD_MAGIC:
            return _unzstd(self._file)
        return iter(lambda: self._file.read(BLOCK), b"")


def _unzstd(file: BinaryIO) -> Iterator[bytes]:
    """The frames of a .zst one after the other; raises EOFError where the last is cut or one is damaged.

    zstandard's own stream reader ends silently at a cut, so the frames are followed here.
    """
    import zstandard

    frame = zstandard.ZstdDecompressor().decompressobj()
    fed = False
    while compressed := file.read(_ZSTD_PIECE):
        while compressed:
            try:
                piece = frame.decompress(compressed)
            except zstandard.ZstdError as error:
                raise EOFError(str(error)) from error
            fed = not frame.eof
            compressed = frame.unused_data if frame.eof else b""
            if frame.eof:
                frame = zstandard.ZstdDecompressor().decompressobj()
            if piece:
                yield piece
    if fed:
        raise EOFError("the last zstd frame is cut")
