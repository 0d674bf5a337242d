"""UDP sockets on the loopback: stamps, order, own drops, multicast, and refusals in words."""

from __future__ import annotations

import errno
import ipaddress
import socket
import sys
import time
from pathlib import Path

import pytest
from support.live import free_udp_port

from pmutools import linux
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Chunk, StampSource
from pmutools.net import udp
from pmutools.net.sockets import explain, resolve
from pmutools.net.udp import UdpSocket, target

pytestmark = pytest.mark.realtime
native_only = pytest.mark.skipif(not linux.NATIVE, reason="needs 64-bit Linux")
paths = pytest.mark.parametrize(
    "native", [pytest.param(True, marks=native_only, id="native"), pytest.param(False, id="portable")]
)
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="loopback multicast as Linux does it")


def read(sock: UdpSocket, count: int, seconds: float = 2.0) -> list[Chunk]:
    """``count`` datagrams, or as many as come in time."""
    chunks: list[Chunk] = []
    end = time.monotonic() + seconds
    while len(chunks) < count and time.monotonic() < end:
        chunks += sock.read()
        time.sleep(0.0002)
    return chunks


@paths
@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_datagrams_arrive_whole_in_order_and_stamped(native: bool, host: str) -> None:
    receiver, sender = UdpSocket(host, 0, native=native), UdpSocket(host, 0, native=native)
    frames = [bytes([k % 251]) * (1 + k % 300) for k in range(500)]
    before_ns = time.time_ns()
    assert sender.send(frames, [target(receiver.address)] * 500) == []
    chunks = read(receiver, 500)
    after_ns = time.time_ns()
    assert [chunk.data for chunk in chunks] == frames
    assert {chunk.flow for chunk in chunks} == {("udp", str(sender.address), str(receiver.address), 0)}
    stamps = [chunk.arrival_ns or 0 for chunk in chunks]
    assert before_ns <= min(stamps)
    assert max(stamps) <= after_ns
    sources = {chunk.stamp_source for chunk in chunks[-100:]}
    assert sources == {StampSource.KERNEL if native else StampSource.USER}
    receiver.close()
    sender.close()


@native_only
def test_kernel_stamps_do_not_depend_on_when_they_are_read() -> None:
    receiver, sender = UdpSocket("127.0.0.1", 0), UdpSocket("127.0.0.1", 0)
    where = [target(receiver.address)]
    sender.send([b"switches stamping on"], where)
    read(receiver, 1)
    sent_ns = []
    for _ in range(3):
        sender.send([b"x"], where)
        sent_ns.append(time.time_ns())
        time.sleep(0.02)
    chunks = read(receiver, 3)
    for chunk, at_ns in zip(chunks, sent_ns, strict=True):
        assert abs((chunk.arrival_ns or 0) - at_ns) < 15_000_000  # read 20 to 60 ms later
    receiver.close()
    sender.close()


