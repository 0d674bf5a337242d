"""Many datagrams, or reads, of many sockets in one set of buffers, looked at as columns. For Linux, as ``linux.py``.

The addresses of all buffers are given to the kernel once; what it fills in (sizes, senders, stamps) is read by numpy.
"""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pmutools.flow import StampSource
from pmutools.linux import CONTROL_ROOM, MSG_DONTWAIT, NS, SO_TIMESTAMPING, SO_TIMESTAMPNS, SOL_SOCKET
from pmutools.linux_columns import array_address

ROWS = 1 << 15
"""Datagrams that the buffers hold: at 120,000/s those of a quarter of a second."""
ROOM = 1536
"""Bytes of a row: a datagram that passes Ethernet whole. 48 MiB in all, of which only what was used is resident."""
CALL = 64
"""Datagrams taken by one system call, at most."""
LARGEST = 1 << 16
LARGE_BYTES = 16 << 20
"""Bytes of datagrams beyond a row that are kept; with more the buffers count as full."""
NAME_ROOM = 32
SOURCES = tuple(StampSource)

_IOVECS = np.dtype([("base", "u8"), ("size", "u8")])
_HEADERS = np.dtype(
    {
        "names": ["name", "namelen", "iov", "iovlen", "control", "controllen", "flags", "size"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "i4", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
CONTROLS = np.dtype(
    {
        # struct cmsghdr, then one timespec, or three of which the last is the network card's
        "names": ["level", "kind", "seconds", "nanoseconds", "card_s", "card_ns"],
        "formats": ["i4", "i4", "i8", "i8", "i8", "i8"],
        "offsets": [8, 12, 16, 24, 48, 56],
        "itemsize": CONTROL_ROOM,
    }
)
_WITH_STAMP = 32
"""Bytes of the shorter control message that holds a stamp."""


class Rows(NamedTuple):
    """N datagrams or reads, in the order in which they were taken; views that hold until the buffers are cleared."""

    octets: NDArray[np.uint8]
    """(N, ROOM) their bytes, where these are no more than ROOM; what follows them is of no meaning."""
    sizes: NDArray[np.uint32]
    """(N,)."""
    sources: NDArray[np.int64]
    """(N,) what the caller called the socket."""
    senders: NDArray[np.uint8]
    """(N, NAME_ROOM) the sender's socket address, 0 behind it, and all 0 on a connection."""
    arrivals_ns: NDArray[np.int64]
    """(N,)."""
    stamp_sources: NDArray[np.uint8]
    """(N,) index into SOURCES."""


class ReceiveColumns:
    """The buffers. ``room``, ``rows`` and ``call`` as the constants say. One thread's."""

    def __init__(self, rows: int = ROWS, room: int = ROOM, call: int = CALL) -> None:
        self.rows, self.room, self.call = rows, room, call
        self.share = rows // 4
        """Datagrams to take from one socket at a time, for the others' sake."""
        self.count = 0
        self._octets = np.zeros((rows, room), np.uint8)
        self._overflow = np.zeros((call, LARGEST - room), np.uint8)  # by place in a call: emptied after each
        self._names = np.zeros((rows, NAME_ROOM), np.uint8)
        self._controls = np.zeros(rows, CONTROLS)
        self._calls: list[tuple[int, int, int, bool]] = []
        """Of each call: how many datagrams it took, their source, when it was made, and whether stamping settled."""
        self._large: dict[int, bytes] = {}
        self._large_bytes = 0
        number = np.arange(rows, dtype=np.uint64)
        self._iovecs = np.zeros((rows, 2), _IOVECS)
        self._iovecs["base"][:, 0] = array_address(self._octets) + room * number
        self._iovecs["size"][:, 0] = room
        self._iovecs["size"][:, 1] = LARGEST - room
        self._headers = np.zeros(rows, _HEADERS)
        self._headers["name"] = array_address(self._names) + NAME_ROOM * number
        self._headers["iov"] = array_address(self._iovecs) + 32 * number
        self._headers["iovlen"] = 2
        self._headers["control"] = array_address(self._controls) + CONTROL_ROOM * number
        self._iovecs["base"][:, 1] = array_address(self._overflow) + (LARGEST - room) * (number % call)
        self._headers_at = array_address(self._headers)
        self._sizes = memoryview(self._headers.view(np.uint32).data)[14::16]
        self._recvmmsg = _recvmmsg()
        self.clear(rows)

    @property
    def full(self) -> bool:
        """Whether what is there must be taken before more is received."""
        return self.count >= self.rows or self._large_bytes > LARGE_BYTES

    def receive(self, fd: int, source: int, at_most: int, *, settling: bool = False) -> int:
        """Take what waits on a socket by one call, and call it ``source``; 0 where nothing does, or :attr:`full`.

        ``settling`` says that stamping has begun a moment ago: what arrived before gets its stamp while it is read,
        and counts as stamped there (in user space).

        Raises
        ------
        OSError
            The socket's pending error; on a connection EPIPE where the other side has ended it.
        """
        first = self.count
        ask = min(at_most, self.rows - first, self.call)
        if not ask or self._large_bytes > LARGE_BYTES:
            return 0
        asked_ns = time.time_ns()
        count: int = self._recvmmsg(fd, self._headers_at + 64 * first, ask, MSG_DONTWAIT, None)
        if count < 0:
            error = ctypes.get_errno()
            if error in (errno.EAGAIN, errno.EINTR):
                return 0
            raise OSError(error, os.strerror(error))
        self.count = last = first + count
        self._calls.append((count, source, asked_ns, settling))
        if max(self._sizes[first:last], default=0) > self.room:
            self._keep_large(first, last)
        return count

    def receive_stream(self, fd: int, source: int, *, settling: bool = False) -> int:
        """:meth:`receive` one read of a connection; 0 where nothing waits. Raises OSError (EPIPE) at its end."""
        if not self.receive(fd, source, 1, settling=settling):
            return 0
        if not self._sizes[self.count - 1]:
            self.count -= 1
            self._calls.pop()
            self._reset(slice(self.count, self.count + 1))
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        return 1

    def look(self) -> Rows:
        """What was received since the last :meth:`clear`."""
        held = slice(0, self.count)
        calls = np.array(self._calls, np.int64).reshape(-1, 4).T
        sources, asked_ns, settling = calls[1:].repeat(calls[0], axis=1)
        controls, lengths = self._controls[held], self._headers["controllen"][held]
        arrivals_ns, codes = stamps(controls, lengths, asked_ns, settling != 0)
        return Rows(self._octets[held], self._headers["size"][held], sources, self._names[held], arrivals_ns, codes)

    def datagram(self, row: int) -> bytes:
        """The whole of one."""
        return self._large.get(row) or self._octets[row, : self._sizes[row]].tobytes()

    def sender(self, row: int) -> bytes:
        """The socket address of whoever sent one."""
        return self._names[row, : self._headers["namelen"][row]].tobytes()

    def clear(self, count: int | None = None) -> None:
        """Make room."""
        self._reset(slice(0, self.count if count is None else count))
        self.count = self._large_bytes = 0
        self._calls.clear()
        self._large.clear()

    def _reset(self, used: slice) -> None:
        """What the kernel writes, and reads again."""
        self._names[used] = 0
        self._headers["namelen"][used] = NAME_ROOM
        self._headers["controllen"][used] = CONTROL_ROOM

    def _keep_large(self, first: int, last: int) -> None:
        """What the next call would overwrite."""
        for row in range(first, last):
            beyond = self._sizes[row] - self.room
            if beyond > 0:
                rest = self._overflow[row % self.call, :beyond]
                self._large[row] = data = self._octets[row].tobytes() + rest.tobytes()
                self._large_bytes += len(data)


def _recvmmsg() -> Callable[..., int]:
    """The call with the types of its arguments told: that is faster than to wrap each of them."""
    call = ctypes.CDLL(None, use_errno=True).recvmmsg
    call.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
    return call


def stamps(
    controls: NDArray[np.void],
    lengths: NDArray[np.uint64],
    asked_ns: NDArray[np.int64],
    fresh: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Arrivals (N,), ns, and who took them (index into SOURCES), from control messages of ``lengths`` bytes.

    ``asked_ns`` is when each was asked for: the arrival of those that no one has stamped. A ``fresh`` one with a stamp
    later than that was stamped while it was read.
    """
    kind = controls["kind"]
    stamped = (lengths >= _WITH_STAMP) & (controls["level"] == SOL_SOCKET)
    both = stamped & (kind == SO_TIMESTAMPING)
    kernel_ns = controls["seconds"] * NS + controls["nanoseconds"]
    card_ns = controls["card_s"] * NS + controls["card_ns"] if both.any() else np.zeros_like(kernel_ns)
    by_card = both & (card_ns != 0)
    by_kernel = (both | (stamped & (kind == SO_TIMESTAMPNS))) & ~by_card & (kernel_ns != 0)
    codes = np.full(len(controls), _USER, np.uint8)
    codes[by_kernel & ~(fresh & (kernel_ns >= asked_ns))] = _KERNEL
    codes[by_card] = _HARDWARE
    return np.where(by_card, card_ns, np.where(by_kernel, kernel_ns, asked_ns)), codes


_USER, _KERNEL, _HARDWARE = map(SOURCES.index, (StampSource.USER, StampSource.KERNEL, StampSource.HARDWARE))
