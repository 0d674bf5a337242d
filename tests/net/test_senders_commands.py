"""The sending front end: what clients ask for they get."""

from __future__ import annotations

import random
import socket
import time
from contextlib import ExitStack

import pytest
from support.clients import CONFIG, START, clients, hearing, paths, serving, started
from support.live import CLOCK, data_frame, free_udp_port, stream, values

from pmutools import linux
from pmutools.c37118 import Command, FrameType, decode_prefix, encode_command
from pmutools.c37118.session import Outcome, served
from pmutools.errors import SettingsError, SourceError
from pmutools.net.dialogue import LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.outlet import ServerKind
from pmutools.net.server import Senders

pytestmark = pytest.mark.realtime


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
