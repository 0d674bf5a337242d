"""Doing the reader's writing: at once, or in a thread of its own, so that a slow disk keeps nothing waiting."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

Step = Callable[[], None]
QUEUED_BYTES = 256 << 20
"""What waits to be written at most, about; then the reader waits too, and the kernel drops what it cannot hold."""


class Steps(Protocol):
    """Does one step after the other. What a step raises comes out of this call, or of a later one."""

    def do(self, step: Step, nbytes: int = 0) -> None:
        """Do a step, which holds ``nbytes`` until it is done."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for the end of all steps; after an error, of the present one."""


class Direct:
    """Steps are done at once."""

    def do(self, step: Step, nbytes: int = 0) -> None:
        step()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


class Threaded:
    """Steps are done in order in another thread."""

    def __init__(self, limit_bytes: int = QUEUED_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._queue: deque[tuple[Step, int]] = deque()
        self._queued_bytes = 0
        self._changed = threading.Condition()
        self._over = False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    def do(self, step: Step, nbytes: int = 0) -> None:
        with self._changed:
            self._changed.wait_for(self._has_room)
            self._raise()
            self._queue.append((step, nbytes))
            self._queued_bytes += nbytes
            self._changed.notify_all()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._over = True
            if error is not None:
                self._queue.clear()
            self._changed.notify_all()
        self._thread.join()
        if error is None:
            self._raise()

    def _has_room(self) -> bool:
        return self._failure is not None or self._queued_bytes < self._limit_bytes

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._over)
                if not self._queue:
                    return
                step, nbytes = self._queue[0]
            try:
                step()
            except BaseException as error:  # it is raised where the steps come from
                with self._changed:
                    self._failure = error
                    self._changed.notify_all()
                return
            with self._changed:
                if self._queue:
                    self._queue.popleft()
                self._queued_bytes -= nbytes
                self._changed.notify_all()
