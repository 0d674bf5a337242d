"""The sending front end: what clients ask for they get, and no client harms another."""

from __future__ import annotations

import errno
import random
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.live import CLOCK, PATIENCE_NS, Ear, data_frame, free_udp_port, stream, values

from pmutools import linux
from pmutools.c37118 import Command, Frame, Framer, FrameType, StreamConfig, decode_prefix, encode_command
from pmutools.c37118.session import Outcome, served
from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Cut, Hangup, Segmentation
from pmutools.net import outlet as outlet_module
from pmutools.net import tcp
from pmutools.net.cargo import Frames
from pmutools.net.dialogue import LinkKind
from pmutools.net.endpoint import Endpoint, Scheme, parse_endpoint
from pmutools.net.outlet import ServerEvent, ServerKind
from pmutools.net.receiver import Receivers
from pmutools.net.server import Senders
from pmutools.net.udp import UdpSocket

pytestmark = pytest.mark.realtime
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


# --- commands


@paths
@pytest.mark.parametrize("scheme", ["tcp", "udp+cmd", "tcp+udp"])
@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_our_client_and_our_server_understand_each_other(scheme: str, host: str, native: bool) -> None:
    data = f"data={free_udp_port(host.strip('[]'))}&" if scheme == "tcp+udp" else ""
    with serving(f"{scheme}://{host}:0?{data}".rstrip("?&"), native=native) as server:
        with hearing(f"{scheme}://{host}:{server.address[1]}?{data}idcode=7") as ear:
            events = ear.until(lambda: server.senders.audience(server.handles[0]) == 1, server.senders)
            server.publish(20)
            events += ear.until(lambda: values(ear.messages) == list(range(20)), server.senders)
            assert ear.kinds[-2:] == [LinkKind.CONFIGURED, LinkKind.STREAMING]
        server.events += events
        server.until(lambda: Outcome.STOPPED in server.kinds())
        assert server.senders.audience(server.handles[0]) == 0
        server.publish(1)


def test_every_command_over_tcp() -> None:
    with serving("tcp://127.0.0.1:0", CONFIG, stream(9)) as server, clients(server, 1) as (client,):
        for code in (Command.SEND_CFG1, Command.SEND_CFG2, Command.SEND_CFG3):
            client.say(encode_command(9, code))
        client.say(encode_command(9, Command.SEND_HEADER) + encode_command(9, 0x0123) + encode_command(5, 2))
        client.say(encode_command(7, Command.EXTENDED, extended=b"hi"))
        server.until(lambda: Outcome.EXTENDED in server.kinds() and len(client.hear()) == 3)
        assert [(frame.type, frame.idcode) for frame in client.frames] == [
            (FrameType.CFG1, 9),
            (FrameType.CFG2, 9),
            (FrameType.CFG3, 9),
        ]
        assert server.kinds() == [
            ServerKind.CONNECTED,
            *[Outcome.ANSWERED] * 3,
            Outcome.UNAVAILABLE,
            Outcome.UNKNOWN,
            Outcome.FOREIGN,
            Outcome.EXTENDED,
        ]
        assert server.events[-1].extended == b"hi"
        assert abs(decode_prefix(client.frames[1].data).soc - time.time()) < 5


def test_commands_split_and_merged_at_random() -> None:
    rng = random.Random(5)
    wire = encode_command(7, Command.SEND_CFG2) * 40
    cuts = sorted(rng.sample(range(1, len(wire)), 60))
    with serving("tcp://127.0.0.1:0") as server, clients(server, 1) as (client,):
        for start, end in zip([0, *cuts], [*cuts, len(wire)], strict=True):
            client.say(wire[start:end])
            server.senders.poll(0)
        server.until(lambda: len(client.hear()) == 40)


def test_each_client_has_its_own_start_and_stop() -> None:
    with serving("tcp://127.0.0.1:0", CONFIG, stream(9)) as server, clients(server, 3) as (one, both, none):
        one.say(START)
        both.say(START + encode_command(9, Command.START_DATA))
        server.until(
            lambda: server.kinds().count(Outcome.STARTED) == 3 and server.kinds().count(ServerKind.CONNECTED) == 3
        )
        server.publish(2)
        server.senders.publish([(server.handles[1], data_frame(stream(9), 10**9))])
        server.until(lambda: len(one.hear()) == 2 and len(both.hear()) == 3)
        one.say(encode_command(7, Command.STOP_DATA))
        server.until(lambda: Outcome.STOPPED in server.kinds())
        server.publish(1, first=2)
        server.until(lambda: len(both.hear()) == 4)
        assert (len(one.hear()), len(none.hear())) == (2, 0)


def test_many_clients() -> None:
    with serving("tcp://127.0.0.1:0") as server, clients(server, 150) as joined:
        for client in joined:
            client.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 150)
        server.publish(30)
        server.until(lambda: all(len(client.hear()) == 30 for client in joined))


