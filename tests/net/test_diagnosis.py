"""What looks wrong is told in words, once, and a flood of it does not become a flood of news."""

from __future__ import annotations

import random
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
from support.live import CLOCK, Ear, data_frame, free_udp_port, stream

from pmutools.c37118 import StreamConfig, encode_config
from pmutools.c37118.config import PhasorChannel
from pmutools.c37118.demux import Bounds, Demux, Message
from pmutools.c37118.session import Timing
from pmutools.clock import VirtualClock
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.net import notices, receiver
from pmutools.net.dialogue import LinkEvent, LinkKind, silence
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.notices import Notices
from pmutools.net.receiver import Receivers
from pmutools.timebase import NS

pytestmark = pytest.mark.realtime
MS = 1_000_000


class Bench:
    """Receivers in virtual time, fed with chunks from whoever a test likes."""

    def __init__(self, *queries: str, **options: Any) -> None:
        port = free_udp_port()
        self.clock = VirtualClock(monotonic_ns=10**15)
        endpoints = [parse_endpoint(f"udp://127.0.0.1:{port}{query}") for query in queries]
        self.receivers = Receivers(endpoints, self.clock, **options)
        self.local = f"127.0.0.1:{port}"
        self.news: list[LinkEvent] = []
        self.frames: list[bytes] = []

    def send(self, source: str, *datagrams: bytes) -> None:
        flow = Flow("udp", source, self.local)
        for datagram in datagrams:
            chunk = Chunk(datagram, self.clock.realtime_ns(), flow, StampSource.KERNEL)
            self.frames += [part.frame.data for part in self.receivers.parse(chunk) if hasattr(part, "frame")]

    def wait(self, duration_ns: int) -> None:
        end_ns = self.clock.monotonic_ns() + duration_ns
        while (left_ns := end_ns - self.clock.monotonic_ns()) > 0:
            self.news += [item for item in self.receivers.poll(left_ns) if isinstance(item, LinkEvent)]
        self.news += [item for item in self.receivers.poll(0) if isinstance(item, LinkEvent)]

    def of(self, kind: LinkKind) -> list[LinkEvent]:
        return [event for event in self.news if event.kind is kind]


@contextmanager
def bench(*queries: str, **options: Any) -> Iterator[Bench]:
    found = Bench(*queries or ("",), **options)
    try:
        yield found
    finally:
        found.receivers.close()


def frames(config: StreamConfig, count: int = 1, first: int = 0) -> list[bytes]:
    return [data_frame(config, (first + k) * NS, value=k) for k in range(count)]


# --- duplicate senders


