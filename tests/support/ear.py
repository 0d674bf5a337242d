"""Receivers that share nothing with pmutools: plain sockets in a process of their own, and frames read by hand.

::

    with listening(Ear("a", "udp", port), Ear("b", "tcp", other, idcode=7)) as ears:
        ...                                                   # what is sent meanwhile is kept, with kernel stamps
    heard = ears["a"].chunks                                  # when the with is left

Run as a program this file is that process. Only the standard library is imported, so it starts in some 50 ms.
"""

from __future__ import annotations

import binascii
import pickle
import selectors
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

STOP, START, HEADER, CFG1, CFG2, CFG3 = range(1, 7)
_SO_TIMESTAMPNS = 35
_AGAIN_S = 0.01
_LIMIT_S = 60.0


class Ear(NamedTuple):
    """One receiver. ``udp`` binds to ``port``; others connect there, send ``ask`` (commands by code) and listen."""

    name: str
    scheme: str
    port: int
    idcode: int = 0
    host: str = "127.0.0.1"
    ask: tuple[int, ...] = (CFG2, START)
    later: tuple[tuple[int, int], ...] = ()
    """(after so many reads, a command)."""
    again: bool = False
    """Connect, and ask, anew whenever the connection ends."""
    data_port: int = 0
    """Of ``tcp+udp``; 0: another ear hears the data."""


class Chunk(NamedTuple):
    """What one read gave: a datagram, or bytes of a stream. ``at_ns`` is the kernel's UTC."""

    at_ns: int
    data: bytes


class Heard(NamedTuple):
    """All that one receiver got; ``events`` are ``connected``, ``fin``, ``rst``, ``refused``, in UTC ns."""

    chunks: list[Chunk]
    events: list[tuple[int, str]]

    def when(self, kind: str) -> list[int]:
        return [at_ns for at_ns, what in self.events if what == kind]


# --- frames, by hand


def crc(octets: bytes) -> int:
    return binascii.crc_hqx(octets, 0xFFFF)


def good(frame: bytes) -> bool:
    """Whether the last two bytes are the CHK of those before."""
    return crc(frame[:-2]) == int.from_bytes(frame[-2:], "big")


def sealed(body: bytes) -> bytes:
    return body + crc(body).to_bytes(2, "big")


def command(idcode: int, code: int) -> bytes:
    return sealed(struct.pack(">HHHIIH", 0xAA41, 18, idcode, 0, 0, code))


def word(frame: bytes, at: int) -> int:
    return int.from_bytes(frame[at : at + 2], "big")


def is_data(frame: bytes) -> bool:
    return frame[:1] == b"\xaa" and frame[1:2] in (b"\x01", b"\x02")


def undisturbed(octets: bytes) -> Iterator[tuple[int, bytes]]:
    """(position, frame) of whole frames end to end, by their FRAMESIZE; stops where there is none."""
    at = 0
    while at + 4 <= len(octets) and octets[at] == 0xAA and at + word(octets, at + 2) <= len(octets):
        size = word(octets, at + 2)
        if size < 16:
            return
        yield at, octets[at : at + size]
        at += size


# --- the other end


@contextmanager
def listening(*ears: Ear) -> Iterator[dict[str, Heard]]:
    """Receive in another process; the dict is filled when the ``with`` is left, some time after the last frame."""
    heard: dict[str, Heard] = {}
    process = subprocess.Popen([sys.executable, "-I", "-S", __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        pickle.dump([tuple(ear) for ear in ears], process.stdin)
        process.stdin.flush()
        if process.stdout.readline() != b"ready\n":
            raise RuntimeError("the receivers did not start")
        yield heard
        out, _ = process.communicate(timeout=_LIMIT_S)
        told = pickle.loads(out)
        for name, (chunks, events) in told.items():
            heard[name] = Heard([Chunk(*chunk) for chunk in chunks], events)
    finally:
        process.kill()
        process.wait(10)
        process.stdin.close()
        process.stdout.close()


class _Listener:
    def __init__(self, ear: Ear, selector: selectors.BaseSelector) -> None:
        self.ear, self._selector = ear, selector
        self.chunks: list[tuple[int, bytes]] = []
        self.events: list[tuple[int, str]] = []
        self._later = list(ear.later)
        self.lost = False
        if ear.scheme == "udp":
            self._hear(_bound(ear.host, ear.port))
        elif ear.data_port:
            self._hear(_bound("127.0.0.1", ear.data_port))
        if ear.scheme != "udp":
            self.connect()

    def connect(self) -> None:
        self.lost = False
        stream = self.ear.scheme.startswith("tcp")
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM if stream else socket.SOCK_DGRAM)
        try:
            sock.connect((self.ear.host, self.ear.port))
        except OSError:
            sock.close()
            self._note("refused")
            self.lost = True
            return
        self._note("connected")
        self.sock = sock
        self._hear(sock)
        for code in self.ear.ask:
            self.say(code)

    def say(self, code: int) -> None:
        with suppress(OSError):
            self.sock.sendall(command(self.ear.idcode, code))

    def _hear(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.setblocking(False)
        self._selector.register(sock, selectors.EVENT_READ, lambda: self._read(sock))

    def _note(self, kind: str) -> None:
        self.events.append((time.time_ns(), kind))

    def _read(self, sock: socket.socket) -> None:
        try:
            data, control, _, _ = sock.recvmsg(1 << 18, 64)
        except BlockingIOError:
            return
        except OSError:
            data = b""
            self._note("rst")
        else:
            if not data and sock.type == socket.SOCK_STREAM:
                self._note("fin")
        if not data:
            if sock.type == socket.SOCK_STREAM:
                self._selector.unregister(sock)
                sock.close()
                self.lost = True
            return
        at_ns = time.time_ns()
        for level, kind, value in control:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                seconds, rest_ns = struct.unpack("@qq", value)
                at_ns = seconds * 10**9 + rest_ns
        self.chunks.append((at_ns, data))
        while self._later and len(self.chunks) >= self._later[0][0]:
            self.say(self._later.pop(0)[1])


def _bound(host: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    sock.bind((host, port))
    if 224 <= int(host.split(".")[0]) < 240:
        member = socket.inet_aton(host) + socket.inet_aton("127.0.0.1")
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    return sock


def _serve(ears: Sequence[Ear]) -> dict[str, Any]:
    selector = selectors.DefaultSelector()
    listeners = [_Listener(ear, selector) for ear in ears]
    over = False

    def end() -> None:
        nonlocal over
        over = True

    selector.register(sys.stdin.fileno(), selectors.EVENT_READ, end)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    limit = time.monotonic() + _LIMIT_S
    while not over and time.monotonic() < limit:
        lost = [listener for listener in listeners if listener.lost and listener.ear.again]
        for key, _ in selector.select(_AGAIN_S if lost else 1.0):
            key.data()
        for listener in lost:
            listener.connect()
    while ready := [key for key, _ in selector.select(0.02) if key.fd != sys.stdin.fileno()]:
        for key in ready:
            key.data()
    return {listener.ear.name: (listener.chunks, listener.events) for listener in listeners}


if __name__ == "__main__":
    told = _serve([Ear(*ear) for ear in pickle.load(sys.stdin.buffer)])
    sys.stdout.buffer.write(pickle.dumps(told))
