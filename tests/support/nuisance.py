"""Clients that misbehave, each a process of its own: ``python nuisance.py KIND tcp|udp+cmd PORT IDCODE SECONDS``.

Only the standard library is imported. ``stopped`` starts and stops, ``silent`` starts and then reads nothing,
``vanished`` starts and dies without a word, ``resetting`` starts and resets, over and over, ``flooding`` asks for the
configuration as fast as it can, ``babbling`` sends bytes that are no frames.
"""

from __future__ import annotations

import os
import random
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]
from support.ear import CFG2, START, STOP, command  # noqa: E402

KINDS = ("stopped", "silent", "vanished", "resetting", "flooding", "babbling")
DATAGRAMS = ("vanished", "flooding", "babbling")
"""Those that are worth trying over UDP, too."""


@contextmanager
def nuisance(kind: str, scheme: str, port: int, idcode: int, seconds: float) -> Iterator[None]:
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, kind, scheme, str(port), str(idcode), str(seconds)],
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    try:
        if process.stdout.readline() != b"connected\n":
            raise RuntimeError(f"{kind}: no connection")
        yield
    finally:
        process.kill()
        process.wait(10)
        process.stdout.close()


def main(kind: str, scheme: str, port: int, idcode: int, seconds: float) -> None:
    sock = connected(scheme, port)
    sys.stdout.write("connected\n")
    sys.stdout.flush()
    end = time.monotonic() + seconds
    sock.send(command(idcode, START))
    if kind in ("stopped", "vanished"):
        time.sleep(0.2)
        if kind == "vanished":
            os._exit(0)
        sock.send(command(idcode, STOP))
    elif kind == "resetting":
        while time.monotonic() < end:
            time.sleep(0.01)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("@ii", 1, 0))
            sock.close()
            sock = connected(scheme, port)
            sock.send(command(idcode, START))
    elif kind in ("flooding", "babbling"):
        flood(kind, scheme, port, idcode, sock, end)
    time.sleep(max(0.0, end - time.monotonic()))


def connected(scheme: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.connect(("127.0.0.1", port))
    return sock


def flood(kind: str, scheme: str, port: int, idcode: int, sock: socket.socket, end: float) -> None:
    rng = random.Random(1)
    octets = command(idcode, CFG2) * 50 if kind == "flooding" else rng.randbytes(1000)
    while time.monotonic() < end:
        readable, writable, _ = select.select([sock], [sock], [], 0.1)
        try:
            if readable and not sock.recv(1 << 16):
                raise ConnectionResetError
            if writable:
                sock.send(octets, socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass
        except OSError:
            sock.close()
            sock = connected(scheme, port)


if __name__ == "__main__":
    kind_, scheme_, port_, idcode_, seconds_ = sys.argv[1:]
    with suppress(ConnectionError):  # the player has ended
        main(kind_, scheme_, int(port_), int(idcode_), float(seconds_))
