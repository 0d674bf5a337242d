"""Control sessions on sockets, within the player's own loop, which they must not hold up.

All clients together get one step of work (some 0.2 ms) a turn, and a turn a millisecond. A client's next request is not
even read before its answer is on the way, so what a client can make us hold is one line, one portion of an answer, and
the kernel's buffers.
"""

from __future__ import annotations

import errno
import os
import socket
import stat
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from pmutools.errors import SettingsError, SourceError
from pmutools.net.reactor import READ, WRITE, Reactor, Timer
from pmutools.net.sockets import Address, explain, listening_socket, resolve
from pmutools.timebase import NS
from pmutools.tools.player.control import Controlled, ControlSession
from pmutools.tools.player.control_address import ControlAddress

MAX_CLIENTS = 8
"""More are told so and turned away."""
READ_BYTES = 4096
"""Read at once from a client."""
SEND_BYTES = 32 << 10
"""The kernel's send buffer of a client."""
TURN_NS = 1_000_000
"""Between two steps of work."""
STALL_NS = 10 * NS
"""A client that takes nothing for so long while bytes wait for it is sent away."""
_BACKLOG = 16
_ACCEPT_AGAIN_NS = NS
_HOUSEKEEPING_NS = NS


class ControlServer:
    """Listens until closed. ``tell`` gets one line for each client and each thing done.

    Raises SourceError where the address is taken or not permitted, SettingsError for one that cannot be.
    """

    def __init__(
        self, address: ControlAddress, player: Controlled, reactor: Reactor, tell: Callable[[str], None]
    ) -> None:
        self._player, self._reactor, self._tell = player, reactor, tell
        self._listener = _listen_unix(address) if address.path else _listen_tcp(address)
        self._made = os.stat(address.path) if address.path else None
        self.address = address
        if not address.path:
            self.address = ControlAddress(host=address.host, port=self._listener.getsockname()[1])
        if not address.loopback:
            tell(f"control {self.address}: whoever reaches this port controls the player; 127.0.0.1 or a path does not")
        self._clients: set[_Client] = set()
        self._busy = deque[_Client]()
        self._turn_timer: Timer | None = None
        self._next_turn_ns = 0
        self._accepting()
        self._house = reactor.call_in(_HOUSEKEEPING_NS, self._keep_house)

    def close(self, reason: str = "the player has ended") -> None:
        """Take leave of all clients, and remove the socket's path."""
        for client in list(self._clients):
            client.finish_line()
            self.send_away(client, reason)
        self._reactor.forget(self._listener)
        self._listener.close()
        self._house.cancelled = True
        if self._turn_timer is not None:
            self._turn_timer.cancelled = True
        with suppress(OSError):
            if self._made is not None and os.path.samestat(self._made, os.stat(self.address.path)):
                os.unlink(self.address.path)

    def __enter__(self) -> ControlServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- called by clients

    def wants_turn(self, client: _Client) -> None:
        """Put a client in line for a step of work."""
        if client not in self._busy:
            self._busy.append(client)
        self._await_turn()

    def drop(self, client: _Client, why: str) -> None:
        """Close a client's connection; that it has left of itself (no ``why``) is nothing to tell."""
        if client in self._clients:
            self._clients.discard(client)
            client.close()
            if why:
                self._tell(f"control {client.name}: {why}")

    def send_away(self, client: _Client, reason: str) -> None:
        """Close a client's connection, and tell it why if it listens."""
        if not client.within_line:
            with suppress(OSError):
                client.sock.send(ControlSession.farewell(reason))
        self.drop(client, reason)

    # --- inside

    def _accepting(self) -> None:
        self._reactor.watch(self._listener, READ, self._accept)

    def _accept(self, _events: int) -> None:
        try:
            sock, sender = self._listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as error:  # no file descriptor left: try again later instead of spinning
            self._tell(str(explain(error, f"control {self.address}")))
            self._reactor.forget(self._listener)
            self._reactor.call_in(_ACCEPT_AGAIN_NS, self._accept_again)
            return
        name = str(Address(self._listener.family, sender)) if self._made is None else "client"
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
            if self._made is None:
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            if len(self._clients) >= MAX_CLIENTS:
                reason = f"{MAX_CLIENTS} clients are served already; close one"
                self._tell(f"control {name}: turned away, {reason}")
                sock.send(ControlSession.farewell(reason))
                sock.close()
                return
        except OSError:  # gone again already
            sock.close()
            return
        client = _Client(sock, name, ControlSession(self._player, lambda done: self._tell(f"control {name}: {done}")))
        self._clients.add(client)
        client.start(self, self._reactor)

    def _accept_again(self) -> None:
        if self._listener.fileno() >= 0:
            self._accepting()

    def _await_turn(self) -> None:
        if self._busy and self._turn_timer is None:
            self._turn_timer = self._reactor.call_at(self._next_turn_ns, self._turn)

    def _turn(self) -> None:
        self._turn_timer = None
        now_ns = self._reactor.clock.monotonic_ns()
        self._next_turn_ns = now_ns + TURN_NS
        while self._busy:
            client = self._busy.popleft()
            if client in self._clients:
                client.step(now_ns)
                break
        self._await_turn()

    def _keep_house(self) -> None:
        now_ns = self._reactor.clock.monotonic_ns()
        for client in [client for client in self._clients if client.stalled(now_ns)]:
            self.send_away(client, f"took nothing for {STALL_NS // NS} s")
        self._house = self._reactor.call_in(_HOUSEKEEPING_NS, self._keep_house)


