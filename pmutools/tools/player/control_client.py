"""The other end of the control socket: requests sent, answers awaited, for a limited time."""

from __future__ import annotations

import errno
import json
import socket
from collections.abc import Iterator
from typing import Any

from pmutools.errors import PmuError, SourceError
from pmutools.net.sockets import explain, refuse_itself, resolve
from pmutools.tools.player.control import PROTOCOL, to_json
from pmutools.tools.player.control_address import ControlAddress

TIMEOUT_S = 5.0
LINE_BYTES = 64 << 20
"""The longest answer: the state of some hundred thousand streams."""


class Refused(PmuError):
    """The player did not do it; says why."""


class ControlClient:
    """A connection to a player. Raises SourceError where there is none, or none any more."""

    def __init__(self, address: ControlAddress, timeout_s: float = TIMEOUT_S) -> None:
        self.address = address
        self._buffer = bytearray()
        self._id = 0
        self._sock = _connected(address, timeout_s)
        try:
            self._sock.settimeout(timeout_s)
            hello = self._line()
            if hello.get("event") == "bye":
                raise SourceError(f"{address}: turned away: {hello.get('reason')}")
            if "hello" not in hello:
                raise SourceError(f"{address}: {_STRANGER}")
            if hello.get("protocol") != PROTOCOL:
                raise SourceError(
                    f"{address}: speaks protocol {hello.get('protocol')}, not {PROTOCOL}; use the player's own version"
                )
        except BaseException:
            self._sock.close()
            raise

    def close(self) -> None:
        self._sock.close()

    def __enter__(self) -> ControlClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, do: str, **more: object) -> dict[str, Any]:
        """The player's answer; raises Refused with its reason."""
        self._id += 1
        try:
            self._sock.sendall(f"{to_json({'id': self._id, 'do': do} | more)}\n".encode())
        except OSError as error:
            raise explain(error, self.address) from None
        while True:
            said = self._line()
            if said.get("event") == "bye":
                raise SourceError(f"{self.address}: sent away: {said.get('reason')}")
            if said.get("id") == self._id:
                break
        if said.get("ok") is not True:
            raise Refused(f"{self.address}: {said.get('error')}")
        return said

    def states(self, every_s: float) -> Iterator[dict[str, Any]]:
        """The player's state every so often, until the player ends."""
        self.ask("watch", every_s=every_s)
        self._sock.settimeout(every_s + TIMEOUT_S)
        while (said := self._line()).get("event") != "bye":
            if said.get("event") == "status":
                yield said["result"]

    def _line(self) -> dict[str, Any]:
        searched = 0
        while (end := self._buffer.find(b"\n", searched)) < 0:
            searched = len(self._buffer)
            if searched > LINE_BYTES:
                raise SourceError(f"{self.address}: {_STRANGER}")
            try:
                data = self._sock.recv(1 << 16)
            except TimeoutError:
                wait_s = self._sock.gettimeout()
                raise SourceError(
                    f"{self.address}: no answer within {wait_s:g} s; is that a player, and alive?"
                ) from None
            except OSError as error:
                raise explain(error, self.address) from None
            if not data:
                raise SourceError(f"{self.address}: the player closed the connection; has it ended?")
            self._buffer += data
        line = bytes(self._buffer[:end])
        del self._buffer[: end + 1]
        try:
            said = json.loads(line)
        except (ValueError, RecursionError):
            said = None
        if not isinstance(said, dict):
            raise SourceError(f"{self.address}: {_STRANGER}")
        return said


_STRANGER = "not a player's control; give the path or HOST:PORT of pmu play --control"


def _connected(address: ControlAddress, timeout_s: float) -> socket.socket:
    if address.path:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        where: Any = address.path
    else:
        found = resolve(address.host, address.port, datagram=False)
        sock, where = socket.socket(found.family, socket.SOCK_STREAM), found.sockaddr
    try:
        sock.settimeout(timeout_s)
        sock.connect(where)
        if not address.path:
            refuse_itself(sock)
    except OSError as error:
        sock.close()
        if isinstance(error, TimeoutError):
            raise SourceError(f"{address}: no answer within {timeout_s:g} s; is the player reachable?") from None
        if remedy := _REMEDIES.get(error.errno or 0):
            raise SourceError(f"{address}: {remedy}") from None
        raise explain(error, address) from None
    return sock


_REMEDIES = {
    errno.ENOENT: "no such socket; is the player running, with --control and this path?",
    errno.ECONNREFUSED: "nobody listens; is the player running, with --control?",
    errno.ENOTSOCK: "not a socket; give the path of pmu play --control",
    errno.EACCES: "not permitted; the socket is its owner's only",
}
