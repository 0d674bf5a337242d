"""Which stream is whose: to which endpoints its messages go, who plays the client's part, and what looks wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import MIN_FRAME_SIZE
from pmutools.c37118.demux import Message
from pmutools.c37118.session import SPONTANEOUS, ClientEvent, ClientRole, ClientState, Timing
from pmutools.flow import Chunk, Flow
from pmutools.net.dialogue import Dialogue, LinkEvent, LinkKind, silence
from pmutools.net.endpoint import Endpoint
from pmutools.net.link import CommandLink, Plumbing
from pmutools.net.notices import Notices
from pmutools.net.udp import UdpSocket

STRANGERS = 4096
"""Streams that nobody wants, and that were told of; when another comes they are met again as new."""
RIVALRY_NS = 1_000_000_000
"""Two senders of one IDCODE that both go on for so long are no restart of one."""
FORGET_NS = 1_000_000_000
"""How long no stream is looked for that could be forgotten, after hardly any was found."""
SHOWN_BYTES = 16
_SYNC = 0xAA


class Route(NamedTuple):
    """Where the messages of one stream go: to which endpoints, and who plays the client's part."""

    owners: tuple[int, ...]
    dialogue: Dialogue
    link: CommandLink | None

    @property
    def role(self) -> ClientRole:
        return self.dialogue.role

    def hear(self, message: Message, now_ns: int) -> None:
        """A message of the stream came."""
        if self.link is None:
            self.dialogue.hear(message, now_ns)
        else:
            self.link.heard(message, now_ns)

    def hear_alike(self, config: StreamConfig, now_ns: int) -> None:
        """Data frames of the stream came, whose STAT bits 10 are what the role knows already."""
        if self.link is None:
            self.dialogue.hear_alike(config, now_ns)
        else:
            self.link.heard_alike(config, now_ns)


class Rivals(NamedTuple):
    """Two senders of one IDCODE, since the second has come."""

    first: Flow
    second: Flow
    since_ns: int


class Listener:
    """A bound UDP socket and all endpoints that hear through it."""

    def __init__(self, sock: UdpSocket, now_ns: int) -> None:
        self.sock = sock
        self.opened_ns = now_ns
        self.by_idcode: dict[int | None, list[tuple[int, Endpoint]]] = {}
        self.by_host: dict[str, list[CommandLink]] = {}
        """Links whose data come here, by the host that sends them."""
        self.owners: tuple[int, ...] = ()
        self.senders: dict[int, Flow] = {}
        """Who sent an IDCODE last, where nobody was asked for it."""
        self.rivals: dict[int, Rivals] = {}
        self.duplicated: set[int] = set()
        """IDCODEs whose two senders were told of."""
        self.noise = ""
        """What came first that is no C37.118, and from where."""

    def hears(self, host: str, idcode: int | None = None) -> bool:
        """Whether what ``host`` sends here, of one IDCODE or of any, may be asked for."""
        groups = self.by_idcode.values() if idcode is None else map(self.by_idcode.get, (idcode, None))
        sources = (endpoint.source for group in groups for _, endpoint in group or ())
        commanded = (link.idcode for link in self.by_host.get(host, ()))
        return any(source in (None, host) for source in sources) or any(
            idcode is None or asked in (None, idcode) for asked in commanded
        )

    def know_owners(self) -> None:
        """All that hear through it are known now."""
        direct = [index for subscribed in self.by_idcode.values() for index, _ in subscribed]
        links = [link for links in self.by_host.values() for link in links]
        self.owners = (*sorted(direct), *(index for link in links for index in link.owners))


