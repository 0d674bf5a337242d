"""Datagrams of many sockets as columns: whole, in order, with senders and stamps; and stamps of every kind."""

from __future__ import annotations

import random
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools import linux
from pmutools.flow import StampSource

if not linux.NATIVE:
    pytest.skip("needs 64-bit Linux", allow_module_level=True)

from pmutools.linux_receive import CONTROLS, SOURCES, ReceiveColumns, stamps
from pmutools.net.sockets import Address, stamp_arrivals, stamp_source, unpack_sockaddr

pytestmark = pytest.mark.realtime
NS = 10**9


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def pair(stack: ExitStack, host: str = "127.0.0.1") -> tuple[socket.socket, socket.socket]:
    """A receiver that stamps, and a sender connected to it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    receiver, sender = (stack.enter_context(socket.socket(family, socket.SOCK_DGRAM)) for _ in range(2))
    receiver.bind((host, 0))
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    assert stamp_arrivals(receiver)
    sender.bind((host, 0))
    sender.connect(receiver.getsockname())
    return receiver, sender


def take(columns: ReceiveColumns, sock: socket.socket, source: int, count: int) -> None:
    end = time.monotonic() + 2
    before = columns.count
    while columns.count < before + count:
        assert time.monotonic() < end
        columns.receive(sock.fileno(), source, columns.call)


def test_rows_keep_order_bytes_senders_and_stamps(stack: ExitStack) -> None:
    rng, columns = random.Random(1), ReceiveColumns(rows=1000, room=256, call=16)
    sockets = [pair(stack, host) for host in ("127.0.0.1", "::1", "127.0.0.2")]
    for receiver, sender in sockets:  # switch stamping on
        sender.send(b"x")
        take(columns, receiver, 0, 1)
    for _ in range(3):  # and the buffers are used again
        columns.clear()
        sent: list[tuple[int, bytes]] = []
        before_ns = time.time_ns()
        for _ in range(30):
            source = rng.randrange(len(sockets))
            frames = [rng.randbytes(rng.choice((0, 1, 60, 256, 257, 9000, 60_000))) for _ in range(rng.randint(1, 20))]
            for frame in frames:
                sockets[source][1].send(frame)
            take(columns, sockets[source][0], source, len(frames))
            sent += [(source, frame) for frame in frames]
        rows = columns.look()
        assert rows.sources.tolist() == [source for source, _ in sent]
        assert [columns.datagram(row) for row in range(columns.count)] == [frame for _, frame in sent]
        assert rows.sizes.tolist() == [len(frame) for _, frame in sent]
        for row, (source, _) in enumerate(sent):
            sock = sockets[source][1]
            size = 28 if sock.family == socket.AF_INET6 else 16
            sender_bytes = rows.senders[row].tobytes()
            assert unpack_sockaddr(sender_bytes[:size]) == Address(sock.family, sock.getsockname())
            assert not any(sender_bytes[size:])
        assert (rows.stamp_sources == SOURCES.index(StampSource.KERNEL)).all()
        assert (rows.arrivals_ns >= before_ns).all()
        assert (np.diff(rows.arrivals_ns) >= 0).all(), "each socket was read before the next was sent to"


def test_what_finds_no_room_waits_in_the_socket(stack: ExitStack) -> None:
    columns = ReceiveColumns(rows=100, room=256, call=16)
    receiver, sender = pair(stack)
    frames = [k.to_bytes(2, "big") for k in range(250)]
    for frame in frames:
        sender.send(frame)
    got: list[bytes] = []
    end = time.monotonic() + 2
    while len(got) < 250 and time.monotonic() < end:
        while columns.receive(receiver.fileno(), 0, 16):
            pass
        assert columns.full or len(got) + columns.count == 250
        got += [columns.datagram(row) for row in range(columns.count)]
        columns.clear()
    assert got == frames


def test_long_datagrams_are_bounded_too(stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pmutools.linux_receive.LARGE_BYTES", 200_000)
    columns = ReceiveColumns(rows=100, room=256, call=4)
    receiver, sender = pair(stack)
    for k in range(12):
        sender.send(bytes((k,)) * 50_000)
    for _ in range(10):
        columns.receive(receiver.fileno(), 0, 4)
    assert columns.full
    assert columns.count == 8, "a call more than what is too much"
    assert [columns.datagram(row)[0] for row in range(8)] == list(range(8))


def test_a_connection_is_read_once_a_call_and_its_end_is_told(stack: ExitStack) -> None:
    server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    client = stack.enter_context(socket.create_connection(server.getsockname()))
    peer = stack.enter_context(server.accept()[0])
    client.setblocking(False)
    stamp_arrivals(client)
    columns = ReceiveColumns(rows=10, room=256, call=4)
    assert columns.receive_stream(client.fileno(), 5) == 0
    sent = random.Random(2).randbytes(1000)
    peer.sendall(sent)
    peer.close()
    got, end = 0, time.monotonic() + 2
    with pytest.raises(BrokenPipeError):
        while time.monotonic() < end:
            got += columns.receive_stream(client.fileno(), 5)
    assert got == columns.count > 0
    assert b"".join(columns.datagram(row) for row in range(got)) == sent
    assert columns.look().sources.tolist() == [5] * got


# --- stamps


def control(kind: int, *times_ns: int, level: int = socket.SOL_SOCKET) -> bytes:
    """A control message as the kernel writes it, in its room."""
    payload = b"".join(struct.pack("@qq", *divmod(time_ns, NS)) for time_ns in times_ns)
    return (struct.pack("@Nii", 16 + len(payload), level, kind) + payload).ljust(linux.CONTROL_ROOM, b"\xee")


def by_columns(messages: list[bytes], asked_ns: int, *, fresh: bool = False) -> list[tuple[int, StampSource]]:
    controls = np.frombuffer(b"".join(messages), CONTROLS)
    lengths = np.array([struct.unpack_from("@N", message)[0] for message in messages], np.uint64)
    count = len(messages)
    arrivals_ns, codes = stamps(controls, lengths, np.full(count, asked_ns), np.full(count, fresh))
    return [(at_ns, SOURCES[code]) for at_ns, code in zip(arrivals_ns.tolist(), codes.tolist(), strict=True)]


KERNEL_NS, CARD_NS, ASKED_NS = 1_700_000_000_123_456_789, 1_700_000_037_123_450_000, 1_700_000_000_200_000_000


@pytest.mark.parametrize(
    ("message", "stamp"),
    [
        (control(linux.SO_TIMESTAMPNS, KERNEL_NS), (KERNEL_NS, StampSource.KERNEL)),
        (control(linux.SO_TIMESTAMPING, KERNEL_NS, 0, 0), (KERNEL_NS, StampSource.KERNEL)),
        (control(linux.SO_TIMESTAMPING, KERNEL_NS, 0, CARD_NS), (CARD_NS, StampSource.HARDWARE)),
        (control(linux.SO_TIMESTAMPING, 0, 0, CARD_NS), (CARD_NS, StampSource.HARDWARE)),
        (control(linux.SO_TIMESTAMPING, 0, 0, 0), None),
        (control(40, KERNEL_NS), None),
        (control(linux.SO_TIMESTAMPNS, KERNEL_NS, level=socket.SOL_IP), None),
        (control(0)[:0].ljust(linux.CONTROL_ROOM, b"\0"), None),
    ],
    ids=["kernel", "card silent", "card", "card alone", "nothing in it", "another kind", "another level", "none"],
)
def test_the_best_stamp_counts(message: bytes, stamp: tuple[int, StampSource] | None) -> None:
    assert by_columns([message], ASKED_NS) == [stamp or (ASKED_NS, StampSource.USER)]
    length, level, kind = struct.unpack_from("@Nii", message)
    one = linux.arrival_stamp(kind, message[16:length]) if length > 16 and level == socket.SOL_SOCKET else None
    assert one == stamp


times = st.integers(0, 2**32) | st.just(0) | st.integers(10**18, 2 * 10**18)


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.builds(lambda ns: control(linux.SO_TIMESTAMPNS, ns), times)
        | st.builds(lambda *ns: control(linux.SO_TIMESTAMPING, *ns), times, times, times)
        | st.builds(lambda kind, ns: control(kind, ns), st.integers(38, 60), times),
        max_size=20,
    ),
    st.booleans(),
)
def test_columns_and_single_control_messages_are_read_alike(messages: list[bytes], fresh: bool) -> None:
    expected = []
    for message in messages:
        length, _, kind = struct.unpack_from("@Nii", message)
        stamp = linux.arrival_stamp(kind, message[16:length])
        if stamp is None:
            expected.append((ASKED_NS, StampSource.USER))
        else:
            expected.append((stamp.ns, stamp_source(stamp, ASKED_NS, settling=fresh)))
    assert by_columns(messages, ASKED_NS, fresh=fresh) == expected


def test_a_stamp_of_the_reading_is_no_stamp_of_the_arrival() -> None:
    """While the kernel switches stamping on, what it has not stamped gets the time at which it is read."""
    early, late = (control(linux.SO_TIMESTAMPNS, ASKED_NS + by_ns) for by_ns in (-1, 1))
    read = [source for _, source in by_columns([early, late], ASKED_NS, fresh=True)]
    assert read == [StampSource.KERNEL, StampSource.USER]
    assert {source for _, source in by_columns([early, late], ASKED_NS)} == {StampSource.KERNEL}


def test_stamps_of_the_card_can_be_asked_for(stack: ExitStack) -> None:
    """Loopback has no card: the kernel's come instead, in the other form."""
    receiver, sender = pair(stack)
    assert stamp_arrivals(receiver, hardware=True)
    columns = ReceiveColumns(rows=10)
    before_ns = time.time_ns()
    sender.send(b"x")
    take(columns, receiver, 0, 1)
    rows = columns.look()
    assert SOURCES[rows.stamp_sources[0]] is StampSource.KERNEL
    assert before_ns <= rows.arrivals_ns[0] <= time.time_ns()
