"""What was received and is not parsed yet: streams take turns, so that a flood of one delays no other.

Datagrams queue by the port that they came to and the PMU that they claim to be of; those that claim to be of none that
is asked for have one queue a port. There are no more queues than PMUs, ports and connections.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable

from dcon.link.counts import FrontCounts
from pmutools.flow import Chunk, Flow
from pmutools.net.dialogue import LinkEvent
from pmutools.net.routes import claimed

MOST = 512
"""Datagrams of one queue that may wait; more are dropped, and counted as crowded. Chunks of a connection are not: with
as many nothing more is received."""


class Turns:
    """Of each queue first in, first out; of all queues, one each in turn."""

    def __init__(self, counts: FrontCounts, hears: Callable[[Flow, int], bool]) -> None:
        """``hears(flow, idcode)``: whether what claims to be of a stream may be asked for."""
        self._counts, self._hears = counts, hears
        self._waiting: dict[Hashable, deque[Chunk | LinkEvent]] = {}
        """The one whose turn is next comes first."""

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._waiting)

    @property
    def has_room(self) -> bool:
        """For what may not be dropped."""
        return all(len(waiting) < MOST for queue, waiting in self._waiting.items() if isinstance(queue, Flow))

    def add(self, received: Iterable[Chunk | LinkEvent]) -> None:
        for item in received:
            waiting = self._waiting.setdefault(self._queue(item), deque())
            if len(waiting) >= MOST and isinstance(item, Chunk) and not item.flow.is_stream:
                self._counts.crowded += 1
            else:
                waiting.append(item)

    def next(self) -> Chunk | LinkEvent:
        """Raises StopIteration where nothing waits."""
        queue = next(iter(self._waiting))
        waiting = self._waiting.pop(queue)
        item = waiting.popleft()
        if waiting:
            self._waiting[queue] = waiting
        return item

    def _queue(self, item: Chunk | LinkEvent) -> Hashable:
        """News stay behind what came of their connection before."""
        flow = item.flow
        if flow is None or flow.is_stream:
            return flow
        idcode = claimed(item.data) if isinstance(item, Chunk) else None
        return flow.destination, idcode if idcode is not None and self._hears(flow, idcode) else None
