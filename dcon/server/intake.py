"""Bundles from controllers: a connection each, one session recorded at a time, and told how far it is safe."""

from __future__ import annotations

import json
import selectors
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dcon.link import paths
from dcon.link.assembly import Assembly, Pieces, Place
from dcon.link.bundle import LARGEST, Bundle, Kind, decode
from dcon.server.recorder import Report
from dcon.server.scribe import Scribe
from dcon.session.head import Head, head_of

CONNECTIONS = 8
"""Of controllers, at once: one is enough, but a new one may come before an old one is known to be gone."""
BUNDLES_A_ROUND = 64
"""Read from one connection before others have their turn."""
READ_BYTES = LARGEST + 1


class Intake:
    """Hands what is wanted to the scribe. Nothing that a connection brings ends it.

    Parameters
    ----------
    folder
        The run folder. Raises SourceError where ``server.in`` cannot be had.
    resumes
        What need not be sent again.
    opened
        Is called with the head of a session, and whether it is another session than the last.
    ticked
        Is called with each tick, and the time (POSIX UTC) of when it was read.
    """

    def __init__(
        self,
        folder: Path,
        selector: selectors.BaseSelector,
        scribe: Scribe,
        resumes: Place,
        opened: Callable[[Head, bool], None],
        ticked: Callable[[Bundle, int], None],
    ) -> None:
        self._selector, self._scribe = selector, scribe
        self._opened, self._ticked = opened, ticked
        self._assembly = Assembly(resumes)
        self._connections: list[socket.socket] = []
        self._source: socket.socket | None = None
        """The connection whose session is being recorded."""
        self._acked: tuple[int | None, int] = (None, -1)
        self._senseless = 0
        """Messages that are no bundles, and heads that say nothing."""
        self._listener = paths.listen(folder, paths.SERVER)
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    @property
    def is_connected(self) -> bool:
        """Whether the controller whose session is recorded has its connection still."""
        return self._source is not None

    @property
    def malformed(self) -> int:
        """Messages that made no sense."""
        return self._senseless + self._assembly.malformed

    def acknowledge(self, report: Report) -> None:
        """Tell the controller how far its log is safe, where it has not been told."""
        safe = (report.session, report.have)
        if safe != self._acked and report.session == self._assembly.place.session and self._source is not None:
            self._acked = safe
            self._say(self._source, {"ack": report.have})

    def close(self) -> None:
        for sock in self._connections:
            sock.close()
        paths.release(self._listener)

    def _accept(self, _events: int, _now_ns: int, _utc_ns: int) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        sock.setblocking(False)
        if len(self._connections) >= CONNECTIONS:
            self._end(next(each for each in self._connections if each is not self._source))
        self._connections.append(sock)

        def ready(_events: int, _now_ns: int, utc_ns: int) -> None:
            self._receive(sock, utc_ns)

        self._selector.register(sock, selectors.EVENT_READ, ready)
        place = self._assembly.place
        self._say(sock, {"session": place.session, "have": place.have})

    def _end(self, sock: socket.socket) -> None:
        if sock in self._connections:
            self._connections.remove(sock)
            self._selector.unregister(sock)
            sock.close()
        if sock is self._source:
            self._source = None

    def _say(self, sock: socket.socket, said: dict[str, Any]) -> None:
        try:
            sock.send(json.dumps(said).encode())
        except BlockingIOError:  # it does not read: the next word says it all again
            pass
        except OSError:
            self._end(sock)

    def _receive(self, sock: socket.socket, utc_ns: int) -> None:
        for _ in range(BUNDLES_A_ROUND):
            if not self._scribe.has_room or sock not in self._connections:
                return
            try:
                data = sock.recv(READ_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._end(sock)
                return
            bundle = decode(data)
            if bundle is None:
                self._senseless += 1
                self._end(sock)
                return
            self._take(sock, bundle, len(data), utc_ns)

    def _take(self, sock: socket.socket, bundle: Bundle, size: int, utc_ns: int) -> None:
        if not self._assembly.wants(bundle):
            return
        self._scribe.put(bundle, size)
        for item in self._assembly.take(bundle):
            if isinstance(item, Pieces):
                self._open(sock, item)
            elif isinstance(item, Bundle) and item.kind is Kind.TICK:
                self._ticked(item, utc_ns)

    def _open(self, sock: socket.socket, pieces: Pieces) -> None:
        """What the session is: of a session that is known too, for a server that was started again."""
        head = head_of(pieces.bundles)
        if head is None:
            self._senseless += 1
            return
        self._source = sock
        is_new = pieces.session != self._assembly.place.session
        if is_new:
            self._assembly.begin(Place(pieces.session))
        self._opened(head, is_new)
