"""Who gets which stream: the side of sending that knows neither commands nor sockets."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Protocol

from pmutools.flow import Segmentation


class Sink(Protocol):
    """Takes the frames of the streams that it was given."""

    def put(self, frame: bytes, mark: int, now_ns: int, write: Segmentation | None = None) -> bool:
        """Take a frame, the one at ``mark`` in what is published; false if it was dropped at once.

        ``write`` says how it goes into a byte stream, where not whole and at once.
        """


class Audience:
    """Who gets which stream, by the stream's handle. A sink that several clients share gets each frame once."""

    def __init__(self) -> None:
        self.sinks: list[list[Sink]] = []
        self.version = 0
        """Counts the changes."""
        self._shares: dict[tuple[int, Hashable], tuple[Sink, set[Hashable]]] = {}

    def add(self, handle: int, sink: Sink) -> None:
        """From now on ``sink`` gets the stream."""
        self.sinks[handle].append(sink)
        self.version += 1

    def start(self, handle: int, key: Hashable, client: Hashable, make: Callable[[], Sink]) -> None:
        """``client`` wants the stream at the sink called ``key``, which ``make`` makes for the first who does."""
        share = self._shares.get((handle, key))
        if share is None:
            share = self._shares[handle, key] = (make(), set())
            self.add(handle, share[0])
        share[1].add(client)

    def stop(self, handle: int, key: Hashable, client: Hashable) -> None:
        share = self._shares.get((handle, key))
        if share is None:
            return
        share[1].discard(client)
        if not share[1]:
            del self._shares[handle, key]
            self.sinks[handle].remove(share[0])
            self.version += 1
