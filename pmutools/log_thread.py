"""Logging that keeps nobody waiting: a thread writes the lines, however long a pipe or a terminal takes them."""

from __future__ import annotations

import logging
import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from logging.handlers import QueueHandler
from threading import Thread

ROOM = 256
"""Lines that wait to be written at most."""
Aside = Callable[[Callable[[], object]], None]
"""Has something else done by the thread, in its turn; dropped where there is no room."""
END_S = 1.0
"""What is left is given so long in the end."""


_Lines = queue.Queue[logging.LogRecord | Callable[[], object] | None]


class _Handler(QueueHandler):
    """Hands lines over. What finds no room is dropped, and the next line that does says how many were."""

    def __init__(self, lines: _Lines) -> None:
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
def log_in_thread() -> Iterator[Aside]:
    """Whatever is logged within goes to the root logger's handlers by a thread, :data:`ROOM` lines behind at most.

    Begin it before the thread that must not wait is given a real-time policy: threads inherit that.
    """
    root, lines = logging.getLogger(), _Lines(ROOM)
    handlers = root.handlers[:]
    thread = Thread(target=_write, args=(lines, handlers), name="log", daemon=True)
    thread.start()
    root.handlers[:] = [_Handler(lines)]

    def aside(work: Callable[[], object]) -> None:
        with suppress(queue.Full):
            lines.put_nowait(work)

    try:
        yield aside
    finally:
        root.handlers[:] = handlers
        try:
            lines.put(None, timeout=END_S)
        except queue.Full:  # stuck for good: the thread ends with the process
            return
        thread.join(END_S)


def _write(lines: _Lines, handlers: list[logging.Handler]) -> None:
    while (line := lines.get()) is not None:
        if not isinstance(line, logging.LogRecord):
            line()
            continue
        for handler in handlers:
            if line.levelno >= handler.level:
                handler.handle(line)
