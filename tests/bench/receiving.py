"""What it costs to take live streams from sockets to columns, in processor time a frame; the sender is another process.

``PYTHONPATH=tests python -m bench.receiving`` runs it alone.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bench.layouts import RATE, A, C, Layout
from bench.table import Budget, Row, text
from pyarrow import parquet
from support.commands import wait_for_udp
from support.live import free_ports

from pmutools.c37118 import encode_config
from pmutools.c37118.batch import decode_batch
from pmutools.c37118.checksum import seal_array
from pmutools.formats.source import Block
from pmutools.formats.table_rows import LongRows
from pmutools.linux import SockAddr
from pmutools.linux_columns import SendColumns
from pmutools.net.sockets import Address, pack_sockaddr
from pmutools.tools.live import LiveSource

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
    sent: int
    """Streams that are recorded."""


FULL = Sizes(streams=2000, ports=1000, connections=500, seconds=3, sent=1800)
QUICK = Sizes(streams=40, ports=20, connections=10, seconds=0.5, sent=40)
_PMU = (sys.executable, "-c", "from pmutools.cli import main; main()")


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
    log = recorded(sizes.sent, A, sizes.seconds)
    what = f"`pmu read` to Parquet: {log.rate / 1000:.3g} k frames/s from sockets to the file"
    ours = f"{log.sent:,} sent, {log.lost:,} lost ({log.own_drops:,} in its buffer), {log.cpu_s / log.wall_s:.2f} cores"
    yield Row(
        "live", what, ours, "the budget", log.rate / 1000, " k/s", Budget("at least", 100 if sizes is FULL else 0)
    )
    yield Row("live", "... lost", ours, "nothing", float(log.lost), "", Budget("at most", 0))
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
    numbers = free_ports(ports)
    urls = [f"udp://127.0.0.1:{port}" for port in numbers]
    with LiveSource(urls) as source, _sending(_send, streams, numbers, layout.name):
        return _measured(source, seconds)


def connected(connections: int, layout: Layout, seconds: float) -> Cost:
    """Commanded streams, each on a connection of its own."""
    (port,) = free_ports(1)
    urls = [f"tcp://127.0.0.1:{port}?idcode={number + 1}" for number in range(connections)]
    with _sending(_serve, connections, port, layout.name), LiveSource(urls, want_cfg3=False) as source:
        return _measured(source, seconds)


class Log(NamedTuple):
    """What ``pmu read`` made of what was sent to it; ``lost`` frames are in no file."""

    sent: int
    lost: int
    own_drops: int
    cpu_s: float
    wall_s: float

    @property
    def rate(self) -> float:
        return (self.sent - self.lost) / self.wall_s


def recorded(streams: int, layout: Layout, seconds: float) -> Log:
    """``pmu read``, a process of its own, records to Parquet in long form what another sends for ``seconds``.

    Sending begins when the reader has opened its file: what comes at full rate while it is being loaded must fit into
    the socket's buffer, which is the system's to bound.
    """
    (port,) = free_ports(1)
    sent = multiprocessing.get_context("spawn").Value("q", 0)
    with tempfile.TemporaryDirectory() as folder:
        command = ["read", f"udp://127.0.0.1:{port}", "--out", f"{folder}/log.parquet", "--long", "--json", "--quiet"]
        reader = subprocess.Popen((*_PMU, *command), stdout=subprocess.PIPE, text=True)
        try:
            wait_for_udp(port, reader)
            while reader.poll() is None and not Path(folder, "log.parquet").exists():
                time.sleep(0.01)
            with _sending(_send, streams, [port], layout.name, end_with=(sent,)):
                began = time.monotonic()
                time.sleep(seconds)
            wall_s = time.monotonic() - began
            others = resource.getrusage(resource.RUSAGE_CHILDREN)
            reader.send_signal(signal.SIGINT)
            told = json.loads(reader.communicate(timeout=60)[0])
            usage = resource.getrusage(resource.RUSAGE_CHILDREN)
            rows = parquet.read_metadata(f"{folder}/log.parquet").num_rows // _rows_a_frame(layout)
        finally:
            reader.kill()
            reader.wait()
    return Log(sent.value, sent.value - rows, told["own_drops"], _cpu_s(usage) - _cpu_s(others), wall_s)


def _cpu_s(usage: resource.struct_rusage) -> float:
    return usage.ru_utime + usage.ru_stime


def _rows_a_frame(layout: Layout) -> int:
    """Of the long form: a row a value."""
    batch = decode_batch(layout.frames(1).data, layout.config)
    return int(LongRows("polar").rows([batch]).num_rows)


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
def _sending(target: object, *arguments: object, end_with: Sequence[object] = ()) -> Iterator[None]:
    context = multiprocessing.get_context("spawn")
    ready, end = context.Event(), context.Event()
    process = context.Process(target=target, args=(*arguments, ready, end, *end_with), daemon=True)  # type: ignore[arg-type]
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


def _send(streams: int, ports: Sequence[int], name: str, ready: Event, end: Event, sent: Any = None) -> None:
    configs, data = _frames(streams, LAYOUTS[name])
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 << 20)
    sock.bind(("127.0.0.1", 0))
    addresses = [("127.0.0.1", port) for port in ports]
    for number, config in enumerate(configs):
        sock.sendto(config, addresses[number % len(ports)])
    ready.set()
    names = [SockAddr(pack_sockaddr(Address(socket.AF_INET, address))) for address in addresses]
    columns = SendColumns(streams)
    size = data.shape[1]
    at = np.array([names[number % len(ports)].address for number in range(streams)], np.uint64)
    columns.load(
        data.reshape(-1), size * np.arange(streams), np.full(streams, size), at, np.full(streams, 16, np.uint32)
    )
    for first, last in _paced(streams, end):
        columns.send(sock.fileno(), first, last)
        if sent is not None:
            sent.value += last - first


def _serve(connections: int, port: int, name: str, ready: Event, end: Event) -> None:
    configs, data = _frames(connections, LAYOUTS[name])
    with socket.create_server(("127.0.0.1", port), backlog=1024) as listener:
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
