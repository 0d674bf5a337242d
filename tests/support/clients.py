"""Senders with an outlet on loopback, and plain clients of it."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from support.live import CLOCK, PATIENCE_NS, Ear, data_frame, stream

from pmutools import linux
from pmutools.c37118 import Command, Frame, Framer, StreamConfig, encode_command
from pmutools.c37118.session import Outcome, served
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.outlet import ServerEvent, ServerKind
from pmutools.net.receiver import Receivers
from pmutools.net.server import Senders

MS = 1_000_000
CONFIG = stream(7)
START = encode_command(7, Command.START_DATA)
paths = pytest.mark.parametrize("native", [linux.NATIVE, False], ids=["native", "portable"])


class Server:
    """Senders with one listening outlet, and the events they have given."""

    def __init__(self, url: str, *configs: StreamConfig, **options: object) -> None:
        self.senders = Senders(CLOCK, **options)  # type: ignore[arg-type]
        self.handles = [self.senders.add(served(config)) for config in configs or (CONFIG,)]
        self.outlet = self.senders.listen(parse_endpoint(url), self.handles)
        self.events: list[ServerEvent] = []

    @property
    def address(self) -> tuple[str, int]:
        address = self.senders.local(self.outlet)
        assert address is not None
        return address.host, address.port

    def until(self, condition: Callable[[], object]) -> None:
        end_ns = CLOCK.monotonic_ns() + PATIENCE_NS
        while not condition():
            assert CLOCK.monotonic_ns() < end_ns, f"never came true; {self.events[-20:]}"
            self.events += self.senders.poll(MS)

    def kinds(self) -> list[ServerKind | Outcome]:
        return [event.kind for event in self.events]

    def publish(self, count: int, first: int = 0, stream: int = 0) -> None:
        for k in range(first, first + count):
            self.senders.publish([(self.handles[stream], data_frame(CONFIG, k * 10**9, value=k))])


@contextmanager
def serving(url: str, *configs: StreamConfig, **options: object) -> Iterator[Server]:
    server = Server(url, *configs, **options)
    with server.senders:
        yield server


class Client:
    """A plain TCP client."""

    def __init__(self, server: Server) -> None:
        self.sock = socket.create_connection(server.address)
        self.sock.setblocking(False)
        self.framer = Framer(streaming=True)
        self.frames: list[Frame] = []
        self.ended = False

    def say(self, data: bytes) -> None:
        self.sock.setblocking(True)
        self.sock.sendall(data)
        self.sock.setblocking(False)

    def hear(self) -> list[Frame]:
        try:
            while data := self.sock.recv(65536):
                for item in self.framer.feed(data):
                    assert isinstance(item, Frame)
                    self.frames.append(item)
            self.ended = True
        except BlockingIOError:
            pass
        except ConnectionResetError:
            self.ended = True
        return self.frames


@contextmanager
def clients(server: Server, count: int) -> Iterator[list[Client]]:
    joined = [Client(server) for _ in range(count)]
    yield joined
    for client in joined:
        client.sock.close()


@contextmanager
def hearing(*urls: str) -> Iterator[Ear]:
    with Receivers([parse_endpoint(url) for url in urls], CLOCK) as receivers:
        yield Ear(receivers)


def started(server: Server, *joined: Client, idcode: int = 7) -> None:
    """Have the clients start a stream; each has its own start told."""
    told = server.kinds().count(Outcome.STARTED)
    for client in joined:
        client.say(encode_command(idcode, Command.START_DATA))
    server.until(lambda: server.kinds().count(Outcome.STARTED) == told + len(joined))
