"""TCP connections, non-blocking: a client's that stamps what it reads, and a server's whose send queue is bounded.

A read takes what has come, once a wake-up, with the kernel's stamp of its newest segment. The kernel merges segments
that wait, so frames that share a read share that stamp: an upper bound for all but the last of them, which the framer
marks as batched.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import time
from collections import deque
from typing import NamedTuple

from pmutools import linux
from pmutools.flow import Chunk, Cut, Flow, Segmentation, StampSource
from pmutools.net.sockets import (
    SETTLING_NS,
    Address,
    explain,
    listening_socket,
    refuse_itself,
    resolve,
    stamp_arrivals,
    stamp_source,
)

READ_BYTES = 256 << 10
"""Of a connection at once."""
QUEUE_BYTES = 256 << 10
"""Bytes that may wait for one slow client, beside the kernel's send buffer of the same size."""
STALL_NS = 10_000_000_000
"""A client that takes nothing for so long while bytes wait for it is disconnected."""
KEPT_NS = 10_000_000_000
"""Frames that wait for others to share their write wait no longer."""
_BACKLOG = 1024
_VANISHED_MS = 30_000
_LAST_READS = 16


class TcpCounts(NamedTuple):
    """What this end's kernel has counted of connections (TCP_INFO); 0 where it does not tell."""

    retransmits: int = 0
    """Segments sent again by this end. A receiver sends little: loss on the way to it shows in the other count."""
    out_of_order: int = 0
    """Segments that came while an earlier one was missing: it was lost, or overtaken."""


_TCP_INFO_BYTES = 228
_TOTAL_RETRANS, _RCV_OOOPACK = 100, 224


class TcpClient:
    """A connection to a server, being made (until :meth:`finish`) or made.

    ``connection`` numbers the connections to this server, for the flow. ``native=False`` stamps in user space.
    ``read_bytes`` are read at once at most: with few, who sends much waits, and holds nobody up here.
    """

    def __init__(
        self,
        address: Address,
        *,
        local: Address | None = None,
        connection: int = 0,
        native: bool = linux.NATIVE,
        hardware_stamps: bool = False,
        read_bytes: int = READ_BYTES,
    ) -> None:
        self.address = address
        self.flow = Flow("tcp", str(address), "", connection)
        self._sock = sock = socket.socket(address.family, socket.SOCK_STREAM)
        self._buffer = memoryview(bytearray(read_bytes))
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            able = native and hasattr(sock, "recvmsg_into")
            self.stamps = able and stamp_arrivals(sock, hardware=hardware_stamps)
            if local is not None:
                sock.bind(local.sockaddr)
            error = sock.connect_ex(address.sockaddr)
        except OSError as failure:
            sock.close()
            raise explain(failure, f"tcp://{address}") from None
        self._settled_ns = time.monotonic_ns() + SETTLING_NS
        self._refused = error if error not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK) else 0

    def fileno(self) -> int:
        return self._sock.fileno()

    def close(self) -> None:
        """End the connection; what has come is read first, as closing over unread bytes would reset it."""
        try:
            self._sock.shutdown(socket.SHUT_WR)
            for _ in range(_LAST_READS):
                if not self._sock.recv_into(self._buffer):
                    break
        except OSError:  # nothing more has come, or there is no connection
            pass
        self._sock.close()

    def finish(self) -> None:
        """The socket has become writable: the connection is made, or OSError says why not."""
        error = self._refused or self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            raise OSError(error, os.strerror(error))
        refuse_itself(self._sock)
        self.flow = self.flow._replace(destination=str(Address(self.address.family, self._sock.getsockname())))

    def read(self) -> Chunk | None:
        """What has come, or None; raises OSError when the connection is closed (EPIPE) or broken."""
        asked_ns = time.time_ns()
        try:
            size, stamp = self._receive()
        except (BlockingIOError, InterruptedError):
            return None
        if not size:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        data = bytes(self._buffer[:size])
        if stamp is None:
            return Chunk(data, time.time_ns(), self.flow, StampSource.USER)
        return Chunk(data, stamp.ns, self.flow, stamp_source(stamp, asked_ns, settling=self._settling()))

    def counts(self) -> TcpCounts:
        """What the kernel tells of this connection so far."""
        try:
            info = self._sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES) if linux.NATIVE else b""
        except OSError:
            info = b""
        if len(info) < _TCP_INFO_BYTES:
            return TcpCounts()
        return TcpCounts(*(struct.unpack_from("=I", info, at)[0] for at in (_TOTAL_RETRANS, _RCV_OOOPACK)))

    def _settling(self) -> bool:
        return time.monotonic_ns() < self._settled_ns

    def _receive(self) -> tuple[int, linux.Stamp | None]:
        if not self.stamps:
            return self._sock.recv_into(self._buffer), None
        size, control, _flags, _sender = self._sock.recvmsg_into([self._buffer], 128)
        for level, kind, value in control:
            if level == socket.SOL_SOCKET and (stamp := linux.arrival_stamp(kind, value)) is not None:
                return size, stamp
        return size, None

    def send(self, frame: bytes) -> bool:
        """Send a command; false where the server takes none, which on such a connection means it is dead."""
        try:
            return self._sock.send(frame) == len(frame)
        except OSError:
            return False