def test_udp_clients_by_address() -> None:
    with (
        serving("udp+cmd://127.0.0.1:0") as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for sock in (one, other):
            sock.settimeout(2)
            sock.sendto(START, server.address)
        other.sendto(b"\xaa\x41garbage", server.address)
        server.until(lambda: server.senders.audience(server.handles[0]) == 2)
        one.sendto(encode_command(7, Command.STOP_DATA), server.address)
        server.until(lambda: server.senders.audience(server.handles[0]) == 1)
        server.publish(1)
        assert other.recv(100) == data_frame(CONFIG, 0)
        one.settimeout(0.05)
        with pytest.raises(TimeoutError):
            one.recv(100)


def test_clients_that_share_a_data_port_get_each_frame_once() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as data:
        data.bind(("127.0.0.1", 0))
        data.settimeout(0.05)
        with serving(f"tcp+udp://127.0.0.1:0?data={data.getsockname()[1]}") as server, clients(server, 2) as joined:
            for client in joined:
                client.say(START)
            server.until(lambda: server.kinds().count(Outcome.STARTED) == 2)
            server.publish(1)
            joined[0].sock.close()
            server.until(lambda: ServerKind.DISCONNECTED in server.kinds())
            server.publish(1, first=1)
            assert [data.recv(100) for _ in range(2)] == [data_frame(CONFIG, k * 10**9, value=k) for k in range(2)]
            with pytest.raises(TimeoutError):
                data.recv(100)
            assert joined[1].hear() == []


@pytest.mark.skipif(not linux.NATIVE, reason="Linux multicast")
def test_data_to_a_group_are_not_stopped_by_one_of_its_readers() -> None:
    port = free_udp_port()
    query = f"data=239.192.9.2:{port}&iface=127.0.0.1"
    with serving(f"tcp+udp://127.0.0.1:0?{query}&ttl=0") as server:
        url = f"tcp+udp://127.0.0.1:{server.address[1]}?{query}&idcode=7"
        with hearing(url) as ear:
            server.events += ear.until(lambda: server.senders.audience(server.handles[0]) == 1, server.senders)
            server.publish(3)
            ear.until(lambda: values(ear.messages) == [0, 1, 2])
        server.until(lambda: ServerKind.DISCONNECTED in server.kinds())
        assert Outcome.STOPPED not in server.kinds()


@pytest.mark.parametrize(
    ("data", "error", "match"),
    [
        ("no.such.host.invalid:4713", SourceError, "unknown host"),
        ("239.192.9.3:4713&iface=nic9", SettingsError, "iface=nic9: neither an address nor an interface"),
        ("4713&source=192.0.2.123", SourceError, "does not have that address"),
    ],
)
def test_where_data_cannot_go_is_told_at_the_start(data: str, error: type[Exception], match: str) -> None:
    with Senders(CLOCK) as senders, pytest.raises(error, match=match):
        senders.listen(parse_endpoint(f"tcp+udp://127.0.0.1:0?data={data}"), [senders.add(served(CONFIG))])


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
@pytest.mark.parametrize("scheme", ["udp+cmd", "tcp+udp"])
def test_clients_are_sent_to_without_asking_for_names(scheme: str, host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """That takes its time, and may fail."""
    ipv6 = host != "127.0.0.1"
    with socket.socket(socket.AF_INET6 if ipv6 else socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((host.strip("[]"), 0))
        sock.settimeout(1)
        data = f"?data={sock.getsockname()[1]}" if scheme == "tcp+udp" else ""
        with serving(f"{scheme}://{host}:0{data}") as server, ExitStack() as stack:
            address = server.address
            monkeypatch.setattr(socket, "getaddrinfo", lambda *_: pytest.fail("a name was asked for"))
            if scheme == "tcp+udp":
                tcp_sock = stack.enter_context(socket.socket(sock.family, socket.SOCK_STREAM))
                tcp_sock.connect(address)
                tcp_sock.sendall(START)
            else:
                sock.sendto(START, address)
            server.until(lambda: Outcome.STARTED in server.kinds())
            server.publish(1)
            assert sock.recv(100) == data_frame(CONFIG, 0, value=0)


def refuse(handle: int, frame: bytes) -> list[bytes]:
    raise SettingsError("no such fault")


def test_a_command_that_cannot_be_answered_costs_its_client_the_connection_and_nobody_else() -> None:
    with serving("tcp://127.0.0.1:0", treat=refuse) as server, clients(server, 2) as (one, other):
        one.say(encode_command(7, Command.SEND_CFG2))
        server.until(lambda: ServerKind.DISCONNECTED in server.kinds())
        assert server.events[-1].detail == "no such fault"
        started(server, other)


def test_a_command_that_cannot_be_answered_costs_its_udp_client_what_it_has_started() -> None:
    with serving("udp+cmd://127.0.0.1:0", treat=refuse) as server:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(START, server.address)
            sock.sendto(encode_command(7, Command.SEND_CFG2), server.address)
            server.until(lambda: ServerKind.DISCONNECTED in server.kinds())
        assert server.events[-1].detail == "no such fault"
        assert server.senders.audience(server.handles[0]) == 0


# --- clients that misbehave


def test_a_slow_client_neither_delays_others_nor_grows_memory() -> None:
    big = stream(7, phasors=200)
    with serving("tcp://127.0.0.1:0", big, queue_bytes=32_768) as server, clients(server, 2) as (slow, fast):
        for client in (slow, fast):
            client.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 2)
        spent_ns, failed = [], 0
        for k in range(8000):
            frame = data_frame(big, k * 10**9)
            before_ns = CLOCK.monotonic_ns()
            failed += len(server.senders.publish([(server.handles[0], frame)]))
            spent_ns.append(CLOCK.monotonic_ns() - before_ns)
            if k % 10 == 0:
                fast.hear()
                server.senders.poll(0)
        server.until(lambda: len(fast.hear()) == 8000)
        assert failed > 0  # the slow one's queue was full
        assert sorted(spent_ns)[7920] < 5 * MS  # no send waited for it
        assert 0 < server.senders.queued_bytes <= 32_768
        got = len(slow.hear())
        server.until(lambda: len(slow.hear()) == 8000 - failed)  # it gets the rest when it reads, frames whole
        assert got < 8000
        server.until(lambda: not server.senders.queued_bytes)


def test_a_stalled_client_is_sent_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "STALL_NS", 50 * MS)
    monkeypatch.setattr("pmutools.net.server.HOUSEKEEPING_NS", 20 * MS)
    big = stream(7, phasors=200)
    with serving("tcp://127.0.0.1:0", big, queue_bytes=32_768) as server, clients(server, 1) as (client,):
        client.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 1)

        def stalled() -> bool:
            server.senders.publish([(server.handles[0], data_frame(big, 0))])
            return ServerKind.STALLED in server.kinds()

        server.until(stalled)
        assert "frames were dropped" in server.events[-1].detail
        assert server.senders.audience(server.handles[0]) == 0
        server.until(lambda: client.hear() and client.ended)


