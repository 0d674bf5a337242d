"""Keep a part of a recording: from T1 to T2, these streams only."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.frames import stamp_ns
from pmutools.formats.source import Block
from pmutools.parsers import Place

FOREVER = 1 << 62
"""Further from 1970 than any stamp, in ns."""


@dataclass
class Window:
    """Keeps data frames with ``start <= time < end`` and, if ``idcodes`` are named, only their streams.

    Relative times count from the first data frame of the source, ``duration_ns`` from there or from ``start`` if that
    is later. Configurations, headers and commands pass whatever their time. One window reads one source: it learns the
    first stamp from what it is shown.
    """

    start: Place | None = None
    end: Place | None = None
    duration_ns: int | None = None
    idcodes: Collection[int] = ()
    _low: int | None = None
    _high: int | None = None

    @property
    def open(self) -> bool:
        """Whether everything passes."""
        return self.start is None and self.end is None and self.duration_ns is None and not self.idcodes

    def bounds(self, time_ns: int) -> tuple[int, int]:
        """POSIX UTC ns of the first stamp that is kept and of the first that is not any more.

        ``time_ns`` is the stamp of the frame at hand; that of the first call is the source's first.
        """
        if self._low is None or self._high is None:
            self._low = _resolved(self.start, time_ns) if self.start else -FOREVER
            self._high = _resolved(self.end, time_ns) if self.end else FOREVER
            if self.duration_ns is not None:
                self._high = min(self._high, max(self._low, time_ns) + self.duration_ns, FOREVER)
        return self._low, self._high

    def items(self, items: Iterable[Message | Loss]) -> Iterator[Message | Loss]:
        """Messages in the window; losses pass."""
        if self.open:
            yield from items
            return
        for item in items:
            if isinstance(item, Message) and not self._keeps(item):
                continue
            yield item

    def blocks(self, blocks: Iterable[Block | Message | Loss]) -> Iterator[Block | Message | Loss]:
        """The same over blocks, row by row."""
        if self.open:
            yield from blocks
            return
        for item in blocks:
            if isinstance(item, Block):
                yield from self._cut(item)
            elif isinstance(item, Loss) or self._keeps(item):
                yield item

    def _keeps(self, message: Message) -> bool:
        frame, _, config = message
        inside = True
        if frame.type is FrameType.DATA and config is not None:
            time_ns = stamp_ns(frame.data, config)
            low, high = self.bounds(time_ns)
            inside = low <= time_ns < high
        return inside and (not self.idcodes or frame.idcode in self.idcodes)

    def _cut(self, block: Block) -> Iterator[Block]:
        flow, batch = block
        low, high = self.bounds(int(batch.time_ns[0]))
        if self.idcodes and batch.config.idcode not in self.idcodes:
            return
        rows = np.flatnonzero((batch.time_ns >= low) & (batch.time_ns < high))
        if len(rows) == len(batch):
            yield block
        elif len(rows):
            for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
                yield Block(flow, batch[int(run[0]) : int(run[-1]) + 1])


def _resolved(place: Place, first_ns: int) -> int:
    """POSIX UTC ns, given the source's first stamp."""
    return max(-FOREVER, min(first_ns + place.ns if place.relative else place.ns, FOREVER))
