"""The receiving front end against devices played by plain sockets: roles, routing, faults, and news in words."""

from __future__ import annotations

import random
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from typing import Any

import pytest
from support.live import CLOCK, Ear, data_frame, free_udp_port, stream, values

from pmutools import linux
from pmutools.c37118 import Command, FrameType, StreamConfig, as_kind, decode_command, encode_config
from pmutools.c37118.session import Timing
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import StampSource
from pmutools.net import link, receiver
from pmutools.net.dialogue import LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.receiver import Receivers
from pmutools.net.tcp import TcpCounts
from pmutools.net.udp import UdpSocket

pytestmark = pytest.mark.realtime
MS = 1_000_000
QUICK = Timing(answer_ns=120 * MS, cfg3_ns=40 * MS, silence_ns=150 * MS, silence_frames=1, tries=3)
EAGER = Timing(answer_ns=300 * MS)
paths = pytest.mark.parametrize("native", [linux.NATIVE, False], ids=["native", "portable"])


WAY: dict[str, Any] = {}


@pytest.fixture(params=["polled", "soaked", "only wanted"], autouse=True)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything holds whichever way what comes is received."""
    monkeypatch.setattr(Ear, "soaked", request.param == "soaked")
    monkeypatch.setitem(WAY, "only_wanted", request.param == "only wanted")


@contextmanager
def ears(*urls: str, native: bool = linux.NATIVE, **options: Any) -> Iterator[Ear]:
    with Receivers([parse_endpoint(url) for url in urls], CLOCK, native=native, **{**WAY, **options}) as receivers:
        yield Ear(receivers, Ear.soaked)


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        yield sock


class Device:
    """A TCP device that says and hears what the test tells it to."""

    def __init__(self, port: int = 0) -> None:
        self.listener = socket.create_server(("127.0.0.1", port))
        self.listener.settimeout(0)
        self.sock: socket.socket | None = None
        self.heard = b""

    @property
    def port(self) -> int:
        return int(self.listener.getsockname()[1])

    @property
    def commands(self) -> list[int]:
        return [decode_command(self.heard[at : at + 18]).code for at in range(0, len(self.heard) - 17, 18)]

    def poll(self) -> bool:
        """Accept and hear what there is."""
        try:
            if self.sock is None:
                self.sock = self.listener.accept()[0]
                self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.sock.setblocking(False)
            self.heard += self.sock.recv(65536)
        except (BlockingIOError, ConnectionResetError):
            pass
        return True

    def say(self, data: bytes) -> None:
        assert self.sock is not None
        self.sock.setblocking(True)
        self.sock.sendall(data)

    def hang_up(self, *, reset: bool = False) -> None:
        assert self.sock is not None
        if reset:
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.sock.close()
        self.sock = None

    def close(self) -> None:
        self.listener.close()
        if self.sock is not None:
            self.sock.close()


@pytest.fixture
def device() -> Iterator[Device]:
    device = Device()
    yield device
    device.close()


def hears(device: Device, *commands: int) -> Callable[[], bool]:
    """Whether the device has heard these commands; requests repeated on a busy machine count once."""
    return lambda: device.poll() and [command for command, _ in groupby(device.commands)] == list(commands)


def play(device: Device, ear: Ear, config: StreamConfig, count: int = 3) -> None:
    """A whole conversation: configuration asked for and given, data started and sent."""
    before = len(ear.of(LinkKind.STREAMING))
    device.heard = b""
    ear.until(hears(device, Command.SEND_CFG2))
    device.say(encode_config(config))
    ear.until(hears(device, Command.SEND_CFG2, Command.START_DATA))
    for k in range(count):
        device.say(data_frame(config, k * 10**9, value=k))
    ear.until(lambda: len(ear.of(LinkKind.STREAMING)) > before)


# --- spontaneous UDP


@paths
def test_data_before_the_configuration_are_held_then_given(sender: socket.socket, native: bool) -> None:
    config = stream(7)
    with ears("udp://127.0.0.1:0", native=native) as ear:
        address = ear.receivers.local(0)
        assert address is not None
        for k in range(3):
            sender.sendto(data_frame(config, k * 10**9, value=k), address.sockaddr)
        ear.until(lambda: len(ear.chunks) == 3)
        assert ear.messages == []
        assert [event.idcode for event in ear.of(LinkKind.NO_CONFIG)] == [7]
        for frame in (encode_config(config), data_frame(config, 10**10, value=3), encode_config(config)):
            sender.sendto(frame, address.sockaddr)
        ear.until(lambda: len(ear.messages) == 6)
        assert values(ear.messages) == [0, 1, 2, 3]
        assert {message.config for message in ear.messages} == {config}
        assert ear.kinds == [LinkKind.BOUND, LinkKind.NO_CONFIG, LinkKind.CONFIGURED, LinkKind.STREAMING]
        assert ear.messages[-2].frame.stamp_source is (StampSource.KERNEL if native else StampSource.USER)
        flow = ear.messages[0].flow
        assert ear.receivers.owners(flow, 7) == (0,)


def test_streams_on_one_port_go_to_their_owners(sender: socket.socket) -> None:
    port = free_udp_port()
    urls = [f"udp://127.0.0.1:{port}?idcode={idcode}" for idcode in range(1, 101)]
    with ears(*urls, f"udp://127.0.0.1:{port}?idcode=50") as ear:
        for idcode in range(1, 102):
            sender.sendto(encode_config(stream(idcode)), ("127.0.0.1", port))
            sender.sendto(data_frame(stream(idcode), 10**9, value=idcode), ("127.0.0.1", port))
        ear.until(lambda: len(ear.chunks) == 202)
        assert values(ear.messages) == list(range(1, 101))
        for message in ear.messages:
            idcode = message.frame.idcode
            assert ear.receivers.owners(message.flow, idcode) == ((49, 100) if idcode == 50 else (idcode - 1,))
        (foreign,) = ear.of(LinkKind.FOREIGN)
        assert foreign.idcode == 101
        assert ear.receivers.unwanted == 2


def test_only_the_source_asked_for_is_heard() -> None:
    port = free_udp_port()
    with (
        ears(f"udp://127.0.0.1:{port}?source=127.0.0.2", f"udp://127.0.0.1:{port}?source=127.0.0.3&idcode=7") as ear,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as right,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wrong,
    ):
        right.bind(("127.0.0.2", 0))
        wrong.bind(("127.0.0.4", 0))
        for sock in (wrong, right):
            sock.sendto(encode_config(stream(7)), ("127.0.0.1", port))
        ear.until(lambda: len(ear.chunks) == 2)
        (message,) = ear.messages
        assert message.flow.source.startswith("127.0.0.2:")
        assert ear.receivers.owners(message.flow, 7) == (0,)
        assert "127.0.0.4" in ear.of(LinkKind.FOREIGN)[0].detail


@pytest.mark.skipif(not linux.NATIVE, reason="Linux multicast")
def test_a_group_is_joined(sender: socket.socket) -> None:
    port = free_udp_port()
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    with ears(f"udp://239.192.8.1:{port}?iface=127.0.0.1") as ear:
        sender.sendto(encode_config(stream(7)), ("239.192.8.1", port))
        ear.until(lambda: len(ear.messages) == 1)


def test_silence_from_the_start_is_told(monkeypatch: pytest.MonkeyPatch, sender: socket.socket) -> None:
    monkeypatch.setattr(receiver, "NOTHING_NS", 30 * MS)
    port = free_udp_port()
    with ears(f"udp://127.0.0.1:{port}?idcode=7", f"udp://127.0.0.1:{port}?idcode=8") as ear:
        sender.sendto(encode_config(stream(8)), ("127.0.0.1", port))
        ear.until(lambda: LinkKind.NOTHING in ear.kinds)
        (told,) = ear.of(LinkKind.NOTHING)
        assert told.owners == (0,)
        assert "idcode=7" in told.where


def test_a_configuration_that_comes_unasked_with_another_cfgcnt_holds_from_there(sender: socket.socket) -> None:
    """The rate may be another, or only the names: the frames look the same."""
    old = stream(7, cfgcnt=1)
    new = replace(stream(7, cfgcnt=2), data_rate=30)
    with ears("udp://127.0.0.1:0") as ear:
        address = ear.receivers.local(0)
        assert address is not None
        for config in (old, new):
            for frame in (encode_config(config), *(data_frame(config, k * 10**9, value=k) for k in range(3))):
                sender.sendto(frame, address.sockaddr)
        ear.until(lambda: len(ear.messages) == 8)
        assert [message.config for message in ear.messages] == [old] * 4 + [new] * 4
        details = [event.detail for event in ear.of(LinkKind.CONFIGURED)]
        assert details == ["CFG2, 60 frames/s, 1 stations", "CFG2, 30 frames/s, 1 stations"]


@paths
def test_hardware_stamps_are_asked_for_and_the_kernel_s_taken_where_there_are_none(
    sender: socket.socket, device: Device, native: bool
) -> None:
    urls = ("udp://127.0.0.1:0?stamps=hardware", f"tcp://127.0.0.1:{device.port}?idcode=7&stamps=hardware")
    with ears(*urls, native=native) as ear:
        address = ear.receivers.local(0)
        assert address is not None
        sender.sendto(encode_config(stream(8)), address.sockaddr)
        ear.until(lambda: len(ear.messages) == 1)
        play(device, ear, stream(7))
        sources = {message.frame.stamp_source for message in ear.messages} - {StampSource.KERNEL_BATCHED}
        assert sources == {StampSource.KERNEL if native else StampSource.USER}


def test_a_stream_that_stops_is_told_and_told_when_it_is_back(sender: socket.socket) -> None:
    config = stream(7)
    with ears("udp://127.0.0.1:0", timing=QUICK) as ear:
        address = ear.receivers.local(0)
        assert address is not None
        sender.sendto(encode_config(config), address.sockaddr)
        sender.sendto(data_frame(config, 10**9), address.sockaddr)
        ear.until(lambda: LinkKind.SILENT in ear.kinds)
        sender.sendto(data_frame(config, 2 * 10**9), address.sockaddr)
        ear.until(lambda: ear.kinds[-1] is LinkKind.STREAMING)


@pytest.mark.skipif(not linux.NATIVE, reason="SO_MEMINFO")
def test_own_drops_are_told_apart_from_network_loss(monkeypatch: pytest.MonkeyPatch, sender: socket.socket) -> None:
    monkeypatch.setattr(receiver, "HOUSEKEEPING_NS", 20 * MS)
    with ears("udp://127.0.0.1:0", rcvbuf_bytes=4096) as ear:
        address = ear.receivers.local(0)
        assert address is not None
        for sent in (300, 600):
            for k in range(300):
                sender.sendto(data_frame(stream(7), k * 10**9), address.sockaddr)
            ear.until(lambda sent=sent: len(ear.chunks) + sum(event.datagrams for event in ear.news) == sent)  # type: ignore[misc]
        assert len(ear.of(LinkKind.OWN_DROPS)) >= 2


@pytest.mark.skipif(not linux.NATIVE, reason="SO_MEMINFO")
def test_own_drops_of_a_commanded_stream_are_told_too(monkeypatch: pytest.MonkeyPatch, sender: socket.socket) -> None:
    monkeypatch.setattr(receiver, "HOUSEKEEPING_NS", 20 * MS)

    class Small(UdpSocket):
        def __init__(self, host: str, port: int, **given: Any) -> None:
            super().__init__(host, port, rcvbuf_bytes=4096, **given)

    monkeypatch.setattr(link, "UdpSocket", Small)
    with ears(f"udp+cmd://127.0.0.1:{sender.getsockname()[1]}?idcode=7") as ear:
        _, client = sender.recvfrom(100)
        for k in range(300):
            sender.sendto(data_frame(stream(7), k * 10**9), client)
        ear.until(lambda: len(ear.chunks) + sum(event.datagrams for event in ear.news) == 300)
        assert ear.of(LinkKind.OWN_DROPS)


def test_garbage_is_counted_and_does_no_harm(sender: socket.socket) -> None:
    rng = random.Random(1)
    with ears("udp://127.0.0.1:0") as ear:
        address = ear.receivers.local(0)
        assert address is not None
        good = encode_config(stream(7))
        sender.sendto(good, address.sockaddr)
        junk = [bytes(rng.choices((0xAA, 0x01, 0x31, 0x00, 0xFF), k=rng.randrange(60))) for _ in range(200)]
        for data in junk:
            sender.sendto(data, address.sockaddr)
        ear.until(lambda: len(ear.chunks) == 201)
        tally = ear.receivers.demux.tally
        assert (tally.framed, tally.skipped_bytes) == (len(good), sum(map(len, junk)))
        assert (ear.receivers.undecodable, ear.receivers.unwanted) == (200, 0)


def test_a_flood_of_senders_leaves_nothing_behind(sender: socket.socket) -> None:
    with ears("udp://127.0.0.1:0?idcode=7") as ear:
        address = ear.receivers.local(0)
        assert address is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as flood:
            for idcode in range(100, 200):
                flood.sendto(encode_config(stream(idcode)), address.sockaddr)
        for frame in (encode_config(stream(7)), data_frame(stream(7), 10**9, value=5)):
            sender.sendto(frame, address.sockaddr)
        ear.until(lambda: len(ear.chunks) == 102)
        assert values(ear.messages) == [5]
        assert len(ear.receivers.routes) == 1


# --- commanded


@paths
def test_a_conversation_over_tcp(device: Device, native: bool) -> None:
    config = stream(7)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", native=native) as ear:
        play(device, ear, config)
        ear.until(lambda: values(ear.messages) == [0, 1, 2])
        assert ear.kinds == [LinkKind.CONNECTED, LinkKind.CONFIGURED, LinkKind.STREAMING]
        assert ear.receivers.owners(ear.messages[0].flow, 7) == (0,)
    ear.receivers.close()
    device.poll()
    assert device.commands[-1] == Command.STOP_DATA


def test_segments_split_and_merged_at_random_lose_nothing(device: Device) -> None:
    config, rng = stream(7, phasors=4), random.Random(3)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7") as ear:
        play(device, ear, config, count=1)
        wire = b"".join(data_frame(config, k * 10**9, value=k) for k in range(1, 400))
        cuts = sorted(rng.sample(range(1, len(wire)), 500))
        for number, (start, end) in enumerate(zip([0, *cuts], [*cuts, len(wire)], strict=True)):
            device.say(wire[start:end])
            if number % 7 == 0:
                ear.listen(0)
        ear.until(lambda: values(ear.messages) == list(range(400)))


def test_cfg3_falls_back_to_cfg2(device: Device) -> None:
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", want_cfg3=True, timing=QUICK) as ear:
        ear.until(hears(device, Command.SEND_CFG3))
        ear.until(hears(device, Command.SEND_CFG3, Command.SEND_CFG2))
        device.say(encode_config(stream(7)))
        ear.until(hears(device, Command.SEND_CFG3, Command.SEND_CFG2, Command.START_DATA))


def test_a_silent_cfg3_is_not_waited_for_long(device: Device) -> None:
    """As long as a person hardly notices, although an answer may take three seconds."""
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", want_cfg3=True) as ear:
        ear.until(hears(device, Command.SEND_CFG3))
        began_ns = CLOCK.monotonic_ns()
        ear.until(hears(device, Command.SEND_CFG3, Command.SEND_CFG2))
        assert 500 * MS < CLOCK.monotonic_ns() - began_ns < 2500 * MS


def test_a_cfg2_that_comes_unasked_changes_nothing_unless_it_says_something_new(device: Device) -> None:
    """Devices send theirs once a minute; what a CFG-3 says more must not come and go with it."""
    full = as_kind(stream(7, phasors=2, cfgcnt=4), FrameType.CFG3)
    full = replace(full, stations=(replace(full.stations[0], name="A name of more than sixteen characters"),))
    short = as_kind(full, FrameType.CFG2)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", want_cfg3=True, timing=EAGER) as ear:
        ear.until(hears(device, Command.SEND_CFG3))
        device.say(encode_config(full))
        ear.until(hears(device, Command.SEND_CFG3, Command.START_DATA))
        device.say(data_frame(full, 10**9, value=1) + encode_config(short) + data_frame(full, 2 * 10**9, value=2))
        ear.until(lambda: values(ear.messages) == [1, 2])
        assert [message.config for message in ear.messages] == [full] * 4
        assert ear.kinds.count(LinkKind.CONFIGURED) == 1
        device.heard = b""
        CLOCK.sleep_until(CLOCK.monotonic_ns() + EAGER.answer_ns)
        changed = replace(short, stations=(replace(short.stations[0], cfgcnt=5),))
        device.say(encode_config(changed) + data_frame(full, 3 * 10**9, value=3))
        ear.until(hears(device, Command.SEND_CFG3))
        assert ear.messages[-1].config == changed, "until the answer comes it is the best there is"
        device.say(encode_config(replace(full, stations=(replace(full.stations[0], cfgcnt=5),))))
        ear.until(hears(device, Command.SEND_CFG3, Command.START_DATA))
        assert ear.messages[-1].config.kind is FrameType.CFG3  # type: ignore[union-attr]


def test_a_silent_server_is_diagnosed_and_tried_again(device: Device) -> None:
    """What a wrong IDCODE looks like: connected, and never an answer."""
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=8", timing=QUICK) as ear:
        ear.until(lambda: device.poll() and LinkKind.UNANSWERED in ear.kinds)
        detail = ear.of(LinkKind.UNANSWERED)[0].detail
        assert "a device answers its own IDCODE only, IDCODE 8 was asked for" in detail
        assert device.commands == [Command.SEND_CFG2] * 3
        device.hang_up()
        ear.until(lambda: device.poll() and ear.kinds.count(LinkKind.CONNECTED) == 2)


def test_an_idcode_not_given_is_learnt(device: Device) -> None:
    """A device that sends unasked shows its IDCODE; without one the commands would go to stream 1."""
    config = stream(33)
    with ears(f"tcp://127.0.0.1:{device.port}") as ear:
        ear.until(hears(device, Command.SEND_CFG2))
        assert decode_command(device.heard[:18]).prefix.idcode == 1
        device.say(data_frame(config, 10**9, value=1))
        ear.until(lambda: device.poll() and len(device.heard) == 36)
        assert device.commands == [Command.SEND_CFG2] * 2
        assert decode_command(device.heard[18:36]).prefix.idcode == 33
        device.say(encode_config(config))
        ear.until(lambda: values(ear.messages) == [1])


def test_another_idcode_on_the_connection_is_not_passed_on(device: Device) -> None:
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7") as ear:
        ear.until(hears(device, Command.SEND_CFG2))
        device.say(encode_config(stream(9)) + encode_config(stream(7)))
        ear.until(lambda: bool(ear.messages))
        assert [message.frame.idcode for message in ear.messages] == [7]
        assert "IDCODE 9" in ear.of(LinkKind.FOREIGN)[0].detail


@pytest.mark.parametrize("reset", [False, True], ids=["fin", "rst"])
def test_a_lost_connection_is_made_again_as_a_new_flow(device: Device, reset: bool) -> None:
    config = stream(7)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7") as ear:
        play(device, ear, config)
        device.say(data_frame(config, 10**9)[:10])  # dies mid-frame
        ear.until(lambda: len(ear.chunks[-1].data) == 10 or ear.receivers.demux.pending == 10)
        device.hang_up(reset=reset)
        ear.until(lambda: LinkKind.LOST in ear.kinds)
        assert ("reset" if reset else "closed") in ear.of(LinkKind.LOST)[0].detail
        play(device, ear, replace(config, data_rate=30))
        assert [message.flow.connection for message in ear.messages] == [0] * 4 + [1] * 4
        assert ear.receivers.demux.tally.skipped_bytes == 10


def test_a_refused_connection_is_told_and_tried_again() -> None:
    device = Device()
    port = device.port
    device.close()
    with ears(f"tcp://127.0.0.1:{port}?idcode=7") as ear:
        ear.until(lambda: LinkKind.FAILED in ear.kinds)
        assert f"tcp://127.0.0.1:{port}?idcode=7: refused: nothing serves this port" in ear.news[0].detail
        device = Device(port)
        play(device, ear, stream(7))
    device.close()


def test_a_host_that_does_not_answer_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A listener whose queue is full drops what knocks, like a firewall."""
    monkeypatch.setattr(link, "CONNECT_NS", 50 * MS)
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        address = full.getsockname()
        knocking = [socket.socket() for _ in range(3)]
        for sock in knocking:
            sock.setblocking(False)
            sock.connect_ex(address)
        with ears(f"tcp://127.0.0.1:{address[1]}?idcode=7") as ear:
            ear.until(lambda: LinkKind.FAILED in ear.kinds)
            assert "no connection within" in ear.news[0].detail
        for sock in knocking:
            sock.close()


