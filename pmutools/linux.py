"""System calls that Python lacks, through ctypes: absolute sleep, scheduling, memory locking, clock state, mmsg.

All of them are Linux's. Elsewhere, on 32-bit systems and where the environment has ``PMUTOOLS_PORTABLE=1``, ``NATIVE``
is false: callers then take their portable path (each class that has both takes ``native=`` too, so that one process
can test both), and the functions below say politely that they did nothing.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
import sys
from collections.abc import Sequence
from typing import NamedTuple

from pmutools.flow import StampSource

NATIVE = sys.platform == "linux" and sys.maxsize > 2**32 and os.environ.get("PMUTOOLS_PORTABLE") != "1"
libc = ctypes.CDLL(None, use_errno=True) if NATIVE else None

# Socket options and flags absent from the socket module of Python 3.11 (asm-generic values: x86-64, arm64).
SO_TIMESTAMPNS = 35
SO_MEMINFO = 55
SO_RCVBUFFORCE = 33
SO_SNDBUFFORCE = 32
IP_ADD_SOURCE_MEMBERSHIP = 39
IP_MULTICAST_ALL = 49
MCAST_JOIN_SOURCE_GROUP = 46
SO_TIMESTAMPING = 37
TX_SOFTWARE, SOFTWARE, OPT_ID, OPT_TSONLY = 1 << 1, 1 << 4, 1 << 7, 1 << 11
"""Flags of SO_TIMESTAMPING: stamp what is sent, report such stamps, number them, leave the datagram out."""
RX_HARDWARE, RX_SOFTWARE, RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 6
"""More of them: have the network card, and the kernel, stamp what arrives; report the card's stamps as they are."""
MEMINFO_RMEM_ALLOC, MEMINFO_DROPS = 0, 8
"""Among the nine uint32 of SO_MEMINFO: bytes that wait to be read, with what the kernel keeps about them (or a while
ago: it may count them later), and the drop counter."""

SOL_SOCKET = 1
MSG_DONTWAIT = 0x40
NS = 1_000_000_000


def sleep_until(deadline_ns: int) -> None:
    """clock_nanosleep to an absolute CLOCK_MONOTONIC time, through signals that do not raise; needs ``NATIVE``."""
    assert libc is not None
    monotonic, absolute = 1, 1
    request = (ctypes.c_int64 * 2)(*divmod(max(deadline_ns, 0), NS))
    while error := libc.clock_nanosleep(monotonic, absolute, request, None):
        if error != errno.EINTR:
            raise OSError(error, os.strerror(error))


# --- scheduling --------------------------------------------------------------------------------------------------


def timer_slack(slack_ns: int = 1) -> str | None:
    """Let the kernel delay this thread's wake-ups by ``slack_ns`` only (default 50 µs). None, or why not."""
    if libc is None:
        return "timer slack: only Linux has it"
    pr_set_timerslack = 29
    if libc.prctl(pr_set_timerslack, ctypes.c_ulong(slack_ns), 0, 0, 0):
        return f"timer slack: {os.strerror(ctypes.get_errno())}"
    return None


def fifo(priority: int = 10) -> str | None:
    """Run this thread under SCHED_FIFO, ahead of every normal task. None, or why not."""
    if not hasattr(os, "sched_setscheduler"):
        return "SCHED_FIFO: only Linux has it"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f"SCHED_FIFO: {error.strerror}; run as root or with CAP_SYS_NICE for it"
    return None


def lock_memory() -> str | None:
    """Keep memory that this process has used from being paged out. None, or why not.

    What is only reserved (Arrow reserves a GB) is not filled for it: that would take seconds. Future mappings are
    locked too only where no RLIMIT_MEMLOCK holds: under a limit they would start to fail.
    """
    if libc is None:
        return "memory lock: only Linux has it"
    import resource

    mcl_current, mcl_future, mcl_onfault = 1, 2, 4
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    free = limit == resource.RLIM_INFINITY or _may_lock_memory()
    if libc.mlockall(mcl_onfault | mcl_current | (mcl_future if free else 0)):
        return f"memory lock: {os.strerror(ctypes.get_errno())}; raise RLIMIT_MEMLOCK ({limit} bytes) for it"
    return None


def _may_lock_memory() -> bool:
    """Whether CAP_IPC_LOCK is effective: root inside a container may lack it."""
    cap_ipc_lock = 14
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            masks = [int(line.split()[1], 16) for line in status if line.startswith("CapEff:")]
    except OSError:
        return False
    return bool(masks and masks[0] >> cap_ipc_lock & 1)


