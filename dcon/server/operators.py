"""Operators' connections: lines of JSON over TCP, every number bounded.

A client that is too many takes the place of another, by :class:`Worth`; one that reads too slowly misses statuses, and
is cut off where it misses answers.
"""

from __future__ import annotations

import logging
import selectors
import socket
from collections import Counter, deque
from collections.abc import Iterable
from enum import IntEnum
from typing import Any

from dcon.server.client import CROWDED_OUT
from dcon.server.desk import Desk
from dcon.server.pending import Answer
from dcon.server.status import to_json
from pmutools.net.endpoint import Endpoint
from pmutools.net.sockets import Address, listening_socket, resolve
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
MOST_CLIENTS = 32
BACKLOG = 512
"""Connections that wait to be accepted: what a client sends meanwhile is read with its acceptance."""
ACCEPTED_A_ROUND = 8
"""Before others have their turn: fewer than there are places, so that a new one is heard before it can lose its own."""
GRACE_NS = NS
"""A new client has so long to say what it wants."""
LONGEST_LINE = 16 << 10
"""Bytes."""
LINES_A_SECOND = 20
"""Of one client; more are answered with an error."""
TOO_FAST = to_json({"error": f"more than {LINES_A_SECOND} lines in a second"})
IDLE_NS = 60 * NS
WAITING_BYTES = 256 << 10
"""To be sent to one client; beyond this it is cut off."""
WATCHED_BYTES = 64 << 10
"""Beyond this a watching client gets no new status."""


class Worth(IntEnum):
    """Who makes room: the least; of equals one of the address with most places, and there who is silent for longest."""

    SILENT = 0
    WATCHES = 1
    NEW = 2
    """Not yet :data:`GRACE_NS` here, and does not watch."""
    PROVEN = 3
    """Has signed an order with a key that the server knows: nobody without one takes this place while others go."""
    AWAITS = 4
    """And what became of it is still to be told."""


class Client:
    """One connection."""

    def __init__(self, sock: socket.socket, host: str, number: int, now_ns: int) -> None:
        self.sock = sock
        self.host = host
        self.number = number
        self.watches = False
        self.since_ns = self.heard_ns = self.drained_ns = now_ns
        self._in = bytearray()
        self._out = bytearray()
        self._recent: deque[int] = deque(maxlen=LINES_A_SECOND)

    @property
    def waiting(self) -> int:
        return len(self._out)

    def lines(self, data: bytes) -> list[bytes] | None:
        """Whole lines, now that ``data`` came; None where one is too long."""
        self._in += data
        *whole, rest = self._in.split(b"\n")
        self._in = bytearray(rest)
        if max(map(len, (*whole, rest))) > LONGEST_LINE:
            return None
        return [bytes(line) for line in whole if line.strip()]

    def is_too_fast(self, now_ns: int) -> bool:
        fast = len(self._recent) == LINES_A_SECOND and now_ns - self._recent[0] < NS
        if not fast:
            self._recent.append(now_ns)
        return fast

    def say(self, line: bytes) -> bool:
        """False where the connection is broken, or its client does not read."""
        self._out += line
        return self.pump() and len(self._out) <= WAITING_BYTES

    def pump(self) -> bool:
        """Send what the system takes; false where the connection is broken."""
        try:
            while self._out:
                del self._out[: self.sock.send(self._out)]
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True