@paths
def test_a_closed_udp_port_is_told(native: bool) -> None:
    port = free_udp_port()
    with ears(f"udp+cmd://127.0.0.1:{port}?idcode=7", native=native) as ear:
        ear.until(lambda: LinkKind.FAILED in ear.kinds)
        assert "refused" in ear.of(LinkKind.FAILED)[0].detail


def test_frames_of_another_size_make_it_ask_again(device: Device) -> None:
    old, new = stream(7), stream(7, phasors=3, cfgcnt=1)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", timing=EAGER) as ear:
        play(device, ear, old)
        device.heard = b""
        CLOCK.sleep_until(CLOCK.monotonic_ns() + EAGER.answer_ns)  # requests keep this distance
        device.say(data_frame(new, 10 * 10**9, value=10))
        ear.until(hears(device, Command.SEND_CFG2))
        device.say(encode_config(new))
        ear.until(lambda: values(ear.messages) == [0, 1, 2, 10])
        assert ear.messages[-1].config == new
        assert ear.kinds.count(LinkKind.CONFIGURED) == 2


def test_the_configuration_change_bit_makes_it_ask_again(device: Device) -> None:
    config = stream(7)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", timing=EAGER) as ear:
        play(device, ear, config)
        device.heard = b""
        CLOCK.sleep_until(CLOCK.monotonic_ns() + EAGER.answer_ns)
        device.say(data_frame(config, 10 * 10**9, stat=0x0400))
        ear.until(hears(device, Command.SEND_CFG2))