@pytest.mark.parametrize("reset", [False, True], ids=["fin", "rst"])
def test_a_client_that_vanishes_is_forgotten(reset: bool) -> None:
    with serving("tcp://127.0.0.1:0") as server, clients(server, 2) as (gone, stays):
        for client in (gone, stays):
            client.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 2)
        if reset:
            gone.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        gone.sock.close()
        server.publish(5)  # before the server has looked
        server.until(lambda: ServerKind.DISCONNECTED in server.kinds())
        server.publish(5, first=5)
        server.until(lambda: len(stays.hear()) == 10)
        assert server.senders.audience(server.handles[0]) == 1


def test_garbage_ends_the_connection_after_its_measure() -> None:
    with serving("tcp://127.0.0.1:0") as server, clients(server, 1) as (client,):
        junk = b"\x00" * outlet_module.GARBAGE_BYTES
        for count in range(1, 4):
            client.say(junk[:-20] + START)  # is skipped, as long as a frame comes now and then
            server.until(lambda count=count: server.kinds().count(Outcome.STARTED) == count)  # type: ignore[misc]
        client.say(junk + b"\x00")
        server.until(lambda: ServerKind.GARBAGE in server.kinds())
        server.until(lambda: client.hear() is not None and client.ended)


@pytest.mark.parametrize("code", [Command.SEND_CFG2, Command.START_DATA, 0x0007])
def test_a_flood_of_commands_is_bounded(code: int) -> None:
    """A client that asks without reading: its answers are dropped beyond its queue, others are served."""
    with serving("tcp://127.0.0.1:0", queue_bytes=32_768) as server, clients(server, 2) as (flood, other):
        other.say(START)
        wire = encode_command(7, code) * 500
        for _ in range(40):
            try:
                flood.sock.send(wire)
            except BlockingIOError:
                break
            server.events += server.senders.poll(0)
        server.until(lambda: server.senders.audience(server.handles[0]) >= 1)
        server.publish(3)
        server.until(lambda: len(other.hear()) == 3)


def frames_of(code: int, count: int, idcode: int = 7) -> bytes:
    return encode_command(idcode, code) * count


FLOODS = {
    "cfg2": frames_of(Command.SEND_CFG2, 100_000),
    "start-stop": (START + encode_command(7, Command.STOP_DATA)) * 50_000,
    "unknown": frames_of(0x0007, 100_000),
    "garbage": bytes(1_800_000),
    "false-syncs": b"\xaa\x41\x7f\xff" * 450_000,
    "hidden": b"\xaa\x41\xff\xff\x00\x09" + frames_of(Command.SEND_CFG2, 100_000),
}


