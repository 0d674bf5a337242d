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
from pmutools.flow import Chunk, Cut, Segmentation, StampSource
from pmutools.net import tcp
from pmutools.net.sockets import Address, listening_socket, resolve
from pmutools.net.tcp import CutOff, TcpClient, TcpListener, TcpPeer

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


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_connection_to_itself_is_refused_and_leaves_the_port_to_a_server(host: str) -> None:
    """The system may give a client the very port that it tries, where nobody listens at it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((host, 0))
        address = Address(family, probe.getsockname())
    client = TcpClient(address, local=address)
    with pytest.raises(ConnectionRefusedError):
        client.finish()
    client.close()
    TcpListener(host, address.port).close()


def test_ipv6_and_ipv4_listen_on_one_port_and_who_cannot_is_told_by_its_name() -> None:
    with listening_socket(resolve("::", 0, datagram=False), 1, "six") as six:
        four = resolve("0.0.0.0", six.getsockname()[1], datagram=False)
        with listening_socket(four, 1, "four"), pytest.raises(SourceError, match=r"^another: already in use"):
            listening_socket(four, 1, "another")


def test_a_local_address_that_is_none_is_told() -> None:
    listener = TcpListener("127.0.0.1", 0)
    with pytest.raises(SourceError, match="does not have that address"):
        TcpClient(listener.address, local=Address(socket.AF_INET, ("192.0.2.123", 0)))
    listener.close()


# --- how a frame is written


MS = 1_000_000


def received(client: TcpClient, count: int) -> bytes:
    """What has come by the time ``count`` bytes have; more, if there is more."""
    got = bytearray()

    def enough() -> bool:
        if (chunk := client.read()) is not None:
            got.extend(chunk.data)
        return len(got) >= count

    wait(enough)
    got.extend(b"" if (chunk := client.read()) is None else chunk.data)
    return bytes(got)


class Witness(socket.socket):
    """A connected socket that notes each send call."""

    def __init__(self, inner: socket.socket) -> None:
        super().__init__(inner.family, inner.type, inner.proto, inner.detach())
        self.calls: list[bytes] = []

    def send(self, data: ReadableBuffer, flags: int = 0, /) -> int:
        self.calls.append(bytes(data))
        return super().send(data, flags)


def witnessed(*, queue_bytes: int = tcp.QUEUE_BYTES) -> tuple[TcpListener, TcpClient, TcpPeer, list[bytes]]:
    listener, client, peer = connected(queue_bytes=queue_bytes)
    peer._sock = witness = Witness(peer._sock)
    return listener, client, peer, witness.calls


def test_a_split_frame_goes_piece_by_piece_and_later_frames_wait_behind_it() -> None:
    listener, client, peer, calls = witnessed()
    first, second, third = FRAMES[:3]
    assert peer.put(first, 0, Segmentation(Cut.SPLIT, 3, 5 * MS))
    assert peer.put(second, MS)
    assert peer.put(third, MS, Segmentation(Cut.SPLIT, 2, 7 * MS))
    assert len(calls) == 1
    assert peer.queued_bytes == 3 * len(first) - len(calls[0])
    assert not peer.blocked
    times = []
    while (due_ns := peer.due_ns) is not None:
        peer.release(due_ns - 1)  # a timer that rings early does no harm
        assert peer.due_ns == due_ns
        peer.release(due_ns)
        times.append(due_ns)
    assert times == [5 * MS, 10 * MS, 17 * MS]
    assert [len(call) for call in calls[:3]] == [8, 9, 9]
    assert calls[3] == second
    assert b"".join(calls) == first + second + third == received(client, 3 * len(first))
    assert len(calls) == 6
    assert not peer.queued_bytes
    assert not peer.stalled(1 << 62)  # time that we let pass is not the client's
    close(listener, client, peer)


def test_pieces_are_no_smaller_than_a_byte() -> None:
    listener, client, peer, calls = witnessed()
    assert peer.put(b"abc", 0, Segmentation(Cut.SPLIT, 1000))
    assert peer.put(b"de", 0, Segmentation(Cut.SPLIT, 0))
    assert calls == [b"a", b"b", b"c", b"de"]
    close(listener, client, peer)


def test_coalesced_frames_share_one_write() -> None:
    listener, client, peer, calls = witnessed()
    three = Segmentation(Cut.COALESCE, 3)
    for frame in FRAMES[:2]:
        assert peer.put(frame, 0, three)
    assert not calls
    assert peer.queued_bytes == 2 * len(FRAMES[0])
    peer.put(FRAMES[2], 0, three)
    assert calls == [b"".join(FRAMES[:3])]
    peer.put(FRAMES[3], 0, three)
    peer.put(FRAMES[4], 0)  # one that may not wait takes those kept along, before it
    assert calls[1:] == FRAMES[3:5]
    peer.put(FRAMES[5], 0, three)
    peer.tidy(tcp.KEPT_NS)
    assert len(calls) == 3
    peer.tidy(tcp.KEPT_NS + 1)
    assert calls[3:] == FRAMES[5:6]
    peer.put(FRAMES[6], 0, three)
    assert received(client, 6 * len(FRAMES[0])) == b"".join(FRAMES[:6])
    peer.close()
    chunks: list[Chunk | None] = []
    wait(lambda: chunks.append(client.read()) or chunks[-1])
    assert chunks[-1] is not None
    assert chunks[-1].data == FRAMES[6]
    with pytest.raises(BrokenPipeError):  # FIN, not RST
        wait(client.read)
    close(listener, client)


def test_frames_kept_are_bounded_by_the_queue() -> None:
    listener, client, peer, calls = witnessed(queue_bytes=4096)
    sent = 0
    while not calls:
        assert peer.put(FRAMES[sent], 0, Segmentation(Cut.COALESCE, 10**9))
        sent += 1
        assert peer.queued_bytes <= 4096
    assert calls == [b"".join(FRAMES[: sent - 1])]
    assert not peer.dropped
    close(listener, client, peer)


def test_a_stall_holds_back_all_that_follows() -> None:
    listener, client, peer, calls = witnessed()
    peer.put(FRAMES[0], 0)
    peer.put(FRAMES[1], 10 * MS, Segmentation(Cut.STALL, gap_ns=50 * MS))
    peer.put(FRAMES[2], 20 * MS)
    peer.put(FRAMES[3], 30 * MS, Segmentation(Cut.COALESCE, 2))
    assert peer.due_ns == 60 * MS
    peer.release(60 * MS)
    assert calls == FRAMES[:3]
    peer.put(FRAMES[4], 70 * MS, Segmentation(Cut.COALESCE, 2))
    assert calls[3:] == [FRAMES[3] + FRAMES[4]]
    close(listener, client, peer)


@pytest.mark.parametrize(("count", "taken"), [(5, 5), (0, len(FRAMES[1]) // 2), (10**6, len(FRAMES[1]))])
def test_a_reset_comes_amid_the_frame(count: int, taken: int) -> None:
    listener, client, peer = connected()
    peer.put(FRAMES[0], 0)
    with pytest.raises(CutOff):
        peer.put(FRAMES[1], 0, Segmentation(Cut.RESET, count))
    assert not peer.put(FRAMES[2], 0)
    peer.close(reset=True)
    got = bytearray()

    def ended() -> bool:
        if (chunk := client.read()) is not None:
            got.extend(chunk.data)
        return False

    with pytest.raises(ConnectionResetError):
        wait(ended)
    assert got == FRAMES[0] + FRAMES[1][:taken]
    close(listener, client)


def test_what_is_planned_obeys_the_bound_of_the_queue() -> None:
    listener, client, peer, _calls = witnessed(queue_bytes=4096)
    peer.put(FRAMES[0], 0, Segmentation(Cut.STALL, gap_ns=MS))
    taken = [frame for frame in FRAMES[1:] if peer.put(frame, 0, Segmentation(Cut.SPLIT, 2))]
    assert peer.dropped == len(FRAMES) - 1 - len(taken) > 0
    assert 4096 - len(FRAMES[0]) < peer.queued_bytes <= 4096
    assert not peer.put(FRAMES[-1], 0, Segmentation(Cut.RESET))  # its bytes find no room; the reset holds
    got = bytearray()

    def cut_off() -> None:
        peer.flush(MS)
        if (chunk := client.read()) is not None:
            got.extend(chunk.data)

    with pytest.raises(CutOff):
        wait(cut_off)
    expected = FRAMES[0] + b"".join(taken)
    got += received(client, len(expected) - len(got))
    assert got == expected
    close(listener, client, peer)


def test_a_slow_client_gets_its_pieces_in_order_and_its_slowness_counts() -> None:
    sock = Scripted(10, 0, 1000, 1000, 1000, 1000)
    peer = TcpPeer(sock, Address(socket.AF_INET, ("192.0.2.1", 1)), Address(socket.AF_INET, ("192.0.2.2", 2)))
    peer.put(b"x" * 30, 0, Segmentation(Cut.SPLIT, 2, MS))
    assert peer.due_ns is None  # five bytes wait for the client, the other piece for them
    assert peer.blocked
    peer.release(2 * MS)
    peer.flush(3 * MS)
    assert sock.takes == [1000] * 4
    assert peer.stalled(tcp.STALL_NS + 1)
    peer.put(b"y", 3 * MS)
    peer.flush(4 * MS)
    assert sock.takes == [1000]  # the rest, the second piece, what came after
    assert not peer.queued_bytes
    peer.close()


def test_any_mixture_of_writes_keeps_the_bytes_in_order() -> None:
    rng = random.Random(11)
    listener, client, peer = connected(queue_bytes=1 << 20)
    now_ns, framer, got, sent = 0, Framer(streaming=True), list[bytes](), list[bytes]()
    cuts = (Cut.SPLIT, Cut.COALESCE, Cut.STALL)
    for k in range(2000):
        now_ns += rng.randrange(2 * MS)
        write = rng.choice([None, None, Segmentation(rng.choice(cuts), rng.randrange(9), rng.randrange(3 * MS))])
        frame = data_frame(CONFIG, k * 10**9, value=k)
        assert peer.put(frame, now_ns, write)
        sent.append(frame)
        if (due_ns := peer.due_ns) is not None and due_ns <= now_ns:
            peer.release(now_ns)
    peer.tidy(now_ns + tcp.KEPT_NS + 1)

    def drained() -> bool:
        nonlocal now_ns
        now_ns += 3 * MS
        peer.flush(now_ns)
        while (chunk := client.read()) is not None:
            for item in framer.feed(chunk.data):
                assert isinstance(item, Frame)
                got.append(item.data)
        return len(got) == len(sent)

    wait(drained, seconds=5)
    assert got == sent
    close(listener, client, peer)
