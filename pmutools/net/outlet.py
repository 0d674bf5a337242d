"""The server's side of a listening endpoint: clients, their commands, and who gets which stream.

No client delays another: what TCP clients do not take waits in bounded queues of their own, UDP never blocks. Memory is
bounded by (clients) x (queue), and a client that takes nothing for ten seconds is disconnected. However fast a client
asks, a turn of the loop obeys :data:`COMMANDS` of its commands at most; the rest waits, in the end in its own system.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import islice
from typing import NamedTuple

from pmutools import linux
from pmutools.c37118.checksum import chk
from pmutools.c37118.config import frames_in
from pmutools.c37118.constants import Command, FrameType
from pmutools.c37118.framer import Frame, Framer
from pmutools.c37118.session import Outcome, Served, ServerRole
from pmutools.errors import PmuError, SourceError
from pmutools.flow import Hangup, Segmentation
from pmutools.net.audience import Audience, Sink
from pmutools.net.endpoint import Endpoint, Scheme, scoped
from pmutools.net.outbox import Flushable, Outbox, UdpSink
from pmutools.net.reactor import READ, WRITE, Reactor, Timer
from pmutools.net.sockets import Address, explain, resolve
from pmutools.net.tcp import CutOff, TcpListener, TcpPeer
from pmutools.net.udp import Batches, UdpSocket, target

MAX_CLIENTS = 1024
"""Clients of one listening endpoint: of TCP more are turned away, of UDP the one heard longest ago makes room."""
GARBAGE_BYTES = 64 << 10
"""Bytes in a row that are no frame, before a TCP client is sent away."""
COMMANDS = 16
"""Commands of one client, or of one UDP port, that a turn of the loop obeys."""
_COMMAND_BYTES = 18
_FRAME_BYTES = 0xFFFF
_READ_BYTES = COMMANDS * _COMMAND_BYTES
_ACCEPTS = 64
_ACCEPT_AGAIN_NS = 1_000_000_000
_LISTEN_AGAIN_NS = 1_000_000_000


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
    CUT_OFF = "cut-off"
    """It was reset amid a frame, as the frame's :class:`~pmutools.flow.Segmentation` said."""
    REFUSED = "refused"
    """It would have a stream start that is hung up (:attr:`~pmutools.flow.Hangup.REFUSE`); it gets no answer."""
    NOT_LISTENING = "not-listening"
    """The port, closed for a while, could not be had again; it is tried every second. ``client`` is its address."""


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
    dirty: dict[Flushable, None]
    """Who is to be flushed, in this order; they take themselves out as they are."""
    outbox: Callable[[Address, Endpoint], Outbox]
    """The box of the socket that sends to an address, in the way an endpoint asks for."""
    batches: Batches | None
    native: bool = linux.NATIVE
    stamped: bool = False
    """Whether departures are stamped."""
    treat: Callable[[int, bytes], Sequence[bytes]] = lambda handle, frame: (frame,)
    """What becomes of a configuration or a header of a stream (by its handle) on its way out."""


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
        self.unheard: deque[Frame] = deque()
        """Commands that have come and wait for their turn: a read's, and what the framer had held back."""
        self._outlet = outlet
        self._writing = False
        self._timer: Timer | None = None

    def put(self, frame: bytes, mark: int, now_ns: int, write: Segmentation | None = None) -> bool:
        try:
            taken = self.peer.put(frame, now_ns, write)
        except OSError as error:
            self._outlet.lose(self, error)
            return False
        if self.peer.queued_bytes:
            self._attend()
        return taken

    def flush(self, now_ns: int) -> None:
        self.peer.flush(now_ns)
        self._attend()

    def keep_house(self, now_ns: int) -> None:
        self.peer.tidy(now_ns)
        self._attend()

    def close(self, *, reset: bool) -> None:
        if self._timer is not None:
            self._timer.cancelled = True
        self.peer.close(reset=reset)

    def _attend(self) -> None:
        """Be called when the client takes bytes again, or when the next piece is due."""
        if self.peer.blocked is not self._writing:
            self._writing = self.peer.blocked
            self._outlet.watch(self, READ | WRITE if self._writing else READ)
        due_ns = self.peer.due_ns
        if self._timer is not None and self._timer.deadline_ns != due_ns:
            self._timer.cancelled = True
            self._timer = None
        if due_ns is not None and self._timer is None:
            self._timer = self._outlet.stage.reactor.call_at(due_ns, self._release)

    def _release(self) -> None:
        self._timer = None
        try:
            self.peer.release(self._outlet.stage.reactor.clock.monotonic_ns())
            self._attend()
        except OSError as error:
            self._outlet.lose(self, error)
            self._outlet.flush()


