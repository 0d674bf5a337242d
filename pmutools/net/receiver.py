"""The front end of everything that listens: any number of endpoints, one loop, chunks and news out.

::

    with Receivers([parse_endpoint("udp://0.0.0.0:4713"), ...], SystemClock()) as receivers:
        while ...:
            for item in receivers.poll(100_000_000):    # Chunk | LinkEvent, within 100 ms
                for message in receivers.parse(item):   # Message | Loss
                    ...

:meth:`Receivers.poll` binds, connects, reads and stamps. :meth:`Receivers.parse` frames, finds the configuration and
plays the client's part (asks for it, starts the data, asks again when it changes). They are two steps so that raw bytes
can be kept, and a control loop can tell receiving from parsing; every item must go through both, in order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import NamedTuple

from pmutools import linux
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Demux, Loss, Message
from pmutools.c37118.session import (
    CFG2_FIRST,
    CFG3_FIRST,
    SAVED_CONFIG,
    SPONTANEOUS,
    ClientEvent,
    ClientRole,
    ClientTable,
    Timing,
)
from pmutools.clock import Clock
from pmutools.flow import Chunk, Flow
from pmutools.net.dialogue import Dialogue, LinkEvent, LinkKind
from pmutools.net.endpoint import Endpoint, Scheme, is_multicast, scoped
from pmutools.net.link import CommandLink, Plumbing
from pmutools.net.reactor import READ, Reactor
from pmutools.net.sockets import RCVBUF_BYTES, Address
from pmutools.net.udp import Batches, UdpSocket

MAX_STREAMS = 1 << 16
"""Streams (a flow and an IDCODE) known at once; more come from nowhere but a flood, and are not passed on."""
HOUSEKEEPING_NS = 1_000_000_000
NOTHING_NS = 5_000_000_000


class Route(NamedTuple):
    """Where the messages of one stream go: to which endpoints, and who plays the client's part."""

    owners: tuple[int, ...]
    dialogue: Dialogue
    link: CommandLink | None


class _Listener:
    """A bound UDP socket and all endpoints that hear through it."""

    def __init__(self, sock: UdpSocket) -> None:
        self.sock = sock
        self.by_idcode: dict[int | None, list[tuple[int, Endpoint]]] = {}
        self.by_host: dict[str, list[CommandLink]] = {}
        """Links whose data come here, by the host that sends them."""
        self.drops = sock.own_drops or 0

    @property
    def owners(self) -> tuple[int, ...]:
        direct = [index for subscribed in self.by_idcode.values() for index, _ in subscribed]
        return (*sorted(direct), *(index for links in self.by_host.values() for link in links for index in link.owners))