class TcpListener:
    """A listening socket; raises SourceError where the port is taken or not permitted."""

    def __init__(self, host: str, port: int) -> None:
        wanted = resolve(host, port, datagram=False)
        self._sock = listening_socket(wanted, _BACKLOG, f"tcp://{wanted}")
        self.address = Address(wanted.family, self._sock.getsockname())

    def fileno(self) -> int:
        return self._sock.fileno()

    def close(self) -> None:
        self._sock.close()

    def accept(self, queue_bytes: int = QUEUE_BYTES) -> TcpPeer | None:
        """The next waiting client, or None; raises OSError where the process has no socket left for it."""
        try:
            sock, sender = self._sock.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return None
        try:
            return TcpPeer(sock, Address(self.address.family, sender), self.address, queue_bytes)
        except OSError:  # gone again already
            sock.close()
            return None


class CutOff(ConnectionResetError):
    """A :class:`Segmentation` says that the connection ends here, by RST."""


class _Piece(NamedTuple):
    """Bytes for one send call, ``wait_ns`` after the piece before; ``last``: then the connection is cut off."""

    data: bytes
    wait_ns: int = 0
    last: bool = False


def _pieces(frame: bytes, write: Segmentation | None) -> list[_Piece]:
    """How a frame is written; coalescing concerns several frames, and is none of this function's business."""
    if write is not None and write.cut is Cut.SPLIT:
        count = max(1, min(write.count, len(frame)))
        bounds = [len(frame) * k // count for k in range(count + 1)]
        return [_Piece(frame[bounds[k] : bounds[k + 1]], write.gap_ns if k else 0) for k in range(count)]
    if write is not None and write.cut is Cut.STALL:
        return [_Piece(frame, write.gap_ns)]
    if write is not None and write.cut is Cut.RESET:
        return [_Piece(frame[: write.count or len(frame) // 2]), _Piece(b"", last=True)]
    return [_Piece(frame)]


class TcpPeer:
    """A client of ours. What it does not take at once waits in a queue of at most ``queue_bytes``.

    Frames that do not fit are dropped, whole, and counted: a slow client sees a gap, never half a frame.

    Bytes leave in the order in which frames were put: first the queue (what the client would not take), then the plan
    (pieces that wait for their time), then the frames kept to share a write. All three count as queued. The owner calls
    :meth:`flush` when the client takes bytes again, :meth:`release` at :attr:`due_ns`, and :meth:`tidy` now and then;
    these and :meth:`put` raise OSError when the connection is broken, :class:`CutOff` when it is to be reset.
    """

    def __init__(self, sock: socket.socket, address: Address, local: Address, queue_bytes: int = QUEUE_BYTES) -> None:
        self.address = address
        self.flow = Flow("tcp", str(address), str(local))
        self.queue_bytes = queue_bytes
        self.dropped = 0
        self._sock = sock
        self._queue = bytearray()
        self._plan: deque[_Piece] = deque()
        self._plan_bytes = 0
        self._plan_due_ns = 0
        self._kept: list[bytes] = []
        self._kept_bytes = 0
        self._kept_since_ns = 0
        self._ending = False
        self._stuck_since_ns: int | None = None
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, queue_bytes)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # a client that has vanished acknowledges nothing
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _VANISHED_MS)

    def fileno(self) -> int:
        return self._sock.fileno()

    def close(self, *, reset: bool = False) -> None:
        """End the connection with FIN, or with RST and whatever waits thrown away."""
        if reset:
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("@ii", 1, 0))
        else:
            with contextlib.suppress(OSError):  # the client may be gone
                if self._kept and not self._queue and not self._plan:
                    self._send(b"".join(self._kept))
                for _ in range(_LAST_READS):  # closing over unread commands would reset
                    if not self._sock.recv(READ_BYTES):
                        break
        self._sock.close()

    @property
    def queued_bytes(self) -> int:
        """Bytes not yet handed to the system: the client's slowness, and what is held back on purpose."""
        return len(self._queue) + self._plan_bytes + self._kept_bytes

    @property
    def blocked(self) -> bool:
        """Whether bytes wait for the client to take some."""
        return bool(self._queue)

    @property
    def due_ns(self) -> int | None:
        """When :meth:`release` has something to do; None while nothing is planned, or the client blocks it."""
        return self._plan_due_ns if self._plan and not self._queue else None

    def put(self, frame: bytes, now_ns: int, write: Segmentation | None = None) -> bool:
        """Send, or queue, one frame whole, in the way ``write`` says; false if it was dropped.

        ``now_ns`` is monotonic.
        """
        if write is None and not (self._queue or self._plan or self._kept):
            self._write(frame, now_ns)  # the usual case
            return True
        if self._ending:
            return False
        if write is not None and write.cut is Cut.COALESCE:
            return self._keep(frame, write.count, now_ns)
        self._release_kept(now_ns)
        pieces = _pieces(frame, write)
        self._ending = pieces[-1].last
        if not self._fits(frame):
            self.dropped += 1
            if self._ending:  # a full queue does not save the connection
                self._schedule(pieces[1:], now_ns)
            return False
        if write is None and self._queue and not self._plan:
            self._queue += frame
        else:
            self._schedule(pieces, now_ns)
        return True

    def flush(self, now_ns: int) -> None:
        """Send from the queue what the client takes, and what is due behind it."""
        while self._queue:
            with memoryview(self._queue) as view:
                sent = self._send(view[:READ_BYTES])
            if not sent:
                return
            del self._queue[:sent]
            self._stuck_since_ns = now_ns
        self._stuck_since_ns = None
        self.release(now_ns)

    def release(self, now_ns: int) -> None:
        """Send the pieces that are due, each by a call of its own."""
        while self._plan and not self._queue and now_ns >= self._plan_due_ns:
            piece = self._plan[0]
            if piece.last:  # and stays: nothing goes past it
                raise CutOff(errno.ECONNRESET, "cut off amid a frame, as asked")
            self._plan.popleft()
            self._plan_bytes -= len(piece.data)
            self._write(piece.data, now_ns)
            if self._plan:  # from now: a late piece does not catch up with the one before
                self._plan_due_ns = now_ns + self._plan[0].wait_ns

    def tidy(self, now_ns: int) -> None:
        """Send the kept frames that have waited :data:`KEPT_NS` for others."""
        if self._kept and now_ns - self._kept_since_ns > KEPT_NS:
            self._release_kept(now_ns)

    def stalled(self, now_ns: int) -> bool:
        """Whether bytes have waited :data:`STALL_NS` without the client taking any."""
        return self._stuck_since_ns is not None and now_ns - self._stuck_since_ns > STALL_NS

    def read(self, nbytes: int = 1 << 16) -> bytes:
        """What the client sent, empty if nothing; raises OSError when the connection is closed (EPIPE) or broken."""
        try:
            data = self._sock.recv(nbytes)
        except (BlockingIOError, InterruptedError):
            return b""
        if not data:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        return data

    def _fits(self, frame: bytes) -> bool:
        """Whether the queue has room; where nothing waits it has, for a frame of any size."""
        return not self.queued_bytes or self.queued_bytes + len(frame) <= self.queue_bytes

    def _keep(self, frame: bytes, count: int, now_ns: int) -> bool:
        if self._kept_bytes + len(frame) > self.queue_bytes:
            self._release_kept(now_ns)
        if not self._fits(frame):
            self.dropped += 1
            return False
        if not self._kept:
            self._kept_since_ns = now_ns
        self._kept.append(frame)
        self._kept_bytes += len(frame)
        if len(self._kept) >= count:
            self._release_kept(now_ns)
        return True

    def _release_kept(self, now_ns: int) -> None:
        if self._kept:
            joined = b"".join(self._kept)
            self._kept.clear()
            self._kept_bytes = 0
            self._schedule([_Piece(joined)], now_ns)

    def _schedule(self, pieces: list[_Piece], now_ns: int) -> None:
        if not self._plan:
            self._plan_due_ns = now_ns + pieces[0].wait_ns
        self._plan += pieces
        self._plan_bytes += sum(len(piece.data) for piece in pieces)
        self.release(now_ns)

    def _write(self, data: bytes, now_ns: int) -> None:
        """Send now, while the queue is empty; what is not taken becomes the queue."""
        sent = self._send(data)
        if sent < len(data):
            self._stuck_since_ns = now_ns
            self._queue += data[sent:]

    def _send(self, data: bytes | memoryview) -> int:
        try:
            return self._sock.send(data)
        except (BlockingIOError, InterruptedError):
            return 0