class Outlet:
    """A listening endpoint that offers ``streams``, by IDCODE; ``handles`` are their places in the audience."""

    def __init__(
        self, index: int, endpoint: Endpoint, streams: dict[int, Served], handles: Mapping[int, int], stage: Stage
    ) -> None:
        self.index = index
        self.endpoint = endpoint
        self.streams = streams
        self.handles = handles
        self.stage = stage
        self.refused: set[int] = set()
        """Streams, by IDCODE, that do not start for now."""

    @property
    def queued_bytes(self) -> int:
        """What waits for clients to take it; nothing ever does over UDP."""
        return 0

    def _obey(self, client: _Client, frame: bytes) -> Sequence[bytes]:
        """Do what a frame from a client asks for; returns the answer to send, in frames."""
        if self.refused and (idcode := _to_start(frame)) in self.refused:
            self._tell(ServerKind.REFUSED, client.address, idcode=idcode, code=Command.START_DATA)
            return ()
        answer = client.role.hear(frame, self.stage.reactor.clock.realtime_ns())
        if answer.outcome is Outcome.STARTED:
            self.stage.audience.start(self.handles[answer.idcode], client.key, client, client.sink)
        elif answer.outcome is Outcome.STOPPED:
            self.stage.audience.stop(self.handles[answer.idcode], client.key, client)
        self._tell(answer.outcome, client.address, idcode=answer.idcode, code=answer.code, extended=answer.extended)
        if answer.frame is None:
            return ()
        treat, handle = self.stage.treat, self.handles[answer.idcode]
        return [treated for part in frames_in(answer.frame) for treated in treat(handle, part)]

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


def _to_start(frame: bytes) -> int | None:
    """The IDCODE of the stream that a frame would have start, if it is such a command."""
    asks = frame[1] >> 4 == FrameType.COMMAND and frame[14:16] == _START
    return int.from_bytes(frame[4:6], "big") if asks else None


_START = Command.START_DATA.to_bytes(2, "big")


def _whole_frames(datagram: bytes) -> Iterator[bytes]:
    """The frames that a datagram consists of, up to what is none: to search on costs more than a stranger is worth."""
    at = 0
    while len(datagram) - at >= _COMMAND_BYTES and datagram[at] == 0xAA:
        size = int.from_bytes(datagram[at + 2 : at + 4], "big")
        frame = datagram[at : at + size]
        if size < _COMMAND_BYTES or len(frame) < size or chk(frame):
            return
        yield frame
        at += size