def trim_heap() -> None:
    """Give back to the system what lies free within the C library's heap; it takes milliseconds.

    A burst of work raises the heap's top, and what is allocated there and kept holds all below it in memory, used or
    not. Does nothing where the C library (musl) has no such call.
    """
    if libc is not None and (trim := getattr(libc, "malloc_trim", None)) is not None:
        trim(ctypes.c_size_t(0))


def end_with_parent(number: int) -> str | None:
    """Have the kernel send this process signal ``number`` when its parent's thread ends. None, or why not."""
    if libc is None:
        return "end with the parent: only Linux has it"
    pr_set_pdeathsig = 1
    if libc.prctl(pr_set_pdeathsig, ctypes.c_ulong(number), 0, 0, 0):
        return f"end with the parent: {os.strerror(ctypes.get_errno())}"
    return None


# --- clock quality -----------------------------------------------------------------------------------------------


class ClockStatus(NamedTuple):
    """What the kernel knows of its UTC clock's discipline (adjtimex); bounds grow until the next update."""

    state: int
    """0 OK, 1 insert and 2 delete leap second pending, 3 in progress, 4 occurred, 5 not synchronised."""
    status: int
    """STA_* bits as the kernel gives them."""
    synchronised: bool
    offset_ns: int
    frequency_ppm: float
    max_error_ns: int
    estimated_error_ns: int
    tai_s: int
    """TAI - UTC, 0 where nobody told the kernel."""


_TIMEX = struct.Struct("@I4x4qi4x3q2qq2qi4x5qi44x")
_STA_UNSYNC, _STA_NANO, _TIME_ERROR = 0x40, 0x2000, 5


def clock_status() -> ClockStatus | None:
    """Read the state of CLOCK_REALTIME, without privilege; None where there is no adjtimex."""
    if libc is None:
        return None
    timex = ctypes.create_string_buffer(_TIMEX.size)
    state = libc.adjtimex(timex)
    if state < 0:
        return None
    _, offset, frequency, max_error, estimated, status, *_rest, tai = _TIMEX.unpack(timex.raw)
    return ClockStatus(
        state,
        status,
        state != _TIME_ERROR and not status & _STA_UNSYNC,
        offset if status & _STA_NANO else offset * 1000,
        frequency / 65536,
        max_error * 1000,
        estimated * 1000,
        tai,
    )


# --- many datagrams a call ---------------------------------------------------------------------------------------

_IOVEC = struct.Struct("@PN")
_MMSGHDR = struct.Struct("@PI4xPNPNi4xI4x")  # name, namelen, iov, iovlen, control, controllen, flags | msg_len
_RECEIVED = struct.Struct("@8xI28xNi4xI4x")  # namelen, controllen, flags, msg_len of the same
_NAME = struct.Struct("@PI")
_CMSG = struct.Struct("@Nii")  # struct cmsghdr: length, level, type
_TIMESPEC = struct.Struct("@qq")
_SCM_TIMESTAMPING = struct.Struct("@qq16xqq")  # of three timespecs the kernel's and the network card's
_NAME_ROOM = 32
CONTROL_ROOM = 64
"""Bytes for control messages: one of either kind of stamp."""


def _address(buffer: bytearray) -> int:
    return ctypes.addressof((ctypes.c_char * len(buffer)).from_buffer(buffer))


class Stamp(NamedTuple):
    """An arrival time, ns, and who took it. The network card's is in the card's own timescale, often TAI."""

    ns: int
    source: StampSource


def arrival_stamp(kind: int, value: bytes | memoryview) -> Stamp | None:
    """The stamp in a control message of level SOL_SOCKET; None where it is of another kind, or holds none."""
    if kind == SO_TIMESTAMPNS:
        seconds, nanoseconds = _TIMESPEC.unpack_from(value)
    elif kind == SO_TIMESTAMPING:
        seconds, nanoseconds, card_s, card_ns = _SCM_TIMESTAMPING.unpack_from(value)
        if card_s or card_ns:
            return Stamp(card_s * NS + card_ns, StampSource.HARDWARE)
    else:
        return None
    return Stamp(seconds * NS + nanoseconds, StampSource.KERNEL) if seconds or nanoseconds else None


class Datagram(NamedTuple):
    """One received datagram: ``sockaddr`` is the sender's, raw; ``stamp`` its arrival's, if there is one."""

    data: bytes
    sockaddr: bytes
    stamp: Stamp | None


