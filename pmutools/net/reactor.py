"""One selector loop: handlers for sockets that are ready, callbacks for times that have come.

Single-threaded: a handler runs to its end before the next, so nothing here or in its users needs a lock.
"""

from __future__ import annotations

import heapq
import selectors
from collections.abc import Callable
from itertools import count
from typing import Protocol

from pmutools.clock import Clock, VirtualClock

READ = selectors.EVENT_READ
WRITE = selectors.EVENT_WRITE


class HasFileno(Protocol):
    """What a selector can wait for."""

    def fileno(self) -> int: ...


class Timer:
    """A callback to come; setting ``cancelled`` keeps it from coming."""

    __slots__ = ("callback", "cancelled", "deadline_ns")

    def __init__(self, deadline_ns: int, callback: Callable[[], None]) -> None:
        self.deadline_ns = deadline_ns
        self.callback = callback
        self.cancelled = False


class Reactor:
    """The loop: sockets and timers, and who is called for them."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._selector = selectors.DefaultSelector()
        self._handlers: dict[int, Callable[[int], None]] = {}
        """By descriptor."""
        self._timers: list[tuple[int, int, Timer]] = []
        self._order = count()
        self._forgotten: set[int] = set()
        self._again: dict[int, int] = {}
        """Sockets to be called in the next turn whether ready or not, by descriptor: their events."""

    def watch(self, source: HasFileno, events: int, handler: Callable[[int], None]) -> None:
        """Call ``handler(events)`` when ``source`` is ready; replaces what was watched before."""
        try:
            key = self._selector.modify(source, events)
        except KeyError:
            key = self._selector.register(source, events)
        self._handlers[key.fd] = handler

    def forget(self, source: HasFileno) -> None:
        """Stop watching, before ``source`` is closed; nothing happens if it was not watched."""
        try:
            fd = self._selector.unregister(source).fd
        except (KeyError, ValueError):
            return
        del self._handlers[fd]
        self._forgotten.add(fd)
        self._again.pop(fd, None)

    def again(self, source: HasFileno, events: int) -> None:
        """Call the handler of ``source`` in the next turn too: it has left off in favour of others."""
        fd = source.fileno()
        self._again[fd] = self._again.get(fd, 0) | events

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> Timer:
        """Call back once the monotonic clock reads ``deadline_ns``."""
        timer = Timer(deadline_ns, callback)
        heapq.heappush(self._timers, (deadline_ns, next(self._order), timer))
        return timer

    def call_in(self, delay_ns: int, callback: Callable[[], None]) -> Timer:
        return self.call_at(self.clock.monotonic_ns() + delay_ns, callback)

    def run(self, timeout_ns: int | None, budget_ns: int | None = None) -> None:
        """Wait until something is ready or due, at most ``timeout_ns`` (None: however long), and handle it.

        Handlers of sockets are called for ``budget_ns`` (None: as long as it takes), and at least one; the rest come
        first in the next turn.
        """
        timers = self._timers
        if timers:
            next_ns = max(timers[0][0] - self.clock.monotonic_ns(), 0)
            timeout_ns = next_ns if timeout_ns is None else min(timeout_ns, next_ns)
        self._forgotten.clear()
        owed, self._again = self._again, {}
        for key, events in self._select(0 if owed else timeout_ns):
            owed[key.fd] = owed.get(key.fd, 0) | events
        self._handle(owed, budget_ns)
        now_ns = self.clock.monotonic_ns()
        while timers and timers[0][0] <= now_ns:
            timer = heapq.heappop(timers)[2]
            if not timer.cancelled:
                timer.callback()

    def _handle(self, owed: dict[int, int], budget_ns: int | None) -> None:
        end_ns = None if budget_ns is None else self.clock.monotonic_ns() + budget_ns
        handlers = self._handlers
        late = False
        for fd, events in owed.items():
            if fd in self._forgotten:  # an earlier handler of this round has closed it
                continue
            if late:
                self._again[fd] = self._again.get(fd, 0) | events
                continue
            handlers[fd](events)
            late = end_ns is not None and self.clock.monotonic_ns() >= end_ns

    def _select(self, timeout_ns: int | None) -> list[tuple[selectors.SelectorKey, int]]:
        if isinstance(self.clock, VirtualClock):  # its time does not pass while the selector waits
            ready = self._selector.select(0)
            if not ready:
                self.clock.advance(timeout_ns or 0)
            return ready
        return self._selector.select(None if timeout_ns is None else timeout_ns / 1e9)

    def close(self) -> None:
        self._selector.close()
        self._timers.clear()
