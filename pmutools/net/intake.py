"""Receiving in bulk: what comes to many sockets is gathered as columns, until it is looked at all together.

Datagram sockets whose datagrams the kernel stamps need no prompt reading: while something comes they are swept now and
then, so that a system call takes many. Connections are read as soon as something comes, since the kernel merges what
waits there under one stamp.
"""

from __future__ import annotations

import select
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

from pmutools.flow import Flow
from pmutools.net.reactor import READ, HasFileno, Reactor
from pmutools.net.sockets import SETTLING_NS
from pmutools.net.udp import UdpSocket

if TYPE_CHECKING:
    from pmutools.linux_receive import ReceiveColumns

SHORTEST_NS, LONGEST_NS = 1_000_000, 50_000_000
"""How long datagrams wait in receive buffers between two sweeps; where there are many sockets up to twice as long."""
PER_SOCKET_NS = 50_000
CHARGE_BYTES = 2304
"""What the kernel charges a receive buffer for a small datagram, at most usually."""
FULL_ENOUGH = 0.25
"""So much of a receive buffer may fill between two sweeps, by what came last."""
ANSWER_NS = 10_000_000
"""How long what may be an answer of a conversation waits to be looked at."""


class Swept(NamedTuple):
    """A socket that is swept: its number in the columns, its size, and what its owner wants to know."""

    number: int
    rcvbuf_bytes: int
    fail: Callable[[OSError], None]
    """Called with what the socket reports instead of a datagram."""
    awaited: Callable[[], bool]
    """Whether what comes may be an answer."""


class Intake:
    """The columns, who is in them, and when to sweep. ``loop`` does what is not swept."""

    def __init__(self, loop: Reactor) -> None:
        from pmutools.linux_receive import ReceiveColumns  # numpy is slow to import, and not all who listen need it

        self.columns: ReceiveColumns = ReceiveColumns()
        self.sources: dict[int, UdpSocket | Flow] = {}
        """Who is called what in the columns: a socket that hears many senders, or the flow of a connection."""
        self._epoll = select.epoll()
        self._swept: dict[int, Swept] = {}
        """By descriptor."""
        self._loop, self._clock = loop, loop.clock
        self._numbers = count()
        self._gone: list[int] = []
        self._settled_ns = self._clock.monotonic_ns() + SETTLING_NS
        self._sweep_ns: int | None = self._clock.monotonic_ns()
        """When to sweep; None while nothing comes: then the loop tells when something does."""
        self._nap_ns = SHORTEST_NS
        self._answer_ns: int | None = None

    def add(self, source: UdpSocket | Flow) -> int:
        """Its number in the columns."""
        number = next(self._numbers)
        self.sources[number] = source
        return number

    def drop(self, number: int) -> None:
        """It has ended, if it ever began; what is there of it can still be looked at."""
        self._gone.append(number)

    def sweep(self, sock: UdpSocket, swept: Swept) -> None:
        """Read a socket now and then from now on."""
        self._swept[sock.fileno()] = swept
        self._epoll.register(sock.fileno(), select.EPOLLIN)

    def forget(self, sock: HasFileno) -> None:
        """Sweep a socket no more, before it is closed."""
        if self._swept.pop(sock.fileno(), None) is not None:
            self._epoll.unregister(sock.fileno())

    def read(self, sock: HasFileno, number: int, *, stream: bool, awaited: bool) -> None:
        """Take what waits on a socket, of a connection one read. Raises OSError for what the socket reports."""
        settling = self._clock.monotonic_ns() < self._settled_ns
        if stream:
            taken = self.columns.receive_stream(sock.fileno(), number, settling=settling)
        else:
            taken = self._take(sock.fileno(), number, settling)
        if taken and awaited:
            self._expect()

    def flow(self, number: int, sender: bytes) -> Flow:
        """Whose a row is, by its source and the 32 bytes of its sender's address."""
        source = self.sources[number]
        return source.flow_from(sender[: source.name_bytes]) if isinstance(source, UdpSocket) else source

    def run(self, end_ns: int) -> bool:
        """Receive until ``end_ns``, or until what is there should be looked at: then true. 0: take what waits."""
        clock = self._clock
        now_ns = clock.monotonic_ns()
        if end_ns <= now_ns:
            self._loop.run(0)
            self._sweep(now_ns)
        while True:
            if self._sweep_ns is not None and now_ns >= self._sweep_ns:
                self._sweep(now_ns)
            until_ns = end_ns if self._answer_ns is None else min(end_ns, self._answer_ns)
            if self.columns.full or now_ns >= until_ns:
                return self.columns.full or until_ns != end_ns
            if self._sweep_ns is not None:
                until_ns = min(until_ns, self._sweep_ns)
            self._loop.run(max(until_ns - clock.monotonic_ns(), 0))
            now_ns = clock.monotonic_ns()

    def clear(self) -> None:
        """What is there was looked at."""
        if self.columns.full and self._sweep_ns is not None:
            self._sweep_ns = self._clock.monotonic_ns()  # more waits
        self.columns.clear()
        self._answer_ns = None
        for number in self._gone:
            self.sources.pop(number, None)
        self._gone.clear()

    def close(self) -> None:
        self._epoll.close()

    def _sweep(self, now_ns: int) -> None:
        """Read all that waits, and see how long it may wait until the next time."""
        self._loop.forget(self._epoll)
        settling, fill = now_ns < self._settled_ns, 0.0
        for fd, _ in self._epoll.poll(0, len(self._swept)) if self._swept else ():
            if (swept := self._swept.get(fd)) is None:  # forgotten meanwhile
                continue
            try:
                taken = self._take(fd, swept.number, settling)
            except OSError as error:
                swept.fail(error)
                continue
            fill = max(fill, taken * CHARGE_BYTES / swept.rcvbuf_bytes if taken < self.columns.share else 1.0)
            if taken and swept.awaited():
                self._expect()
        if not fill:
            self._sweep_ns = None
            self._loop.watch(self._epoll, READ, self._wake)
            return
        longest_ns = SHORTEST_NS if settling else LONGEST_NS + min(PER_SOCKET_NS * len(self._swept), LONGEST_NS)
        self._nap_ns = min(max(int(self._nap_ns * min(FULL_ENOUGH / fill, 2.0)), SHORTEST_NS), longest_ns)
        self._sweep_ns = self._clock.monotonic_ns() + self._nap_ns

    def _take(self, fd: int, number: int, settling: bool) -> int:
        """Datagrams of one socket, at most its share."""
        receive, call, share = self.columns.receive, self.columns.call, self.columns.share
        taken = count = receive(fd, number, call, settling=settling)
        while count == call and taken < share:
            taken += (count := receive(fd, number, call, settling=settling))
        return taken

    def _expect(self) -> None:
        """Look at what is there soon."""
        if self._answer_ns is None:
            self._answer_ns = self._clock.monotonic_ns() + ANSWER_NS

    def _wake(self, _events: int) -> None:
        self._nap_ns = SHORTEST_NS
        self._sweep_ns = self._clock.monotonic_ns()
