"""Who gets which stream, and over which socket: the side of sending that knows nothing of commands."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Protocol

from pmutools.flow import Segmentation
from pmutools.net.udp import Target, UdpSocket


class Sink(Protocol):
    """Takes the frames of the streams that it was given."""

    def put(self, frame: bytes, mark: int, now_ns: int, write: Segmentation | None = None) -> bool:
        """Take a frame, the one at ``mark`` in what is published; false if it was dropped at once.

        ``write`` says how its bytes go into a byte stream; datagrams are always whole.
        """


class Flushable(Protocol):
    """Has put off what a system call is to do for all at once."""

    def flush(self) -> list[int]:
        """Do what was put off; returns the marks of the frames that failed in it."""


class Outbox:
    """What one UDP socket sends with its next flush; it enters itself in ``dirty`` when there is something to flush."""

    def __init__(self, sock: UdpSocket, dirty: list[Flushable]) -> None:
        self.sock = sock
        self._dirty = dirty
        self._frames: list[bytes] = []
        self._targets: list[Target] = []
        self._marks: list[int] = []

    def put(self, frame: bytes, where: Target, mark: int) -> None:
        if not self._frames:
            self._dirty.append(self)
        self._frames.append(frame)
        self._targets.append(where)
        self._marks.append(mark)

    def flush(self) -> list[int]:
        if not self._frames:
            return []
        failed = self.sock.send(self._frames, self._targets)
        marks = [self._marks[index] for index in failed]
        self._frames, self._targets, self._marks = [], [], []
        return marks


class UdpSink:
    """One destination of datagrams, through the outbox of a socket."""

    __slots__ = ("outbox", "where")

    def __init__(self, outbox: Outbox, where: Target) -> None:
        self.outbox, self.where = outbox, where

    def put(self, frame: bytes, mark: int, now_ns: int, write: Segmentation | None = None) -> bool:
        self.outbox.put(frame, self.where, mark)
        return True


class Audience:
    """Who gets which stream, by the stream's handle. A sink that several clients share gets each frame once."""

    def __init__(self) -> None:
        self.sinks: list[list[Sink]] = []
        self._shares: dict[tuple[int, Hashable], tuple[Sink, set[Hashable]]] = {}

    def start(self, handle: int, key: Hashable, client: Hashable, make: Callable[[], Sink]) -> None:
        """``client`` wants the stream at the sink called ``key``, which ``make`` makes for the first who does."""
        share = self._shares.get((handle, key))
        if share is None:
            share = self._shares[handle, key] = (make(), set())
            self.sinks[handle].append(share[0])
        share[1].add(client)

    def stop(self, handle: int, key: Hashable, client: Hashable) -> None:
        share = self._shares.get((handle, key))
        if share is None:
            return
        share[1].discard(client)
        if not share[1]:
            del self._shares[handle, key]
            self.sinks[handle].remove(share[0])
