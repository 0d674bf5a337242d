"""The command channel of one endpoint, over TCP or UDP: connect, converse, come back after a failure."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable
from dataclasses import dataclass, field

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.c37118.session import (
    ClientAction,
    ClientEvent,
    ClientRole,
    ClientState,
    ClientTable,
    Timing,
    backoff_ns,
    command_for,
)
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Chunk, Flow
from pmutools.net.dialogue import Dialogue, LinkEvent, LinkKind, own_drops, silence
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.net.intake import Intake, Swept
from pmutools.net.reactor import READ, WRITE, Reactor, Timer
from pmutools.net.sockets import Address, explain, resolve
from pmutools.net.tcp import TcpClient, TcpCounts
from pmutools.net.udp import Batches, UdpSocket

CONNECT_NS = 5_000_000_000
UNKNOWN_IDCODE = 1
"""Asked for where the user names no IDCODE, until a frame shows the right one."""


@dataclass
class Plumbing:
    """What all links of one front end share. ``emit`` takes what :meth:`Receivers.poll` gives out."""

    reactor: Reactor
    emit: Callable[[Chunk | LinkEvent], None]
    batches: Batches | None
    native: bool
    tcp_read_bytes: int
    links: dict[Flow, CommandLink] = field(default_factory=dict)
    """By the flows that the links have opened; :class:`Receivers` takes them out."""
    intake: Intake | None = None
    """Where what comes is gathered; without one it is emitted in chunks."""


class CommandLink:
    """One commanded endpoint, from the client's side.

    ``owners`` are the places of this endpoint in the user's list, ``table`` and ``timing`` those of the role. A server
    that cannot be reached now is news, and tried again later.

    Raises
    ------
    SourceError
        The host is unknown.
    SettingsError
        Port 0, or an ``iface`` that is no local address.
    """

    def __init__(
        self, endpoint: Endpoint, owners: tuple[int, ...], table: ClientTable, timing: Timing, plumbing: Plumbing
    ) -> None:
        self.endpoint = endpoint
        self.owners = owners
        self.idcode = endpoint.idcode
        self.flow: Flow | None = None
        self.plumbing = plumbing
        self.dialogue = Dialogue(ClientRole(table, timing), plumbing.reactor, self._tell, self._act)
        self._over_tcp = endpoint.scheme is not Scheme.UDP_COMMANDED
        if not endpoint.port:
            raise SettingsError(f"{endpoint}: port 0 is nowhere to connect to")
        self.address = resolve(endpoint.host, endpoint.port, datagram=not self._over_tcp)
        self._local = _local(endpoint.iface, self._over_tcp)
        self._transport: TcpClient | UdpSocket | None = None
        self._connections = 0
        self._failures = 0
        self._timer: Timer | None = None
        self._opened_ns = 0
        self._number = -1
        """The connection's in the intake."""
        self.noise = ""
        """What came first on this connection and is no C37.118; empty once something is."""
        self._ended = TcpCounts()
        self._open()

    def learn(self, idcode: int) -> None:
        """Frames of ``idcode`` come on this link: if the user named none, it is the one to ask for."""
        if self.idcode is not None:
            return
        self.idcode = idcode
        state = self.dialogue.role.state
        if state in _REQUEST_IN:
            self._act(_REQUEST_IN[state], state)

    def heard(self, message: Message, now_ns: int) -> None:
        """A message of this endpoint's stream came, over whichever channel; ``now_ns`` is monotonic."""
        self.noise = ""
        self.dialogue.hear(message, now_ns)
        if self.dialogue.role.state is ClientState.STREAMING:
            self._failures = 0

    def heard_alike(self, config: StreamConfig, now_ns: int) -> None:
        """Data frames came, whose STAT bits 10 are what the role knows already."""
        self.dialogue.hear_alike(config, now_ns)
        self._failures = 0

    def listen(self) -> None:
        """Have what comes read, the way that holds now."""
        transport, intake, reactor = self._transport, self.plumbing.intake, self.plumbing.reactor
        if transport is None or self.flow is None:
            return
        if intake is not None:
            self._number = intake.add(self.flow)
            if isinstance(transport, UdpSocket) and transport.stamps:
                reactor.forget(transport)
                intake.sweep(transport, Swept(self._number, transport.rcvbuf_bytes, self._broken, self._waits))
                return
        reactor.watch(transport, READ, self._read)

    def tcp_counts(self) -> TcpCounts:
        """What the kernel tells of this endpoint's connections, those that have ended included."""
        now = self._transport.counts() if isinstance(self._transport, TcpClient) else TcpCounts()
        return TcpCounts(*map(sum, zip(self._ended, now, strict=True)))

    def tell_drops(self) -> None:
        """Tell of datagrams that this connection's receive buffer has lost since this was last done."""
        if isinstance(self._transport, UdpSocket) and (lost := self._transport.newly_dropped()):
            self.plumbing.emit(own_drops(str(self.endpoint), self.owners, lost))

    def close(self) -> None:
        """Stop the data, unless they go to a group that others may be listening to, and hang up."""
        self.dialogue.step(ClientEvent.CLOSED if self.endpoint.is_multicast else ClientEvent.STOP)
        self.dialogue.close()
        self._hang_up()

    def _open(self) -> None:
        reactor = self.plumbing.reactor
        try:
            if not self._over_tcp:
                wildcard = "::" if self.address.family == socket.AF_INET6 else "0.0.0.0"
                udp = UdpSocket(
                    self._local.host if self._local else wildcard,
                    0,
                    batches=self.plumbing.batches,
                    native=self.plumbing.native,
                )
                self._transport = udp
                udp.connect(self.address)
                if self.endpoint.hardware_stamps:
                    udp.stamp_by_hardware()
                self._opened(Flow("udp", str(self.address), str(udp.address)))
                return
            tcp = TcpClient(
                self.address,
                local=self._local,
                connection=self._connections,
                native=self.plumbing.native,
                hardware_stamps=self.endpoint.hardware_stamps,
                read_bytes=self.plumbing.tcp_read_bytes,
            )
        except SourceError as error:
            self._fail(LinkKind.FAILED, str(error))
            return
        self._transport = tcp
        self._timer = reactor.call_in(CONNECT_NS, self._too_late)
        reactor.watch(tcp, WRITE, lambda _: self._connected(tcp))

    def _too_late(self) -> None:
        self._fail(LinkKind.FAILED, f"{self.endpoint}: no connection within {CONNECT_NS // 10**9} s; is the device on?")

    def _connected(self, tcp: TcpClient) -> None:
        try:
            tcp.finish()
        except OSError as error:
            self._fail(LinkKind.FAILED, str(explain(error, self.endpoint)))
            return
        if self._timer is not None:
            self._timer.cancelled = True
        self._connections += 1
        self._opened(tcp.flow)

    def _opened(self, flow: Flow) -> None:
        self.flow = flow
        self.noise = ""
        self._opened_ns = self.plumbing.reactor.clock.monotonic_ns()
        self.plumbing.links[flow] = self
        self.listen()
        self._tell(LinkKind.CONNECTED, f"from {flow.destination}")
        self.dialogue.step(ClientEvent.OPENED)

    def _read(self, _events: int) -> None:
        transport, plumbing = self._transport, self.plumbing
        assert transport is not None
        try:
            if plumbing.intake is not None:
                plumbing.intake.read(transport, self._number, stream=self._over_tcp, awaited=self._waits())
            elif isinstance(transport, UdpSocket):
                for datagram in transport.read():
                    plumbing.emit(datagram)
            elif (chunk := transport.read()) is not None:
                plumbing.emit(chunk)
        except OSError as error:
            self._broken(error)

    def _waits(self) -> bool:
        """Whether what comes may be an answer, with which the conversation goes on."""
        return self.dialogue.role.state is not ClientState.STREAMING

    def _broken(self, error: OSError) -> None:
        """Nothing more comes; over UDP this is the answer to what we sent: nobody is there."""
        self._fail(LinkKind.LOST if self._over_tcp else LinkKind.FAILED, str(explain(error, self.endpoint)))

    def _act(self, action: ClientAction, before: ClientState) -> None:
        if action is ClientAction.DISCONNECT:
            self._fail(LinkKind.UNANSWERED, self._silence(before))
            return
        clock = self.plumbing.reactor.clock
        frame = command_for(action, self.idcode or UNKNOWN_IDCODE, clock.realtime_ns())
        if frame is None or self._transport is None:
            return
        # A send that fails needs no care of its own: reading tells of a dead connection, a time-out of a lost datagram.
        if isinstance(self._transport, TcpClient):
            self._transport.send(frame)
        else:
            self._transport.send_connected(frame)

    def _silence(self, before: ClientState) -> str:
        if before is ClientState.WAIT_DATA:
            where = self.endpoint.data_port
            question = f"; does the server send them to UDP port {where}, and no firewall take them?" if where else ""
            return f"{self.endpoint}: no data came after the start command{question}"
        if self.noise:
            return f"{self.endpoint}: what came is no C37.118: {self.noise}; is it another service's port?"
        asked = f"IDCODE {self.idcode}" if self.idcode else f"IDCODE {UNKNOWN_IDCODE} (none was given)"
        return f"{self.endpoint}: no configuration came; a device answers its own IDCODE only, {asked} was asked for"

    def _fail(self, kind: LinkKind, detail: str) -> None:
        """Tell, hang up, and try again later."""
        self._tell(kind, detail)
        self._hang_up()
        self.dialogue.step(ClientEvent.CLOSED)
        self._timer = self.plumbing.reactor.call_in(backoff_ns(self._failures), self._open)
        self._failures += 1

    def _hang_up(self) -> None:
        if self._timer is not None:
            self._timer.cancelled = True
        if self._transport is not None:
            self._ended = self.tcp_counts()
            self.tell_drops()
            self.plumbing.reactor.forget(self._transport)
            if (intake := self.plumbing.intake) is not None:
                intake.forget(self._transport)
                intake.drop(self._number)
                self._number = -1
            self._transport.close()
        self._transport = self.flow = None

    def _tell(self, kind: LinkKind, detail: str) -> None:
        if kind is LinkKind.SILENT:
            detail = silence(self.endpoint.is_multicast, self.plumbing.reactor.clock.monotonic_ns() - self._opened_ns)
        self.plumbing.emit(LinkEvent(kind, str(self.endpoint), self.owners, detail, self.idcode, self.flow))


_REQUEST_IN = {
    ClientState.WAIT_CFG3: ClientAction.REQUEST_CFG3,
    ClientState.WAIT_CFG2: ClientAction.REQUEST_CFG2,
    ClientState.WAIT_DATA: ClientAction.SEND_START,
}


def _local(iface: str | None, over_tcp: bool) -> Address | None:
    """The local address a connection is made from, if ``iface`` names one."""
    try:
        return None if iface is None else resolve(str(ipaddress.ip_address(iface)), 0, datagram=not over_tcp)
    except ValueError:
        raise SettingsError(f"iface={iface}: a connection is made from an address of this machine") from None
