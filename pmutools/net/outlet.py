"""The server's side of a listening endpoint: clients, their commands, and who gets which stream.

No client delays another: what TCP clients do not take waits in bounded queues of their own, UDP never blocks. Memory is
bounded by (clients) x (queue), and a client that takes nothing for ten seconds is disconnected.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from enum import StrEnum
from typing import NamedTuple

from pmutools import linux
from pmutools.c37118.framer import Frame, Framer
from pmutools.c37118.session import Outcome, Served, ServerRole
from pmutools.flow import Chunk
from pmutools.net.audience import Audience, Flushable, Outbox, Sink, UdpSink
from pmutools.net.endpoint import Endpoint, Scheme, scoped
from pmutools.net.reactor import READ, WRITE, Reactor
from pmutools.net.sockets import Address, explain, resolve
from pmutools.net.tcp import TcpListener, TcpPeer
from pmutools.net.udp import Batches, UdpSocket, target

MAX_CLIENTS = 1024
"""Clients of one listening endpoint: of TCP more are turned away, of UDP the one heard longest ago makes room."""
GARBAGE_BYTES = 64 << 10
"""Bytes in a row that are no frame, before a TCP client is sent away."""
_ACCEPT_AGAIN_NS = 1_000_000_000


class ServerKind(StrEnum):
    """What a client has done or what has become of it, beside the :class:`Outcome` of its commands."""

    CONNECTED = "connected"
    DISCONNECTED = "disconnected"
    TURNED_AWAY = "turned-away"
    """Too many clients, or no file descriptor left."""
    STALLED = "stalled"
    """It took nothing for too long, and is disconnected."""
    GARBAGE = "garbage"
    """It sent what is no C37.118, and is disconnected."""


class ServerEvent(NamedTuple):
    """News of the listening endpoint number ``outlet``; ``client`` is its ``host:port``."""

    kind: ServerKind | Outcome
    outlet: int
    client: str
    idcode: int | None = None
    code: int = 0
    detail: str = ""
    extended: bytes = b""


class Stage(NamedTuple):
    """What all outlets of one front end share."""

    reactor: Reactor
    audience: Audience
    tell: Callable[[ServerEvent], None]
    dirty: list[Flushable]
    outbox: Callable[[Address, Endpoint], Outbox]
    """The box of the socket that sends to an address, in the way an endpoint asks for."""
    batches: Batches | None
    native: bool = linux.NATIVE


# --- clients -----------------------------------------------------------------------------------------------------


class _Client:
    """One client: its address, what it has started, and where its data go."""

    def __init__(self, address: Address, role: ServerRole, key: Hashable, sink: Callable[[], Sink]) -> None:
        self.address = address
        self.role = role
        self.key = key
        self.sink = sink


class _UdpClient(_Client):
    def __init__(self, address: Address, role: ServerRole, source: str, outbox: Outbox) -> None:
        self.where = where = target(address)
        super().__init__(address, role, source, lambda: UdpSink(outbox, where))


class _TcpClient(_Client):
    """A connected client, and a sink for data that share its connection."""

    def __init__(self, peer: TcpPeer, role: ServerRole, outlet: TcpOutlet) -> None:
        super().__init__(peer.address, role, self, lambda: self)
        self.peer = peer
        self.framer = Framer(streaming=True)
        self.garbage = 0
        self._outlet = outlet
        self._writing = False

    def put(self, frame: bytes, mark: int, now_ns: int) -> bool:
        try:
            taken = self.peer.put(frame, now_ns)
        except OSError as error:
            self._outlet.lose(self, error)
            return False
        if self.peer.queued_bytes and not self._writing:
            self._writing = True
            self._outlet.watch(self, READ | WRITE)
        return taken

    def flush(self, now_ns: int) -> None:
        self.peer.flush(now_ns)
        if not self.peer.queued_bytes and self._writing:
            self._writing = False
            self._outlet.watch(self, READ)


class Outlet:
    """A listening endpoint that offers ``streams``, by IDCODE; ``handles`` are their places in the audience."""

    def __init__(
        self, index: int, endpoint: Endpoint, streams: Mapping[int, Served], handles: Mapping[int, int], stage: Stage
    ) -> None:
        self.index = index
        self.endpoint = endpoint
        self.streams = streams
        self.handles = handles
        self.stage = stage

    @property
    def queued_bytes(self) -> int:
        """What waits for clients to take it; nothing ever does over UDP."""
        return 0

    def _obey(self, client: _Client, frame: bytes) -> bytes | None:
        """Do what a frame from a client asks for; returns the answer to send."""
        answer = client.role.hear(frame, self.stage.reactor.clock.realtime_ns())
        if answer.outcome is Outcome.STARTED:
            self.stage.audience.start(self.handles[answer.idcode], client.key, client, client.sink)
        elif answer.outcome is Outcome.STOPPED:
            self.stage.audience.stop(self.handles[answer.idcode], client.key, client)
        self._tell(answer.outcome, client.address, idcode=answer.idcode, code=answer.code, extended=answer.extended)
        return answer.frame

    def _forget(self, client: _Client) -> None:
        for idcode in client.role.started:
            self.stage.audience.stop(self.handles[idcode], client.key, client)

    def _tell(
        self,
        kind: ServerKind | Outcome,
        address: Address,
        detail: str = "",
        *,
        idcode: int | None = None,
        code: int = 0,
        extended: bytes = b"",
    ) -> None:
        self.stage.tell(ServerEvent(kind, self.index, str(address), idcode, code, detail, extended))


class UdpOutlet(Outlet):
    """Commands and data over one UDP port; data go to where the start command came from.

    A client is nothing but the streams it has started: it is forgotten with the last one it stops. UDP clients do not
    say good-bye: one that has started streams and vanished is sent to until it, or the run, stops, or others need room.
    """

    def __init__(
        self, index: int, endpoint: Endpoint, streams: Mapping[int, Served], handles: Mapping[int, int], stage: Stage
    ) -> None:
        super().__init__(index, endpoint, streams, handles, stage)
        self._sock = UdpSocket(endpoint.host, endpoint.port, batches=stage.batches, native=stage.native)
        self.address = self._sock.address
        self._outbox = Outbox(self._sock, stage.dirty)
        self._framer = Framer(streaming=False)
        self._clients: dict[str, _UdpClient] = {}
        """By ``host:port``, the one heard longest ago first."""
        stage.reactor.watch(self._sock, READ, self._ready)

    def close(self) -> None:
        self.stage.reactor.forget(self._sock)
        self._sock.close()

    def keep_house(self, now_ns: int) -> None:
        """Nothing: clients of UDP cannot be seen to stall."""

    def _ready(self, _events: int) -> None:
        try:
            chunks = self._sock.read()
        except OSError:  # an earlier answer met a closed port (Windows)
            return
        for chunk in chunks:
            self._hear(chunk)
        self._outbox.flush()

    def _hear(self, chunk: Chunk) -> None:
        source = chunk.flow.source
        for item in self._framer.feed(chunk.data):
            if not isinstance(item, Frame):
                continue
            client = self._clients.pop(source, None) or self._stranger(source)
            if (answer := self._obey(client, item.data)) is not None:
                self._outbox.put(answer, client.where, 0)
            if client.role.started:
                self._clients[source] = client
        while len(self._clients) > MAX_CLIENTS:
            oldest = self._clients.pop(next(iter(self._clients)))
            self._forget(oldest)
            self._tell(ServerKind.DISCONNECTED, oldest.address, f"heard longest ago of more than {MAX_CLIENTS} clients")

    def _stranger(self, source: str) -> _UdpClient:
        host, _, port = source.rpartition(":")
        address = resolve(host.strip("[]"), int(port), datagram=True, family=self.address.family)
        return _UdpClient(address, ServerRole(self.streams), source, self._outbox)


class TcpOutlet(Outlet):
    """Commands over TCP; data on the same connection, or over UDP to the client's (or a group's) data port."""

    def __init__(
        self,
        index: int,
        endpoint: Endpoint,
        streams: Mapping[int, Served],
        handles: Mapping[int, int],
        stage: Stage,
        queue_bytes: int,
    ) -> None:
        super().__init__(index, endpoint, streams, handles, stage)
        self._listener = TcpListener(endpoint.host, endpoint.port)
        self.address = self._listener.address
        self._queue_bytes = queue_bytes
        self._clients: set[_TcpClient] = set()
        self._lost: list[tuple[_TcpClient, OSError]] = []
        self._listen()

    def close(self) -> None:
        self.stage.reactor.forget(self._listener)
        self._listener.close()
        self.disconnect()

    def disconnect(self, *, reset: bool = False) -> None:
        """Send all clients away, with FIN or RST."""
        for client in list(self._clients):
            self._drop(client, ServerKind.DISCONNECTED, "by this side", reset=reset)

    @property
    def queued_bytes(self) -> int:
        return sum(client.peer.queued_bytes for client in self._clients)

    def watch(self, client: _TcpClient, events: int) -> None:
        self.stage.reactor.watch(client.peer, events, lambda ready: self._ready(client, ready))

    def lose(self, client: _TcpClient, error: OSError) -> None:
        """A send has failed, perhaps amid publishing: the client goes with the next :meth:`flush`."""
        self._lost.append((client, error))
        self.stage.dirty.append(self)

    def flush(self) -> list[int]:
        lost, self._lost = self._lost, []
        for client, error in lost:
            self._drop(client, ServerKind.DISCONNECTED, str(explain(error, client.address)))
        return []

    def keep_house(self, now_ns: int) -> None:
        for client in [client for client in self._clients if client.peer.stalled(now_ns)]:
            detail = f"{client.peer.queued_bytes} bytes waited, {client.peer.dropped} frames were dropped"
            self._drop(client, ServerKind.STALLED, detail, reset=True)

    def _listen(self) -> None:
        self.stage.reactor.watch(self._listener, READ, self._accept)

    def _accept(self, _events: int) -> None:
        while True:
            try:
                peer = self._listener.accept(self._queue_bytes)
            except OSError as error:  # no file descriptor left: try again later instead of spinning
                self._tell(ServerKind.TURNED_AWAY, self.address, str(explain(error, self.endpoint)))
                self.stage.reactor.forget(self._listener)
                self.stage.reactor.call_in(_ACCEPT_AGAIN_NS, self._listen)
                return
            if peer is None:
                return
            if len(self._clients) >= MAX_CLIENTS:
                self._tell(ServerKind.TURNED_AWAY, peer.address, f"{MAX_CLIENTS} clients are served already")
                peer.close(reset=True)
                continue
            self._welcome(peer)

    def _welcome(self, peer: TcpPeer) -> None:
        client = _TcpClient(peer, ServerRole(self.streams), self)
        if self.endpoint.scheme is Scheme.TCP_UDP:
            host, port = self.endpoint.data_host or peer.address.host, self.endpoint.data_port or 0
            address = resolve(scoped(host, self.endpoint.iface), port, datagram=True)
            client.key = address
            client.sink = lambda: UdpSink(self.stage.outbox(address, self.endpoint), target(address))
        self._clients.add(client)
        self.watch(client, READ)
        self._tell(ServerKind.CONNECTED, peer.address)

    def _ready(self, client: _TcpClient, events: int) -> None:
        now_ns = self.stage.reactor.clock.monotonic_ns()
        try:
            if events & WRITE:
                client.flush(now_ns)
            if events & READ:
                self._hear(client, client.peer.read(), now_ns)
        except OSError as error:
            self.lose(client, error)
        self.flush()

    def _hear(self, client: _TcpClient, data: bytes, now_ns: int) -> None:
        for item in client.framer.feed(data):
            if isinstance(item, Frame):
                client.garbage = 0
                if (answer := self._obey(client, item.data)) is not None:
                    client.put(answer, 0, now_ns)
            else:
                client.garbage += item.nbytes
        if client.garbage > GARBAGE_BYTES:
            self._drop(client, ServerKind.GARBAGE, "more than 64 KiB without a frame", reset=True)

    def _drop(self, client: _TcpClient, kind: ServerKind, detail: str, *, reset: bool = False) -> None:
        if client not in self._clients:
            return
        self._clients.discard(client)
        self._forget(client)
        self.stage.reactor.forget(client.peer)
        client.peer.close(reset=reset)
        self._tell(kind, client.address, detail)