@pytest.mark.parametrize("kind", FLOODS)
def test_a_flood_delays_nobody(kind: str) -> None:
    """A hundred thousand commands as fast as they are taken, answers unread; another client is served meanwhile."""
    left = memoryview(FLOODS[kind])
    garbage = kind in ("garbage", "false-syncs")
    with serving("tcp://127.0.0.1:0", queue_bytes=32_768) as server, clients(server, 2) as (flood, other):
        started(server, other)
        told: Counter[ServerKind | Outcome] = Counter()
        late_ns, k = [], 0
        while not (told[ServerKind.GARBAGE] if garbage else sum(told.values()) >= 100_000):
            with suppress(BlockingIOError, ConnectionError):
                left = left[flood.sock.send(left[: 1 << 18]) :]
            deadline_ns = CLOCK.monotonic_ns() + 5 * MS
            while events := server.senders.serve_until(deadline_ns):
                assert len(events) <= outlet_module.COMMANDS + 2  # of one turn
                told.update(event.kind for event in events)
            late_ns.append(CLOCK.monotonic_ns() - deadline_ns)
            server.publish(1, first=k)
            k += 1
            assert server.senders.queued_bytes <= 2 * 32_768
            outlet = server.senders._outlets[server.outlet]
            assert isinstance(outlet, outlet_module.TcpOutlet)
            assert sum(len(client.unheard) for client in outlet._clients) * 18 <= 1 << 17
            other.hear()
        server.until(lambda: len(other.hear()) == k)
        assert min(late_ns) >= 0
        assert sorted(late_ns)[len(late_ns) * 9 // 10] < 10 * MS, sorted(late_ns)


@pytest.mark.parametrize("scheme", ["tcp", "udp+cmd"])
def test_answers_leave_nothing_behind_where_nothing_is_published(scheme: str) -> None:
    ask = encode_command(7, Command.SEND_CFG2)
    with serving(f"{scheme}://127.0.0.1:0") as server, ExitStack() as stack:
        kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
        for k in range(1, 21):
            sock = stack.enter_context(socket.socket(socket.AF_INET, kind))
            sock.connect(server.address)
            sock.send(ask)
            server.until(lambda k=k: server.kinds().count(Outcome.ANSWERED) == k)  # type: ignore[misc]
            if scheme == "tcp":  # it goes with RST
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                sock.close()
                server.until(lambda k=k: server.kinds().count(ServerKind.DISCONNECTED) == k)  # type: ignore[misc]
        assert len(server.senders._dirty) == 0


def test_many_flooding_clients_share_the_turns() -> None:
    wire = frames_of(Command.SEND_CFG2, 5_000)
    with serving("tcp://127.0.0.1:0") as server, clients(server, 40) as joined:
        for client in joined:
            client.sock.send(wire)
        late_ns = []
        for _ in range(40):
            deadline_ns = CLOCK.monotonic_ns() + 5 * MS
            while events := server.senders.serve_until(deadline_ns):
                server.events += events
            late_ns.append(CLOCK.monotonic_ns() - deadline_ns)
        assert sorted(late_ns)[30] < 5 * MS, late_ns
        server.until(lambda: all(client.hear() for client in joined))  # each has its turn


def test_a_flood_of_datagrams_is_taken_bit_by_bit() -> None:
    """Datagrams full of commands, and of bytes that look like them: a turn obeys its measure, nothing is lost."""
    with (
        serving("udp+cmd://127.0.0.1:0") as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as flood,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for _ in range(5):
            flood.sendto(frames_of(0x0007, 500), server.address)
            flood.sendto(b"\xaa\x41\x7f\xff" * 15_000, server.address)
            flood.sendto(START[:-1], server.address)
        other.sendto(b"\xaa\x41\x00\x12" + START, server.address)  # what follows no frame is not looked for
        other.sendto(START, server.address)
        turns = []
        while Outcome.STARTED not in server.kinds():
            events = server.senders.poll(100 * MS)
            turns.append(len(events))
            server.events += events
            assert len(turns) < 1000
        assert max(turns) <= outlet_module.COMMANDS
        assert server.kinds().count(Outcome.UNKNOWN) == 2500
        assert server.kinds().count(Outcome.STARTED) == 1


def test_too_many_clients_are_turned_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet_module, "MAX_CLIENTS", 3)
    with serving("tcp://127.0.0.1:0") as server, clients(server, 4) as joined:
        server.until(lambda: ServerKind.TURNED_AWAY in server.kinds())
        server.until(lambda: [client.hear() is not None and client.ended for client in joined] == [False] * 3 + [True])


def test_at_the_limit_the_udp_client_heard_longest_ago_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet_module, "MAX_CLIENTS", 3)
    with serving("udp+cmd://127.0.0.1:0") as server, ExitStack() as stack:
        socks = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(4)]
        for sock in (*socks[:3], socks[0], socks[3]):  # the first is heard again, so the second is the oldest
            seen = len(server.events)
            sock.sendto(START, server.address)
            server.until(lambda seen=seen: len(server.events) > seen)  # type: ignore[misc]
        assert server.kinds() == [Outcome.STARTED] * 5 + [ServerKind.DISCONNECTED]
        assert server.events[-1].client == f"127.0.0.1:{socks[1].getsockname()[1]}"
        assert server.senders.audience(server.handles[0]) == 3


def test_udp_clients_that_have_started_nothing_take_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet_module, "MAX_CLIENTS", 1)
    stop, ask = encode_command(7, Command.STOP_DATA), encode_command(7, Command.SEND_CFG2)
    foreign = encode_command(8, Command.START_DATA)
    with serving("udp+cmd://127.0.0.1:0") as server:
        for said in [(START, stop), (ask,), (foreign,), (data_frame(CONFIG, 0),), (START, stop), (START,)]:
            awaited = len(server.events) + len(said)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                for frame in said:
                    sock.sendto(frame, server.address)
                server.until(lambda awaited=awaited: len(server.events) == awaited)  # type: ignore[misc]
        assert ServerKind.DISCONNECTED not in server.kinds()
        assert server.senders.audience(server.handles[0]) == 1


