"""``.c37118``, ``.PmuCapture``: frames end to end, nothing between. No arrival times; ``.gz`` and ``.zst`` allowed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.flow import Chunk, Flow
from pmutools.formats.capture.window import Window
from pmutools.formats.output import OutputFile
from pmutools.formats.sink import FrameSink, SinkOptions
from pmutools.formats.source import ByteSource


class _Chunks:
    """The file as one flow, a block of about 1 MiB at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.failed = False

    def __iter__(self) -> Iterator[Chunk]:
        flow = Flow("file", self.path.name)
        with Window(self.path) as window:
            window.advance(0, 1)
            while window.data:
                yield Chunk(window.data, None, flow)
                window.advance(len(window.data), 1)
            self.failed = window.failed

    def defects(self) -> dict[str, int]:
        return {"compression damaged": 1} if self.failed else {}


def read(path: Path, configs: Iterable[StreamConfig] = ()) -> ByteSource:
    """Open a file of frames; ``configs`` are for those it has no configuration of."""
    chunks = _Chunks(path)
    return ByteSource(path, "raw", chunks, chunks.defects, configs)


class RawSink(FrameSink):
    """Writes every frame as it is; skipped bytes, flows and arrivals have no place in the file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = OutputFile(path)

    def put(self, message: Message) -> None:
        self._file.write(message.frame.data)

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def create(path: Path, options: SinkOptions) -> RawSink:
    """Begin a file of frames."""
    return RawSink(path)
