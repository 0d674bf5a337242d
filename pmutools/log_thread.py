"""Logging that keeps nobody waiting: a thread writes the lines, however long a pipe or a terminal takes them."""

from __future__ import annotations

import logging
import queue
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import QueueHandler
from threading import Thread

ROOM = 256
"""Lines that wait to be written at most."""
END_S = 1.0
"""What is left is given so long in the end."""


class _Aside(QueueHandler):
    """Hands lines over. What finds no room is dropped, and the next line that does says how many were."""

    def __init__(self, lines: queue.Queue[logging.LogRecord | None]) -> None:
        super().__init__(lines)
        self.dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        if self.dropped:
            record.msg = f"{record.msg} ({self.dropped} lines before it found no room)"
        try:
            self.queue.put_nowait(record)
            self.dropped = 0
        except queue.Full:
            self.dropped += 1


@contextmanager
def log_in_thread() -> Iterator[None]:
    """Whatever is logged within goes to the root logger's handlers by a thread, :data:`ROOM` lines behind at most.

    Begin it before the thread that must not wait is given a real-time policy: threads inherit that.
    """
    root, lines = logging.getLogger(), queue.Queue[logging.LogRecord | None](ROOM)
    handlers = root.handlers[:]
    thread = Thread(target=_write, args=(lines, handlers), name="log", daemon=True)
    thread.start()
    root.handlers[:] = [_Aside(lines)]
    try:
        yield
    finally:
        root.handlers[:] = handlers
        try:
            lines.put(None, timeout=END_S)
        except queue.Full:  # stuck for good: the thread ends with the process
            return
        thread.join(END_S)


def _write(lines: queue.Queue[logging.LogRecord | None], handlers: list[logging.Handler]) -> None:
    while (record := lines.get()) is not None:
        for handler in handlers:
            if record.levelno >= handler.level:
                handler.handle(record)