def test_no_descriptor_left_is_told_and_tried_again_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet_module, "_ACCEPT_AGAIN_NS", 30 * MS)
    accept = tcp.TcpListener.accept
    left = [OSError(errno.EMFILE, "Too many open files")]

    def scarce(self: tcp.TcpListener, queue_bytes: int) -> tcp.TcpPeer | None:
        if left:
            raise left.pop()
        return accept(self, queue_bytes)

    monkeypatch.setattr(tcp.TcpListener, "accept", scarce)
    with serving("tcp://127.0.0.1:0") as server, clients(server, 1):
        server.until(lambda: len(server.events) == 2)
        assert server.kinds() == [ServerKind.TURNED_AWAY, ServerKind.CONNECTED]
        assert "ulimit -n" in server.events[0].detail


# --- how frames are written


def put(server: Server, number: int, write: Segmentation | None = None) -> None:
    """Publish one frame to all who have started the stream, written as ``write`` says."""
    frame = data_frame(CONFIG, number * 10**9, value=number)
    for sink in server.senders._audience.sinks[server.handles[0]]:
        sink.put(frame, 0, CLOCK.monotonic_ns(), write)
    server.senders._flush()


def test_pieces_leave_by_the_clock_and_answers_queue_behind_them() -> None:
    with serving("tcp://127.0.0.1:0") as server, clients(server, 1) as (client,):
        client.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 1)
        begun_ns = CLOCK.monotonic_ns()
        put(server, 0, Segmentation(Cut.SPLIT, 3, 20 * MS))
        put(server, 1)
        client.say(encode_command(7, Command.SEND_CFG2))
        server.until(lambda: Outcome.ANSWERED in server.kinds())
        assert CLOCK.monotonic_ns() - begun_ns > 40 * MS or server.senders.queued_bytes
        server.until(lambda: len(client.hear()) == 3)
        assert CLOCK.monotonic_ns() - begun_ns >= 40 * MS
        assert [frame.type for frame in client.frames] == [FrameType.DATA, FrameType.DATA, FrameType.CFG2]
        begun_ns = CLOCK.monotonic_ns()
        put(server, 2, Segmentation(Cut.STALL, gap_ns=30 * MS))
        put(server, 3)
        server.until(lambda: len(client.hear()) == 5)
        assert CLOCK.monotonic_ns() - begun_ns >= 30 * MS


def test_a_client_that_is_cut_off_goes_and_others_stay() -> None:
    with serving("tcp://127.0.0.1:0") as server, clients(server, 2) as (one, other):
        one.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 1)
        put(server, 0, Segmentation(Cut.STALL, gap_ns=20 * MS))
        put(server, 1, Segmentation(Cut.RESET))  # takes effect by the clock
        server.until(lambda: ServerKind.CUT_OFF in server.kinds())
        server.until(lambda: one.hear() and one.ended)
        assert [frame.data for frame in one.frames] == [data_frame(CONFIG, 0, value=0)]
        assert one.framer.pending == len(one.frames[0].data) // 2
        other.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 1)
        put(server, 2, Segmentation(Cut.RESET, 4))  # at once
        server.until(lambda: server.kinds().count(ServerKind.CUT_OFF) == 2)
        server.until(lambda: other.hear() is not None and other.ended)
        assert server.senders.audience(server.handles[0]) == 0


def test_kept_frames_go_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "KEPT_NS", 30 * MS)
    monkeypatch.setattr("pmutools.net.server.HOUSEKEEPING_NS", 10 * MS)
    with serving("tcp://127.0.0.1:0") as server, clients(server, 1) as (client,):
        client.say(START)
        server.until(lambda: server.senders.audience(server.handles[0]) == 1)
        put(server, 0, Segmentation(Cut.COALESCE, 5))
        assert server.senders.queued_bytes
        server.until(lambda: len(client.hear()) == 1)


# --- streams that fall silent


def started(server: Server, *joined: Client, idcode: int = 7) -> None:
    """Have the clients start a stream; each has its own start told."""
    told = server.kinds().count(Outcome.STARTED)
    for client in joined:
        client.say(encode_command(idcode, Command.START_DATA))
    server.until(lambda: server.kinds().count(Outcome.STARTED) == told + len(joined))


def refuses(server: Server) -> bool:
    try:
        socket.create_connection(server.address, timeout=1).close()
    except ConnectionRefusedError:
        return True
    return False


