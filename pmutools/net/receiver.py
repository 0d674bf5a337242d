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

Who can wait a little takes all that came in some tenths of a second at once, at a tenth of the cost::

    receivers.soak(250_000_000)             # receive for 250 ms
    for item in receivers.collect():        # Message | Loss | DataRun | LinkEvent
        ...

What comes out is the same: what is not a whole data frame of a known stream goes the other way's way.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from types import TracebackType

from pmutools import linux
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import BOUNDS, Bounds, DataRun, Demux, Loss, Message
from pmutools.c37118.session import CFG2_FIRST, CFG3_FIRST, SAVED_CONFIG, ClientTable, Timing
from pmutools.clock import Clock
from pmutools.flow import Chunk, Flow
from pmutools.net.dialogue import LinkEvent, LinkKind, own_drops
from pmutools.net.endpoint import Endpoint, Scheme, is_multicast, scoped
from pmutools.net.intake import Intake, Swept
from pmutools.net.link import CommandLink, Plumbing
from pmutools.net.reactor import READ, Reactor
from pmutools.net.routes import Listener, Routes
from pmutools.net.sockets import RCVBUF_BYTES, Address, allow_open_files
from pmutools.net.tcp import READ_BYTES, TcpCounts
from pmutools.net.udp import Batches, UdpSocket

HOUSEKEEPING_NS = 1_000_000_000
NOTHING_NS = 5_000_000_000


