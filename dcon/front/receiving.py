"""From sockets to frames of the settings' PMUs, in one thread: receive, then parse, in turn.

The kernel stamps arrivals, so parsing costs no stamp its exactness. What is not of a configured source and IDCODE goes
no further. One round takes at most 256 datagrams from each port, and of large ones fewer (``READ_DATAGRAMS`` and
``READ_BYTES`` of :mod:`pmutools.net.udp`), and :data:`TCP_READ_BYTES` of each connection. What is kept is bounded
(:data:`KEPT`): of strangers nothing is. What passes is no more than a tick can do with: of each PMU so many frames
(:mod:`dcon.front.allowance`), and no configuration that would take long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dcon.front.allowance import Allowance
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item, PmuFrameIn
from pmutools.c37118 import FrameType, Message, StreamConfig
from pmutools.c37118.config import is_fragment, whole
from pmutools.c37118.demux import Bounds
from pmutools.clock import Clock
from pmutools.flow import Chunk
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import Endpoint
from pmutools.net.receiver import Receivers
from pmutools.timebase import NS

HELD_NS = NS
"""Frames that came so long before the first configuration of their PMU are too old to control by."""
LONGEST_CONFIG = 16 << 10
"""Bytes: some sixty stations, or eight hundred channels. The tick that takes one into use takes some 6 ms longer."""
KEPT = Bounds(
    flows=4096,
    held_bytes=1 << 18,
    all_held_bytes=4 << 20,
    longest_config=LONGEST_CONFIG,
    all_config_bytes=4 << 20,
    all_fragment_bytes=1 << 20,
)
"""Little: the collector goes over all of it now and then, and everybody waits for it."""
TCP_READ_BYTES = 4 << 10
"""Of a connection at once: some milliseconds of parsing. Who sends more waits."""


class Reception:
    """The two loops of the front: :meth:`receive` and :meth:`parse`."""

    def __init__(self, receivers: Receivers, counts: FrontCounts | None = None) -> None:
        self.receivers = receivers
        self.counts = FrontCounts() if counts is None else counts
        self._allowance = Allowance()
        self._unusable = 0
        """Frames that were read, and cannot be handed on, or rule nothing."""
        self._configs: dict[int, StreamConfig] = {}
        self._since_ns: dict[int, int] = {}
        """By PMU, from which arrival on its frames count: what was held for its first configuration may be old."""
        self._refused: set[int] = set()
        """Whose newest configuration cannot be handed on: their data would be read by an older one."""

    @classmethod
    def of(cls, endpoints: Sequence[Endpoint], clock: Clock, counts: FrontCounts | None = None) -> Reception:
        """From sockets. Raises as :class:`Receivers` does."""
        receivers = Receivers(endpoints, clock, bounds=KEPT, only_wanted=True, tcp_read_bytes=TCP_READ_BYTES)
        return cls(receivers, counts)

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
            for found in receivers.parse(item):
                if isinstance(found, Message):  # what is lost the receivers count
                    self._route(found, take)
        counts.foreign, counts.held = receivers.unwanted, receivers.held
        counts.undecodable = receivers.undecodable + self._unusable

    def _route(self, message: Message, take: Callable[[Item], object]) -> None:
        frame, flow, config = message
        owners = self.receivers.owners(flow, frame.idcode)
        if frame.type is FrameType.DATA:
            for owner in owners:
                if owner in self._refused:
                    self._unusable += 1
                elif not self._allowance.takes(owner, frame.arrival_ns or 0):
                    self.counts.crowded += 1
                elif (frame.arrival_ns or 0) < self._since_ns.get(owner, 0):
                    self.counts.unreadable_yet += 1
                else:
                    take(PmuFrameIn(owner, frame))
        elif config is None and frame.type.is_config and frame.idcode in self.receivers.demux.too_long:
            self._unusable += 1
            for owner in set(owners) - self._refused:
                take(self._refuse(owner, message))
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
                self._refused.discard(owner)
                take(PmuFrameIn(owner, frame._replace(data=whole(frame.data, config)), is_config=True))

    def _refuse(self, owner: int, message: Message) -> LinkEvent:
        """Its configuration is too long: nothing of it is taken until another comes."""
        frame, flow, _ = message
        self._refused.add(owner)
        self._configs.pop(owner, None)
        why = (
            f"its configuration takes more than {LONGEST_CONFIG} bytes and is refused; "
            "have its sender, or a PDC, send fewer stations or channels"
        )
        where = f"{flow.transport}://{flow.source}"
        return LinkEvent(LinkKind.NO_CONFIG, where, (owner,), why, frame.idcode, flow)

    def close(self) -> None:
        self.receivers.close()
