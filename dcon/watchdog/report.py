"""Lines for people, from a thread of their own: a full pipe or a stuck disk never holds the watchdog up.

At most :data:`QUEUED` lines wait, others are dropped and counted. A log file that would grow beyond its bound becomes
``FILE.1``, over the one before: two bounds of disk at most.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import deque
from typing import Any, Final

QUEUED: Final = 256


class Report:
    """JSON lines to a file, or to stderr. Call :meth:`line` from one thread only."""

    def __init__(self, path: str = "", max_bytes: int = 10_000_000) -> None:
        """Raises OSError where ``path`` cannot be written."""
        self._path, self._max_bytes = path, max_bytes
        self._handle = _opened(path) if path else 2
        self._size = os.fstat(self._handle).st_size if path else 0
        self._lines: deque[dict[str, Any]] = deque()
        self._wake, self._ending = threading.Event(), False
        self.dropped = 0
        threading.stack_size(256 << 10)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def line(self, **fields: Any) -> None:
        """Write a line when there is time. Never waits, never raises."""
        if len(self._lines) >= QUEUED:
            self.dropped += 1
            return
        if self.dropped:
            fields["dropped"] = self.dropped
        self._lines.append(fields)
        self._wake.set()

    def close(self, timeout_s: float = 0.5) -> None:
        """Write what waits, for so long at most."""
        self._ending = True
        self._wake.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            while self._lines:
                fields = self._lines.popleft()
                self._write(json.dumps({"utc": _utc(), **fields}).encode() + b"\n")
            if self._ending:
                return

    def _write(self, data: bytes) -> None:
        try:
            if self._path and self._size and self._size + len(data) > self._max_bytes:
                os.replace(self._path, self._path + ".1")
                handle = _opened(self._path)
                os.close(self._handle)
                self._handle, self._size = handle, 0
            while data:
                written = os.write(self._handle, data)
                data, self._size = data[written:], self._size + written
        except OSError:
            self.dropped += 1


def _opened(path: str) -> int:
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)


def _utc() -> str:
    second, ns = divmod(time.time_ns(), 10**9)
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(second)) + f".{ns // 10**6:03d}Z"
