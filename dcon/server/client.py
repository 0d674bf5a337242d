"""The operator's end of the server's lines."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any

from dcon.link.orders import ANSWER_NS, REPLAYED, TOO_OLD, Operator, SignedOrder, sign
from pmutools.errors import SourceError
from pmutools.net.endpoint import Endpoint, join_host
from pmutools.net.sockets import refuse_itself
from pmutools.timebase import NS

CONNECT_S = 3.0
PATIENCE_S = ANSWER_NS / NS + 3.0
LONGEST_ANSWER = 1 << 20
TRIES = 3
"""Connections made for one ask."""
LEAST_S = 0.5
"""The last of them waits for so long, whatever went before."""
CROWDED_OUT = "others need this place"
"""Error that a client is told whose place another takes."""


class Ended(SourceError):
    """The server was there, and ended the connection before it answered."""


def order(
    where: Endpoint, by: Operator, name: str, *, value: float = 0.0, text: str = "", why: str = "", now_ns: int
) -> dict[str, Any]:
    """Sign an order and await what becomes of it: ``{"accepted", "state"}``, or ``{"refused"}`` with the reason.

    ``now_ns`` (POSIX UTC) is its time and its sequence. Raises SourceError as :class:`Client` does, ValueError for what
    is no order.
    """
    signed = sign(SignedOrder(by.name, now_ns, now_ns, name, value, text, why), by.key)
    return ask(where, {"signed": signed.decode()})


def ask(where: Endpoint, asked: dict[str, Any]) -> dict[str, Any]:
    """Ask on a connection of its own, and on another where the server gave that to others before it answered.

    An order is sent again as the very same bytes, so that it cannot be taken twice. Where one was perhaps taken before
    and what it came to was not heard, the answer is ``{"unknown"}``. Raises SourceError as :class:`Client` does.
    """
    end_s = time.monotonic() + PATIENCE_S
    for number in range(1, TRIES + 1):
        try:
            with Client(where, max(end_s - time.monotonic(), LEAST_S)) as client:
                answer = client.ask(asked)
        except Ended:
            if number == TRIES:
                raise
            continue
        if answer.get("error") != CROWDED_OUT:
            break
    if number > 1 and answer.get("refused") in (REPLAYED, TOO_OLD):
        return {"unknown": "the connection ended before the answer; the order may have been taken: look at the status"}
    return answer


class Client:
    """A connection; raises SourceError where the server cannot be reached, or does not answer."""

    def __init__(self, where: Endpoint, patience_s: float = PATIENCE_S) -> None:
        """``patience_s``: how long an answer is waited for."""
        self._name = join_host(where.host, where.port)
        self._rest = b""
        try:
            self._sock = _connected(where)
        except OSError as error:
            raise SourceError(f"{self._name}: {error.strerror or error}; is dcon server running there?") from None
        self._patience_s = patience_s
        self._sock.settimeout(patience_s)

    def ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Send, and await the answer."""
        self.send(asked)
        return self._answer()

    def send(self, asked: dict[str, Any]) -> None:
        try:
            self._sock.sendall(json.dumps(asked).encode() + b"\n")
        except ConnectionError as error:
            raise Ended(f"{self._name}: {error.strerror or error}") from None
        except OSError as error:
            raise SourceError(f"{self._name}: {error.strerror or error}") from None

    def answers(self) -> Iterator[dict[str, Any]]:
        """All that come."""
        while True:
            yield self._answer()

    def close(self) -> None:
        self._sock.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _answer(self) -> dict[str, Any]:
        while b"\n" not in self._rest:
            try:
                data = self._sock.recv(65536)
            except TimeoutError:
                raise SourceError(f"{self._name}: no answer in {self._patience_s:.2g} s") from None
            except ConnectionError as error:
                raise Ended(f"{self._name}: {error.strerror or error}") from None
            except OSError as error:
                raise SourceError(f"{self._name}: {error.strerror or error}") from None
            if not data:
                raise Ended(f"{self._name}: the server ended the connection")
            self._rest += data
            if len(self._rest) > LONGEST_ANSWER:
                raise SourceError(f"{self._name}: not what a dcon server says")
        line, _, self._rest = self._rest.partition(b"\n")
        try:
            said = json.loads(line)
        except ValueError:
            said = None
        if not isinstance(said, dict):
            raise SourceError(f"{self._name}: not what a dcon server says")
        return said


def _connected(where: Endpoint) -> socket.socket:
    """Raises OSError."""
    sock = socket.create_connection((where.host, where.port), CONNECT_S)
    try:
        refuse_itself(sock)
    except OSError:
        sock.close()
        raise
    return sock
