"""An independent sender of C37.118: frames packed by :mod:`support.wire`, sent by plain sockets at exact times.

Nothing here imports pmutools. What was sent when is kept, so that it can be held against what was measured.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from support.wire import Block, Name, PhasorSpec, Stamp, StationSpec, StreamSpec, config_frame, data_frame

NS = 1_000_000_000
MS = 1_000_000
BASE = 1_000_000


def spec(idcode: int = 7, rate: int = 60, phasors: int = 1, name: str = "ALPHA") -> StreamSpec:
    """A one-station stream of integer phasors."""
    channels = tuple(PhasorSpec(Name(f"V{k}", f"V{k}"), False, 1000) for k in range(phasors))
    return StreamSpec(idcode, (StationSpec(Name(name, name), idcode, 0, channels),), rate, BASE)


def stamp(time_ns: int, quality: int = 0) -> Stamp:
    soc, rest = divmod(time_ns, NS)
    return Stamp(soc, quality, (rest * BASE + NS // 2) // NS)


def config(of: StreamSpec) -> bytes:
    return config_frame(of, "cfg2", stamp(time.time_ns()))


def data(of: StreamSpec, time_ns: int, value: int = 0, stat: int = 0) -> bytes:
    phasors = tuple((1000.0, -1000.0) for _ in of.stations[0].phasors)
    return data_frame(of, stamp(time_ns), [Block(stat, tuple((int(a), int(b)) for a, b in phasors), value, 0, (), ())])


def slots_from(of: StreamSpec, after_ns: int, count: int) -> list[int]:
    """Reporting instants of a stream from ``after_ns`` on, UTC ns."""
    first = -(-after_ns * of.data_rate // NS)
    return [-(-slot * NS // of.data_rate) for slot in range(first, first + count)]


@dataclass
class Plan:
    """What to send, and when: (UTC ns, frame), in any order."""

    frames: list[tuple[int, bytes]] = field(default_factory=list)
    sent: dict[bytes, list[int]] = field(default_factory=dict)
    """UTC ns just before each sending of a frame."""

    def add(self, at_ns: int, frame: bytes) -> None:
        self.frames.append((at_ns, frame))

    def play(self, send: Callable[[bytes], object]) -> None:
        """Send all, each at its time, and no sooner."""
        for at_ns, frame in sorted(self.frames, key=lambda entry: entry[0]):
            while (left_ns := at_ns - time.time_ns()) > 0:
                time.sleep(left_ns / NS if left_ns > 200_000 else 0)
            self.sent.setdefault(frame, []).append(time.time_ns())
            send(frame)


@contextlib.contextmanager
def beside(work: Callable[[], object]):  # type: ignore[no-untyped-def]
    """``work`` in a thread; its error is raised at the end. Yields a function that tells whether it is done."""
    failed: list[BaseException] = []

    def run() -> None:
        try:
            work()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield lambda: not thread.is_alive()
    finally:
        thread.join(30)
    if failed:
        raise failed[0]


@contextlib.contextmanager
def udp_to(port: int, source_port: int = 0):  # type: ignore[no-untyped-def]
    """A function that sends a datagram to a port of loopback, from one socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", source_port))
        yield lambda frame: sock.sendto(frame, ("127.0.0.1", port))


class Device:
    """A PMU over TCP on loopback that answers any request with its CFG-2, and sends once it is told to start."""

    def __init__(self, of: StreamSpec) -> None:
        self.of = of
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._listener.settimeout(20)

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()

    def serve(self, plan: Callable[[], Plan]) -> Plan:
        """Take one client, wait for its start command, send what is planned from then on, and hang up."""
        client, _ = self._listener.accept()
        with client:
            client.settimeout(20)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while not self._started(client.recv(4096), client):
                pass
            made = plan()
            made.play(client.sendall)
            time.sleep(0.3)  # for what is under way to be read before the connection ends
        return made

    def _started(self, asked: bytes, client: socket.socket) -> bool:
        assert asked, "the client went away"
        commands = [asked[at : at + 18] for at in range(0, len(asked), 18)]
        for command in commands:
            if command[:2] == b"\xaa\x41" and command[14:16] in (b"\x00\x05", b"\x00\x04"):
                client.sendall(config(self.of))
        return any(command[14:16] == b"\x00\x02" for command in commands)


def planned(of: StreamSpec, after_ns: int, delays_ms: Sequence[Sequence[float]]) -> Plan:
    """Slot k of a stream sent so many ms after its stamp, once for each number; () is a loss."""
    plan = Plan()
    for at_ns, copies in zip(slots_from(of, after_ns, len(delays_ms)), delays_ms, strict=True):
        for delay_ms in copies:
            plan.add(at_ns + round(delay_ms * MS), data(of, at_ns))
    return plan