@pytest.mark.parametrize("port_of", ["own", "shared"])
def test_commands_over_tcp_data_over_udp(device: Device, port_of: str, sender: socket.socket) -> None:
    port, config = free_udp_port(), stream(7)
    urls = [f"tcp+udp://127.0.0.1:{device.port}?idcode=7&data={port}"]
    if port_of == "shared":
        urls.append(f"udp://0.0.0.0:{port}?idcode=8")
    with ears(*urls) as ear:
        ear.until(hears(device, Command.SEND_CFG2))
        device.say(encode_config(config))
        ear.until(hears(device, Command.SEND_CFG2, Command.START_DATA))
        for k in range(3):
            sender.sendto(data_frame(config, k * 10**9, value=k), ("127.0.0.1", port))
        ear.until(lambda: values(ear.messages) == [0, 1, 2])
        assert ear.of(LinkKind.STREAMING)
        assert {message.flow.transport for message in ear.messages} == {"tcp", "udp"}
        assert {ear.receivers.owners(message.flow, 7) for message in ear.messages} == {(0,)}
        changed = replace(config, data_rate=30)  # another meaning, frames of the same size
        device.say(encode_config(changed))
        ear.until(lambda: ear.messages[-1].frame.type is FrameType.CFG2)
        sender.sendto(data_frame(config, 3 * 10**9, value=3), ("127.0.0.1", port))
        ear.until(lambda: values(ear.messages) == [0, 1, 2, 3])
        assert ear.messages[-1].config == changed


