"""A folder of recordings as one: its files merged on time. Such a folder is what a sink of tables makes."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message, Tally
from pmutools.c37118.frames import stamp_ns
from pmutools.formats.source import Block, Source


class MergedSource:
    """Several sources as one, in order of arrival where all know it, else of their stamps; ``tally`` is their sum.

    A source's own order is kept. Blocks of different streams overlap in time; they come in order of their first rows.
    """

    def __init__(self, path: Path, kind: str, sources: Sequence[Source]) -> None:
        self.path, self.kind = path, kind
        self._sources = sources
        self.tally = Tally()

    def items(self) -> Iterator[Message | Loss]:
        return self._merged([source.items() for source in self._sources], _item_times)

    def blocks(self) -> Iterator[Block | Message | Loss]:
        return self._merged([source.blocks() for source in self._sources], _block_times)

    def defects(self) -> dict[str, int]:
        return {
            f"{source.path.name}: {name}": count for source in self._sources for name, count in source.defects().items()
        }

    def _merged(self, streams: Sequence[Iterator[Any]], times: Callable[[Any], tuple[int, int]]) -> Iterator[Any]:
        walks = [_Walk(stream, times, number) for number, stream in enumerate(streams)]
        by_arrival = all(walk.arrival_ns != NO_TIME for walk in walks if walk.more)
        try:
            merged = heapq.merge(*(walk.keyed(by_arrival) for walk in walks), key=lambda entry: entry[:2])
            yield from (item for *_, item in merged)
        finally:
            self._sum_up()

    def _sum_up(self) -> None:
        """Bring ``tally``, which others may hold, up to date."""
        total, tallies = self.tally, [source.tally for source in self._sources]
        total.fed = sum(tally.fed for tally in tallies)
        total.framed = sum(tally.framed for tally in tallies)
        total.ignored = sum(tally.ignored for tally in tallies)
        total.ignored_flows = sum(tally.ignored_flows for tally in tallies)
        total.frames = dict(sum((Counter(tally.frames) for tally in tallies), Counter()))
        total.skipped = dict(sum((Counter(tally.skipped) for tally in tallies), Counter()))


class _Walk:
    """One source's items, the first of them looked at; ``arrival_ns`` is its."""

    def __init__(self, stream: Iterator[Any], times: Callable[[Any], tuple[int, int]], number: int) -> None:
        self._stream, self._times, self._number = stream, times, number
        self._first = next(stream, None)
        self.more = self._first is not None
        self.arrival_ns = times(self._first)[1] if self.more else NO_TIME

    def keyed(self, by_arrival: bool) -> Iterator[tuple[int, int, Any]]:
        """(time, source number, item); an item without a time has that of the one before it."""
        latest, item = NO_TIME, self._first
        while item is not None:
            latest = max(latest, self._times(item)[by_arrival])
            yield latest, self._number, item
            item = next(self._stream, None)


def _item_times(item: Message | Loss) -> tuple[int, int]:
    """Stamp and arrival of an item, NO_TIME where it has none."""
    if isinstance(item, Loss):
        return NO_TIME, NO_TIME
    frame, _, config = item
    arrival_ns = NO_TIME if frame.arrival_ns is None else frame.arrival_ns
    if config is None or frame.type is not FrameType.DATA:
        return NO_TIME, arrival_ns
    return stamp_ns(frame.data, config), arrival_ns


def _block_times(item: Block | Message | Loss) -> tuple[int, int]:
    if isinstance(item, Block):
        return int(item.batch.time_ns[0]), int(item.batch.arrival_ns[0])
    return _item_times(item)