@pytest.mark.parametrize("how", [Hangup.FIN, Hangup.RST])
def test_a_stream_is_hung_up_for_those_who_have_started_it(how: Hangup) -> None:
    with serving("tcp://127.0.0.1:0", CONFIG, stream(9)) as server, clients(server, 3) as (one, both, other):
        started(server, one, both)
        started(server, both, other, idcode=9)
        both.say(encode_command(7, 0x0007))  # FIN all the same, though a command waits unread
        assert server.senders.hang_up(server.handles[0], Hangup.SILENCE) == 0
        assert server.senders.hang_up(server.handles[0], how) == 2
        for client in (one, both):
            with pytest.raises(BlockingIOError if how is Hangup.FIN else ConnectionResetError):
                assert client.sock.recv(1) == b""
                raise BlockingIOError
        server.until(lambda: server.kinds().count(ServerKind.DISCONNECTED) == 2)
        assert server.senders.hang_up(server.handles[0], how) == 0
        server.senders.take_up(server.handles[0])  # nothing was refused
        assert server.senders.audience(server.handles[1]) == 1
        with clients(server, 1) as (back,):
            started(server, back)
        assert not other.hear()
        assert not other.ended


def test_a_refused_stream_does_not_start_while_others_do() -> None:
    with serving("tcp://127.0.0.1:0", CONFIG, stream(9)) as server, clients(server, 2) as (one, other):
        senders, (seven, nine) = server.senders, server.handles
        started(server, one)
        started(server, other, idcode=9)
        assert senders.hang_up(seven, Hangup.REFUSE) == 1
        assert senders.hang_up(seven, Hangup.REFUSE) == 0
        other.say(START + encode_command(7, Command.SEND_CFG2))
        server.until(lambda: Outcome.ANSWERED in server.kinds())
        refused = [event for event in server.events if event.kind is ServerKind.REFUSED]
        assert [(event.idcode, event.code) for event in refused] == [(7, Command.START_DATA)]
        assert (senders.audience(seven), senders.audience(nine)) == (0, 1)
        senders.take_up(seven)
        started(server, other)
        assert senders.audience(seven) == 1


def test_where_all_streams_are_refused_nobody_listens_until_one_is_taken_up() -> None:
    with serving("tcp://127.0.0.1:0", CONFIG, stream(9)) as server, clients(server, 2) as (one, idle):
        senders, (seven, nine) = server.senders, server.handles
        started(server, one)
        assert senders.hang_up(nine, Hangup.REFUSE) == 0
        assert not refuses(server)
        assert senders.hang_up(seven, Hangup.REFUSE) >= 2  # and those who have started nothing
        assert refuses(server)
        server.until(lambda: one.hear() is not None and one.ended and idle.hear() is not None and idle.ended)
        for _ in range(2):
            senders.take_up(nine)
        with clients(server, 1) as (back,):
            started(server, back, idcode=9)
            back.say(START)
            server.until(lambda: ServerKind.REFUSED in server.kinds())
        for _ in range(2):  # again and again
            assert senders.hang_up(nine, Hangup.REFUSE) in (0, 1)
        assert refuses(server)
        senders.take_up(seven)
        assert not refuses(server)


def test_a_port_taken_meanwhile_is_told_and_had_back_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet_module, "_LISTEN_AGAIN_NS", 20 * MS)
    with serving("tcp://127.0.0.1:0") as server:
        senders, (seven,) = server.senders, server.handles
        senders.hang_up(seven, Hangup.REFUSE)
        with socket.socket() as thief:
            thief.bind(server.address)
            thief.listen()
            for _ in range(3):
                senders.take_up(seven)
            server.until(lambda: server.kinds() == [ServerKind.NOT_LISTENING])
            assert "already in use" in server.events[0].detail
            end_ns = CLOCK.monotonic_ns() + 50 * MS
            while CLOCK.monotonic_ns() < end_ns:
                server.events += senders.poll(5 * MS)
        assert server.kinds() == [ServerKind.NOT_LISTENING]  # once
        server.until(lambda: not refuses(server))
        with clients(server, 1) as (client,):
            started(server, client)


# --- departures


def sent_now(senders: Senders, handle: int, marks: range) -> list[int]:
    """Send so many frames; returns the rows that failed."""
    data = data_frame(stream(), 10**9)
    starts = np.arange(len(marks)) * len(data)
    frames = Frames(
        np.full(len(marks), handle),
        starts,
        np.full(len(marks), len(data)),
        np.frombuffer(data * len(marks), np.uint8),
        np.ones(len(marks), np.bool_),
        np.array(marks),
    )
    return senders.send(senders.load(frames), 0, len(marks))


@pytest.mark.skipif(not linux.NATIVE, reason="only Linux stamps departures")
def test_departures_to_clients_that_ask_over_udp_are_stamped_too() -> None:
    with serving("udp+cmd://127.0.0.1:0", stream(), stamp_departures=True) as server:
        senders = server.senders
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.sendto(START, server.address)
            server.until(lambda: Outcome.STARTED in server.kinds())
            before_ns = time.time_ns()
            assert sent_now(senders, 0, range(100, 110)) == []
            marks, times = senders.departures()
        assert marks.tolist() == [*range(100, 110)]
        assert before_ns <= times.min() <= times.max() <= time.time_ns()
        senders.poll(0)
        assert senders.departures()[0].tolist() == [], "each is told once"