@paths
def test_a_flood_of_large_datagrams_has_its_turn_by_bytes(native: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """All come, in order; small ones many at a time."""
    monkeypatch.setattr(udp, "READ_BYTES", 8192)
    receiver, sender = UdpSocket("127.0.0.1", 0, native=native), UdpSocket("127.0.0.1", 0)
    where = target(receiver.address)
    assert sender.send([bytes(4000)] * 12, [where] * 12) == []
    rounds = [receiver.read() for _ in range(12)]
    assert sum(map(len, rounds)) == 12 and max(map(len, rounds)) <= 3
    frames = [bytes([k]) * 20 for k in range(200)]
    assert sender.send(frames, [where] * 200) == []
    rounds = [receiver.read() for _ in range(20)]
    assert [chunk.data for chunks in rounds for chunk in chunks] == frames
    assert max(map(len, rounds)) >= 64
    receiver.close()
    sender.close()


@native_only
def test_own_drops_account_for_every_datagram() -> None:
    receiver, sender = UdpSocket("127.0.0.1", 0, rcvbuf_bytes=4096), UdpSocket("127.0.0.1", 0)
    assert receiver.rcvbuf_bytes < 65536
    assert receiver.own_drops == 0
    assert sender.send([b"x" * 100] * 500, [target(receiver.address)] * 500) == []
    received = len(read(receiver, 500, seconds=0.2))
    assert received < 500
    assert receiver.own_drops == 500 - received
    receiver.close()
    sender.close()


def test_the_receive_buffer_got_is_told() -> None:
    small, big = UdpSocket("127.0.0.1", 0, rcvbuf_bytes=8192), UdpSocket("127.0.0.1", 0)
    assert small.rcvbuf_bytes < big.rcvbuf_bytes
    small.close()
    big.close()


@paths
def test_a_closed_port_shows_on_a_connected_socket_only(native: bool) -> None:
    port = free_udp_port()
    nobody = resolve("127.0.0.1", port, datagram=True)
    loose, bound = UdpSocket("127.0.0.1", 0, native=native), UdpSocket("127.0.0.1", 0, native=native)
    loose.send([b"x"], [target(nobody)])
    assert loose.read() == []
    bound.connect(nobody)
    assert bound.send_connected(b"x")
    with pytest.raises(ConnectionRefusedError):
        for _ in range(200):
            bound.read()
            time.sleep(0.001)
    assert bound.read() == []  # told once; the socket stays usable
    loose.close()
    bound.close()


@paths
def test_a_connected_socket_hears_its_peer_only(native: bool) -> None:
    peer, stranger, ours = (UdpSocket("127.0.0.1", 0, native=native) for _ in range(3))
    ours.connect(peer.address)
    stranger.send([b"no"], [target(ours.address)])
    peer.send([b"yes"], [target(ours.address)])
    assert [chunk.data for chunk in read(ours, 1)] == [b"yes"]
    for sock in (peer, stranger, ours):
        sock.close()


@paths
def test_a_frame_that_cannot_be_sent_is_named(native: bool) -> None:
    receiver, sender = UdpSocket("127.0.0.1", 0, native=native), UdpSocket("127.0.0.1", 0, native=native)
    frames = [b"1", b"x" * 65_530, b"3"]
    assert sender.send(frames, [target(receiver.address)] * 3) == [1]
    assert [chunk.data for chunk in read(receiver, 2)] == [b"1", b"3"]
    receiver.close()
    sender.close()


def test_many_senders_do_not_grow_the_cache_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "_FLOWS", 8)
    receiver = UdpSocket("127.0.0.1", 0)
    seen = set()
    for _ in range(30):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"x", receiver.address.sockaddr)
            (chunk,) = read(receiver, 1)
            seen.add(chunk.flow.source)
    assert len(seen) > 8
    assert len(receiver._flows) <= 8
    receiver.close()


# --- departures


@native_only
@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_each_datagram_is_stamped_as_it_leaves(host: str) -> None:
    receiver, sender = UdpSocket(host, 0), UdpSocket(host, 0, rcvbuf_bytes=4096)
    where = target(receiver.address)
    sender.send([b"before"], [where])
    assert sender.departures() == []
    assert sender.stamp_departures()
    before_ns = time.time_ns()
    sender.send([b"x"] * 3000, [where] * 3000)
    middle_ns = time.time_ns()
    sender.send([b"y"], [where])
    after_ns = time.time_ns()
    left = sender.departures()
    assert [number for number, _ in left] == list(range(3001))
    stamps_ns = [stamp_ns for _, stamp_ns in left]
    assert stamps_ns == sorted(stamps_ns)
    assert before_ns <= stamps_ns[0] <= stamps_ns[2999] <= middle_ns <= stamps_ns[3000] <= after_ns
    assert sender.departures() == []
    arrivals = read(receiver, 3002)
    assert [chunk.stamp_source for chunk in arrivals[-10:]] == [StampSource.KERNEL] * 10
    sender.send([b"back"], [target(sender.address)])
    assert [chunk.stamp_source for chunk in read(sender, 1)] == [StampSource.KERNEL]  # arrivals are stamped as before
    receiver.close()
    sender.close()


