"""The last seconds of all streams in memory: wire bytes and arrivals, decoded again when they are wanted."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import decode_batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Loss, Message
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.tools.reader.reading import Round

ITEM_BYTES = 600
"""What a block or message takes beside its bytes, about."""


class _Packed(NamedTuple):
    """A block without its columns."""

    flow: Flow
    config: StreamConfig
    wire: bytes
    arrival_ns: npt.NDArray[np.int64]
    stamp_source: npt.NDArray[np.uint8]

    def block(self) -> Block:
        return Block(self.flow, decode_batch(self.wire, self.config, self.arrival_ns, self.stamp_source, check=False))


@dataclass(frozen=True)
class _Entry:
    at_ns: int
    items: tuple[_Packed | Block | Message | Loss, ...]
    nbytes: int


class History:
    """Rounds by number, the first one ``first``; how many are kept is said by who keeps them."""

    def __init__(self) -> None:
        self._entries: deque[_Entry] = deque()
        self.first = 0
        self.nbytes = 0

    @property
    def end(self) -> int:
        """The number that the next round will have."""
        return self.first + len(self._entries)

    def add(self, found: Round, at_ns: int) -> None:
        """A round that ended at ``at_ns``."""
        items = tuple(_packed(item) for item in found if not (isinstance(item, Loss) and item.undecoded is None))
        nbytes = sum(map(_nbytes, items))
        self._entries.append(_Entry(at_ns, items, nbytes))
        self.nbytes += nbytes

    def at_ns(self, number: int) -> int:
        return self._entries[number - self.first].at_ns

    def round(self, number: int) -> list[Block | Message | Loss]:
        """Round ``number``, as it was."""
        entry = self._entries[number - self.first]
        return [item.block() if isinstance(item, _Packed) else item for item in entry.items]

    def drop(self) -> None:
        """Forget the first round."""
        entry = self._entries.popleft()
        self.first += 1
        self.nbytes -= entry.nbytes


def _packed(item: Block | Message | Loss) -> _Packed | Block | Message | Loss:
    if isinstance(item, Block) and item.batch.wire is not None:
        flow, batch = item
        sources = np.ascontiguousarray(batch.stamp_source)
        return _Packed(flow, batch.config, item.batch.wire.tobytes(), batch.arrival_ns, sources)
    return item


def _nbytes(item: _Packed | Block | Message | Loss) -> int:
    if isinstance(item, _Packed):
        return ITEM_BYTES + len(item.wire) + item.arrival_ns.nbytes + item.stamp_source.nbytes
    if isinstance(item, Block):
        return ITEM_BYTES + len(item.batch) * item.batch.config.frame_size * 5
    return ITEM_BYTES + (item.skipped.nbytes if isinstance(item, Loss) else len(item.frame.data))
