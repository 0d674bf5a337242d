"""TCP connections on the loopback: stamps, framing, bounded queues, and connections that end badly."""

from __future__ import annotations

import random
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from support.live import data_frame, stream

from pmutools import linux
from pmutools.c37118.framer import Frame, Framer, Skipped
from pmutools.errors import SourceError
from pmutools.flow import Chunk, StampSource
from pmutools.net import tcp
from pmutools.net.sockets import Address
from pmutools.net.tcp import TcpClient, TcpListener, TcpPeer

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

pytestmark = pytest.mark.realtime
CONFIG = stream()
FRAMES = [data_frame(CONFIG, k * 10**9, value=k) for k in range(200)]


def wait(condition: Callable[[], object], seconds: float = 2.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "never came true"
        time.sleep(0.0005)


def connected(*, native: bool = True, queue_bytes: int = tcp.QUEUE_BYTES) -> tuple[TcpListener, TcpClient, TcpPeer]:
    listener = TcpListener("127.0.0.1", 0)
    client = TcpClient(listener.address, native=native)
    peers: list[TcpPeer | None] = []
    wait(lambda: peers.append(listener.accept(queue_bytes)) or peers[-1])
    client.finish()
    assert peers[-1] is not None
    return listener, client, peers[-1]


def close(*ends: TcpListener | TcpClient | TcpPeer) -> None:
    for end in ends:
        end.close()


def read_frames(client: TcpClient, count: int) -> list[Frame]:
    framer, found = Framer(streaming=True), list[Frame | Skipped]()

    def enough() -> bool:
        if (chunk := client.read()) is not None:
            found.extend(framer.feed(chunk.data, chunk.arrival_ns, chunk.stamp_source))
        return len(found) >= count

    wait(enough)
    return [item for item in found if isinstance(item, Frame)]


@pytest.mark.parametrize("native", [True, False])
def test_frames_survive_any_segmentation(native: bool) -> None:
    listener, client, peer = connected(native=native)
    rng = random.Random(7)
    wire = b"".join(FRAMES)
    cuts = sorted(rng.sample(range(1, len(wire)), 300))
    for start, end in zip([0, *cuts], [*cuts, len(wire)], strict=True):
        assert peer.put(wire[start:end], 0)
    frames = read_frames(client, len(FRAMES))
    assert [frame.data for frame in frames] == FRAMES
    close(listener, client, peer)


@pytest.mark.skipif(not linux.NATIVE, reason="kernel stamps")
def test_frames_that_share_a_read_are_marked() -> None:
    """Of three frames in one read, the kernel's stamp is that of the last one's segment."""
    listener, client, peer = connected()
    peer.put(FRAMES[0], 0)
    read_frames(client, 1)  # stamping is on from now at the latest
    time.sleep(0.01)
    for frame in FRAMES[1:4]:
        peer.put(frame, 0)
    sent_ns = time.time_ns()
    time.sleep(0.03)
    batched = read_frames(client, 3)
    peer.put(FRAMES[4] + FRAMES[5][:9], 0)
    (ahead,) = read_frames(client, 1)
    expected = [StampSource.KERNEL_BATCHED, StampSource.KERNEL_BATCHED, StampSource.KERNEL]
    assert [frame.stamp_source for frame in batched] == expected
    assert all(abs((frame.arrival_ns or 0) - sent_ns) < 20_000_000 for frame in batched)  # not when they were read
    assert ahead.stamp_source is StampSource.KERNEL_BATCHED  # part of the next frame came with it
    close(listener, client, peer)


def test_portable_stamps_say_so() -> None:
    listener, client, peer = connected(native=False)
    peer.put(FRAMES[0], 0)
    chunks: list[Chunk | None] = []
    wait(lambda: chunks.append(client.read()) or chunks[-1])
    assert chunks[-1] is not None
    assert chunks[-1].stamp_source is StampSource.USER
    assert abs((chunks[-1].arrival_ns or 0) - time.time_ns()) < 10**9
    close(listener, client, peer)


def test_flows_tell_both_ends_and_the_connection() -> None:
    listener = TcpListener("127.0.0.1", 0)
    client = TcpClient(listener.address, connection=3)
    peers: list[TcpPeer | None] = []
    wait(lambda: peers.append(listener.accept()) or peers[-1])
    client.finish()
    assert peers[-1] is not None
    assert client.flow == ("tcp", str(listener.address), str(peers[-1].address), 3)
    close(listener, client, peers[-1])


def test_a_client_that_does_not_read_loses_frames_whole_and_memory_is_bounded() -> None:
    listener, client, peer = connected(queue_bytes=16_384)
    big = stream(phasors=50)
    sent, put = [], 0
    for k in range(20_000):
        frame = data_frame(big, k * 10**9, value=k % 30_000)
        put += 1
        if peer.put(frame, k):
            sent.append(frame)
        assert peer.queued_bytes <= 16_384
        if peer.dropped > 50:
            break
    assert peer.dropped == put - len(sent) > 50
    framer, got = Framer(streaming=True), list[bytes]()

    def drained() -> bool:
        chunk = client.read()
        if chunk is not None:
            for item in framer.feed(chunk.data):
                assert isinstance(item, Frame)  # a gap, never half a frame
                got.append(item.data)
        peer.flush(0)
        return len(got) == len(sent)

    wait(drained, seconds=5)
    assert got == sent
    assert not peer.queued_bytes
    close(listener, client, peer)


class Scripted(socket.socket):
    """A socket that takes as many bytes, send by send, as its script says."""

    def __init__(self, *takes: int) -> None:
        super().__init__()
        self.takes = list(takes)

    def send(self, data: ReadableBuffer, flags: int = 0, /) -> int:
        if not (take := self.takes.pop(0)):
            raise BlockingIOError
        return min(take, len(memoryview(data)))


def test_a_stall_is_judged_by_progress() -> None:
    sock = Scripted(30, 0, 10, 0, 0, 1000)
    peer = TcpPeer(sock, Address(socket.AF_INET, ("192.0.2.1", 1)), Address(socket.AF_INET, ("192.0.2.2", 2)))
    assert peer.put(b"x" * 100, 0)
    assert peer.queued_bytes == 70
    peer.flush(1000)
    assert not peer.stalled(tcp.STALL_NS)
    assert peer.stalled(tcp.STALL_NS + 1)
    peer.flush(2000)  # ten bytes more
    assert peer.queued_bytes == 60
    assert not peer.stalled(tcp.STALL_NS + 2000)
    assert peer.stalled(tcp.STALL_NS + 2001)
    peer.put(b"y" * 10, 3000)
    assert peer.stalled(tcp.STALL_NS + 2001)  # what is added is no progress
    peer.flush(4000)
    peer.flush(5000)
    assert not peer.queued_bytes
    assert not peer.stalled(10 * tcp.STALL_NS)
    peer.close()


def test_ends_of_connections_are_told_apart() -> None:
    listener, client, peer = connected()
    peer.close()
    with pytest.raises(BrokenPipeError):
        wait(client.read)
    close(listener, client)
    listener, client, peer = connected()
    peer.close(reset=True)
    with pytest.raises(ConnectionResetError):
        wait(client.read)
    close(listener, client)
    listener, client, peer = connected()
    client.close()
    with pytest.raises(BrokenPipeError):
        wait(peer.read)
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        wait(lambda: not peer.put(b"x", 0))
    close(listener, peer)


def test_a_last_command_arrives_although_data_were_left_unread() -> None:
    listener, client, peer = connected()
    peer.put(FRAMES[0], 0)
    time.sleep(0.01)
    assert client.send(b"stop")
    client.close()
    heard: list[bytes] = []
    with pytest.raises(BrokenPipeError):  # FIN, not RST
        wait(lambda: heard.append(peer.read()))
    assert b"".join(heard) == b"stop"
    close(listener, peer)


def test_a_refused_connection_says_so() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = Address(socket.AF_INET, probe.getsockname())
        client = TcpClient(address)
        with pytest.raises(ConnectionRefusedError):
            wait(lambda: client.finish() or client.read())
        client.close()


def test_a_port_in_use_is_told_with_a_remedy() -> None:
    listener = TcpListener("127.0.0.1", 0)
    with pytest.raises(SourceError, match=rf"tcp://127.0.0.1:{listener.address.port}: already in use"):
        TcpListener("127.0.0.1", listener.address.port)
    with pytest.raises(SourceError, match="does not have that address"):
        TcpListener("192.0.2.123", 0)
    listener.close()


def test_a_local_address_that_is_none_is_told() -> None:
    listener = TcpListener("127.0.0.1", 0)
    with pytest.raises(SourceError, match="does not have that address"):
        TcpClient(listener.address, local=Address(socket.AF_INET, ("192.0.2.123", 0)))
    listener.close()
