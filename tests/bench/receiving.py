"""What it costs to take live streams from sockets to columns, in processor time a frame; the sender is another process.

``PYTHONPATH=tests python -m bench.receiving`` runs it alone.
"""

from __future__ import annotations

import multiprocessing
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event
from typing import NamedTuple

import numpy as np
from bench.layouts import RATE, A, C, Layout
from bench.table import Budget, Row, text

from pmutools.c37118 import encode_config
from pmutools.c37118.checksum import seal_array
from pmutools.formats.source import Block
from pmutools.linux import SockAddr
from pmutools.linux_columns import SendColumns
from pmutools.net.sockets import Address, pack_sockaddr
from pmutools.tools.live import LiveSource

FIRST_PORT = 20_000
"""Below those that the system gives away."""
LAYOUTS = {layout.name: layout for layout in (A, C)}
WARM_UP_S = 0.5
TICKS = 1000
"""Times a second at which the sender sends what is due: its streams are spread evenly over the reporting interval."""


@dataclass(frozen=True)
class Sizes:
    streams: int
    ports: int
    connections: int
    seconds: float


FULL = Sizes(streams=2000, ports=1000, connections=500, seconds=3)
QUICK = Sizes(streams=40, ports=20, connections=10, seconds=0.5)


class Cost(NamedTuple):
    """Of one run: data frames that came as columns, datagrams that this machine dropped, time in seconds."""

    frames: int
    dropped: int
    cpu_s: float
    wall_s: float

    @property
    def us(self) -> float:
        return 1e6 * self.cpu_s / max(self.frames, 1)


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows."""
    many, ports = sizes.streams, sizes.ports
    yield _row(f"{many:,} streams x {RATE}/s to one port (A)", taken(many, 1, A, sizes.seconds), 3)
    yield _row(f"{ports:,} streams x {RATE}/s to {ports:,} ports (A)", taken(ports, ports, A, sizes.seconds), 4)
    yield _row(f"{ports:,} streams x {RATE}/s to one port (C)", taken(ports, 1, C, sizes.seconds), 4)
    connections = sizes.connections
    yield _row(f"{connections:,} streams x {RATE}/s over TCP (A)", connected(connections, A, sizes.seconds), 15)


def _row(what: str, cost: Cost, at_most_us: float) -> Row:
    rate = cost.frames / cost.wall_s
    ours = f"{rate / 1000:.3g} k/s, {100 * cost.cpu_s / cost.wall_s:.0f} % of a core, {cost.dropped} dropped"
    return Row(
        "live", f"from sockets to columns: {what}", ours, "the budget", cost.us, " us", Budget("at most", at_most_us)
    )


def taken(streams: int, ports: int, layout: Layout, seconds: float) -> Cost:
    """Spontaneous streams, spread over so many ports."""
    urls = [f"udp://127.0.0.1:{FIRST_PORT + port}" for port in range(ports)]
    with LiveSource(urls) as source, _sending(_send, streams, ports, layout.name):
        return _measured(source, seconds)


def connected(connections: int, layout: Layout, seconds: float) -> Cost:
    """Commanded streams, each on a connection of its own."""
    urls = [f"tcp://127.0.0.1:{FIRST_PORT}?idcode={number + 1}" for number in range(connections)]
    with _sending(_serve, connections, layout.name), LiveSource(urls, want_cfg3=False) as source:
        return _measured(source, seconds)


def _measured(source: LiveSource, seconds: float) -> Cost:
    """The cost of ``seconds`` once streams have come for half a second."""
    frames, marks = 0, list[tuple[int, int, float, float]]()
    for found in source.rounds():
        frames += sum(len(item.batch) for item in found if isinstance(item, Block))
        if not frames:
            continue
        marks.append((frames, source.own_drops, time.process_time(), time.monotonic()))
        if marks[-1][-1] - marks[0][-1] > seconds + WARM_UP_S:
            break
    began = next(mark for mark in marks if mark[-1] - marks[0][-1] > WARM_UP_S)
    return Cost(*(after - before for after, before in zip(marks[-1], began, strict=True)))


# --- the other process ----------------------------------------------------------------------------------------------


@contextmanager
def _sending(target: object, *arguments: object) -> Iterator[None]:
    context = multiprocessing.get_context("spawn")
    ready, end = context.Event(), context.Event()
    process = context.Process(target=target, args=(*arguments, ready, end), daemon=True)  # type: ignore[arg-type]
    process.start()
    try:
        assert ready.wait(20), "no sender"
        yield
    finally:
        end.set()
        process.join(10)
        process.kill()


def _frames(streams: int, layout: Layout) -> tuple[list[bytes], np.ndarray]:
    """Configurations and (streams, FRAMESIZE) data frames."""
    configs = [encode_config(replace(layout.config, idcode=number + 1)) for number in range(streams)]
    size = layout.config.frame_size
    data = np.frombuffer(layout.frames(streams).data, np.uint8).reshape(-1, size).copy()
    data[:, 4:6] = (np.arange(streams) + 1).astype(">u2")[:, None].view("u1")
    seal_array(data)
    return configs, data


def _send(streams: int, ports: int, name: str, ready: Event, end: Event) -> None:
    configs, data = _frames(streams, LAYOUTS[name])
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 << 20)
    sock.bind(("127.0.0.1", 0))
    addresses = [("127.0.0.1", FIRST_PORT + port) for port in range(ports)]
    for number, config in enumerate(configs):
        sock.sendto(config, addresses[number % ports])
    ready.set()
    names = [SockAddr(pack_sockaddr(Address(socket.AF_INET, address))) for address in addresses]
    columns = SendColumns(streams)
    size = data.shape[1]
    at = np.array([names[number % ports].address for number in range(streams)], np.uint64)
    columns.load(
        data.reshape(-1), size * np.arange(streams), np.full(streams, size), at, np.full(streams, 16, np.uint32)
    )
    for first, last in _paced(streams, end):
        columns.send(sock.fileno(), first, last)


def _serve(connections: int, name: str, ready: Event, end: Event) -> None:
    configs, data = _frames(connections, LAYOUTS[name])
    with socket.create_server(("127.0.0.1", FIRST_PORT), backlog=1024) as listener:
        listener.settimeout(20)
        ready.set()
        clients: list[socket.socket | None] = [None] * connections
        for _ in range(connections):
            client = listener.accept()[0]
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            number = int.from_bytes(client.recv(18)[4:6], "big") - 1
            client.sendall(configs[number])
            clients[number] = client
        frames = [row.tobytes() for row in data]
        for first, last in _paced(connections, end):
            for number in range(first, last):
                client = clients[number]
                assert client is not None
                try:
                    client.send(frames[number])
                except OSError:  # the reader has gone
                    return


def _paced(streams: int, end: Event) -> Iterator[tuple[int, int]]:
    """Which streams are due: each sends every reporting interval, one after the other."""
    began, sent = time.monotonic(), 0
    while not end.is_set():
        due = int((time.monotonic() - began) * RATE * streams)
        while sent < due:
            first = sent % streams
            last = min(streams, first + due - sent)
            yield first, last
            sent += last - first
        time.sleep(1 / TICKS)


def main(arguments: Sequence[str]) -> None:
    print(text(list(rows(QUICK if "--quick" in arguments else FULL))))


if __name__ == "__main__":
    main(sys.argv[1:])