class Receivers:
    """See the module's text. Not thread-safe; close it, or use it in a ``with``.

    Parameters
    ----------
    endpoints
        Equal ones share a connection, those on one local port a socket. News and :meth:`owners` refer to them by place.
    configs
        Saved configurations, by their IDCODE, for streams that may never send theirs.
    want_cfg3
        Ask for CFG-3 before CFG-2.
    native
        False takes the portable path: user-space stamps, a system call a datagram.

    Raises
    ------
    SourceError
        A local port is taken or not permitted, a host unknown, a group refused.
    SettingsError
        An endpoint that cannot be received from.
    """

    def __init__(
        self,
        endpoints: Sequence[Endpoint],
        clock: Clock,
        *,
        configs: Iterable[StreamConfig] = (),
        want_cfg3: bool = False,
        timing: Timing | None = None,
        rcvbuf_bytes: int = RCVBUF_BYTES,
        native: bool = linux.NATIVE,
    ) -> None:
        saved = tuple(configs)
        self.endpoints = tuple(endpoints)
        self.demux = Demux(saved)
        self.unwanted = 0
        """Messages that no endpoint asked for."""
        self._saved = frozenset(config.idcode for config in saved)
        self._first: ClientTable = CFG3_FIRST if want_cfg3 else CFG2_FIRST
        self._timing = timing or Timing()
        self._rcvbuf_bytes = rcvbuf_bytes
        self._out: list[Chunk | LinkEvent] = []
        self._clock = clock
        self._reactor = Reactor(clock)
        self._plumbing = Plumbing(self._reactor, self._out.append, Batches() if native else None, native, {})
        self._listeners: dict[tuple[str, int], _Listener] = {}
        self._by_local: dict[str, _Listener] = {}
        """By the destination of the flows that come in through them."""
        self._links: list[CommandLink] = []
        self._routes: dict[Flow, dict[int, Route | None]] = {}
        self._streams = 0
        self._held: dict[tuple[Flow, int], int] = {}
        self._heard: set[int] = set()
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        self._reactor.call_in(HOUSEKEEPING_NS, self._keep_house)
        self._reactor.call_in(NOTHING_NS, self._tell_of_nothing)

    def __enter__(self) -> Receivers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def poll(self, timeout_ns: int | None) -> list[Chunk | LinkEvent]:
        """What has arrived and happened; waits for it at most ``timeout_ns`` (0: not at all, None: for ever)."""
        self._reactor.run(0 if self._out else timeout_ns)
        out = self._out[:]
        self._out.clear()
        return out

    def parse(self, item: Chunk | LinkEvent) -> list[Message | Loss]:
        """The messages that a polled item completes, of wanted streams only.

        Also moves the conversation on; the news of that come with the next :meth:`poll`.
        """
        if isinstance(item, LinkEvent):
            return self._end(item.flow) if item.kind in _ENDS and item.flow is not None else []
        out: list[Message | Loss] = []
        now_ns = self._clock.monotonic_ns()
        found = self.demux.feed(item)
        for part in found:
            if isinstance(part, Loss):
                out.append(part)
                continue
            route = self._route(part.flow, part.frame.idcode)
            if route is None:
                self.unwanted += 1
                continue
            if route.link is None:
                route.dialogue.hear(part, now_ns)
            else:
                route.link.heard(part, now_ns)
            out.append(part)
        if not found:
            self._look_at_held(item.flow, now_ns)
        return out

    def finish(self) -> list[Message | Loss]:
        """The end: what of wanted streams was pending. Own drops not yet told come with the next :meth:`poll`."""
        self._look_for_drops()
        return [
            part
            for part in self.demux.close()
            if isinstance(part, Loss) or self._route(part.flow, part.frame.idcode) is not None
        ]

    def owners(self, flow: Flow, idcode: int) -> tuple[int, ...]:
        """The places of the endpoints that a stream belongs to."""
        route = self._route(flow, idcode)
        return route.owners if route is not None else ()

    def local(self, index: int) -> Address | None:
        """Where endpoint ``index`` is bound, or None for one that only connects."""
        for listener in self._listeners.values():
            if index in listener.owners:
                return listener.sock.address
        return None

    def close(self) -> None:
        """Send stop where data were started, and close all sockets."""
        for link in self._links:
            link.close()
        for listener in self._listeners.values():
            listener.sock.close()
        self._links.clear()
        self._listeners.clear()
        self._reactor.close()

    # --- opening

    def _open(self) -> None:
        places: dict[Endpoint, list[int]] = {}
        for index, endpoint in enumerate(self.endpoints):
            places.setdefault(endpoint, []).append(index)
        for endpoint, indices in places.items():
            if endpoint.scheme is Scheme.UDP:
                listener = self._listen(endpoint, endpoint.host, endpoint.port, endpoint.source)
                listener.by_idcode.setdefault(endpoint.idcode, []).extend((index, endpoint) for index in indices)
            else:
                self._connect(endpoint, tuple(indices))
        for listener in self._listeners.values():
            detail = f"receive buffer {listener.sock.rcvbuf_bytes} bytes"
            self._out.append(LinkEvent(LinkKind.BOUND, f"udp://{listener.sock.address}", listener.owners, detail))

    def _listen(self, endpoint: Endpoint, host: str, port: int, source: str | None) -> _Listener:
        host = scoped(host, endpoint.iface)
        key = (host, port)
        listener = self._listeners.get(key) if port else None
        if listener is None:
            plumbing = self._plumbing
            sock = UdpSocket(
                host, port, rcvbuf_bytes=self._rcvbuf_bytes, batches=plumbing.batches, native=plumbing.native
            )
            listener = _Listener(sock)
            self._listeners[host, port or sock.address.port] = listener
            self._by_local[str(sock.address)] = listener
            self._reactor.watch(sock, READ, lambda _, heard=listener: self._read(heard))  # type: ignore[misc]
        if is_multicast(host):
            listener.sock.join(host, iface=endpoint.iface, source=source)
        return listener

    def _connect(self, endpoint: Endpoint, owners: tuple[int, ...]) -> None:
        table = SAVED_CONFIG if endpoint.idcode in self._saved else self._first
        listener = None
        if endpoint.scheme is Scheme.TCP_UDP:
            host = endpoint.data_host or ("::" if ":" in endpoint.host else "0.0.0.0")
            listener = self._listen(endpoint, host, endpoint.data_port or 0, endpoint.source)
        link = CommandLink(endpoint, owners, table, self._timing, self._plumbing)
        self._links.append(link)
        if listener is not None:
            listener.by_host.setdefault(endpoint.source or link.address.host, []).append(link)

    # --- receiving

    def _read(self, listener: _Listener) -> None:
        try:
            chunks = listener.sock.read()
        except OSError:  # an ICMP error to something sent from here earlier (Windows): nothing was received
            return
        self._out += chunks

    def _route(self, flow: Flow, idcode: int) -> Route | None:
        routes = self._routes.get(flow)
        if routes is not None and idcode in routes:
            return routes[idcode]
        if self._streams >= MAX_STREAMS:
            self._forget_unwanted()
            if self._streams >= MAX_STREAMS:
                return None
        self._streams += 1
        route = self._new_route(flow, idcode)
        self._routes.setdefault(flow, {})[idcode] = route
        if route is not None:
            self._heard.update(route.owners)
        return route

    def _new_route(self, flow: Flow, idcode: int) -> Route | None:
        if link := self._plumbing.links.get(flow):
            return self._link_route(link, link.owners, flow, idcode)
        listener = self._by_local.get(flow.destination) if flow.transport == "udp" else None
        if listener is None:  # a connection that has ended meanwhile
            return None
        host = flow.source.rpartition(":")[0].strip("[]")
        owners = tuple(
            index
            for wanted in (idcode, None)
            for index, endpoint in listener.by_idcode.get(wanted, ())
            if endpoint.source in (None, host)
        )
        for link in listener.by_host.get(host, ()):
            if link.idcode in (None, idcode):
                return self._link_route(link, owners + link.owners, flow, idcode)
        if not owners:
            self._tell_of_foreign(listener.owners, flow, idcode)
            return None
        role = ClientRole(SPONTANEOUS, self._timing)

        def tell(kind: LinkKind, detail: str) -> None:
            self._out.append(LinkEvent(kind, f"udp://{flow.source}", owners, detail, idcode, flow))

        dialogue = Dialogue(role, self._reactor, tell)
        dialogue.step(ClientEvent.OPENED)
        return Route(owners, dialogue, None)

    def _link_route(self, link: CommandLink, owners: tuple[int, ...], flow: Flow, idcode: int) -> Route | None:
        if link.idcode not in (None, idcode):
            self._tell_of_foreign(owners, flow, idcode)
            return None
        link.learn(idcode)
        return Route(owners, link.dialogue, link)

    def _look_at_held(self, flow: Flow, now_ns: int) -> None:
        """Data frames that fit no configuration do not come out of the demultiplexer; notice them all the same."""
        for idcode, nbytes in self.demux.held(flow).items():
            before = self._held.get((flow, idcode))
            if nbytes == before:
                continue
            if (route := self._route(flow, idcode)) is None:
                self.unwanted += 1
                self.demux.ignore(flow, idcode)
                continue
            self._held[flow, idcode] = nbytes
            if before is None:
                detail = "held until one comes; a spontaneous sender repeats its own about once a minute"
                where = str(self.endpoints[route.owners[0]])
                self._out.append(LinkEvent(LinkKind.NO_CONFIG, where, route.owners, detail, idcode, flow))
            route.dialogue.hear_misfit(now_ns)

    def _end(self, flow: Flow) -> list[Message | Loss]:
        self._plumbing.links.pop(flow, None)
        for idcode in self._routes.pop(flow, {}):
            self._streams -= 1
            self._held.pop((flow, idcode), None)
        return self.demux.end(flow)

    def _forget_unwanted(self) -> None:
        """Too many senders: forget those nobody asked for. Those who still send are met again as new."""
        for flow in list(self._routes):
            routes = self._routes[flow]
            if not any(routes.values()):
                self._streams -= len(self._routes.pop(flow))

    # --- telling

    def _keep_house(self) -> None:
        self._look_for_drops()
        self._reactor.call_in(HOUSEKEEPING_NS, self._keep_house)

    def _look_for_drops(self) -> None:
        for listener in self._listeners.values():
            drops = listener.sock.own_drops
            if drops is not None and drops != listener.drops:
                lost = (drops - listener.drops) & 0xFFFFFFFF
                listener.drops = drops
                where = f"udp://{listener.sock.address}"
                detail = "this machine's receive buffer was full"
                self._out.append(LinkEvent(LinkKind.OWN_DROPS, where, listener.owners, detail, datagrams=lost))

    def _tell_of_nothing(self) -> None:
        for index, endpoint in enumerate(self.endpoints):
            if index not in self._heard and endpoint.scheme is Scheme.UDP:
                detail = "nothing has come; is the sender on, and sending to this address and port?"
                self._out.append(LinkEvent(LinkKind.NOTHING, str(endpoint), (index,), detail, endpoint.idcode))

    def _tell_of_foreign(self, owners: tuple[int, ...], flow: Flow, idcode: int) -> None:
        asked = ", ".join(sorted({str(self.endpoints[index]) for index in owners[:3]}))
        detail = f"IDCODE {idcode} comes from {flow.source}; asked for: {asked}{', ...' if len(owners) > 3 else ''}"
        self._out.append(LinkEvent(LinkKind.FOREIGN, f"{flow.transport}://{flow.source}", owners, detail, idcode, flow))


_ENDS = frozenset((LinkKind.LOST, LinkKind.FAILED, LinkKind.UNANSWERED))