class ReceiveBatch:
    """Buffers for recvmmsg, shared by any number of sockets of one thread; at most ``size`` datagrams a call."""

    def __init__(self, size: int = 64, room: int = 1 << 16) -> None:
        self.size = size
        self._room = room
        self._data = bytearray(size * room)  # zero pages until a datagram touches them
        self._names = bytearray(size * _NAME_ROOM)
        self._controls = bytearray(size * CONTROL_ROOM)
        self._iovecs = bytearray(size * _IOVEC.size)
        data, name, control, iovec = map(_address, (self._data, self._names, self._controls, self._iovecs))
        for index in range(size):
            _IOVEC.pack_into(self._iovecs, index * _IOVEC.size, data + index * room, room)
        self._fresh = b"".join(
            _MMSGHDR.pack(
                name + index * _NAME_ROOM,
                _NAME_ROOM,
                iovec + index * _IOVEC.size,
                1,
                control + index * CONTROL_ROOM,
                CONTROL_ROOM,
                0,
                0,
            )
            for index in range(size)
        )
        self._headers = bytearray(self._fresh)
        self._headers_at = ctypes.c_void_p(_address(self._headers))
        self._view = memoryview(self._data)

    def receive(self, fd: int, most: int | None = None) -> list[Datagram]:
        """All that waits on a UDP socket, up to ``most`` (``size`` unless given); empty if nothing does.

        Raises
        ------
        OSError
            The socket's pending error, such as ECONNREFUSED on a connected one.
        """
        assert libc is not None
        self._headers[:] = self._fresh  # the kernel overwrites the lengths
        count = libc.recvmmsg(fd, self._headers_at, min(most or self.size, self.size), MSG_DONTWAIT, None)
        if count < 0:
            error = ctypes.get_errno()
            if error in (errno.EAGAIN, errno.EINTR):
                return []
            raise OSError(error, os.strerror(error))
        received = []
        heads = _RECEIVED.iter_unpack(memoryview(self._headers)[: count * _MMSGHDR.size])
        for index, (namelen, controllen, _flags, length) in enumerate(heads):
            start, name = index * self._room, index * _NAME_ROOM
            stamp = self._stamp(index * CONTROL_ROOM) if controllen > _CMSG.size else None
            data = bytes(self._view[start : start + length])
            received.append(Datagram(data, bytes(self._names[name : name + namelen]), stamp))
        return received

    def _stamp(self, at: int) -> Stamp | None:
        """The arrival's stamp, the one control message that our sockets ask for."""
        _size, level, kind = _CMSG.unpack_from(self._controls, at)
        value = memoryview(self._controls)[at + _CMSG.size : at + CONTROL_ROOM]
        return arrival_stamp(kind, value) if level == SOL_SOCKET else None


class SockAddr:
    """A destination in the kernel's form, kept at a fixed address for :class:`SendBatch`."""

    __slots__ = ("_buffer", "address", "raw")

    def __init__(self, raw: bytes) -> None:
        self.raw = raw
        self._buffer = bytearray(raw)
        self.address = _address(self._buffer)


class SendBatch:
    """Buffers for sendmmsg, at most ``size`` (the kernel's limit is 1024) datagrams a call."""

    def __init__(self, size: int = 1024) -> None:
        self.size = size
        self._iovecs = bytearray(size * _IOVEC.size)
        iovecs = _address(self._iovecs)
        self._headers = bytearray(
            b"".join(_MMSGHDR.pack(0, 0, iovecs + index * _IOVEC.size, 1, 0, 0, 0, 0) for index in range(size))
        )
        self._headers_at = _address(self._headers)

    def send(self, fd: int, frames: Sequence[bytes], targets: Sequence[SockAddr]) -> list[int]:
        """Send ``frames[i]`` to ``targets[i]``; returns the indices of those the kernel would not take."""
        failed: list[int] = []
        for start in range(0, len(frames), self.size):
            self._send(fd, frames[start : start + self.size], targets[start : start + self.size], start, failed)
        return failed

    def _send(
        self, fd: int, frames: Sequence[bytes], targets: Sequence[SockAddr], start: int, failed: list[int]
    ) -> None:
        assert libc is not None
        joined = b"".join(frames)
        base = ctypes.cast(ctypes.c_char_p(joined), ctypes.c_void_p).value or 0
        pack_iovec, pack_name, headers, iovecs = _IOVEC.pack_into, _NAME.pack_into, self._headers, self._iovecs
        for index, (frame, target) in enumerate(zip(frames, targets, strict=True)):
            pack_iovec(iovecs, index * 16, base, len(frame))
            pack_name(headers, index * 64, target.address, len(target.raw))
            base += len(frame)
        done = 0
        while done < len(frames):
            left = len(frames) - done
            sent = libc.sendmmsg(fd, ctypes.c_void_p(self._headers_at + done * 64), left, MSG_DONTWAIT)
            if sent > 0:
                done += sent
            elif ctypes.get_errno() != errno.EINTR:
                failed.append(start + done)  # an error always concerns the first datagram of the call
                done += 1
