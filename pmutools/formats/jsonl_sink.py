"""The objects of ``pmu dump --json``, one a line, written."""

from __future__ import annotations

import json
from pathlib import Path

from pmutools.c37118.demux import Message
from pmutools.formats.describe import describe
from pmutools.formats.output import OutputFile
from pmutools.formats.sink import FrameSink, SinkOptions


class JsonSink(FrameSink):
    """Writes every frame as an object, NaN as null."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = OutputFile(path)
        self._encode = json.JSONEncoder(separators=(",", ":")).encode

    def put(self, message: Message) -> None:
        self._file.write(f"{self._encode(describe(message))}\n".encode())

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def create(path: Path, options: SinkOptions) -> JsonSink:
    """Begin a file of objects."""
    return JsonSink(path)