class UdpOutlet(Outlet):
    """Commands and data over one UDP port; data go to where the start command came from.

    A client is nothing but the streams it has started: it is forgotten with the last one it stops. UDP clients do not
    say good-bye: one that has started streams and vanished is sent to until it, or the run, stops, or others need room.
    """

    def __init__(
        self, index: int, endpoint: Endpoint, streams: dict[int, Served], handles: Mapping[int, int], stage: Stage
    ) -> None:
        super().__init__(index, endpoint, streams, handles, stage)
        self._sock = UdpSocket(endpoint.host, endpoint.port, batches=stage.batches, native=stage.native)
        self.address = self._sock.address
        self.outbox = Outbox(self._sock, stage.dirty, stamped=stage.stamped)
        self._unheard: Iterator[tuple[str, bytes]] = iter(())
        """(source, command) of the datagrams last read that wait for their turn."""
        self._clients: dict[str, _UdpClient] = {}
        """By ``host:port``, the one heard longest ago first."""
        stage.reactor.watch(self._sock, READ, self._ready)

    def close(self) -> None:
        self.stage.reactor.forget(self._sock)
        self._sock.close()

    def keep_house(self, now_ns: int) -> None:
        """Nothing: clients of UDP cannot be seen to stall."""

    def _ready(self, _events: int) -> None:
        if self.outbox.departures is not None:  # stamps that wait make the socket ready, too
            self.outbox.departures.collect()
        heard = list(islice(self._unheard, COMMANDS))
        if not heard:  # all before is done
            self._read()
            heard = list(islice(self._unheard, COMMANDS))
        for source, frame in heard:
            self._hear(source, frame)
        if len(heard) == COMMANDS:
            self.stage.reactor.again(self._sock, READ)
        self.outbox.flush()

    def _read(self) -> None:
        try:
            chunks = self._sock.read()
        except OSError:  # an earlier answer met a closed port (Windows)
            return
        self._unheard = ((chunk.flow.source, frame) for chunk in chunks for frame in _whole_frames(chunk.data))

    def _hear(self, source: str, frame: bytes) -> None:
        client = self._clients.pop(source, None) or self._stranger(source)
        try:
            for answer in self._obey(client, frame):
                self.outbox.put(answer, client.where, 0)
        except PmuError as error:
            self._forget(client)
            self._tell(ServerKind.DISCONNECTED, client.address, str(error))
            return
        if client.role.started:
            self._clients[source] = client
        while len(self._clients) > MAX_CLIENTS:
            oldest = self._clients.pop(next(iter(self._clients)))
            self._forget(oldest)
            self._tell(ServerKind.DISCONNECTED, oldest.address, f"heard longest ago of more than {MAX_CLIENTS} clients")

    def _stranger(self, source: str) -> _UdpClient:
        host, _, port = source.rpartition(":")
        address = self.address.at(host.strip("[]"), int(port))  # on the link of this socket, where it is bound to one
        return _UdpClient(address, ServerRole(self.streams), source, self.outbox)


class _DataPort:
    """Where the data of ``tcp+udp://`` go: to a host of their own, or to a port of whoever has connected."""

    def __init__(self, endpoint: Endpoint, stage: Stage) -> None:
        host = scoped(endpoint.data_host or endpoint.host, endpoint.iface)
        where = resolve(host, endpoint.data_port or 0, datagram=True)
        self._outbox = stage.outbox(where, endpoint)
        self._port = where.port
        self._fixed = where if endpoint.data_host else None

    def of(self, peer: TcpPeer) -> tuple[Hashable, Callable[[], Sink]]:
        """What a client shares with all whose data go to the same place, and what makes that sink."""
        where = self._fixed or peer.address.at(peer.address.host, self._port)
        return where, lambda: UdpSink(self._outbox, target(where))