class Operators:
    """Listens, and brings asks to the desk. The caller's selector tells which sockets are ready."""

    def __init__(self, where: Endpoint, desk: Desk, selector: selectors.BaseSelector) -> None:
        """Raises SourceError where the port cannot be had."""
        wanted = resolve(where.host, where.port, datagram=False)
        self._desk = desk
        self._selector = selector
        self._sock = listening_socket(wanted, BACKLOG, f"[server] listen {wanted}")
        family, sockaddr = self._sock.family, self._sock.getsockname()
        self.address = Address(family, sockaddr)
        self.clients: dict[int, Client] = {}
        self.turned_away = 0
        """Clients that had to make room, or broke a bound."""
        self._number = 0
        selector.register(self._sock, selectors.EVENT_READ, self._accept)

    def watched(self, status: bytes, now_ns: int) -> None:
        """Send a status to who watches, and end what has been idle for long."""
        for client in list(self.clients.values()):
            if not client.waiting:
                client.drained_ns = now_ns
            if client.watches:
                fine = client.say(status) if client.waiting <= WATCHED_BYTES else now_ns - client.drained_ns < IDLE_NS
                self._after(client, fine)
            elif now_ns - client.heard_ns > IDLE_NS and not self._desk.pending.awaits(client.number):
                self._end(client)

    @property
    def is_watched(self) -> bool:
        return any(client.watches for client in self.clients.values())

    def answer(self, answers: Iterable[Answer]) -> None:
        for asker, said in answers:
            if isinstance(asker, int) and (client := self.clients.get(asker)) is not None:
                self._say(client, said)

    def close(self) -> None:
        for client in list(self.clients.values()):
            self._end(client)
        self._selector.unregister(self._sock)
        self._sock.close()

    def _accept(self, _events: int, now_ns: int, utc_ns: int) -> None:
        for _ in range(ACCEPTED_A_ROUND):
            try:
                sock, peer = self._sock.accept()
            except OSError:  # none is left, it is gone again, or too many files are open: it waits in the backlog
                return
            self._welcome(sock, peer[0], now_ns, utc_ns)

    def _welcome(self, sock: socket.socket, host: str, now_ns: int, utc_ns: int) -> None:
        sock.setblocking(False)
        self._make_room(now_ns, utc_ns)
        self._number += 1
        client = self.clients[self._number] = Client(sock, host, self._number, now_ns)

        def ready(events: int, now_ns: int, utc_ns: int) -> None:
            self._ready(client, events, now_ns, utc_ns)

        self._selector.register(sock, selectors.EVENT_READ, ready)
        self._read(client, now_ns, utc_ns)

    def _make_room(self, now_ns: int, utc_ns: int) -> None:
        """Have a place free. Whose turn it is to go is read first: what it has sent may be an order."""
        while len(self.clients) >= MOST_CLIENTS:
            places = Counter(client.host for client in self.clients.values())
            going = min(self.clients.values(), key=lambda c: (self._worth(c, now_ns), -places[c.host], c.heard_ns))
            worth = self._worth(going, now_ns)
            self._read(going, now_ns, utc_ns)
            if going.number in self.clients and self._worth(going, now_ns) == worth:
                self.turned_away += 1
                self._say(going, {"error": CROWDED_OUT})
                self._end(going)

    def _worth(self, client: Client, now_ns: int) -> Worth:
        if client.number in self._desk.proven:
            return Worth.AWAITS if self._desk.pending.awaits(client.number) else Worth.PROVEN
        if client.watches:
            return Worth.WATCHES
        return Worth.NEW if now_ns - client.since_ns < GRACE_NS else Worth.SILENT

    def _ready(self, client: Client, events: int, now_ns: int, utc_ns: int) -> None:
        if client.number not in self.clients:
            return
        if events & selectors.EVENT_WRITE:
            self._after(client, client.pump())
        if events & selectors.EVENT_READ and client.number in self.clients:
            self._read(client, now_ns, utc_ns)

    def _read(self, client: Client, now_ns: int, utc_ns: int) -> None:
        try:
            data = client.sock.recv(LONGEST_LINE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._end(client)
            return
        client.heard_ns = now_ns
        lines = client.lines(data)
        if lines is None:
            self.turned_away += 1
            self._say(client, {"error": f"a line is longer than {LONGEST_LINE} bytes"})
            self._end(client)
            return
        too_fast = 0
        for line in lines:
            if client.number not in self.clients:
                return
            if client.is_too_fast(now_ns):
                too_fast += 1
            else:
                self._ask(client, line, now_ns, utc_ns)
        if too_fast and client.number in self.clients:  # at once: a flood of lines must not take the time of others
            self._after(client, client.say(TOO_FAST * too_fast))

    def _ask(self, client: Client, line: bytes, now_ns: int, utc_ns: int) -> None:
        answer = self._desk.ask(client.number, line, utc_ns=utc_ns, now_ns=now_ns)
        if answer == {"watch": True}:
            client.watches = True
        elif answer is not None:
            self._say(client, answer)

    def _say(self, client: Client, said: dict[str, Any]) -> None:
        self._after(client, client.say(to_json(said)))

    def _after(self, client: Client, fine: bool) -> None:
        if not fine:
            self._end(client)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.waiting else 0)
        key = self._selector.get_key(client.sock)
        if key.events != wanted:
            self._selector.modify(client.sock, wanted, key.data)

    def _end(self, client: Client) -> None:
        if self.clients.pop(client.number, None) is not None:
            self._desk.forget(client.number)
            self._selector.unregister(client.sock)
            client.sock.close()
