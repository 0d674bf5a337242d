"""From sockets to frames of the settings' PMUs, in one thread: receive, then parse, in turn.

The kernel stamps arrivals, so parsing costs no stamp its exactness. What is not of a configured source and IDCODE goes
no further. One round takes at most 256 datagrams from each port, and of large ones fewer (``READ_DATAGRAMS`` and
``READ_BYTES`` of :mod:`pmutools.net.udp`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dcon.front.strangers import Strangers
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item, PmuFrameIn
from pmutools.c37118 import FrameType, Message, StreamConfig
from pmutools.c37118.config import is_fragment, whole
from pmutools.c37118.constants import MAX_FRAME_SIZE
from pmutools.flow import Chunk
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.receiver import Receivers
from pmutools.timebase import NS

HELD_NS = NS
"""Frames that came so long before the first configuration of their PMU are too old to control by."""


class Reception:
    """The two loops of the front: :meth:`receive` and :meth:`parse`."""

    def __init__(self, receivers: Receivers, counts: FrontCounts | None = None) -> None:
        self.receivers = receivers
        self.counts = FrontCounts() if counts is None else counts
        self._strangers = Strangers(receivers.routes.hears)
        self._unusable = 0
        """Frames that were read, and cannot be handed on, or rule nothing."""
        self._configs: dict[int, StreamConfig] = {}
        self._since_ns: dict[int, int] = {}
        """By PMU, from which arrival on its frames count: what was held for its first configuration may be old."""
        self._refused: set[int] = set()
        """Whose newest configuration cannot be handed on: their data would be read by an older one."""

    def receive(self, timeout_ns: int) -> list[Chunk | LinkEvent]:
        """What has come; waits for it at most ``timeout_ns``."""
        return self.receivers.poll(timeout_ns)

    def parse(self, received: Sequence[Chunk | LinkEvent], take: Callable[[Item], object]) -> None:
        """Hand ``take`` the frames that are somebody's, and the news, in order."""
        receivers, counts = self.receivers, self.counts
        for item in received:
            if not isinstance(item, Chunk):
                counts.own_drops += item.datagrams
                take(item)
            elif self._strangers.drop(item):
                continue
            for found in receivers.parse(item):
                if isinstance(found, Message):  # what is lost the receivers count
                    self._route(found, take)
        counts.foreign, counts.held = receivers.unwanted + self._strangers.dropped, receivers.held
        counts.undecodable = receivers.undecodable + self._unusable

    def _route(self, message: Message, take: Callable[[Item], object]) -> None:
        frame, flow, config = message
        owners = self.receivers.owners(flow, frame.idcode)
        if frame.type is FrameType.DATA:
            for owner in owners:
                if owner in self._refused:
                    self._unusable += 1
                elif (frame.arrival_ns or 0) < self._since_ns.get(owner, 0):
                    self.counts.unreadable_yet += 1
                else:
                    take(PmuFrameIn(owner, frame))
        elif config is None and frame.type.is_config and not is_fragment(frame.data):
            self._unusable += 1
        elif config is None or not frame.type.rules_data:
            self.counts.unneeded += 1
        else:
            fresh = [owner for owner in owners if self._configs.get(owner) != config]
            self.counts.repeated += not fresh
            for owner in fresh:
                self._configs[owner] = config
                self._since_ns.setdefault(owner, (frame.arrival_ns or 0) - HELD_NS)
                take(self._handed_on(owner, message, config))

    def _handed_on(self, owner: int, message: Message, config: StreamConfig) -> Item:
        """The whole configuration; where it is longer than a frame can be, that it is refused."""
        frame, flow, _ = message
        data = whole(frame.data, config)
        if len(data) > MAX_FRAME_SIZE:
            self._refused.add(owner)
            self._unusable += 1
            where = f"{flow.transport}://{flow.source}"
            why = f"its configuration takes {len(data)} bytes, which is more than the {MAX_FRAME_SIZE} of a frame"
            return LinkEvent(LinkKind.NO_CONFIG, where, (owner,), f"{why}; it is refused", frame.idcode, flow)
        self._refused.discard(owner)
        return PmuFrameIn(owner, frame._replace(data=data), is_config=True)

    def close(self) -> None:
        self.receivers.close()
