"""The sending front end: no client harms another, whatever it does."""

from __future__ import annotations

import errno
import socket
import struct
from collections import Counter
from contextlib import ExitStack, suppress

import pytest
from support.clients import CONFIG, MS, START, clients, serving, started
from support.live import CLOCK, data_frame, stream

from pmutools.c37118 import Command, encode_command
from pmutools.c37118.session import Outcome
from pmutools.net import outlet as outlet_module
from pmutools.net import tcp
from pmutools.net.outlet import ServerKind

pytestmark = pytest.mark.realtime


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
