"""The other ends of a run folder: who listens, who sends, and what has come."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dcon.link import paths
from dcon.link.beats import Readback, decode_readback


class Listener:
    """Takes whatever comes to a name, with the monotonic time of it."""

    def __init__(self, folder: Path, name: str) -> None:
        self.heard: list[tuple[int, bytes]] = []
        self._sock = paths.bind_datagram(folder, name)
        self._sock.setblocking(True)
        self._sock.settimeout(0.02)
        self._ended = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended:
            with contextlib.suppress(TimeoutError):
                data = self._sock.recv(65536)
                self.heard.append((time.monotonic_ns(), data))

    def close(self) -> None:
        self._ended = True
        self._thread.join(5)
        paths.release(self._sock)

    def beats(self, loop: str) -> list[tuple[int, int, int]]:
        """(arrival, counter, state) of each beat of a loop."""
        found = []
        for arrival_ns, data in list(self.heard):
            if data[:4] == b"DCB1" and data[4:12].rstrip(b"\0") == loop.encode():
                found.append((arrival_ns, int.from_bytes(data[12:16], "big"), data[24]))
        return found

    def readbacks(self) -> list[Readback]:
        found = [decode_readback(data) for _, data in list(self.heard)]
        return [readback for readback in found if readback is not None]

    def said(self, kind: str) -> list[dict[str, Any]]:
        """News as JSON, of one kind."""
        objects = [json.loads(data) for _, data in list(self.heard) if data[:1] == b"{"]
        return [news for news in objects if news["kind"] == kind]


@contextmanager
def listening(folder: Path, *names: str) -> Iterator[tuple[Listener, ...]]:
    listeners = tuple(Listener(folder, name) for name in names)
    try:
        yield listeners
    finally:
        for listener in listeners:
            listener.close()


def send(folder: Path, name: str, datagram: bytes) -> None:
    """To a name, waiting for room."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(datagram, os.fspath(folder / name))


def is_socket(path: Path) -> bool:
    return path.exists() and stat.S_ISSOCK(path.stat().st_mode)


@contextmanager
def in_thread(run: Callable[[], None], stop: Callable[[], None]) -> Iterator[threading.Thread]:
    """``run`` beside the test, until the end of the block; fails where it does not end."""
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield thread
    finally:
        stop()
        thread.join(10)
        assert not thread.is_alive()