def both_send(found: Bench, config: StreamConfig, seconds: int, *sources: str) -> None:
    for _ in range(seconds * 2):
        for source in sources:
            found.send(source, *frames(config))
        found.wait(NS // 2)


def test_two_senders_of_one_idcode_are_told_once() -> None:
    with bench() as found:
        config = stream(7)
        found.send("10.0.0.1:4713", encode_config(config), *frames(config))
        found.wait(NS)
        found.send("10.0.0.2:4713", encode_config(config))  # its data come later
        found.wait(NS)
        both_send(found, config, 30, "10.0.0.1:4713", "10.0.0.2:4713")
        (told,) = found.of(LinkKind.DUPLICATE)
        assert "IDCODE 7 comes from 10.0.0.1:4713 and from 10.0.0.2:4713" in told.detail
        assert "?source=" in told.detail
        assert (told.owners, told.idcode) == ((0,), 7)
        assert len(found.frames) == 3 + 120, "both are heard all the same"


def test_a_sender_that_was_restarted_is_no_duplicate() -> None:
    with bench() as found:
        config = stream(7)
        found.send("10.0.0.1:5001", encode_config(config))
        both_send(found, config, 3, "10.0.0.1:5001")
        found.send("10.0.0.1:5002", encode_config(config))
        both_send(found, config, 30, "10.0.0.1:5002")
        found.send("10.0.0.1:5003", encode_config(config))
        both_send(found, config, 3, "10.0.0.1:5003")
        assert not found.of(LinkKind.DUPLICATE)


def test_two_senders_that_are_asked_for_apart_are_no_duplicates() -> None:
    with bench("?source=10.0.0.1", "?source=10.0.0.2") as found:
        config = stream(7)
        for source in ("10.0.0.1:4713", "10.0.0.2:4713"):
            found.send(source, encode_config(config))
        both_send(found, config, 10, "10.0.0.1:4713", "10.0.0.2:4713")
        assert not found.of(LinkKind.DUPLICATE)


# --- what is no C37.118


def test_another_protocol_on_the_port_is_told_once_with_its_first_bytes() -> None:
    with bench("?idcode=7", "?idcode=8") as found:
        for _ in range(50):
            found.send("10.0.0.1:514", b"<13>Jan  1 00:00:00 host prog: text")
        found.wait(NS)
        (told,) = found.of(LinkKind.NOISE)
        assert told.owners == (0, 1)
        assert "35 bytes from 10.0.0.1:514 are no C37.118: 3c 31 33 3e 4a" in told.detail
        found.wait(10 * NS)
        assert [event.owners for event in found.of(LinkKind.NOTHING)] == [(0,), (1,)]
        assert all("are no C37.118: 3c 31 33" in event.detail for event in found.of(LinkKind.NOTHING))


def test_damaged_frames_of_a_known_stream_are_no_noise() -> None:
    with bench() as found:
        config = stream(7)
        found.send("10.0.0.1:1", encode_config(config), *frames(config), b"garbage", frames(config)[0][:-1] + b"!")
        found.send("10.0.0.2:1", *frames(stream(8)))  # waits for its configuration
        found.wait(NS)
        assert not found.of(LinkKind.NOISE)
        assert found.receivers.demux.tally.skipped_bytes > 0


def test_another_service_that_answers_over_tcp_is_told() -> None:
    quick = Timing(answer_ns=60 * MS, tries=2)
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = parse_endpoint(f"tcp://127.0.0.1:{server.getsockname()[1]}?idcode=7")
        with Receivers([endpoint], CLOCK, timing=quick) as receivers:
            ear = Ear(receivers)
            client = server.accept()[0]
            client.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")
            ear.until(lambda: bool(ear.of(LinkKind.UNANSWERED)))
            client.close()
    detail = ear.of(LinkKind.UNANSWERED)[0].detail
    assert "what came is no C37.118: 53 53 48 2d 32 2e 30" in detail
    assert "another service's port" in detail


# --- silence


@pytest.mark.parametrize(
    ("multicast", "minutes", "told"),
    [(True, 4.3, True), (True, 2, True), (True, 10, True), (True, 1, False), (True, 30, False), (False, 4.3, False)],
)
def test_a_group_that_falls_silent_after_minutes_is_a_switch_s_doing(
    multicast: bool, minutes: float, told: bool
) -> None:
    detail = silence(multicast, int(minutes * 60 * NS))
    assert ("IGMP querier" in detail) == told


def test_a_multicast_stream_s_silence_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, port = VirtualClock(), free_udp_port()
    with Receivers([parse_endpoint(f"udp://239.192.8.2:{port}?iface=127.0.0.1")], clock) as receivers:
        flow, config = Flow("udp", "10.0.0.1:4713", f"239.192.8.2:{port}"), stream(7)
        news: list[LinkEvent] = []

        def listen(until_ns: int) -> None:
            while clock.monotonic_ns() < until_ns:
                news.extend(
                    item for item in receivers.poll(until_ns - clock.monotonic_ns()) if isinstance(item, LinkEvent)
                )

        receivers.parse(Chunk(encode_config(config), 0, flow))
        for second in range(260):
            receivers.parse(Chunk(data_frame(config, second * NS), 0, flow))
            listen((second + 1) * NS)
        listen(280 * NS)
        (silent,) = [event for event in news if event.kind is LinkKind.SILENT]
        assert "4 minutes after the group was joined" in silent.detail


# --- floods


@pytest.mark.parametrize("only_wanted", [True, False])
def test_a_flood_of_senders_is_told_in_a_few_lines(only_wanted: bool) -> None:
    """Each with frames that are good, each from an address of its own; one PMU sends on, and is heard throughout."""
    config, spoofed = stream(7), encode_config(stream(9))
    with bench("?idcode=7", bounds=Bounds(flows=1000), only_wanted=only_wanted) as found:
        found.send("10.9.9.9:4713", encode_config(config))
        for number in range(4000):
            found.send(f"10.{number >> 8}.{number & 255}.1:4713", spoofed)
            if number % 100 == 0:
                found.send("10.9.9.9:4713", *frames(config, first=number))
        found.wait(NS)
        assert len(found.of(LinkKind.FOREIGN)) == notices.TOLD
        found.wait(120 * NS)
        summary = found.of(LinkKind.FOREIGN)[notices.TOLD :]
        assert len(summary) == 1
        assert f"{4000 - notices.TOLD} more of this kind" in summary[0].detail
        assert found.receivers.unwanted == 4000
        assert len(found.receivers.routes) == 1
        assert len(found.receivers.demux._flows) <= (1 if only_wanted else 1000)
        assert values_of(found) == 40
        assert found.receivers.demux.tally.skipped_bytes == 0, "what is heard is not forgotten"


def test_a_flood_of_senders_that_are_wanted_is_forgotten_when_silent() -> None:
    """The endpoint takes any IDCODE; the flood leaves room for a PMU that comes later."""
    with bench(bounds=Bounds(flows=500)) as found:
        for number in range(3000):
            found.send(f"10.{number >> 8}.{number & 255}.1:4713", *frames(stream(9)))
        found.wait(NS)
        assert len(found.of(LinkKind.NO_CONFIG)) == notices.TOLD
        assert len(found.receivers.routes) <= 500
        found.wait(5 * NS)
        config = stream(7)
        found.send("10.9.9.9:4713", encode_config(config), *frames(config, 3))
        assert values_of(found) == 3


def test_long_configurations_of_ever_more_flows_push_out_those_that_are_silent_and_nobody_who_sends_on() -> None:
    """All in the name of one IDCODE that is asked for; what is kept of them is bounded."""
    config = stream(7)
    (station,) = config.stations
    more = tuple(PhasorChannel(f"P{k}", 0) for k in range(500))
    long = encode_config(replace(config, stations=(replace(station, phasors=station.phasors + more),)))
    with bench("?idcode=7", bounds=Bounds(all_config_bytes=50 * len(long)), only_wanted=True) as found:
        found.send("10.9.9.9:4713", encode_config(config))
        for number in range(1000):
            found.send(f"10.{number >> 8}.{number & 255}.1:4713", long)
            if number % 10 == 0:
                found.send("10.9.9.9:4713", *frames(config, first=number))
            assert found.receivers.demux._config_bytes <= 51 * len(long)
        assert values_of(found) == 100
        assert len(found.receivers.demux._flows) <= 51


def test_of_streams_that_nobody_wants_nothing_is_kept_over_a_connection_either() -> None:
    wanted, other = stream(7), stream(9)
    demux = Demux(wants=lambda flow, idcode: idcode == 7)
    flow = Flow("tcp", "10.0.0.1:4712", "127.0.0.1:5000")
    data = b"".join(
        (*frames(other, 3), encode_config(other), *frames(other, 3), encode_config(wanted), *frames(wanted))
    )
    found = [part for part in demux.feed(Chunk(data, 1, flow, StampSource.KERNEL)) if isinstance(part, Message)]
    assert [(part.frame.idcode, part.config is not None) for part in found] == [*[(9, False)] * 7, *[(7, True)] * 2]
    assert demux.held_frames == 0 and list(demux._flows[flow].configs) == [7]
    assert demux.tally.fed == demux.tally.framed


def test_a_flood_of_garbage_is_told_once() -> None:
    rng = random.Random(1)
    with bench(bounds=Bounds(flows=1000)) as found:
        for number in range(5000):
            found.send(f"10.{number >> 8}.{number & 255}.1:4713", rng.randbytes(rng.randrange(40)))
        found.wait(NS)
        assert len(found.of(LinkKind.NOISE)) == 1
        assert {event.kind for event in found.news} == {LinkKind.BOUND, LinkKind.NOISE}
        assert len(found.receivers.demux._flows) <= 1000
        tally = found.receivers.demux.tally
        assert tally.fed == tally.ignored + found.receivers.demux.pending


def values_of(found: Bench) -> int:
    return sum(frame[1] >> 4 == 0 for frame in found.frames)


def test_news_that_nobody_can_cause_are_never_held_back() -> None:
    told: list[LinkEvent] = []
    notes = Notices(told.append, 0)
    for _ in range(100):
        notes.tell(LinkEvent(LinkKind.LOST, "tcp://h:1", (0,)))
    assert len(told) == 100
    for number in range(100):
        notes.tell(LinkEvent(LinkKind.FOREIGN, f"udp://{number}", (0,), flow=Flow("udp", f"{number}", f"{number % 2}")))
    assert len(told) == 100 + 2 * notices.TOLD, "of each local port"
    notes.sum_up(notices.WINDOW_NS - 1)
    assert len(told) == 100 + 2 * notices.TOLD
    notes.sum_up(notices.WINDOW_NS)
    assert [event.detail.split(",")[0] for event in told[-2:]] == ["30 more of this kind"] * 2
    notes.tell(LinkEvent(LinkKind.FOREIGN, "udp://1", (0,), "again", flow=Flow("udp", "1", "1")))
    assert told[-1].detail == "again"
    notes.sum_up(0, end=True)
    assert told[-1].detail == "again"


def test_nothing_is_told_of_where_something_came(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiver, "NOTHING_NS", NS)
    with bench("?idcode=7", "?idcode=8") as found:
        found.send("10.0.0.1:1", encode_config(stream(8)))
        found.wait(2 * NS)
        assert [event.owners for event in found.of(LinkKind.NOTHING)] == [(0,)]
