"""A live source whose rounds are looked at on their way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Self

from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.formats.source import Block, Gatherer
from pmutools.tools.live import ROUND_NS, LiveSource


class TappedSource(LiveSource):
    """Polls as they come; :attr:`each_round` is given them as :meth:`LiveSource.rounds` gathers them, and the time.

    For who takes messages one by one; who takes rounds has no need of it.
    """

    each_round: Callable[[list[Block | Message | Loss], int], None] | None = None

    def __enter__(self) -> Self:
        return self

    def polls(self) -> Iterator[list[Message | Loss]]:
        gatherer, out = Gatherer(), list[Block | Message | Loss]()
        due_ns = self.clock.monotonic_ns() + ROUND_NS
        for found in super().polls():
            if self.each_round is not None:
                for item in found:
                    if isinstance(item, Loss) or item.frame.type is not FrameType.DATA:
                        out.append(item)
                    elif (block := gatherer.add(item)) is not None:
                        out.append(block)
                if (now_ns := self.clock.monotonic_ns()) >= due_ns:
                    due_ns = now_ns + ROUND_NS
                    self.each_round([*out, *gatherer.flush()], now_ns)
                    out = []
            yield found