class Receivers:
    """See the module's text. Not thread-safe; close it, or use it in a ``with``. Poll it or soak it, not both.

    Parameters
    ----------
    endpoints
        Equal ones share a connection, those on one local port a socket. News and :meth:`owners` refer to them by place.
    configs
        Saved configurations, by their IDCODE, for streams that may never send theirs.
    want_cfg3
        Ask for CFG-3 before CFG-2.
    bounds
        Of what is kept; flows and streams alike.
    only_wanted
        Nothing is kept of streams that nobody asks for, and no datagram is looked at that claims to be of one, for who
        must not be held up: their bytes are in no tally.
    tcp_read_bytes
        Of a connection at once.
    native
        False takes the portable path: user-space stamps, a system call a datagram.

    Raises
    ------
    SourceError
        A local port is taken or not permitted, a host unknown, a group refused; too many endpoints for this process.
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
        bounds: Bounds = BOUNDS,
        only_wanted: bool = False,
        tcp_read_bytes: int = READ_BYTES,
        native: bool = linux.NATIVE,
    ) -> None:
        saved = tuple(configs)
        self.endpoints = tuple(endpoints)
        self.unwanted = 0
        """Messages that no endpoint asked for, and what else came from addresses of which none asks for anything."""
        self.undecodable = 0
        """From the others: runs of bytes in no frame, empty datagrams, and data frames given up for want of a
        configuration."""
        self._saved = frozenset(config.idcode for config in saved)
        self._first: ClientTable = CFG3_FIRST if want_cfg3 else CFG2_FIRST
        self._timing = timing or Timing()
        self._rcvbuf_bytes = rcvbuf_bytes
        self._out: list[Chunk | LinkEvent] = []
        self._clock = clock
        self._reactor = Reactor(clock)
        self._plumbing = Plumbing(
            self._reactor, self._out.append, Batches() if native else None, native, tcp_read_bytes
        )
        self._listeners: dict[tuple[str, int], Listener] = {}
        self._by_local: dict[str, Listener] = {}
        self._links: list[CommandLink] = []
        self.routes = routes = Routes(self.endpoints, self._by_local, self._timing, self._plumbing, bounds.flows)
        self._only_wanted = only_wanted
        self.demux = Demux(saved, bounds=bounds, wants=routes.hears) if only_wanted else Demux(saved, bounds=bounds)
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
        assert self._plumbing.intake is None, "these are soaked"
        self._reactor.run(0 if self._out else timeout_ns)
        return self._taken()

    def parse(self, item: Chunk | LinkEvent) -> list[Message | Loss]:
        """The messages that a polled item completes, of wanted streams only.

        Also moves the conversation on; the news of that come with the next :meth:`poll`.
        """
        if isinstance(item, LinkEvent):
            if item.kind not in _ENDS or item.flow is None:
                return []
            runs = self.demux.runs
            lost = self.demux.end(item.flow)
            self._count(item.flow, self.demux.runs - runs, lost)
            self.routes.end(item.flow)
            return lost
        if self._only_wanted and self.routes.turn_away(item):
            self.unwanted += 1
            return []
        out: list[Message | Loss] = []
        now_ns = self._clock.monotonic_ns()
        runs = self.demux.runs
        found = self.demux.feed(item)
        self._count(item.flow, self.demux.runs - runs + (not item.data and not item.flow.is_stream), found)
        for part in found:
            if isinstance(part, Loss):
                out.append(part)
                continue
            route = self.routes.find(part.flow, part.frame.idcode)
            if route is None:
                self.unwanted += 1
                continue
            route.hear(part, now_ns)
            out.append(part)
        if not found and self.demux.put_on_hold:
            for idcode in self.demux.put_on_hold:
                self._note_held(item.flow, idcode, 1, now_ns)
        elif not found and item.data:
            self.routes.note_noise(item)
        return out

    def soak(self, timeout_ns: int) -> bool:
        """Receive for ``timeout_ns`` (0: what is there), or until :meth:`collect` should be called: then it is true.

        That is so where much has come, and where what came may be an answer.
        """
        end_ns = self._clock.monotonic_ns() + timeout_ns
        if self._plumbing.native:
            return (self._plumbing.intake or self._gather()).run(end_ns)
        self._reactor.run(0 if self._out else timeout_ns)
        return bool(self._out)

    def collect(self) -> list[Message | Loss | DataRun | LinkEvent]:
        """What was received since the last time: of each stream in order, a configuration before what it rules.

        Data frames that came whole, one a datagram or read, come in runs, behind everything else.
        """
        out: list[Message | Loss | DataRun | LinkEvent] = []
        intake = self._plumbing.intake
        if intake is not None and intake.columns.count:
            from pmutools.net.harvest import harvest  # numpy is slow to import, and not all who listen need it

            found = harvest(intake, self.demux, self.routes)
            for chunk in found.chunks:
                out += self.parse(chunk)
            now_ns = self._clock.monotonic_ns()
            for run, route in found.runs:
                if not self.demux.take(run):  # what came before it in the round has changed something
                    out += [part for chunk in run.train.chunks() for part in self.parse(chunk)]
                elif route is None:
                    self.unwanted += len(run.train.arrivals_ns)
                else:
                    route.hear_alike(run.config, now_ns)
                    out.append(run)
            for train in found.waiting:
                if self.demux.hold(train):
                    self._note_held(train.flow, train.data[4] << 8 | train.data[5], len(train.arrivals_ns), now_ns)
                else:
                    out += [part for chunk in train.chunks() for part in self.parse(chunk)]
            intake.clear()
        for item in self._taken():
            if isinstance(item, LinkEvent):
                out.append(item)
            out += self.parse(item)
        return out

    def finish(self) -> list[Message | Loss]:
        """The end: what of wanted streams was pending. News not yet told come with the next :meth:`poll`."""
        self._look_for_drops()
        self.routes.notices.sum_up(self._clock.monotonic_ns(), end=True)
        return [
            part
            for part in self.demux.close()
            if isinstance(part, Loss) or self.routes.find(part.flow, part.frame.idcode) is not None
        ]

    def owners(self, flow: Flow, idcode: int) -> tuple[int, ...]:
        """The places of the endpoints that a stream belongs to."""
        route = self.routes.find(flow, idcode)
        return route.owners if route is not None else ()

    @property
    def held(self) -> int:
        """Data frames that wait for a configuration now."""
        return self.demux.held_frames

    def local(self, index: int) -> Address | None:
        """Where endpoint ``index`` is bound, or None for one that only connects."""
        for listener in self._listeners.values():
            if index in listener.owners:
                return listener.sock.address
        return None

    def tcp_counts(self, index: int) -> TcpCounts:
        """What the kernel has counted of the connections of endpoint ``index``; those of several are added up."""
        counts = [link.tcp_counts() for link in self._links if index in link.owners]
        return TcpCounts(*map(sum, zip(TcpCounts(), *counts, strict=True)))

    def close(self) -> None:
        """Send stop where data were started, and close all sockets."""
        for link in self._links:
            link.close()
        for listener in self._listeners.values():
            listener.sock.close()
        self._links.clear()
        self._listeners.clear()
        if self._plumbing.intake is not None:
            self._plumbing.intake.close()
        self._reactor.close()

    # --- opening

    def _open(self) -> None:
        places: dict[Endpoint, list[int]] = {}
        for index, endpoint in enumerate(self.endpoints):
            places.setdefault(endpoint, []).append(index)
        allow_open_files(2 * len(places))
        for endpoint, indices in places.items():
            if endpoint.scheme is Scheme.UDP:
                listener = self._listen(endpoint, endpoint.host, endpoint.port, endpoint.source)
                listener.by_idcode.setdefault(endpoint.idcode, []).extend((index, endpoint) for index in indices)
            else:
                self._connect(endpoint, tuple(indices))
        for listener in self._listeners.values():
            listener.know_owners()
            detail = f"receive buffer {listener.sock.rcvbuf_bytes} bytes"
            self._out.append(LinkEvent(LinkKind.BOUND, f"udp://{listener.sock.address}", listener.owners, detail))

    def _listen(self, endpoint: Endpoint, host: str, port: int, source: str | None) -> Listener:
        host = scoped(host, endpoint.iface)
        key = (host, port)
        listener = self._listeners.get(key) if port else None
        if listener is None:
            plumbing = self._plumbing
            sock = UdpSocket(
                host, port, rcvbuf_bytes=self._rcvbuf_bytes, batches=plumbing.batches, native=plumbing.native
            )
            listener = Listener(sock, self._clock.monotonic_ns())
            self._listeners[host, port or sock.address.port] = listener
            self._by_local[str(sock.address)] = listener
            self._reactor.watch(sock, READ, lambda _, heard=listener: self._read(heard))  # type: ignore[misc]
        if is_multicast(host):
            listener.sock.join(host, iface=endpoint.iface, source=source)
        if endpoint.hardware_stamps:
            listener.sock.stamp_by_hardware()
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

    def _taken(self) -> list[Chunk | LinkEvent]:
        out = self._out[:]
        self._out.clear()
        return out

    def _read(self, listener: Listener) -> None:
        try:
            chunks = listener.sock.read()
        except OSError:  # an ICMP error to something sent from here earlier (Windows): nothing was received
            return
        self._out += chunks

    def _gather(self) -> Intake:
        """From now on all sockets are read into columns."""
        intake = self._plumbing.intake = Intake(self._reactor)
        for listener in self._listeners.values():
            sock = listener.sock
            number = intake.add(sock)
            if sock.stamps:
                self._reactor.forget(sock)
                intake.sweep(sock, Swept(number, sock.rcvbuf_bytes, fail=lambda _: None, awaited=lambda: False))
            else:  # without a stamp it is the reading that counts
                read = partial(intake.read, sock, number, stream=False, awaited=False)
                self._reactor.watch(sock, READ, lambda _, read=read: read())  # type: ignore[misc]
        for link in self._links:
            link.listen()
        return intake

    def _count(self, flow: Flow, runs: int, found: Sequence[Message | Loss]) -> None:
        """Count what is in no message: ``runs`` of ``flow``, and data frames that nobody holds any longer."""
        if runs and self.routes.hears(flow):
            self.undecodable += runs
        else:
            self.unwanted += runs
        self.undecodable += sum(isinstance(part, Loss) and part.undecoded is not None for part in found)

    def _note_held(self, flow: Flow, idcode: int, count: int, now_ns: int) -> None:
        """Data frames that fit no configuration do not come out of the demultiplexer; notice them all the same."""
        if not self.routes.hold(flow, idcode, now_ns):
            self.unwanted += count
            self.demux.ignore(flow, idcode)

    # --- telling

    def _keep_house(self) -> None:
        now_ns = self._clock.monotonic_ns()
        self._look_for_drops()
        self.routes.look_for_rivals(now_ns)
        self.routes.notices.sum_up(now_ns)
        self._reactor.call_in(HOUSEKEEPING_NS, self._keep_house)

    def _look_for_drops(self) -> None:
        for listener in self._listeners.values():
            if lost := listener.sock.newly_dropped():
                self._out.append(own_drops(f"udp://{listener.sock.address}", listener.owners, lost))
        for link in self._links:
            link.tell_drops()

    def _tell_of_nothing(self) -> None:
        noise = {index: heard.noise for heard in self._listeners.values() for index in heard.owners if heard.noise}
        for index, endpoint in enumerate(self.endpoints):
            if index in self.routes.heard or endpoint.scheme is not Scheme.UDP:
                continue
            detail = noise.get(index, "nothing has come; is the sender on, and sending to this address and port?")
            self._out.append(LinkEvent(LinkKind.NOTHING, str(endpoint), (index,), detail, endpoint.idcode))


_ENDS = frozenset((LinkKind.LOST, LinkKind.FAILED, LinkKind.UNANSWERED))
