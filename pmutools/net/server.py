"""The front end of everything that sends: streams published to fixed destinations and to clients that ask for them.

::

    with Senders(SystemClock()) as senders:
        stream = senders.add(served(config))                                    # a handle
        senders.send_to(parse_endpoint("udp://239.1.2.3:4713"), [stream])       # spontaneous
        senders.listen(parse_endpoint("tcp://0.0.0.0:4712"), [stream])          # a PMU or PDC that answers commands
        senders.announce()                                                      # configurations of spontaneous streams
        while ...:
            events = senders.serve_until(deadline_ns)                           # commands are answered meanwhile
            senders.publish([(stream, frame), ...])                             # one tick, one system call where it can
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType

import numpy as np

from pmutools import linux
from pmutools.c37118.session import Served
from pmutools.clock import Clock
from pmutools.errors import SettingsError
from pmutools.flow import Hangup
from pmutools.net.audience import Audience
from pmutools.net.cargo import I64, Cargo, Frames, Table
from pmutools.net.endpoint import Endpoint, Scheme, is_multicast, scoped
from pmutools.net.outbox import Flushable, Outbox, UdpSink
from pmutools.net.outlet import ServerEvent, Stage, TcpOutlet, UdpOutlet
from pmutools.net.reactor import Reactor
from pmutools.net.sockets import Address, resolve
from pmutools.net.tcp import QUEUE_BYTES
from pmutools.net.udp import Batches, UdpSocket, check_broadcast, target

CFG_PERIOD_NS = 60_000_000_000
HOUSEKEEPING_NS = 1_000_000_000
COARSE_NS = 2_000_000
"""How long before a deadline waiting for sockets, in whole milliseconds, gives way to an exact sleep."""
HANDLING_NS = 1_000_000
"""Longest time in a row for what clients ask, before whoever serves can look after its deadlines."""
_SHARES = 64
"""A period's configurations leave in so many portions, not in one burst."""
_SENDING_RCVBUF = 4096
_NONE = np.zeros(0, np.int64)