@pytest.mark.skipif(not linux.NATIVE, reason="only Linux stamps departures")
def test_stamps_of_what_left_before_a_failed_send_are_not_lost() -> None:
    """The kernel's numbers begin anew there."""
    too_long = b"\0" * 70_000
    with Senders(CLOCK, stamp_departures=True) as senders:
        handle = senders.add(served(stream()))
        senders.send_to(parse_endpoint(f"udp://127.0.0.1:{free_udp_port()}"), [handle])
        sent_now(senders, handle, range(5))
        assert senders.publish([(handle, too_long)]) == [0]
        sent_now(senders, handle, range(10, 13))
        assert senders.departures()[0].tolist() == [*range(5), 10, 11, 12]


# --- spontaneous


@paths
def test_spontaneous_streams_announce_themselves_and_go_out_in_one_tick(native: bool) -> None:
    port = free_udp_port()
    with hearing(f"udp://127.0.0.1:{port}") as ear, Senders(CLOCK, native=native) as senders:
        handles = [senders.add(served(stream(idcode))) for idcode in range(1, 129)]
        senders.send_to(parse_endpoint(f"udp://127.0.0.1:{port}"), handles)
        senders.announce()
        tick = [(handle, data_frame(stream(handle + 1), 10**9, value=handle)) for handle in handles]
        assert senders.publish(tick) == []
        ear.until(lambda: values(ear.messages) == list(range(128)))
        assert len(ear.messages) == 256


def test_configurations_are_repeated_once_a_period_and_not_in_one_burst() -> None:
    clock = VirtualClock()
    with UdpSocket("127.0.0.1", 0) as ears, Senders(clock, cfg_period_ns=60 * 10**9) as senders:
        handles = [senders.add(served(stream(idcode))) for idcode in range(1, 129)]
        senders.send_to(parse_endpoint(f"udp://{ears.address}"), handles)
        heard: dict[int, list[int]] = {}
        bursts = []
        while clock.monotonic_ns() <= 180 * 10**9:
            senders.poll(100 * MS)
            clock.advance(30 * MS)  # whoever polls is late now and then; the period must not grow by it
            chunks = ears.read()
            bursts.append(len(chunks))
            for chunk in chunks:
                heard.setdefault(decode_prefix(chunk.data).idcode, []).append(clock.monotonic_ns())
        assert set(heard) == set(range(1, 129))
        periods_ns = {later - earlier for times_ns in heard.values() for earlier, later in pairwise(times_ns)}
        assert all(abs(period_ns - 60 * 10**9) <= 200 * MS for period_ns in periods_ns)
        assert min(map(len, heard.values())) >= 2
        assert max(bursts) <= 4


@pytest.mark.skipif(not linux.NATIVE, reason="Linux multicast")
def test_one_stream_to_a_group_and_to_an_address() -> None:
    group, single = free_udp_port(), free_udp_port()
    urls = [f"udp://239.192.9.1:{group}?iface=127.0.0.1", f"udp://127.0.0.1:{single}?source=127.0.0.5"]
    with Receivers([parse_endpoint(url) for url in urls], CLOCK) as receivers, Senders(CLOCK) as senders:
        ear, stream_7 = Ear(receivers), senders.add(served(CONFIG))
        for url in (f"udp://239.192.9.1:{group}?iface=127.0.0.1&ttl=0", urls[1]):
            senders.send_to(parse_endpoint(url), [stream_7])
        assert senders.audience(stream_7) == 2
        senders.announce([stream_7])
        senders.publish([(stream_7, data_frame(CONFIG, 0, value=1))])
        ear.until(lambda: values(ear.messages) == [1, 1])
        owners = {ear.receivers.owners(message.flow, 7) for message in ear.messages}
        assert owners == {(0,), (1,)}


@pytest.mark.skipif(not linux.NATIVE, reason="Linux's loopback network")
@pytest.mark.parametrize("destination", ["127.255.255.255", "255.255.255.255"])
def test_a_broadcast_reaches_all_who_listen(destination: str) -> None:
    with ExitStack() as stack:
        ears = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for ear in ears:
            ear.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            ear.bind(("0.0.0.0", ears[0].getsockname()[1]))
            ear.settimeout(2)
        senders = stack.enter_context(Senders(CLOCK))
        seven = senders.add(served(CONFIG))
        port = ears[0].getsockname()[1]
        senders.send_to(parse_endpoint(f"udp://{destination}:{port}?source=127.0.0.1"), [seven])
        assert senders.publish([(seven, b"to all")]) == []
        assert [ear.recvfrom(100)[0] for ear in ears] == [b"to all"] * 2


@pytest.mark.skipif(not linux.NATIVE, reason="Linux's errors")
def test_a_broadcast_that_cannot_leave_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(self: socket.socket, address: object) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    with Senders(CLOCK) as senders:
        seven = senders.add(served(CONFIG))
        monkeypatch.setattr(socket.socket, "connect", unreachable)
        for host in ("255.255.255.255", "127.255.255.255"):
            with pytest.raises(SourceError, match=rf"broadcast to {host}:4713 from 0.0.0.0: no route to this network"):
                senders.send_to(parse_endpoint(f"udp://{host}:4713"), [seven])
        assert senders.audience(seven) == 0
        senders.send_to(parse_endpoint("udp://127.0.0.1:4713"), [seven])  # no broadcast: not looked into