def test_equal_endpoints_share_a_connection(device: Device) -> None:
    url = f"tcp://127.0.0.1:{device.port}?idcode=7"
    with ears(url, url) as ear:
        play(device, ear, stream(7))
        assert ear.receivers.owners(ear.messages[0].flow, 7) == (0, 1)
        assert ear.kinds.count(LinkKind.CONNECTED) == 1


def test_a_saved_configuration_needs_no_answer(device: Device) -> None:
    config = stream(7)
    with ears(f"tcp://127.0.0.1:{device.port}?idcode=7", configs=[config]) as ear:
        ear.until(hears(device, Command.SEND_CFG2, Command.START_DATA))
        device.say(data_frame(config, 10**9, value=4))
        ear.until(lambda: values(ear.messages) == [4])


def test_many_connections_in_one_loop() -> None:
    devices = [Device() for _ in range(60)]
    urls = [f"tcp://127.0.0.1:{device.port}?idcode={number + 1}" for number, device in enumerate(devices)]
    with ears(*urls) as ear:
        ear.until(lambda: all(device.poll() and device.commands for device in devices))
        for number, device in enumerate(devices):
            config = stream(number + 1)
            device.say(encode_config(config) + data_frame(config, 10**9, value=number))
        ear.until(lambda: sorted(values(ear.messages)) == list(range(60)))
        for message in ear.messages:
            assert ear.receivers.owners(message.flow, message.frame.idcode) == (message.frame.idcode - 1,)
    for device in devices:
        device.close()


