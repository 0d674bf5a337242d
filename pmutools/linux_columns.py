"""System calls for columns of datagrams: many sent with one call, and when they left read back; from numpy arrays.

Apart from :mod:`pmutools.linux`, which whoever only asks for help imports too. For Linux, as all there.
"""

from __future__ import annotations

import ctypes
import errno
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmutools.linux import MSG_DONTWAIT, NS, SO_TIMESTAMPING, SOL_SOCKET, libc

MSG_ERRQUEUE = 0x2000

_IOVECS = np.dtype([("base", "u8"), ("size", "u8")])
_MMSGHDRS = np.dtype(
    {
        "names": ["name", "namelen", "iov", "iovlen", "control", "controllen"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8"],
        "offsets": [0, 8, 16, 24, 32, 40],
        "itemsize": 64,
    }
)
_LONGEST_CALL = 1024


def array_address(array: NDArray[Any]) -> int:
    """Where an array's memory begins."""
    return int(array.__array_interface__["data"][0])


class SendColumns:
    """Datagrams for sendmmsg given as columns: where in one buffer each lies, and where it goes.

    ``size`` is the number it has room for; more is made as it is asked for.
    """

    def __init__(self, size: int = _LONGEST_CALL) -> None:
        self._count = 0
        self._base: NDArray[np.uint8] | None = None
        self._make_room(size)

    def _make_room(self, size: int) -> None:
        self._iovecs = np.zeros(size, _IOVECS)
        self._headers = np.zeros(size, _MMSGHDRS)
        self._headers["iov"] = array_address(self._iovecs) + 16 * np.arange(size, dtype=np.uint64)
        self._headers["iovlen"] = 1
        self._headers_at = array_address(self._headers)

    def load(
        self,
        base: NDArray[np.uint8],
        at: NDArray[np.int64],
        nbytes: NDArray[np.integer[Any]],
        names: NDArray[np.uint64],
        namelens: NDArray[np.uint32],
    ) -> None:
        """Take the datagrams ``base[at[i] : at[i] + nbytes[i]]``; ``base`` (contiguous) is kept until the next load.

        ``names[i]`` is the address in memory of a socket address of ``namelens[i]`` bytes (:class:`SockAddr`, kept by
        the caller), or 0 on a connected socket.
        """
        self._count = count = len(at)
        if count > len(self._headers):
            self._make_room(max(count, 2 * len(self._headers)))
        self._base = base
        iovecs, headers = self._iovecs[:count], self._headers[:count]
        iovecs["base"] = at + array_address(base)
        iovecs["size"] = nbytes
        headers["name"] = names
        headers["namelen"] = namelens

    def send(self, fd: int, first: int, last: int) -> list[int]:
        """Send the datagrams [first, last); returns those, as places in the load, that the kernel would not take."""
        assert libc is not None
        if not 0 <= first <= last <= self._count:
            raise IndexError(f"datagrams {first}..{last} of {self._count}")
        failed: list[int] = []
        while first < last:
            at = ctypes.c_void_p(self._headers_at + first * 64)
            sent = libc.sendmmsg(fd, at, min(last - first, _LONGEST_CALL), MSG_DONTWAIT)
            if sent > 0:
                first += sent
            elif ctypes.get_errno() != errno.EINTR:
                failed.append(first)  # an error always concerns the first datagram of the call
                first += 1
        return failed


# --- when datagrams left -----------------------------------------------------------------------------------------

_DEPARTURE_ROOM = 192
_STAMPNS_SPACE = 32
"""A control message of SO_TIMESTAMPNS, which goes before where a socket has asked for it."""
_DEPARTURE = np.dtype(
    {
        # struct cmsghdr with scm_timestamping, then struct cmsghdr with sock_extended_err
        "names": ["level", "kind", "seconds", "nanoseconds", "errno", "origin", "info", "id"],
        "formats": ["i4", "i4", "i8", "i8", "u4", "u1", "u4", "u4"],
        "offsets": [8, 12, 16, 24, 80, 84, 88, 92],
        "itemsize": _DEPARTURE_ROOM,
    }
)
_ORIGIN_TIMESTAMPING = 4
_TSTAMP_SND = 0


class DepartureBatch:
    """Buffers for reading the kernel's stamps of what was sent from error queues, at most ``size`` a call."""

    def __init__(self, size: int = _LONGEST_CALL) -> None:
        self.size = size
        self._controls = np.zeros(size * _DEPARTURE_ROOM + _STAMPNS_SPACE, np.uint8)
        self._views = [
            self._controls[start : start + size * _DEPARTURE_ROOM].view(_DEPARTURE) for start in (0, _STAMPNS_SPACE)
        ]
        self._headers = np.zeros(size, _MMSGHDRS)
        self._headers["control"] = array_address(self._controls) + _DEPARTURE_ROOM * np.arange(size, dtype=np.uint64)
        self._headers_at = ctypes.c_void_p(array_address(self._headers))

    def read(self, fd: int) -> tuple[NDArray[np.uint32], NDArray[np.int64], bool]:
        """(ids, UTC ns, whether more may wait), in the order of the queue.

        What else is in the queue, such as errors that the network has reported, is taken and ignored.
        """
        assert libc is not None
        self._headers["controllen"] = _DEPARTURE_ROOM  # the kernel overwrites it
        count = max(libc.recvmmsg(fd, self._headers_at, self.size, MSG_ERRQUEUE | MSG_DONTWAIT, None), 0)
        found: tuple[NDArray[np.uint32], NDArray[np.int64]] | None = None
        for view in self._views:
            rows = view[:count]
            good = (
                (rows["kind"] == SO_TIMESTAMPING)
                & (rows["level"] == SOL_SOCKET)
                & (rows["errno"] == errno.ENOMSG)
                & (rows["origin"] == _ORIGIN_TIMESTAMPING)
                & (rows["info"] == _TSTAMP_SND)
            )
            if good.any():  # of one socket all have the same form
                rows = rows[good]
                found = rows["id"].copy(), rows["seconds"] * NS + rows["nanoseconds"]
                break
        ids, stamps_ns = found or (np.zeros(0, np.uint32), np.zeros(0, np.int64))
        return ids, stamps_ns, count == self.size
