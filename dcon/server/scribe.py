"""The recorder's thread: a disk that hangs holds up the log, and neither operators nor the emergency stop."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from functools import partial

from dcon.link.bundle import Bundle
from dcon.server.recorder import Recorder, Report

LOG = logging.getLogger(__name__)
FLUSH_S = 0.5
"""Between flushes: what the log of a machine that dies may lack at most, beside what was on its way."""
WAITING_BYTES = 32 << 20
"""Bundles that may wait for the disk; beyond this the controller keeps them."""


class Scribe:
    """Takes bundles at once, and writes them when the disk does. ``told`` is called in the thread after a flush."""

    def __init__(self, recorder: Recorder, told: Callable[[Report], None]) -> None:
        self._recorder = recorder
        self._told = told
        self._queue: queue.SimpleQueue[tuple[Bundle, int] | None] = queue.SimpleQueue()
        self._put = 0
        self._taken = 0
        self.came_round = time.monotonic()
        """When the thread last had written all it was about to."""
        self._thread = threading.Thread(target=self._run, name="scribe", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Bytes."""
        return self._put - self._taken

    @property
    def has_room(self) -> bool:
        return self.waiting < WAITING_BYTES

    def hangs(self, patience_s: float) -> bool:
        """Whether the disk has held the thread up for so long."""
        return time.monotonic() - self.came_round > patience_s

    def put(self, bundle: Bundle, size: int) -> None:
        self._put += size
        self._queue.put((bundle, size))

    def close(self, patience_s: float = 10.0) -> bool:
        """Write what waits, and end; false where the disk does not let that be in time."""
        self._queue.put(None)
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        recorder = self._recorder
        due = time.monotonic()
        while True:
            now = self.came_round = time.monotonic()
            if now >= due:
                due = now + FLUSH_S
                self._safely(lambda: self._told(recorder.flush()))
            try:
                item = self._queue.get(timeout=max(due - time.monotonic(), 0.001))
            except queue.Empty:
                continue
            if item is None:
                self._safely(recorder.close)
                self._safely(lambda: self._told(recorder.flush()))
                return
            bundle, size = item
            self._safely(partial(recorder.take, bundle))
            self._taken += size

    @staticmethod
    def _safely(do: Callable[[], object]) -> None:
        try:
            do()
        except Exception:  # the edge of the thread: one bundle may fail, the log goes on
            LOG.exception("the log failed; it goes on")
