"""Clients that misbehave cost others nothing: neither frames nor their order, hardly time, and no memory."""

from __future__ import annotations

import select
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
from support.chain import EarlyClock, playing
from support.commands import started, wait_for_tcp
from support.ear import CFG1, CFG2, CFG3, HEADER, START, STOP, Ear, Heard, good, is_data, listening, undisturbed, word
from support.ear import command as command_of
from support.live import free_ports
from support.nuisance import DATAGRAMS, KINDS, nuisance
from support.peers import free_port
from support.playing import MS, interleaved, number, recording, reel_of, stream
from support.recordings import write

from pmutools.c37118 import Format, Message, PhasorChannel, Station, StreamConfig
from pmutools.net.endpoint import parse_endpoint
from pmutools.tools.player.cast import as_recorded
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.play import Options, Player

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="receivers ask for Linux's arrival stamps"),
]

FRAMES = 200
SPEED = 5
RUN_S = FRAMES / 50 / SPEED
LATE_NS = {0.5: 3 * MS, 0.9: 8 * MS, 0.99: 20 * MS}
"""By share of the frames, what is never too late."""


def wide(frames: int, phasors: int = 1000) -> list[Message]:
    """Frames of 8 bytes a phasor."""
    channels = tuple(PhasorChannel(f"V{k}") for k in range(phasors))
    return recording(StreamConfig(7, (Station("WIDE", 7, Format.PHASOR_FLOAT, channels),), 50), frames)


class Outcome(NamedTuple):
    numbers: list[int]
    """Of the frames that the well-behaved client got, in order."""
    late_ns: list[int]
    """How late the frames left, by the ledger, sorted."""

    def late(self, share: float) -> int:
        return self.late_ns[int(share * (len(self.late_ns) - 1))]


def data_of(heard: Heard) -> list[bytes]:
    return [frame for _, frame in undisturbed(b"".join(chunk.data for chunk in heard.chunks)) if is_data(frame)]


def run(scheme: str, kind: str | None, ledger: Path) -> Outcome:
    """A good client, with or without a bad one beside it."""
    import pyarrow.parquet as pq

    reel = reel_of(wide(FRAMES))
    clock, over = EarlyClock(reel.first_due_ns), threading.Event()
    options = Options(listen=[parse_endpoint(f"{scheme}://127.0.0.1:0")], speed=SPEED)  # type: ignore[arg-type]
    player = Player(as_recorded(reel), options, clock, stop=over.is_set)
    address = player.senders.local(0)
    assert address is not None
    with listening(Ear("good", scheme, address.port, 7)) as heard, ExitStack() as stack:
        if kind is not None:
            stack.enter_context(nuisance(kind, scheme, address.port, 7, RUN_S + 0.5))
        clock.be_early(reel.first_due_ns, 200 * MS)
        with playing(player, over, LedgerWriter(ledger)):
            pass
    rows = pq.read_table(ledger).to_pylist()
    assert [row["fate"] for row in rows] == ["sent"] * FRAMES
    late_ns = sorted(row["sent_ns"] - row["scheduled_ns"] for row in rows)
    return Outcome(list(map(number, data_of(heard["good"]))), late_ns)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    path = tmp_path_factory.mktemp("alone") / "ledger.parquet"
    return {scheme: run(scheme, None, path) for scheme in ("tcp", "udp+cmd")}


@pytest.mark.parametrize(
    ("scheme", "kind"), [("tcp", kind) for kind in KINDS] + [("udp+cmd", kind) for kind in DATAGRAMS]
)
def test_a_bad_client_costs_a_good_one_nothing(
    scheme: str, kind: str, alone: dict[str, Outcome], tmp_path: Path
) -> None:
    for _ in range(3):  # two of three processes have a core, if no others want one
        outcome = run(scheme, kind, tmp_path / "ledger.parquet")
        assert outcome.numbers == [*range(FRAMES)]
        bounds = {share: max(10 * alone[scheme].late(share), least_ns) for share, least_ns in LATE_NS.items()}
        if all(outcome.late(share) <= most_ns for share, most_ns in bounds.items()):
            return
    pytest.fail(f"late by {[outcome.late(share) / MS for share in bounds]} ms, at most {bounds}")


def resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


@contextmanager
def connection(port: int, rcvbuf: int | None = None) -> Iterator[socket.socket]:
    with socket.socket() as sock:
        if rcvbuf is not None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, rcvbuf)
        sock.settimeout(10)
        sock.connect(("127.0.0.1", port))
        yield sock