@native_only
def test_after_a_failed_send_the_numbers_can_begin_again() -> None:
    receiver, sender = UdpSocket("127.0.0.1", 0), UdpSocket("127.0.0.1", 0)
    sender.restart_departures()  # nothing is stamped: nothing happens
    assert sender.stamp_departures()
    where = target(receiver.address)
    assert sender.send([b"0", b"x" * 70_000, b"1"], [where] * 3) == [1]
    assert len(sender.departures()) == 2
    sender.restart_departures()
    sender.send([b"0", b"1"], [where] * 2)
    assert [number for number, _ in sender.departures()] == [0, 1]
    receiver.close()
    sender.close()


@native_only
def test_errors_that_the_network_reports_are_no_departures() -> None:
    receiver, sender = UdpSocket("127.0.0.1", 0), UdpSocket("127.0.0.1", 0)
    ip_recverr = 11  # Linux's; Python 3.11 has no name for it
    sender._sock.setsockopt(socket.IPPROTO_IP, ip_recverr, 1)  # reports of closed ports go to the same queue
    assert sender.stamp_departures()
    nobody, somebody = target(resolve("127.0.0.1", free_udp_port(), datagram=True)), target(receiver.address)
    reported = 0
    for k in range(20):
        try:
            sender.send([bytes([k])], [nobody if k % 2 else somebody])
        except ConnectionRefusedError:
            reported += 1
    time.sleep(0.01)
    left = sender.departures()
    numbers = [number for number, _ in left]
    assert len(numbers) >= 10
    assert numbers == list(range(len(numbers)))
    now_ns = time.time_ns()
    assert all(0 <= now_ns - stamp_ns < 10**9 for _, stamp_ns in left)
    receiver.close()
    sender.close()


def test_the_portable_path_stamps_no_departures() -> None:
    with UdpSocket("127.0.0.1", 0, native=False) as sock:
        assert not sock.stamp_departures()
        sock.restart_departures()
        sock.send([b"x"], [target(sock.address)])
        assert sock.departures() == []


# --- multicast


def multicast_pair(host: str, iface: str, *, native: bool = linux.NATIVE) -> tuple[UdpSocket, UdpSocket]:
    receiver = UdpSocket(host, free_udp_port(), native=native)
    sender = UdpSocket("127.0.0.1", 0, native=native)
    sender.send_via(iface=iface, ttl=0)
    return receiver, sender


@on_linux
@paths
@pytest.mark.parametrize("iface", ["127.0.0.1", "lo"])
def test_a_group_is_heard_on_the_interface_that_joined(native: bool, iface: str) -> None:
    receiver, sender = multicast_pair("239.192.7.1", iface, native=native)
    where = [target(resolve("239.192.7.1", receiver.address.port, datagram=True))]
    sender.send([b"before"], where)
    time.sleep(0.01)
    assert receiver.read() == []
    receiver.join("239.192.7.1", iface=iface)
    sender.send([b"after"], where)
    assert [chunk.data for chunk in read(receiver, 1)] == [b"after"]
    receiver.close()
    sender.close()


@on_linux
def test_what_others_joined_is_not_heard() -> None:
    """By default Linux delivers to a socket its group on whatever interface any socket of the machine has joined."""
    ours, sender = multicast_pair("239.192.7.1", "127.0.0.1")
    other = UdpSocket("239.192.7.1", ours.address.port)
    other.join("239.192.7.1", iface="127.0.0.1")
    sender.send([b"x"], [target(resolve("239.192.7.1", ours.address.port, datagram=True))])
    assert [chunk.data for chunk in read(other, 1)] == [b"x"]
    assert ours.read() == []
    for sock in (ours, other, sender):
        sock.close()


