"""What UDP sockets have to send, for all at once, and when it has left."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pmutools.flow import Segmentation
from pmutools.linux_columns import SendColumns
from pmutools.net.udp import Target, UdpSocket

I64 = npt.NDArray[np.int64]
NO_ROW = -1
_REMEMBERED = 1 << 18
"""Datagrams whose departure stamps are waited for, and stamps that wait to be read: two seconds of 100,000/s."""
_NONE = np.zeros(0, np.int64)


class Flushable(Protocol):
    """Has put off what a system call is to do for all at once."""

    def flush(self) -> list[int]:
        """Do what was put off; returns the marks of the frames that failed in it."""


class Addresses(NamedTuple):
    """Where N datagrams go: the addresses of their ``sockaddr`` in memory, the lengths of those, and the targets."""

    names: npt.NDArray[np.uint64]
    lengths: npt.NDArray[np.uint32]
    targets: npt.NDArray[np.object_]

    @classmethod
    def of(cls, targets: Sequence[Target]) -> Addresses:
        objects = np.empty(len(targets), np.object_)
        objects[:] = targets
        return cls(
            np.array([where.sockaddr.address for where in targets], np.uint64),
            np.array([len(where.sockaddr.raw) for where in targets], np.uint32),
            objects,
        )

    def take(self, rows: I64) -> Addresses:
        return Addresses(self.names[rows], self.lengths[rows], self.targets[rows])


class Outbox:
    """What one UDP socket sends: single frames with its next flush, and columns of frames, loaded and sent in runs.

    It enters itself in ``dirty`` when there is something to flush. With ``stamped`` the kernel stamps
    :attr:`departures`.
    """

    def __init__(self, sock: UdpSocket, dirty: dict[Flushable, None], *, stamped: bool = False) -> None:
        self.sock = sock
        self._dirty = dirty
        self._frames: list[bytes] = []
        self._targets: list[Target] = []
        self._marks: list[int] = []
        self._columns = SendColumns() if sock.native else None
        self._loaded: tuple[npt.NDArray[np.uint8], I64, I64, Addresses]
        self.departures = Departures(sock) if stamped and sock.stamp_departures() else None

    def put(self, frame: bytes, where: Target, mark: int) -> None:
        if not self._frames:
            self._dirty[self] = None
        self._frames.append(frame)
        self._targets.append(where)
        self._marks.append(mark)

    def flush(self) -> list[int]:
        self._dirty.pop(self, None)
        if not self._frames:
            return []
        failed = self.sock.send(self._frames, self._targets)
        if self.departures is not None:
            self.departures.sent(np.full(len(self._frames), NO_ROW), failed)
        marks = [self._marks[index] for index in failed]
        self._frames, self._targets, self._marks = [], [], []
        return marks

    def load(self, wire: npt.NDArray[np.uint8], at: I64, nbytes: I64, to: Addresses) -> None:
        """Make datagrams ready: ``nbytes`` from ``at`` on (N,) in ``wire``, each with its own address."""
        self._loaded = (wire, at, nbytes, to)
        if self._columns is not None:
            self._columns.load(wire, at, nbytes, to.names, to.lengths)

    @property
    def direct(self) -> Callable[[int, int], list[int]] | None:
        """What sends loaded datagrams where nobody asks for their departures; None on the portable path."""
        if self._columns is None or self.departures is not None:
            return None
        return partial(self._columns.send, self.sock.fileno())

    def send(self, first: int, last: int, marks: I64) -> list[int]:
        """Send the loaded datagrams ``first`` to ``last - 1``; returns those that the system would not take.

        ``marks`` (N,) is what their departures are to be known by.
        """
        if self._columns is not None:
            failed = self._columns.send(self.sock.fileno(), first, last)
        else:
            wire, at, nbytes, to = self._loaded
            frames = [wire[at[k] : at[k] + nbytes[k]].tobytes() for k in range(first, last)]
            failed = [first + k for k in self.sock.send(frames, to.targets[first:last].tolist())]
        if self.departures is not None:
            self.departures.sent(marks[first:last], [k - first for k in failed])
        return failed


class Departures:
    """The kernel's stamps of when datagrams left, matched with whose they are.

    It remembers as many as may wait for their stamps, and as many stamps that nobody has read yet: the newest.
    """

    def __init__(self, sock: UdpSocket) -> None:
        self._sock = sock
        self._marks = np.full(_REMEMBERED, NO_ROW, np.int64)
        self._next = 0
        self._counted_from_ns = 0
        """POSIX UTC since which numbers are as they are: what is stamped before has a number of the count before."""
        self._found: deque[tuple[I64, I64]] = deque()
        self._unread = 0

    def sent(self, marks: I64, failed: Sequence[int]) -> None:
        """Datagrams were handed to the kernel, those of ``marks`` in this order."""
        if failed:  # whether those were counted depends on where they failed: begin a new count
            self.collect()
            self._sock.restart_departures()
            self._marks[:], self._next = NO_ROW, 0
            self._counted_from_ns = time.time_ns()
            return
        self._marks[(self._next + np.arange(len(marks))) % _REMEMBERED] = marks
        self._next = self._next + len(marks) & 0xFFFF_FFFF

    def collect(self) -> None:
        """Take what has come off the socket: while any stamps wait there, a selector finds it ready."""
        stamps = self._sock.departures()
        if not stamps:
            return
        found = np.array(stamps, np.int64)
        marks, times = self._marks[found[:, 0] % _REMEMBERED], found[:, 1]
        known = (marks != NO_ROW) & (times >= self._counted_from_ns)
        if known.any():
            self._found.append((marks[known], times[known]))
            self._unread += int(known.sum())
        while self._unread > _REMEMBERED:
            self._unread -= len(self._found.popleft()[0])

    def read(self) -> tuple[I64, I64]:
        """(mark, POSIX UTC ns) of the stamps that have come since this was last asked."""
        self.collect()
        marks, times = zip((_NONE, _NONE), *self._found, strict=True)
        self._found.clear()
        self._unread = 0
        return np.concatenate(marks), np.concatenate(times)


class UdpSink:
    """One destination of datagrams, through the outbox of a socket."""

    __slots__ = ("outbox", "where")

    def __init__(self, outbox: Outbox, where: Target) -> None:
        self.outbox, self.where = outbox, where

    def put(self, frame: bytes, mark: int, now_ns: int, write: Segmentation | None = None) -> bool:
        self.outbox.put(frame, self.where, mark)
        return True