class TcpOutlet(Outlet):
    """Commands over TCP; data on the same connection, or over UDP to the client's (or a group's) data port.

    What data over UDP need is had when the endpoint is opened, so that what cannot be is no client's affair.
    """

    def __init__(
        self,
        index: int,
        endpoint: Endpoint,
        streams: dict[int, Served],
        handles: Mapping[int, int],
        stage: Stage,
        queue_bytes: int,
    ) -> None:
        super().__init__(index, endpoint, streams, handles, stage)
        self._data = _DataPort(endpoint, stage) if endpoint.scheme is Scheme.TCP_UDP else None
        self._listener: TcpListener | None = TcpListener(endpoint.host, endpoint.port)
        self.address = self._listener.address
        self._relisten: Timer | None = None
        self._queue_bytes = queue_bytes
        self._clients: set[_TcpClient] = set()
        self._lost: list[tuple[_TcpClient, OSError | PmuError]] = []
        self._listen()

    def close(self) -> None:
        self._close_listener()
        for client in list(self._clients):
            self._drop(client, ServerKind.DISCONNECTED, "by this side")

    def hang_up(self, idcode: int, how: Hangup) -> int:
        """Send away whoever has started the stream; returns how many.

        Once all streams are refused, nobody listens, and clients that have started nothing go too.
        """
        if how is Hangup.REFUSE:
            self.refused.add(idcode)
        closed = self.refused >= self.streams.keys()
        gone = [client for client in self._clients if closed or idcode in client.role.started]
        if closed:
            self._close_listener()
        for client in gone:
            detail = f"stream {idcode} hung up ({how})"
            self._drop(client, ServerKind.DISCONNECTED, detail, reset=how is not Hangup.FIN)
        return len(gone)

    def take_up(self, idcode: int) -> None:
        """The stream may be started again."""
        self.refused.discard(idcode)
        if self._relisten is None:
            self._listen_anew(told=False)

    @property
    def queued_bytes(self) -> int:
        return sum(client.peer.queued_bytes for client in self._clients)

    def watch(self, client: _TcpClient, events: int) -> None:
        self.stage.reactor.watch(client.peer, events, lambda ready: self._ready(client, ready))

    def lose(self, client: _TcpClient, error: OSError | PmuError) -> None:
        """A send has failed, perhaps amid publishing, or an answer: the client goes with the next :meth:`flush`."""
        self._lost.append((client, error))
        self.stage.dirty[self] = None

    def flush(self) -> list[int]:
        self.stage.dirty.pop(self, None)
        lost, self._lost = self._lost, []
        for client, error in lost:
            if isinstance(error, CutOff):
                self._drop(client, ServerKind.CUT_OFF, str(error.strerror), reset=True)
            elif isinstance(error, PmuError):
                self._drop(client, ServerKind.DISCONNECTED, str(error))
            else:
                self._drop(client, ServerKind.DISCONNECTED, str(explain(error, client.address)))
        return []

    def keep_house(self, now_ns: int) -> None:
        for client in [client for client in self._clients if client.peer.stalled(now_ns)]:
            detail = f"{client.peer.queued_bytes} bytes waited, {client.peer.dropped} frames were dropped"
            self._drop(client, ServerKind.STALLED, detail, reset=True)
        for client in self._clients:
            try:
                client.keep_house(now_ns)
            except OSError as error:
                self.lose(client, error)
        self.flush()

    def _listen(self) -> None:
        if self._listener is not None:
            self.stage.reactor.watch(self._listener, READ, self._accept)

    def _close_listener(self) -> None:
        if self._listener is not None:
            self.stage.reactor.forget(self._listener)
            self._listener.close()
            self._listener = None

    def _listen_anew(self, *, told: bool) -> None:
        """Listen where it was listened before, as soon as that can be had."""
        self._relisten = None
        if self._listener is not None or self.refused >= self.streams.keys():
            return
        try:
            self._listener = TcpListener(self.address.host, self.address.port)
        except SourceError as error:
            if not told:
                self._tell(ServerKind.NOT_LISTENING, self.address, str(error))
            again = self.stage.reactor.call_in
            self._relisten = again(_LISTEN_AGAIN_NS, lambda: self._listen_anew(told=True))
            return
        self._listen()

    def _accept(self, _events: int) -> None:
        for _ in range(_ACCEPTS):
            if self._listener is None:
                return
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
        if self._data is not None:
            client.key, client.sink = self._data.of(peer)
        self._clients.add(client)
        self.watch(client, READ)
        self._tell(ServerKind.CONNECTED, peer.address)

    def _ready(self, client: _TcpClient, events: int) -> None:
        now_ns = self.stage.reactor.clock.monotonic_ns()
        try:
            if events & WRITE:
                client.flush(now_ns)
            if events & READ:
                self._hear(client, now_ns)
        except (OSError, PmuError) as error:
            self.lose(client, error)
        self.flush()

    def _hear(self, client: _TcpClient, now_ns: int) -> None:
        if not client.unheard:
            self._read(client)
        for _ in range(min(COMMANDS, len(client.unheard))):
            for answer in self._obey(client, client.unheard.popleft().data):
                client.put(answer, 0, now_ns)
        if client.unheard:
            self.stage.reactor.again(client.peer, READ)

    def _read(self, client: _TcpClient) -> None:
        for item in client.framer.feed(client.peer.read(_READ_BYTES)):
            if isinstance(item, Frame):
                client.garbage = 0
                client.unheard.append(item)
            else:
                client.garbage += item.nbytes
        undecided = client.framer.pending - _FRAME_BYTES  # what cannot be the beginning of one frame
        if client.garbage + max(undecided, 0) > GARBAGE_BYTES:
            client.unheard.clear()
            self._drop(client, ServerKind.GARBAGE, "more than 64 KiB without a frame", reset=True)

    def _drop(self, client: _TcpClient, kind: ServerKind, detail: str, *, reset: bool = False) -> None:
        if client not in self._clients:
            return
        self._clients.discard(client)
        self._forget(client)
        self.stage.reactor.forget(client.peer)
        client.close(reset=reset)
        self._tell(kind, client.address, detail)
