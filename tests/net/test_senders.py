"""The sending front end: spontaneous streams, time, and mistakes in what is to be served."""

from __future__ import annotations

import errno
import socket
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise

import pytest
from support.clients import CONFIG, MS, clients, hearing, paths, serving
from support.live import CLOCK, PATIENCE_NS, Ear, data_frame, free_udp_port, stream, values

from pmutools import linux
from pmutools.c37118 import Command, decode_prefix, encode_command
from pmutools.c37118.session import Outcome, served
from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError, SourceError
from pmutools.net.endpoint import Endpoint, Scheme, parse_endpoint
from pmutools.net.receiver import Receivers
from pmutools.net.server import Senders
from pmutools.net.udp import UdpSocket

pytestmark = pytest.mark.realtime


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