class _Client:
    """A connection: reads while its session is hungry, works while nothing waits to be sent."""

    def __init__(self, sock: socket.socket, name: str, session: ControlSession) -> None:
        self.sock, self.name, self.session = sock, name, session
        self._queue = bytearray()
        self._stuck_since_ns: int | None = None
        self._ended = False
        self._watched = 0
        self._due: Timer | None = None
        self._server: ControlServer
        self._reactor: Reactor

    def start(self, server: ControlServer, reactor: Reactor) -> None:
        self._server, self._reactor = server, reactor
        self._queue += self.session.greeting()
        self._flush()

    def close(self) -> None:
        if self._due is not None:
            self._due.cancelled = True
        self._reactor.forget(self.sock)
        with suppress(OSError):  # what was not read would make a reset of the end, which eats our last words
            self.sock.shutdown(socket.SHUT_WR)
            self.sock.recv(READ_BYTES)
        self.sock.close()

    @property
    def within_line(self) -> bool:
        """Whether the last line that the client got has no end yet."""
        return bool(self._queue) or self.session.speaking

    def finish_line(self) -> None:
        """Say what is being said to its end, if the kernel takes it: there will be no other turn."""
        while self.session.speaking and not self._queue and self.sock.fileno() >= 0:
            self.step(self._reactor.clock.monotonic_ns())

    def stalled(self, now_ns: int) -> bool:
        return self._stuck_since_ns is not None and now_ns - self._stuck_since_ns > STALL_NS

    def step(self, now_ns: int) -> None:
        """One step of the session's work."""
        if not self._queue:
            self._queue += self.session.step(now_ns)
        self._flush()

    def _ready(self, events: int) -> None:
        if events & READ and self.session.hungry:
            try:
                data = self.sock.recv(READ_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._server.drop(self, str(explain(error, "gone")))
                return
            if data:
                self.session.feed(data)
            else:
                self._ended = True
                self.session.end()
        self._flush()

    def _flush(self) -> None:
        try:
            while self._queue:
                sent = self.sock.send(self._queue)
                del self._queue[:sent]
                self._stuck_since_ns = None
        except (BlockingIOError, InterruptedError):
            self._stuck_since_ns = self._stuck_since_ns or self._reactor.clock.monotonic_ns()
        except OSError as error:
            self._server.drop(self, "" if error.errno == errno.EPIPE else str(explain(error, "gone")))
            return
        self._arrange()

    def _arrange(self) -> None:
        """Wait for what comes next: room to send, a turn to work, a request, the time to send the state again."""
        session = self.session
        if session.over and not self._queue:
            self._server.drop(self, session.over)
        elif self._queue:
            self._watch(WRITE)
        elif session.busy:
            self._watch(0)
            self._server.wants_turn(self)
        elif self._ended and session.due_ns is None:
            self._server.drop(self, "")
        else:
            self._watch(0 if self._ended else READ)
            self._await_due(session.due_ns)

    def _await_due(self, due_ns: int | None) -> None:
        if self._due is not None and self._due.deadline_ns != due_ns:
            self._due.cancelled, self._due = True, None
        if self._due is None and due_ns is not None:
            self._due = self._reactor.call_at(due_ns, self._is_due)

    def _is_due(self) -> None:
        self._due = None
        if not self._queue:  # else the client is slow: what is due comes after it has taken what waits
            self._server.wants_turn(self)

    def _watch(self, events: int) -> None:
        if events == self._watched:
            return
        self._watched = events
        if events:
            self._reactor.watch(self.sock, events, self._ready)
        else:
            self._reactor.forget(self.sock)


# --- listening ---------------------------------------------------------------------------------------------------


def _listen_tcp(address: ControlAddress) -> socket.socket:
    return listening_socket(resolve(address.host, address.port, datagram=False), _BACKLOG, f"--control {address}")


def _listen_unix(address: ControlAddress) -> socket.socket:
    """A socket that only its owner can use; takes the place of one that nobody listens to any more."""
    path = address.path
    _make_room(path)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)  # so that there is no moment at which others may connect
    try:
        sock.setblocking(False)
        sock.bind(path)
        sock.listen(_BACKLOG)
    except OSError as error:
        sock.close()
        why = _REMEDIES.get(error.errno or 0, error.strerror or str(error))
        raise SourceError(f"--control {path}: {why}") from None
    finally:
        os.umask(before)
    return sock


_REMEDIES = {
    errno.ENOENT: "no such folder; make it first",
    errno.EACCES: "not permitted; choose a folder of your own",
    errno.EADDRINUSE: "another program has just taken this path; choose another",
}


def _make_room(path: str) -> None:
    """Remove the socket of a dead player; raises where the path is something else, or alive."""
    try:
        found = os.lstat(path)
    except OSError:  # nothing there; what else is wrong, binding will tell
        return
    if not stat.S_ISSOCK(found.st_mode):
        raise SettingsError(f"--control {path}: a file is there that is no socket; choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            with suppress(OSError):  # what cannot be removed, binding will tell
                os.unlink(path)
            return
        except BlockingIOError:  # its queue is full, so someone is there
            pass
        except OSError as error:
            raise SourceError(f"--control {path}: {error.strerror or error}; remove it, or choose another") from None
    raise SourceError(f"--control {path}: another player is controlled there; stop it, or choose another path")