# --- mistakes


RUN_OUT = """
import resource, time
from pmutools.clock import SystemClock
from pmutools.errors import SourceError
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.receiver import Receivers
resource.setrlimit(resource.RLIMIT_NOFILE, (100, {hard}))
began = time.process_time()
try:
    with Receivers([parse_endpoint("udp://127.0.0.1:0?idcode=%d" % (k + 1)) for k in range({count})], SystemClock()):
        print("opened", time.process_time() - began < 1)
except SourceError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them")
def test_thousands_of_sockets_are_opened_as_far_as_the_system_lets_us(way: None) -> None:
    import resource

    def opened(hard: int) -> str:
        command = [sys.executable, "-c", RUN_OUT.format(hard=hard, count=2000)]
        return subprocess.run(command, capture_output=True, text=True, timeout=30, check=True).stdout.strip()

    if resource.getrlimit(resource.RLIMIT_NOFILE)[1] < 5000:
        pytest.skip("this system lets nobody open so many")
    assert opened(5000) == "opened True"
    told = opened(500)
    assert "this process may have 500 files open; raise the limit (ulimit -Hn, LimitNOFILE=)" in told
    assert "\n" not in told


def test_what_tcp_has_counted_is_told_by_endpoint(device: Device) -> None:
    """On loopback nothing is lost; the counts of a connection outlive it."""
    url = f"tcp://127.0.0.1:{device.port}?idcode=7"
    with ears(url, url, "udp://127.0.0.1:0") as ear:
        play(device, ear, stream(7))
        assert ear.receivers.tcp_counts(0) == ear.receivers.tcp_counts(1) == TcpCounts(0, 0)
        link = ear.receivers._links[0]
        link._ended = TcpCounts(3, 4)
        device.hang_up()
        ear.until(lambda: LinkKind.LOST in ear.kinds)
        assert ear.receivers.tcp_counts(0) == TcpCounts(3, 4)
        assert ear.receivers.tcp_counts(2) == TcpCounts()


def test_what_cannot_be_opened_is_told_before_anything_runs() -> None:
    with ears("udp://127.0.0.1:0") as ear:
        address = ear.receivers.local(0)
        assert address is not None
        with pytest.raises(SourceError, match="already in use"), ears("udp://127.0.0.1:0", f"udp://{address}"):
            pass
    with pytest.raises(SourceError, match="unknown host"), ears("tcp://no.such.host.invalid:4712"):
        pass
    with pytest.raises(SettingsError, match="port 0 is nowhere"), ears("tcp://127.0.0.1:0"):
        pass
    with pytest.raises(SettingsError, match="iface"), ears("tcp://127.0.0.1:4712?iface=eth0"):
        pass
