"""Work that may take longer than the sockets can wait: done step by step between rounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator

BUDGET_NS = 50_000_000
"""What chores may take of a round."""


class Chores:
    """Iterators, each by a name, that are run a step at a time. One of a name goes on at a time."""

    def __init__(self, monotonic_ns: Callable[[], int]) -> None:
        self._now_ns = monotonic_ns
        self._running: dict[str, Iterator[None]] = {}
        self.took_ns: dict[str, int] = {}
        """What the last one of a name has taken so far."""

    def busy(self, name: str) -> bool:
        """Whether one of this name is not done."""
        return name in self._running

    def start(self, name: str, work: Iterator[None]) -> None:
        """Have it done; one of this name that is not, is finished before."""
        if name in self._running:
            self._run(name, None)
        self._running[name], self.took_ns[name] = work, 0

    def drop(self, name: str) -> None:
        """Give up what is not done."""
        self._running.pop(name, None)

    def work(self, budget_ns: int = BUDGET_NS) -> None:
        """Go on for so long, and at least a step."""
        end_ns = self._now_ns() + budget_ns
        while self._running:
            self._run(next(iter(self._running)), end_ns)
            if self._now_ns() >= end_ns:
                return

    def finish(self) -> None:
        """Do all that is left."""
        for name in list(self._running):
            self._run(name, None)

    def _run(self, name: str, end_ns: int | None) -> None:
        work, began_ns = self._running[name], self._now_ns()
        try:
            for _ in work:
                if end_ns is not None and self._now_ns() >= end_ns:
                    self._running[name] = self._running.pop(name)  # others have their turn
                    return
            del self._running[name]
        except BaseException:
            self._running.pop(name, None)
            raise
        finally:
            self.took_ns[name] += self._now_ns() - began_ns
