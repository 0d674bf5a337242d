"""Frames into one file a stream, side by side in a folder; tables do this by themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.errors import SourceError
from pmutools.flow import Flow
from pmutools.formats.naming import FileNames, folder_for
from pmutools.formats.sink import FrameSink, Sink, SinkOptions

_Key = tuple[Flow, int]
EARLY = 64
"""Messages of a stream that wait for the configuration which names its file."""


class PerStreamSink(FrameSink):
    """One file for each flow and IDCODE. Connections between the same two endpoints are one stream.

    A stream without a configuration is called by its IDCODE.
    """

    def __init__(
        self, path: Path, suffix: str, create: Callable[[Path, SinkOptions], Sink], options: SinkOptions
    ) -> None:
        self._folder = folder_for(path, suffix)
        super().__init__(self._folder)
        self.paths = []
        self._create, self._options = create, options
        self._names = FileNames(suffix)
        self._sinks: dict[_Key, Sink] = {}
        self._early: dict[_Key, list[Message]] = {}
        self._closed = False

    def put(self, message: Message) -> None:
        key = message.flow.ends, message.frame.idcode
        sink = self._sinks.get(key)
        if sink is None:
            early = self._early.setdefault(key, [])
            early.append(message)
            if message.config is not None or len(early) >= EARLY:
                self._begin(key, message.config)
            return
        sink.write(message)

    def flush(self) -> None:
        for sink in self._sinks.values():
            sink.flush()

    def close(self) -> None:
        """Finish all files; the folder goes if there are none."""
        if self._closed:
            return
        self._closed = True
        failures: list[SourceError] = []
        for key in list(self._early):
            self._begin(key, None)
        for sink in self._sinks.values():
            try:
                sink.close()
            except SourceError as error:
                failures.append(error)
        if not self._sinks and not any(self._folder.iterdir()):
            self._folder.rmdir()
        if failures:
            raise failures[0]

    def _begin(self, key: _Key, config: StreamConfig | None) -> None:
        stem = f"stream-{key[1]}" if config is None else self._options.name(key[0], config)
        path = self._folder / self._names.unique(stem)
        sink = self._sinks[key] = self._create(path, self._options)
        self.paths.append(path)
        for message in self._early.pop(key):
            sink.write(message)