@on_linux
def test_source_specific_multicast_hears_one_source() -> None:
    receiver, sender = multicast_pair("232.7.7.7", "127.0.0.1")
    stranger = UdpSocket("127.0.0.2", 0)
    stranger.send_via(iface="127.0.0.1")
    receiver.join("232.7.7.7", iface="127.0.0.1", source="127.0.0.1")
    where = [target(resolve("232.7.7.7", receiver.address.port, datagram=True))]
    stranger.send([b"no"], where)
    sender.send([b"yes"], where)
    assert [chunk.data for chunk in read(receiver, 2, seconds=0.1)] == [b"yes"]
    for sock in (receiver, sender, stranger):
        sock.close()


@on_linux
@pytest.mark.parametrize("source", [None, "2001:db8::1"])
def test_ipv6_groups_are_joined_on_their_interface(source: str | None) -> None:
    """The loopback carries no IPv6 multicast, so the kernel's own list of memberships is the witness."""
    receiver = UdpSocket("ff12::7:1%lo", free_udp_port())
    receiver.join("ff12::7:1%lo", source=source)
    receiver.send_via(iface="lo", ttl=1)
    group = f"lo {ipaddress.IPv6Address('ff12::7:1').packed.hex()}"
    members = [" ".join(line.split()[1:3]) for line in Path("/proc/net/igmp6").read_text().splitlines()]
    assert group in members
    if source is not None:
        filters = [" ".join(line.split()[1:4]) for line in Path("/proc/net/mcfilter6").read_text().splitlines()]
        assert f"{group} {ipaddress.IPv6Address(source).packed.hex()}" in [f.replace("0x", "") for f in filters]
    receiver.close()


# --- mistakes


def test_a_port_in_use_is_told_with_a_remedy() -> None:
    first = UdpSocket("127.0.0.1", 0)
    with pytest.raises(SourceError, match=rf"udp://127.0.0.1:{first.address.port}: already in use; stop the other"):
        UdpSocket("127.0.0.1", first.address.port)
    first.close()


@pytest.mark.parametrize(
    ("host", "says"),
    [
        ("192.0.2.123", "does not have that address"),
        ("no.such.host.invalid", "unknown host"),
        ("a" * 70, "unknown host"),
    ],
)
def test_addresses_that_cannot_be_bound(host: str, says: str) -> None:
    with pytest.raises(SourceError, match=says) as caught:
        UdpSocket(host, 4713)
    assert host in str(caught.value)


@on_linux
def test_interfaces_and_sources_that_are_none() -> None:
    sock = UdpSocket("239.192.7.1", 0)
    with pytest.raises(SettingsError, match="iface=nosuch0: neither an address nor an interface"):
        sock.join("239.192.7.1", iface="nosuch0")
    with pytest.raises(SettingsError, match="iface=nosuch0"):
        sock.send_via(iface="nosuch0")
    with pytest.raises(SettingsError, match="by its address"):
        sock.join("239.192.7.1", iface="lo", source="127.0.0.1")
    with pytest.raises(SourceError, match=r"multicast group 239.192.7.1 on 192.0.2.99"):
        sock.join("239.192.7.1", iface="192.0.2.99")
    sock.close()
    with pytest.raises(SourceError, match="needs its interface"):
        UdpSocket("ff02::7", 0)
    sock = UdpSocket("ff05::7", 0)
    with pytest.raises(SettingsError, match="an IPv6 group has IPv6 sources"):
        sock.join("ff05::7", iface="lo", source="127.0.0.1")
    sock.close()


def test_localhost_is_the_same_to_both_ends() -> None:
    assert {resolve("localhost", 1, datagram=datagram).host for datagram in (False, True)} == {"127.0.0.1"}


@pytest.mark.parametrize("code", [errno.EADDRINUSE, errno.ECONNREFUSED, errno.EACCES, errno.EIO])
def test_every_refusal_is_one_line_that_names_the_place(code: int) -> None:
    message = str(explain(OSError(code, "words of the system"), "tcp://h:1"))
    assert message.startswith("tcp://h:1: ")
    assert "\n" not in message
    assert code != errno.EIO or message.endswith("words of the system")
