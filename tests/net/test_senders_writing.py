"""The sending front end: how frames are written, streams that fall silent, and departures."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest
from support.clients import CONFIG, MS, START, Server, clients, serving, started
from support.live import CLOCK, data_frame, free_udp_port, stream

from pmutools import linux
from pmutools.c37118 import Command, FrameType, encode_command
from pmutools.c37118.session import Outcome, served
from pmutools.flow import Cut, Hangup, Segmentation
from pmutools.net import outlet as outlet_module
from pmutools.net import tcp
from pmutools.net.cargo import Frames
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.outlet import ServerKind
from pmutools.net.server import Senders

pytestmark = pytest.mark.realtime


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
