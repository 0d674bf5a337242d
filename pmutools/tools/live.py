"""Live streams: read from endpoints for a while, as messages, blocks and news."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import FLOWS, DataRun, Loss, Message
from pmutools.clock import Clock, SystemClock
from pmutools.flow import Chunk, Flow
from pmutools.host import ClockStep, Heartbeat, HostLog, Stall
from pmutools.net.dialogue import LinkEvent
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.net.receiver import Receivers
from pmutools.net.sockets import RCVBUF_BYTES
from pmutools.net.tcp import TcpCounts
from pmutools.sites import Site

if TYPE_CHECKING:
    from pmutools.formats.source import Block, Gatherer  # they bring numpy: sockets are bound before that

POLL_NS = 100_000_000
"""How often a silent reader looks at the time."""
ROUND_NS = 250_000_000
"""How long data frames are gathered before they are handed on, and at most before they are looked at."""
BACKLOG_NS = 30_000_000_000
"""Reading what waits in the sockets in the end takes no longer, whatever its stamps say."""
TOLD = 3
"""So many of the endpoints that a sender belongs to are named."""
ROUND_FRAMES = 1 << 16
"""So many data frames are handed on before their round is over."""


class LiveSource:
    """Endpoints as a source: bound when made, read by iterating, closed by leaving the ``with``.

    ``tell`` is given the news of connections, ``tell_host`` those of this machine. Iteration ends ``duration_ns`` after
    the source was made, or when ``stop``, asked every 0.1 s, says so. CFG-3 is asked for, and after a second of silence
    CFG-2; with ``want_cfg3`` false, only that. Sites bring their saved configurations, other streams take ``configs``.

    Raises SourceError where an endpoint cannot be opened or a saved configuration not be read, SettingsError for a URL
    that is none and for saved configurations that contradict each other.
    """

    kind = "live"

    def __init__(
        self,
        urls: Sequence[str | Endpoint | Site],
        *,
        duration_ns: int | None = None,
        configs: Iterable[StreamConfig] = (),
        want_cfg3: bool = True,
        tell: Callable[[LinkEvent], None] | None = None,
        tell_host: Callable[[Stall | ClockStep], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
        clock: Clock | None = None,
        rcvbuf_bytes: int = RCVBUF_BYTES,
    ) -> None:
        self.sites = tuple(url if isinstance(url, Site) else None for url in urls)
        """The sites among ``urls``, by place."""
        endpoints = [_endpoint(url) for url in urls]
        self.path = Path(str(endpoints[0]) if len(endpoints) == 1 else f"{len(endpoints)} endpoints")
        self.clock = clock or SystemClock()
        saved = (*configs, *_saved(self.sites))
        self.receivers = Receivers(endpoints, self.clock, configs=saved, want_cfg3=want_cfg3, rcvbuf_bytes=rcvbuf_bytes)
        self.tally = self.receivers.demux.tally
        self._owners: dict[tuple[Flow, int], tuple[int, ...]] = {}
        self.own_drops = 0
        """Datagrams lost in this machine's receive buffers: not the network's doing."""
        self.host = HostLog(self.clock)
        """How this machine stood still and had its clock set, while reading, by the machine's own clock."""
        self._tell, self._tell_host, self._stop = tell, tell_host, stop
        started_ns = self.clock.monotonic_ns()
        self.end_ns = None if duration_ns is None else started_ns + duration_ns
        """When reading ends, by the monotonic clock; None: when it is stopped."""

    def __enter__(self) -> LiveSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.receivers.close()

    def polls(self) -> Iterator[list[Message | Loss]]:
        """What came, poll by poll, an empty list at least every 0.1 s; the last ones hold what was pending."""
        with self._heartbeat():
            while (left_ns := self._left_ns()) > 0 and not self._stop():
                yield self._poll(min(POLL_NS, left_ns))
        yield self._poll(0)
        yield self.receivers.finish()
        yield self._poll(0)  # the news of the end

    def _poll(self, timeout_ns: int) -> list[Message | Loss]:
        found: list[Message | Loss] = []
        for item in self.receivers.poll(timeout_ns):
            if not isinstance(item, Chunk):
                self._take_news(item)
            found += self.receivers.parse(item)
        self._take_host_news()
        return found

    def rounds(self, round_ns: int = ROUND_NS) -> Iterator[list[Block | Message | Loss]]:
        """What came, gathered for ``round_ns``: a block a stream of data frames, in order; other frames; losses.

        A configuration frame comes after the blocks that were ruled by what held before it, and before those that it
        rules. A list is empty where nothing came, and comes early, with several blocks a stream, where there is much:
        no more than some :data:`ROUND_FRAMES` frames wait.
        """
        from pmutools.formats.source import Gatherer

        gatherer = Gatherer()
        out: list[Block | Message | Loss] = []
        now_ns = self.clock.monotonic_ns()
        due_ns, collect_ns = now_ns + round_ns, now_ns + ROUND_NS
        with self._heartbeat():
            while (left_ns := self._left_ns()) > 0 and not self._stop():
                wait_ns = max(min(due_ns, collect_ns) - now_ns, 0)
                early = self.receivers.soak(min(POLL_NS, left_ns, wait_ns))
                now_ns = self.clock.monotonic_ns()
                if early or now_ns >= min(due_ns, collect_ns):
                    self._gather(self.receivers.collect(), gatherer, out)
                    collect_ns = now_ns + ROUND_NS
                if now_ns >= due_ns or gatherer.waiting >= ROUND_FRAMES:
                    due_ns = now_ns + round_ns
                    yield [*out, *gatherer.flush()]
                    out = []
                    now_ns = self.clock.monotonic_ns()
        for found in self._backlog():
            self._gather(found, gatherer, out)
            if gatherer.waiting >= ROUND_FRAMES:
                yield [*out, *gatherer.flush()]
                out = []
        self._gather(self.receivers.finish(), gatherer, out)
        self._gather(self.receivers.collect(), gatherer, out)  # the news of the end
        yield [*out, *gatherer.flush()]

    def _backlog(self) -> Iterator[list[Message | Loss | DataRun | LinkEvent]]:
        """What had arrived when reading ended, and waits in the sockets' buffers: one that is behind has much there."""
        end_ns, give_up_ns = self.clock.realtime_ns(), self.clock.monotonic_ns() + BACKLOG_NS
        while True:
            self.receivers.soak(0)
            yield (found := self.receivers.collect())
            runs = [item.train.arrivals_ns[-1] for item in found if isinstance(item, DataRun)]
            if not runs or min(at or 0 for at in runs) >= end_ns or self.clock.monotonic_ns() >= give_up_ns:
                return

    def _gather(
        self,
        found: Iterable[Message | Loss | DataRun | LinkEvent],
        gatherer: Gatherer,
        out: list[Block | Message | Loss],
    ) -> None:
        for item in found:
            if isinstance(item, LinkEvent):
                self._take_news(item)
            elif isinstance(item, DataRun):
                if (block := gatherer.add_run(item)) is not None:
                    out.append(block)
            elif isinstance(item, Message) and item.frame.type is FrameType.DATA:
                if (block := gatherer.add(item)) is not None:
                    out.append(block)
            else:
                if isinstance(item, Message) and item.frame.type.rules_data:
                    out += gatherer.flush(item.frame.idcode)
                out.append(item)
        self._take_host_news()

    def sites_of(self, flow: Flow, idcode: int) -> tuple[Site, ...]:
        """The sites that a stream belongs to, also when its connection has ended; none where URLs named it."""
        owners = self.receivers.owners(flow, idcode)
        if owners:
            if len(self._owners) >= FLOWS:
                self._owners.clear()
            self._owners[flow, idcode] = owners
        found = (self.sites[index] for index in owners or self._owners.get((flow, idcode), ()))
        return tuple(site for site in found if site is not None)

    @property
    def silent(self) -> list[tuple[int, str]]:
        """Place and name of the endpoints from which no frame has come."""
        heard = self.receivers.routes.heard
        return [(index, self._name(index)) for index in range(len(self.sites)) if index not in heard]

    def _name(self, index: int) -> str:
        """What the user calls the endpoint at a place."""
        site = self.sites[index]
        return str(self.receivers.endpoints[index]) if site is None else site.name

    def name(self, flow: Flow, config: StreamConfig) -> str:
        """What a stream is called: as its sites, all of them with a ``+`` between, else as its configuration says."""
        return "+".join(site.name for site in self.sites_of(flow, config.idcode)) or config.name

    def tcp_counts(self, index: int) -> TcpCounts:
        """What this machine's kernel has counted so far of the connections of the endpoint at place ``index``."""
        return self.receivers.tcp_counts(index)

    def items(self) -> Iterator[Message | Loss]:
        for found in self.polls():
            yield from found

    def blocks(self) -> Iterator[Block | Message | Loss]:
        from pmutools.formats.source import gather

        return gather(self.items())

    def defects(self) -> dict[str, int]:
        return {"datagrams lost in this machine's receive buffer": self.own_drops} if self.own_drops else {}

    def _left_ns(self) -> int:
        return POLL_NS if self.end_ns is None else self.end_ns - self.clock.monotonic_ns()

    @contextmanager
    def _heartbeat(self) -> Iterator[None]:
        """Watch this machine, where its own clock is the clock."""
        if not isinstance(self.clock, SystemClock):
            yield
            return
        heartbeat = Heartbeat(self.host)
        try:
            yield
        finally:
            heartbeat.stop()

    def _take_news(self, event: LinkEvent) -> None:
        self.own_drops += event.datagrams
        if self._tell is not None:
            self._tell(event._replace(label=self._label(event)))

    def _label(self, event: LinkEvent) -> str:
        """What the user calls the sender that news are about; empty where they are about what he has named."""
        flow = event.flow
        if flow is None or not event.owners or event.where != f"{flow.transport}://{flow.source}":
            return ""
        mine = "+".join(self._name(place) for place in event.owners[:TOLD])
        return mine if flow.source in event.detail else f"{mine} (IDCODE {event.idcode} from {flow.source})"

    def _take_host_news(self) -> None:
        for event in self.host.news():
            if self._tell_host is not None:
                self._tell_host(event)


def _saved(sites: Iterable[Site | None]) -> tuple[StreamConfig, ...]:
    """The saved configurations that sites refer to: slow to read, and seldom there."""
    chosen = [site for site in sites if site is not None and site.config]
    if not chosen:
        return ()
    from pmutools.tools.recordings import saved_configs

    return saved_configs(chosen)


def _endpoint(url: str | Endpoint | Site) -> Endpoint:
    if isinstance(url, Site):
        return url.endpoint
    return parse_endpoint(url) if isinstance(url, str) else url