def take(sock: socket.socket, nbytes: int) -> None:
    buffer = bytearray(1 << 18)
    while nbytes > 0:
        taken = sock.recv_into(buffer)
        assert taken
        nbytes -= taken


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads memory from /proc")
def test_memory_does_not_grow_while_a_client_does_not_read(tmp_path: Path) -> None:
    """24 KiB a frame; 50 MB go to the one that reads, and would have gone to the other."""
    path, port = tmp_path / "wide.c37118", free_port()
    write(path, wide(50, phasors=3000))
    with started("play", path, "--listen", f"tcp://127.0.0.1:{port}", "--loop", 0, "--speed", 40) as player:
        wait_for_tcp(port, player)
        with connection(port) as reading, connection(port, 4096) as silent:
            for client in (silent, reading):
                client.sendall(command_of(7, START))
            take(reading, 5 << 20)
            before = resident_bytes(player.pid)
            take(reading, 50 << 20)
            assert resident_bytes(player.pid) - before < 8 << 20
            assert player.poll() is None


# --- several at once, each with its own start and stop


COMMANDED = ("tcp", "udp+cmd", "tcp+udp")


class Talk(NamedTuple):
    """A client that asks and hears by hand."""

    control: socket.socket
    data: socket.socket
    idcode: int

    def say(self, *codes: int) -> None:
        for code in codes:
            self.control.sendall(command_of(self.idcode, code))

    def hear(self, seconds: float) -> list[bytes]:
        """Whole frames that come within some time, on either socket."""
        end, octets = time.monotonic() + seconds, {self.control: b"", self.data: b""}
        while (left := end - time.monotonic()) > 0:
            for sock in select.select(list(octets), [], [], left)[0]:
                octets[sock] += sock.recv(1 << 18)
        frames = [frame for taken in octets.values() for _, frame in undisturbed(taken)]
        assert sum(map(len, frames)) == sum(map(len, octets.values()))
        assert all(map(good, frames))
        return frames


@contextmanager
def talking(scheme: str, port: int, idcode: int, data_port: int) -> Iterator[Talk]:
    with ExitStack() as stack:
        kind = socket.SOCK_STREAM if scheme.startswith("tcp") else socket.SOCK_DGRAM
        control = stack.enter_context(socket.socket(socket.AF_INET, kind))
        control.connect(("127.0.0.1", port))
        data = control
        if scheme == "tcp+udp":
            data = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            data.bind(("127.0.0.1", data_port))
        yield Talk(control, data, idcode)


@pytest.mark.parametrize("scheme", COMMANDED)
def test_every_command_to_two_streams_from_clients_of_their_own(scheme: str) -> None:
    """Each client has a stream of its own; with ``tcp`` and ``udp+cmd`` a third has started both."""
    reel = reel_of(interleaved(recording(stream(7), 5000), recording(stream(8), 5000)))
    clock, over = EarlyClock(reel.first_due_ns), threading.Event()
    data_ports = free_ports(2)
    urls = [f"{scheme}://127.0.0.1:0"]
    if scheme == "tcp+udp":
        urls = [f"{scheme}://127.0.0.1:0?data={port}&idcode={n}" for n, port in zip((7, 8), data_ports, strict=True)]
    options = Options(listen=list(map(parse_endpoint, urls)), speed=4)  # type: ignore[arg-type]
    player = Player(as_recorded(reel), options, clock, stop=over.is_set)
    ports = [player.senders.local(outlet).port for outlet in range(len(urls))]  # type: ignore[union-attr]
    with playing(player, over), ExitStack() as stack:
        one = stack.enter_context(talking(scheme, ports[0], 7, data_ports[0]))
        two = stack.enter_context(talking(scheme, ports[-1], 8, data_ports[1]))
        for client in (one, two):
            client.say(HEADER, CFG1, CFG2, CFG3)
        for client in (one, two):
            answers = client.hear(0.15)
            assert [word(frame, 0) & 0xFFF0 for frame in answers] == [0xAA10, 0xAA20, 0xAA30, 0xAA50]
            assert {word(frame, 4) for frame in answers} == {client.idcode}
        clock.be_early(reel.first_due_ns, 50 * MS)
        one.say(START)
        assert {word(frame, 4) for frame in one.hear(0.3)} == {7}
        assert two.hear(0.1) == [], "nobody asked for its data"
        two.say(START)
        one.say(STOP)
        one.hear(0.1)
        assert one.hear(0.15) == [], "it has stopped"
        of_two = [frame for frame in two.hear(0.2) if is_data(frame)]
        numbers = list(map(number, of_two))
        assert len(numbers) > 30
        assert numbers == [*range(numbers[0], numbers[-1] + 1)]
        assert {word(frame, 4) for frame in of_two} == {8}
        one.say(CFG2, START)
        again = one.hear(0.2)
        assert word(again[0], 0) == 0xAA31
        assert sum(map(is_data, again)) > 20
        if scheme != "tcp+udp":
            three = stack.enter_context(talking(scheme, ports[0], 7, 0))
            three.say(START)
            three._replace(idcode=8).say(START)
            assert {word(frame, 4) for frame in three.hear(0.2)} == {7, 8}
        over.set()
