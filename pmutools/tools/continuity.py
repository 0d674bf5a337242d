"""Which flows carry on a stream: a sender that was started again, a connection made anew.

Addresses change then, the stream does not: its frames belong into one table, and one count. A new flow carries a stream
on where the host, the listener or server and the IDCODE are the same and the flow before it has fallen silent; two that
send at the same time are two streams.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import FLOWS, Loss, Message
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.timebase import NS

SILENT_FRAMES = 3
"""A datagram sender that has missed so many reporting instants has stopped."""

_Key = tuple[str, str, int]
_Place = tuple[Flow, int]


@dataclass
class _Stream:
    first: Flow
    """Under which it goes on."""
    current: Flow
    last_ns: int
    rate: float = 0.0


class Continuity:
    """Gives the flows of rounds the name that their stream began with. Memory: :data:`FLOWS` flows."""

    def __init__(self) -> None:
        self._by_flow: dict[_Place, _Stream] = {}
        self._streams: dict[_Key, list[_Stream]] = {}

    def settle(self, found: Sequence[Block | Message | Loss]) -> list[Block | Message | Loss]:
        """The round, with blocks and messages under their stream's first flow."""
        for item in found:  # who still sends is known before new flows are judged
            if isinstance(item, Block) and (known := self._by_flow.get((item.flow, item.batch.config.idcode))):
                known.last_ns = max(known.last_ns, int(item.batch.arrival_ns.max()))
                known.rate = float(item.batch.config.rate)
        return [item if isinstance(item, Loss) else self._settled(item) for item in found]

    def _settled(self, item: Block | Message) -> Block | Message:
        if isinstance(item, Block):
            config: StreamConfig = item.batch.config
            stream = self._stream(item.flow, config.idcode, int(item.batch.arrival_ns[0]))
            stream.last_ns, stream.rate = max(stream.last_ns, int(item.batch.arrival_ns.max())), float(config.rate)
            return item if stream.first == item.flow else item._replace(flow=stream.first)
        arrival_ns = item.frame.arrival_ns
        stream = self._stream(item.flow, item.frame.idcode, NO_TIME if arrival_ns is None else arrival_ns)
        return item if stream.first == item.flow else item._replace(flow=stream.first)

    def _stream(self, flow: Flow, idcode: int, first_ns: int) -> _Stream:
        place = flow, idcode
        known = self._by_flow.get(place)
        if known is not None and known.current == flow:
            return known
        if len(self._by_flow) >= FLOWS:
            self._by_flow.clear()
            self._streams.clear()
        streams = self._streams.setdefault(_key(flow, idcode), [])
        ended = [] if known is not None else [one for one in streams if _over(one, flow, first_ns)]
        if len(ended) == 1:
            (stream,) = ended
            stream.current = flow
        else:  # one that comes back after another went on in its place is a stream of its own from then on
            stream = _Stream(flow, flow, first_ns)
            streams.append(stream)
        self._by_flow[place] = stream
        return stream


def _key(flow: Flow, idcode: int) -> _Key:
    """Whose stream it is: the server's, or of a host at a listener."""
    if flow.transport == "tcp":
        return flow.transport, flow.source, idcode
    return flow.transport, f"{flow.source.rpartition(':')[0]}>{flow.destination}", idcode


def _over(stream: _Stream, flow: Flow, first_ns: int) -> bool:
    """Whether ``stream`` has ended when a new ``flow`` begins. A connection made anew follows one that was lost."""
    if flow.transport == "tcp":
        return True
    return first_ns - stream.last_ns > SILENT_FRAMES * NS / stream.rate if stream.rate else True