def test_a_changed_configuration_is_what_is_answered_and_announced_from_then_on() -> None:
    port = free_udp_port()
    with (
        serving("tcp://127.0.0.1:0") as server,
        hearing(f"udp://127.0.0.1:{port}") as ear,
        clients(server, 1) as (client,),
    ):
        senders, handle = server.senders, server.handles[0]
        senders.send_to(parse_endpoint(f"udp://127.0.0.1:{port}"), [handle])
        changed = stream(7, phasors=2, cfgcnt=1)
        senders.replace(handle, served(changed))
        client.say(encode_command(7, Command.SEND_CFG2))
        server.until(lambda: len(client.hear()) == 1)
        senders.announce()
        ear.until(lambda: len(ear.messages) == 1)
        assert ear.messages[0].config == changed
        assert client.frames[0].data[14:][:-2] == ear.messages[0].frame.data[14:-2]
        with pytest.raises(ValueError, match="is 7, not 8"):
            senders.replace(handle, served(stream(8)))


def test_frames_that_did_not_go_out_are_named() -> None:
    with Senders(CLOCK) as senders:
        stream_7 = senders.add(served(CONFIG))
        assert senders.publish([(stream_7, b"to nobody")]) == []
        senders.send_to(Endpoint(Scheme.UDP, "127.0.0.1", free_udp_port()), [stream_7])
        assert senders.publish([(stream_7, b"1"), (stream_7, b"x" * 70_000), (stream_7, b"3")]) == [1]


# --- time


@paths
def test_serving_until_a_deadline_is_exact_and_answers_meanwhile(native: bool) -> None:
    with serving("tcp://127.0.0.1:0", native=native) as server, clients(server, 1) as (client,):
        client.say(encode_command(7, Command.SEND_CFG2))
        late_ns = []
        for _ in range(20):
            deadline_ns = CLOCK.monotonic_ns() + 6 * MS
            while events := server.senders.serve_until(deadline_ns):
                server.events += events
            late_ns.append(CLOCK.monotonic_ns() - deadline_ns)
        assert min(late_ns) >= 0
        assert min(late_ns) < MS, late_ns  # however busy the machine, once in twenty it is on time
        assert Outcome.ANSWERED in server.kinds()
        assert len(client.hear()) == 1
        passed_ns = CLOCK.monotonic_ns()
        assert server.senders.serve_until(passed_ns - 1) == []


def test_close_deadlines_still_let_clients_in() -> None:
    """A player of thousands of streams always has a deadline within two milliseconds."""
    with serving("tcp://127.0.0.1:0") as server, clients(server, 1) as (client,):
        client.say(encode_command(7, Command.SEND_CFG2))
        deadline_ns = CLOCK.monotonic_ns()
        end_ns = deadline_ns + PATIENCE_NS
        while not client.hear():
            deadline_ns = max(deadline_ns + MS // 2, CLOCK.monotonic_ns())
            assert deadline_ns < end_ns
            server.events += server.senders.serve_until(deadline_ns)


def test_virtual_time_serves_too() -> None:
    clock = VirtualClock()
    with Senders(clock) as senders:
        stream_7 = senders.add(served(CONFIG))
        outlet = senders.listen(parse_endpoint("tcp://127.0.0.1:0"), [stream_7])
        assert senders.local(outlet) is not None
        while senders.serve_until(3600 * 10**9):
            pass
        assert clock.monotonic_ns() == 3600 * 10**9


# --- mistakes


def test_what_cannot_be_served_is_told() -> None:
    with serving("tcp://127.0.0.1:0") as server:
        senders = server.senders
        with pytest.raises(SourceError, match="already in use; stop the other program"):
            senders.listen(parse_endpoint(f"tcp://127.0.0.1:{server.address[1]}"), server.handles)
        with pytest.raises(SettingsError, match="knows no commands; use udp\\+cmd://"):
            senders.listen(parse_endpoint("udp://127.0.0.1:0"), server.handles)
        with pytest.raises(SettingsError, match="listen there instead"):
            senders.send_to(parse_endpoint("tcp://127.0.0.1:4712"), server.handles)
        with pytest.raises(SettingsError, match="port 0"):
            senders.send_to(parse_endpoint("udp://127.0.0.1:0"), server.handles)
        with pytest.raises(SourceError, match="unknown host"):
            senders.send_to(parse_endpoint("udp://no.such.host.invalid:4713"), server.handles)
        with pytest.raises(SourceError, match="does not have that address"):
            senders.send_to(parse_endpoint("udp://127.0.0.1:4713?source=192.0.2.123"), server.handles)
        twin = senders.add(served(replace(CONFIG, data_rate=30)))
        with pytest.raises(SettingsError, match="two streams of IDCODE 7"):
            senders.listen(parse_endpoint("tcp://127.0.0.1:0"), [*server.handles, twin])
