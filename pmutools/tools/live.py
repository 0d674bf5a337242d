"""Live streams: read from endpoints for a while, as messages, blocks and news."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.clock import Clock, SystemClock
from pmutools.flow import Chunk, Flow
from pmutools.formats.source import Block, Gatherer, gather
from pmutools.net.dialogue import LinkEvent
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.net.receiver import Receivers
from pmutools.net.sockets import RCVBUF_BYTES
from pmutools.sites import Site

POLL_NS = 100_000_000
"""How often a silent reader looks at the time."""
ROUND_NS = 250_000_000
"""How long data frames are gathered before they are handed on."""


class LiveSource:
    """Endpoints as a source: bound when made, read by iterating, closed by leaving the ``with``.

    ``tell`` is given the news of connections. Iteration ends ``duration_ns`` after the source was made, or when
    ``stop``, asked every 0.1 s, says so. Raises SourceError where an endpoint cannot be opened, SettingsError for a
    URL that is none.
    """

    kind = "live"

    def __init__(
        self,
        urls: Sequence[str | Endpoint | Site],
        *,
        duration_ns: int | None = None,
        configs: Iterable[StreamConfig] = (),
        tell: Callable[[LinkEvent], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        clock: Clock | None = None,
        rcvbuf_bytes: int = RCVBUF_BYTES,
    ) -> None:
        self.sites = tuple(url if isinstance(url, Site) else None for url in urls)
        """The sites among ``urls``, by place."""
        endpoints = [_endpoint(url) for url in urls]
        self.path = Path(str(endpoints[0]) if len(endpoints) == 1 else f"{len(endpoints)} endpoints")
        self.clock = clock or SystemClock()
        self.receivers = Receivers(endpoints, self.clock, configs=configs, rcvbuf_bytes=rcvbuf_bytes)
        self.tally = self.receivers.demux.tally
        self.own_drops = 0
        """Datagrams lost in this machine's receive buffers: not the network's doing."""
        self._tell, self._stop = tell, stop
        started_ns = self.clock.monotonic_ns()
        self._end_ns = None if duration_ns is None else started_ns + duration_ns

    def __enter__(self) -> LiveSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.receivers.close()

    def polls(self) -> Iterator[list[Message | Loss]]:
        """What came, poll by poll, an empty list at least every 0.1 s; the last ones hold what was pending."""
        while (left_ns := self._left_ns()) > 0 and not self._stop():
            yield self._poll(min(POLL_NS, left_ns))
        yield self._poll(0)
        yield self.receivers.finish()
        yield self._poll(0)  # the news of the end

    def _poll(self, timeout_ns: int) -> list[Message | Loss]:
        found: list[Message | Loss] = []
        for item in self.receivers.poll(timeout_ns):
            if not isinstance(item, Chunk):
                self.own_drops += item.datagrams
                if self._tell is not None:
                    self._tell(item)
            found += self.receivers.parse(item)
        return found

    def rounds(self, round_ns: int = ROUND_NS) -> Iterator[list[Block | Message | Loss]]:
        """What came, gathered for ``round_ns``: a block a stream of data frames, in order; other frames; losses.

        A configuration frame comes before the blocks that it rules, and an empty list where nothing came.
        """
        gatherer = Gatherer()
        out: list[Block | Message | Loss] = []
        due_ns = self.clock.monotonic_ns() + round_ns
        for found in self.polls():
            for item in found:
                if isinstance(item, Loss) or item.frame.type is not FrameType.DATA:
                    out.append(item)
                elif (block := gatherer.add(item)) is not None:
                    out.append(block)
            if (now_ns := self.clock.monotonic_ns()) >= due_ns:
                due_ns = now_ns + round_ns
                yield [*out, *gatherer.flush()]
                out = []
        yield [*out, *gatherer.flush()]

    def site(self, flow: Flow, idcode: int) -> Site | None:
        """The site that a stream belongs to; None where it was named by its URL only."""
        owners = self.receivers.owners(flow, idcode)
        return next((self.sites[index] for index in owners if self.sites[index] is not None), None)

    def items(self) -> Iterator[Message | Loss]:
        for found in self.polls():
            yield from found

    def blocks(self) -> Iterator[Block | Message | Loss]:
        return gather(self.items())

    def defects(self) -> dict[str, int]:
        return {"datagrams lost in this machine's receive buffer": self.own_drops} if self.own_drops else {}

    def _left_ns(self) -> int:
        return POLL_NS if self._end_ns is None else self._end_ns - self.clock.monotonic_ns()


def _endpoint(url: str | Endpoint | Site) -> Endpoint:
    if isinstance(url, Site):
        return url.endpoint
    return parse_endpoint(url) if isinstance(url, str) else url