class Routes:
    """All routes, by flow and IDCODE. ``by_local`` are listeners by the destination of their flows.

    ``most`` streams (a flow and an IDCODE) are known at once; more come from nowhere but a flood, and are not passed
    on.
    """

    def __init__(
        self,
        endpoints: Sequence[Endpoint],
        by_local: dict[str, Listener],
        timing: Timing,
        plumbing: Plumbing,
        most: int,
    ) -> None:
        self.heard: set[int] = set()
        """Endpoints of which anything has come."""
        self._endpoints, self._by_local = endpoints, by_local
        self._timing, self._plumbing = timing, plumbing
        self._clock = plumbing.reactor.clock
        self.notices = Notices(plumbing.emit, self._clock.monotonic_ns())
        self._routes: dict[Flow, dict[int, Route]] = {}
        self._most = most
        self._count = 0
        self._strangers: set[tuple[str, str, int | None]] = set()
        """Who was told of: the port, the host, and what it claims."""
        self._held: set[tuple[Flow, int]] = set()
        """Streams told to be without a configuration."""
        self._forget_from_ns = 0

    def __len__(self) -> int:
        return self._count

    def find(self, flow: Flow, idcode: int) -> Route | None:
        """The route of a stream, made at its first message; None where nobody wants it."""
        routes = self._routes.get(flow)
        if routes is not None and idcode in routes:
            return routes[idcode]
        if self._count >= self._most and not self._forget():
            return None
        route = self._new(flow, idcode)
        if route is not None:
            self._count += 1
            self._routes.setdefault(flow, {})[idcode] = route
            self.heard.update(route.owners)
        return route

    def end(self, flow: Flow) -> None:
        """A connection has ended: so have its streams."""
        self._plumbing.links.pop(flow, None)
        for idcode, route in self._routes.pop(flow, {}).items():
            self._drop(flow, idcode, route)

    def hold(self, flow: Flow, idcode: int, now_ns: int) -> bool:
        """A data frame came that fits no configuration, and is held until one does; false where nobody wants it."""
        route = self.find(flow, idcode)
        if route is None:
            return False
        if (flow, idcode) not in self._held:
            self._held.add((flow, idcode))
            detail = "held until one comes; a spontaneous sender repeats its own about once a minute"
            where = str(self._endpoints[route.owners[0]])
            self.notices.tell(LinkEvent(LinkKind.NO_CONFIG, where, route.owners, detail, idcode, flow))
        route.dialogue.hear_misfit(now_ns)
        return True

    def hears(self, flow: Flow, idcode: int | None = None) -> bool:
        """Whether what comes of a flow, of one IDCODE or of any, may be asked for."""
        if link := self._plumbing.links.get(flow):
            return idcode is None or link.idcode in (None, idcode)
        listener = self._by_local.get(flow.destination) if flow.transport == "udp" else None
        return listener is not None and listener.hears(flow.host, idcode)

    def turn_away(self, chunk: Chunk) -> bool:
        """Whether a chunk is a datagram of which nothing is asked for, by its head; then it is told of."""
        flow = chunk.flow
        if flow.is_stream:
            return False
        idcode = claimed(chunk.data)
        if (idcode is not None and idcode in self._routes.get(flow, ())) or self.hears(flow, idcode):
            return False
        if idcode is None:
            self.note_noise(chunk)
        elif (listener := self._by_local.get(flow.destination)) is not None:
            self._tell_of_foreign(listener.owners, flow, idcode)
        return True

    def note_noise(self, chunk: Chunk) -> None:
        """A chunk came in which no frame was found, from a flow that has shown none yet, or may yet end one."""
        if (link := self._plumbing.links.get(chunk.flow)) is not None:
            link.noise = link.noise or _beginning(chunk.data)
        elif (listener := self._by_local.get(chunk.flow.destination)) is not None and not listener.noise:
            listener.noise = (
                f"{len(chunk.data)} bytes from {chunk.flow.source} are no C37.118: {_beginning(chunk.data)}"
            )
            detail = f"{listener.noise}; does something else send to this port?"
            where = f"udp://{chunk.flow.destination}"
            self.notices.tell(LinkEvent(LinkKind.NOISE, where, listener.owners, detail, flow=chunk.flow))

    def look_for_rivals(self, now_ns: int) -> None:
        """Tell of two senders of one IDCODE, once that they both go on; to be called now and then."""
        for listener in self._by_local.values():
            for idcode, rivals in list(listener.rivals.items()):
                first, second = (self._routes.get(flow, {}).get(idcode) for flow in rivals[:2])
                if first is None or second is None:
                    del listener.rivals[idcode]
                    continue
                both_ns = max(min(first.role.heard_ns, second.role.heard_ns), rivals.since_ns)
                if both_ns - rivals.since_ns > RIVALRY_NS:
                    del listener.rivals[idcode]
                    listener.duplicated.add(idcode)
                    self._tell_of_rivals(listener, idcode, rivals)
                elif now_ns - both_ns > max(first.role.silence_ns, second.role.silence_ns):
                    del listener.rivals[idcode]  # one has stopped: it was a restart

    # --- making and forgetting

    def _new(self, flow: Flow, idcode: int) -> Route | None:
        if link := self._plumbing.links.get(flow):
            return self._of_link(link, link.owners, flow, idcode)
        listener = self._by_local.get(flow.destination) if flow.transport == "udp" else None
        if listener is None:  # a connection that has ended meanwhile
            return None
        host = flow.host
        owners = tuple(
            index
            for wanted in (idcode, None)
            for index, endpoint in listener.by_idcode.get(wanted, ())
            if endpoint.source in (None, host)
        )
        for link in listener.by_host.get(host, ()):
            if link.idcode in (None, idcode):
                return self._of_link(link, owners + link.owners, flow, idcode)
        if not owners:
            self._tell_of_foreign(listener.owners, flow, idcode)
            return None
        return Route(owners, self._spontaneous(listener, owners, flow, idcode), None)

    def _spontaneous(self, listener: Listener, owners: tuple[int, ...], flow: Flow, idcode: int) -> Dialogue:
        self._note_rival(listener, owners, flow, idcode)
        multicast = self._endpoints[owners[0]].is_multicast

        def tell(kind: LinkKind, detail: str) -> None:
            if kind is LinkKind.SILENT:
                detail = silence(multicast, self._clock.monotonic_ns() - listener.opened_ns)
            self._plumbing.emit(LinkEvent(kind, f"udp://{flow.source}", owners, detail, idcode, flow))

        dialogue = Dialogue(ClientRole(SPONTANEOUS, self._timing), self._plumbing.reactor, tell)
        dialogue.step(ClientEvent.OPENED)
        return dialogue

    def _of_link(self, link: CommandLink, owners: tuple[int, ...], flow: Flow, idcode: int) -> Route | None:
        if link.idcode not in (None, idcode):
            self._tell_of_foreign(owners, flow, idcode)
            return None
        link.learn(idcode)
        return Route(owners, link.dialogue, link)

    def _note_rival(self, listener: Listener, owners: tuple[int, ...], flow: Flow, idcode: int) -> None:
        before, listener.senders[idcode] = listener.senders.get(idcode), flow
        if before is None or idcode in listener.rivals or idcode in listener.duplicated:
            return
        route = self._routes.get(before, {}).get(idcode)
        if route is not None and set(route.owners) & set(owners):
            listener.rivals[idcode] = Rivals(before, flow, self._clock.monotonic_ns())

    def _forget(self) -> bool:
        """Make room where there are too many streams; whether there is some now.

        Spontaneous ones go that are silent; who still sends is met again as new.
        """
        now_ns = self._clock.monotonic_ns()
        if now_ns < self._forget_from_ns:
            return False
        for flow, routes in list(self._routes.items()):
            for idcode, route in list(routes.items()):
                if route.link is None and route.role.state is not ClientState.STREAMING:
                    del routes[idcode]
                    self._drop(flow, idcode, route)
            if not routes:
                del self._routes[flow]
        if self._count > self._most - self._most // 16:  # in vain: not to be done for each stream of a flood
            self._forget_from_ns = now_ns + FORGET_NS
        return self._count < self._most

    def _drop(self, flow: Flow, idcode: int, route: Route) -> None:
        self._count -= 1
        self._held.discard((flow, idcode))
        if route.link is None:
            route.dialogue.close()
            listener = self._by_local.get(flow.destination)
            if listener is not None and listener.senders.get(idcode) == flow:
                del listener.senders[idcode]

    # --- telling

    def _tell_of_foreign(self, owners: tuple[int, ...], flow: Flow, idcode: int) -> None:
        # a host that nobody asks anything of is one stranger, whatever it claims
        who = flow.destination, flow.host, idcode if self.hears(flow) else None
        if who in self._strangers:
            return
        if len(self._strangers) >= STRANGERS:
            self._strangers.clear()
        self._strangers.add(who)
        asked = ", ".join(sorted({str(self._endpoints[index]) for index in owners[:3]}))
        detail = f"IDCODE {idcode} comes from {flow.source}; asked for: {asked}{', ...' if len(owners) > 3 else ''}"
        where = f"{flow.transport}://{flow.source}"
        self.notices.tell(LinkEvent(LinkKind.FOREIGN, where, owners, detail, idcode, flow))

    def _tell_of_rivals(self, listener: Listener, idcode: int, rivals: Rivals) -> None:
        route = self._routes[rivals.second][idcode]
        one, other = rivals.first.source, rivals.second.source
        detail = f"IDCODE {idcode} comes from {one} and from {other}; take one out, or name the right one by ?source="
        where = f"udp://{rivals.second.destination}"
        self.notices.tell(LinkEvent(LinkKind.DUPLICATE, where, route.owners, detail, idcode, rivals.second))


def claimed(data: bytes) -> int | None:
    """The IDCODE of what claims to be one whole frame."""
    is_frame = len(data) >= MIN_FRAME_SIZE and data[0] == _SYNC and data[2] << 8 | data[3] == len(data)
    return data[4] << 8 | data[5] if is_frame else None


def _beginning(data: bytes) -> str:
    return f"{data[:SHOWN_BYTES].hex(' ')}{' ...' if len(data) > SHOWN_BYTES else ''}"
