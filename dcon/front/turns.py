"""What was received and is not parsed yet: ports take turns, so that what a flooded one holds delays nobody else."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable

from dcon.link.counts import FrontCounts
from pmutools.flow import Chunk
from pmutools.net.dialogue import LinkEvent

MOST = 512
"""Datagrams of one port that may wait; more are dropped, and counted as crowded. Chunks of a connection are not: with
as many nothing more is received."""


class Turns:
    """Of each port first in, first out; of all ports, one each in turn."""

    def __init__(self, counts: FrontCounts) -> None:
        self._counts = counts
        self._waiting: dict[Hashable, deque[Chunk | LinkEvent]] = {}
        """By port; the one whose turn is next comes first."""

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._waiting)

    @property
    def has_room(self) -> bool:
        """For what may not be dropped."""
        return all(len(waiting) < MOST for port, waiting in self._waiting.items() if not isinstance(port, str))

    def add(self, received: Iterable[Chunk | LinkEvent]) -> None:
        for item in received:
            waiting = self._waiting.setdefault(_port(item), deque())
            if len(waiting) >= MOST and isinstance(item, Chunk) and not item.flow.is_stream:
                self._counts.crowded += 1
            else:
                waiting.append(item)

    def next(self) -> Chunk | LinkEvent:
        """Raises StopIteration where nothing waits."""
        port = next(iter(self._waiting))
        waiting = self._waiting.pop(port)
        item = waiting.popleft()
        if waiting:
            self._waiting[port] = waiting
        return item


def _port(item: Chunk | LinkEvent) -> Hashable:
    """Of datagrams the address that they came to, else the flow; news stay behind what came of their flow before."""
    flow = item.flow
    return flow.destination if flow is not None and not flow.is_stream else flow
