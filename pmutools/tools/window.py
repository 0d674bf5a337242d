"""Keep a part of a recording: from T1 to T2, these streams only."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pmutools import timebase
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.prefix import decode_prefix
from pmutools.errors import SettingsError
from pmutools.formats.source import Block


@dataclass(frozen=True, slots=True)
class Moment:
    """A time in a recording: seconds into the source (``relative``), or POSIX UTC; in ns."""

    ns: int
    relative: bool

    def resolve(self, first_ns: int) -> int:
        """POSIX UTC ns, given the source's first stamp."""
        return first_ns + self.ns if self.relative else self.ns


def parse_moment(text: str) -> Moment:
    """``12.5`` (seconds into the source) or an ISO-8601 UTC time; raises SettingsError for anything else."""
    try:
        return Moment(round(float(text) * timebase.NS), relative=True)
    except (ValueError, OverflowError):
        pass
    try:
        return Moment(timebase.parse_utc(text), relative=False)
    except ValueError:
        raise SettingsError(
            f"{text!r} is no time: give seconds into the source (12.5) or UTC (2016-09-08T17:05:11Z)"
        ) from None


@dataclass
class Window:
    """Keeps data frames with ``start <= time < end`` and, if ``idcodes`` are named, only their streams.

    ``duration_ns`` counts from the first stamp kept. Configurations, headers and commands pass whatever their time.
    One window reads one source: it learns the first stamp from what it is shown.
    """

    start: Moment | None = None
    end: Moment | None = None
    duration_ns: int | None = None
    idcodes: Collection[int] = ()
    _low: int | None = None
    _high: int | None = None

    @property
    def open(self) -> bool:
        """Whether everything passes."""
        return self.start is None and self.end is None and self.duration_ns is None and not self.idcodes

    def items(self, items: Iterable[Message | Loss]) -> Iterator[Message | Loss]:
        """Messages in the window; losses pass."""
        if self.open:
            yield from items
            return
        for item in items:
            if isinstance(item, Message):
                if self.idcodes and item.frame.idcode not in self.idcodes:
                    continue
                if item.frame.type is FrameType.DATA and item.config is not None:
                    prefix = decode_prefix(item.frame.data)
                    time_ns = timebase.to_ns(prefix.soc, prefix.fracsec, item.config.time_base)
                    low, high = self._bounds(time_ns)
                    if not low <= time_ns < high:
                        continue
            yield item

    def blocks(self, blocks: Iterable[Block | Message | Loss]) -> Iterator[Block | Message | Loss]:
        """The same over blocks, row by row."""
        if self.open:
            yield from blocks
            return
        for item in blocks:
            if isinstance(item, Loss):
                yield item
            elif isinstance(item, Message):
                if not self.idcodes or item.frame.idcode in self.idcodes:
                    yield item
            elif not self.idcodes or item.batch.config.idcode in self.idcodes:
                times = item.batch.time_ns
                low, high = self._bounds(int(times[0]))
                inside = (times >= low) & (times < high)
                if inside.all():
                    yield item
                elif inside.any():
                    for run in np.split(
                        np.flatnonzero(inside), np.flatnonzero(np.diff(np.flatnonzero(inside)) > 1) + 1
                    ):
                        yield Block(item.flow, item.batch[int(run[0]) : int(run[-1]) + 1])

    def _bounds(self, time_ns: int) -> tuple[float, float]:
        if self._low is None or self._high is None:
            self._low = self.start.resolve(time_ns) if self.start else -(1 << 62)
            self._high = self.end.resolve(time_ns) if self.end else 1 << 62
            if self.duration_ns is not None:
                self._high = min(self._high, max(self._low, time_ns) + self.duration_ns)
        return self._low, self._high