class Senders:
    """See the module's text. Not thread-safe; close it, or use it in a ``with``.

    Parameters
    ----------
    cfg_period_ns
        How often spontaneous streams repeat their configuration; None: only in :meth:`announce`.
    queue_bytes
        Bytes that may wait for one TCP client; frames beyond are dropped for it, and counted.
    native
        False takes the portable path: a system call a datagram.
    treat
        What becomes of a configuration or header of a stream (by its handle) on its way out: faults.
    stamp_departures
        Have the kernel stamp what leaves unasked, for :meth:`departures`.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        cfg_period_ns: int | None = CFG_PERIOD_NS,
        queue_bytes: int = QUEUE_BYTES,
        native: bool = linux.NATIVE,
        stamp_departures: bool = False,
        treat: Callable[[int, bytes], Sequence[bytes]] = lambda handle, frame: (frame,),
    ) -> None:
        self._clock = clock
        self._native = native
        self._stamp_departures = stamp_departures
        self._queue_bytes = queue_bytes
        self._batches = Batches() if native else None
        self.reactor = Reactor(clock)
        self._audience = Audience()
        self._events: list[ServerEvent] = []
        self._interrupted = False
        self._dirty: dict[Flushable, None] = {}
        self._stage = Stage(
            self.reactor,
            self._audience,
            self._events.append,
            self._dirty,
            self._box,
            self._batches,
            native,
            stamp_departures,
            treat,
        )
        self._served: list[Served] = []
        self._outlets: list[TcpOutlet | UdpOutlet | None] = []
        """By number; None for those that only send."""
        self._boxes: dict[tuple[str, str | None, int | None], Outbox] = {}
        self._spontaneous: list[list[UdpSink]] = []
        self._table: Table | None = None
        self._last_poll_ns = 0
        self._share = 0
        if cfg_period_ns is not None:
            self._share_ns = max(cfg_period_ns // _SHARES, 1)
            self._share_due_ns = clock.monotonic_ns()
            self._await_share()
        self.reactor.call_in(HOUSEKEEPING_NS, self._keep_house)

    def __enter__(self) -> Senders:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- what is sent, and where

    def add(self, stream: Served) -> int:
        """Offer a stream; returns its handle. Nobody gets it before :meth:`send_to` or :meth:`listen`."""
        self._served.append(stream)
        self._audience.sinks.append([])
        self._audience.version += 1
        self._spontaneous.append([])
        return len(self._served) - 1

    def replace(self, handle: int, stream: Served) -> None:
        """The stream has another configuration from now on; its IDCODE stays."""
        if stream.idcode != self._served[handle].idcode:
            raise ValueError(f"stream {handle} is {self._served[handle].idcode}, not {stream.idcode}")
        before, self._served[handle] = self._served[handle], stream
        for outlet in self._outlets:
            if outlet is not None and outlet.streams.get(stream.idcode) is before:
                outlet.streams[stream.idcode] = stream

    def send_to(self, endpoint: Endpoint, streams: Sequence[int]) -> int:
        """Send streams to a UDP address without being asked; returns the outlet's number.

        ``iface`` and ``ttl`` of the endpoint choose how multicast leaves, ``source`` the address it comes from;
        that also says on which network 255.255.255.255 is. Raises SourceError for an unknown host, a source that is not
        local or a broadcast that cannot leave, SettingsError for an endpoint that is served.
        """
        if endpoint.scheme is not Scheme.UDP:
            raise SettingsError(
                f"{endpoint}: {endpoint.scheme}:// is served to those who connect; listen there instead"
            )
        if not endpoint.port:
            raise SettingsError(f"{endpoint}: port 0 is nowhere to send to")
        where = target(resolve(scoped(endpoint.host, endpoint.iface), endpoint.port, datagram=True))
        box = self._box(where.address, endpoint)
        check_broadcast(where.address, box.sock.address.host)
        for handle in streams:
            sink = UdpSink(box, where)
            self._audience.add(handle, sink)
            self._spontaneous[handle].append(sink)
        self._outlets.append(None)
        return len(self._outlets) - 1

    def listen(self, endpoint: Endpoint, streams: Sequence[int]) -> int:
        """Serve streams to clients that ask for them; returns the outlet's number.

        Raises SourceError where the port is taken or not permitted, SettingsError for two streams of one IDCODE.
        """
        if endpoint.scheme is Scheme.UDP:
            raise SettingsError(f"{endpoint}: udp:// knows no commands; use udp+cmd://, or send to it unasked")
        offered: dict[int, Served] = {}
        handles: dict[int, int] = {}
        for handle in streams:
            stream = self._served[handle]
            if stream.idcode in offered:
                raise SettingsError(f"{endpoint}: two streams of IDCODE {stream.idcode}; renumber one")
            offered[stream.idcode] = stream
            handles[stream.idcode] = handle
        number = len(self._outlets)
        outlet: TcpOutlet | UdpOutlet
        if endpoint.scheme is Scheme.UDP_COMMANDED:
            outlet = UdpOutlet(number, endpoint, offered, handles, self._stage)
        else:
            outlet = TcpOutlet(number, endpoint, offered, handles, self._stage, self._queue_bytes)
        self._outlets.append(outlet)
        return number

    def local(self, outlet: int) -> Address | None:
        """Where an outlet listens; None for one that only sends."""
        listening = self._outlets[outlet]
        return listening.address if listening is not None else None

    def audience(self, stream: int) -> int:
        """How many destinations a frame of this stream would go to now."""
        return len(self._audience.sinks[stream])

    @property
    def queued_bytes(self) -> int:
        """What waits for TCP clients that are slow to take it."""
        return sum(outlet.queued_bytes for outlet in self._outlets if outlet is not None)

    # --- running

    def publish(self, frames: Iterable[tuple[int, bytes]]) -> list[int]:
        """Send (stream, frame) pairs to whoever is to have them, now, in this order for each destination.

        Returns the places in ``frames`` of those that a destination did not take: a full queue, or a system error.
        """
        now_ns = self._clock.monotonic_ns()
        sinks = self._audience.sinks
        failed: list[int] = []
        for mark, (stream, frame) in enumerate(frames):
            failed += [mark for sink in sinks[stream] if not sink.put(frame, mark, now_ns)]
        return failed + self._flush()

    def load(self, frames: Frames) -> Cargo:
        """Make frames ready for those who are to have them now; unloads what was loaded before."""
        if self._table is None or self._table.version != self._audience.version:
            self._table = Table(self._audience)
        return Cargo(frames, self._table)

    def stale(self, cargo: Cargo) -> bool:
        """Whether someone has come or gone since ``cargo`` was loaded: load it again."""
        return cargo.version != self._audience.version

    def send(self, cargo: Cargo, first: int, last: int) -> list[int]:
        """Send frames ``first`` to ``last - 1`` of a cargo, now; as :meth:`publish`, at the cost of a column.

        Returns the rows that a destination did not take, once for each destination.
        """
        if cargo.direct is not None:
            return cargo.direct(first, last)
        failed = cargo.send(first, last, self._clock.monotonic_ns())
        return failed + self._flush() if self._dirty else failed

    def departures(self) -> tuple[I64, I64]:
        """(mark, POSIX UTC ns) of frames whose departure the kernel has stamped since this was last asked."""
        outboxes = [outlet.outbox for outlet in self._outlets if isinstance(outlet, UdpOutlet)]
        found = [box.departures.read() for box in (*self._boxes.values(), *outboxes) if box.departures is not None]
        marks, times = zip(*found, strict=True) if found else ((), ())
        return np.concatenate([_NONE, *marks]), np.concatenate([_NONE, *times])

    def announce(self, streams: Iterable[int] | None = None) -> None:
        """Send the configurations of spontaneous streams (default: all), stamped with the present time."""
        utc_ns = self._clock.realtime_ns()
        for handle in range(len(self._served)) if streams is None else streams:
            sinks = self._spontaneous[handle]
            if not sinks:
                continue
            for announcement in self._served[handle].announcements(utc_ns):
                for frame in self._stage.treat(handle, announcement):
                    for sink in sinks:
                        sink.put(frame, 0, 0)
        self._flush()

    def inform(self, handle: int) -> None:
        """Send a stream's configurations to all who get its data."""
        announcements = self._served[handle].announcements(self._clock.realtime_ns())
        self.publish([(handle, frame) for told in announcements for frame in self._stage.treat(handle, told)])

    def poll(self, timeout_ns: int | None) -> list[ServerEvent]:
        """Answer clients and repeat configurations; waits for something to do at most ``timeout_ns``."""
        self.reactor.run(0 if self._events else timeout_ns, HANDLING_NS)
        self._last_poll_ns = self._clock.monotonic_ns()
        events = self._events[:]
        self._events.clear()
        return events

    def serve_until(self, deadline_ns: int) -> list[ServerEvent]:
        """Answer clients until the monotonic clock reads ``deadline_ns``; back earlier with events, or interrupted.

        The last milliseconds are an exact sleep, so clients wait that long for an answer. Where deadlines follow each
        other closely, sockets are looked at every few milliseconds.
        """
        while (left_ns := deadline_ns - self._clock.monotonic_ns()) > COARSE_NS:
            if (events := self.poll(left_ns - COARSE_NS)) or self._interrupted:
                self._interrupted = False
                return events
        if self._clock.monotonic_ns() - self._last_poll_ns > 2 * COARSE_NS and (events := self.poll(0)):
            return events
        self._clock.sleep_until(deadline_ns)
        return []

    def interrupt(self) -> None:
        """Have :meth:`serve_until` return as soon as what is being answered is: for those who are called meanwhile."""
        self._interrupted = True

    def hang_up(self, stream: int, how: Hangup) -> int:
        """Let TCP clients that have started a stream feel that it falls silent; returns how many were sent away.

        With :attr:`~pmutools.flow.Hangup.REFUSE` the stream does not start again before :meth:`take_up`: commands to
        start it are told (:attr:`ServerKind.REFUSED`) and not obeyed, and an endpoint of which all streams are refused
        closes its port and sends everybody away. UDP clients see silence in any case.
        """
        if how is Hangup.SILENCE:
            return 0
        return sum(outlet.hang_up(idcode, how) for outlet, idcode in self._offers(stream))

    def take_up(self, stream: int) -> None:
        """End :attr:`~pmutools.flow.Hangup.REFUSE`: listen again on the same port, and obey those who start it.

        A port that cannot be had is told (:attr:`ServerKind.NOT_LISTENING`) and tried again until it can.
        """
        for outlet, idcode in self._offers(stream):
            outlet.take_up(idcode)

    def _offers(self, stream: int) -> list[tuple[TcpOutlet, int]]:
        """The outlets with connections that offer a stream, and its IDCODE there."""
        return [
            (outlet, idcode)
            for outlet in self._outlets
            if isinstance(outlet, TcpOutlet)
            for idcode, handle in outlet.handles.items()
            if handle == stream
        ]

    def close(self) -> None:
        for outlet in self._outlets:
            if outlet is not None:
                outlet.close()
        for box in self._boxes.values():
            box.sock.close()
        self._outlets.clear()
        self._boxes.clear()
        self.reactor.close()

    # --- inside

    def _flush(self) -> list[int]:
        failed: list[int] = []
        while self._dirty:
            failed += next(iter(self._dirty)).flush()
        return failed

    def _box(self, where: Address, endpoint: Endpoint) -> Outbox:
        """The box of the socket for ``where``: one for all that leave from the same address in the same way."""
        local = endpoint.source or ("::" if where.family == socket.AF_INET6 else "0.0.0.0")
        group = is_multicast(where.host)
        way = (local, endpoint.iface if group else None, endpoint.ttl if group else None)
        box = self._boxes.get(way)
        if box is None:
            sock = UdpSocket(local, 0, rcvbuf_bytes=_SENDING_RCVBUF, batches=self._batches, native=self._native)
            sock.send_via(iface=way[1], ttl=way[2])
            box = self._boxes[way] = Outbox(sock, self._dirty, stamped=self._stamp_departures)
        return box

    def _await_share(self) -> None:
        """The next portion is due a fixed time after the one before was; after a long stall, from now."""
        behind = self._clock.monotonic_ns() - self._share_due_ns > _SHARES * self._share_ns
        self._share_due_ns = (self._clock.monotonic_ns() if behind else self._share_due_ns) + self._share_ns
        self.reactor.call_at(self._share_due_ns, self._announce_share)

    def _announce_share(self) -> None:
        self.announce(range(self._share, len(self._served), _SHARES))
        self._share = (self._share + 1) % _SHARES
        self._await_share()

    def _keep_house(self) -> None:
        now_ns = self._clock.monotonic_ns()
        for outlet in self._outlets:
            if outlet is not None:
                outlet.keep_house(now_ns)
        self.reactor.call_in(HOUSEKEEPING_NS, self._keep_house)
