"""What is seen of live streams, and when enough was seen: in virtual time, over real sockets."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest
from support.live import data_frame, free_udp_port, stream
from support.playing import recording

from pmutools.c37118 import StreamConfig, encode_config
from pmutools.clock import VirtualClock
from pmutools.flow import Flow
from pmutools.formats.source import Block, gather
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import NS
from pmutools.tools.survey import LOOK_NS, PATIENCE_NS, Survey, Surveyor, survey


class World:
    """Senders on loopback that are asked every 0.1 s what to send; time passes only while nothing comes."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.port = free_udp_port()
        self.url = f"udp://127.0.0.1:{self.port}"
        self.news: list[LinkEvent] = []
        self._senders: list[tuple[socket.socket, StreamConfig, int, int]] = []
        self._began_ns = self.clock.monotonic_ns()
        self._turns = 0

    def add(self, config: StreamConfig, *, from_s: float = 0, config_s: float | None = None) -> None:
        """A sender: data from ``from_s`` on, its configuration once at ``config_s`` (None: with the first data)."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.connect(("127.0.0.1", self.port))
        config_ns = round((from_s if config_s is None else config_s) * NS)
        self._senders.append((sock, config, round(from_s * NS), config_ns))

    def turn(self) -> bool:
        now_ns = self.clock.monotonic_ns() - self._began_ns
        self.clock.advance(NS // 10)  # else frames would come for ever at one instant
        self._turns += 1
        for number, (sock, config, from_ns, config_ns) in enumerate(self._senders):
            if 0 <= config_ns <= now_ns:
                sock.send(encode_config(config))
                self._senders[number] = (sock, config, from_ns, -1)
            if from_ns <= now_ns:
                sock.send(data_frame(config, self.clock.realtime_ns() - 30_000_000))
        return False

    def survey(self, *urls: str, **options: Any) -> Survey:
        return survey(
            urls or [self.url],
            clock=self.clock,
            tell=self.news.append,
            **{"stop": self.turn} | options,
        )

    @property
    def took_s(self) -> float:
        return (self.clock.monotonic_ns() - self._began_ns) / NS

    def close(self) -> None:
        for sock, *_ in self._senders:
            sock.close()


@pytest.fixture
def world() -> Iterator[World]:
    made = World()
    yield made
    made.close()


def told(found: Survey) -> list[tuple[int, bool]]:
    """(IDCODE, whether data came) of all streams."""
    return [(one.inventory.idcode, one.inventory.frames > 0) for one in found.streams]


def test_it_ends_when_all_streams_have_been_seen_for_a_while(world: World) -> None:
    world.add(stream(2), from_s=1)
    world.add(stream(1), from_s=1.5)
    found = world.survey()
    assert told(found) == [(1, True), (2, True)]
    assert 1.5 + LOOK_NS / NS <= world.took_s < 5
    assert found.endpoints[0].reason == ""
    assert found.streams[0].good.tolist() == [found.streams[0].inventory.frames]
    assert found.streams[0].phasors.tolist() == [1000 * 1e-5 * 100 * (1 - 1j)]
    assert found.listened_ns / NS == pytest.approx(world.took_s, abs=0.3)


def test_a_silent_endpoint_is_waited_for_and_told(world: World) -> None:
    world.add(stream(1))
    silent = f"udp://127.0.0.1:{free_udp_port()}"
    found = world.survey(world.url, silent)
    assert told(found) == [(1, True)]
    assert found.endpoints[1].reason.startswith("nothing has come; is the sender on")
    assert PATIENCE_NS / NS <= world.took_s < PATIENCE_NS / NS + 1
    assert found.to_json()["endpoints"][1] == {
        "url": silent,
        "reason": found.endpoints[1].reason,
        "streams": [],
        "unconfigured": [],
        "foreign": [],
    }


def test_a_refused_endpoint_is_not_waited_for(world: World) -> None:
    world.add(stream(1))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    found = world.survey(world.url, f"tcp://127.0.0.1:{port}")
    assert told(found) == [(1, True)]
    assert found.endpoints[1].reason.startswith("refused: nothing serves this port")
    assert world.took_s < 5


def test_a_configuration_that_comes_late_is_waited_for(world: World) -> None:
    world.add(stream(1))
    world.add(stream(2), config_s=4)
    found = world.survey()
    assert told(found) == [(1, True), (2, True)]
    assert found.endpoints[0].unconfigured == []
    assert 4 + LOOK_NS / NS <= world.took_s < 8
    assert found.skipped == {}


def test_data_whose_configuration_never_comes_are_told(world: World) -> None:
    world.add(stream(1))
    world.add(stream(2), config_s=100)
    found = world.survey()
    assert told(found) == [(1, True)]
    assert found.endpoints[0].unconfigured == [("127.0.0.1", 2)]
    assert list(found.skipped) == ["no-config"]
    assert world.took_s >= PATIENCE_NS / NS


def test_only_data_without_a_configuration(world: World) -> None:
    world.add(stream(2), config_s=100)
    (endpoint,) = world.survey(duration_ns=3 * NS).endpoints
    assert endpoint.streams == []
    assert endpoint.reason.startswith("data came, but no configuration that fits them: held until one comes")
    assert world.took_s == pytest.approx(3, abs=0.3)


def test_a_duration_is_kept(world: World) -> None:
    world.add(stream(1))
    world.survey(duration_ns=20 * NS)
    assert world.took_s == pytest.approx(20, abs=0.3)


def test_a_stream_that_was_not_asked_for_is_named(world: World) -> None:
    world.add(stream(1))
    world.add(stream(2))
    (endpoint,) = world.survey(f"{world.url}?idcode=1").endpoints
    assert [one.inventory.idcode for one in endpoint.streams] == [1]
    assert endpoint.foreign == {2: "127.0.0.1"}
    assert LinkKind.FOREIGN in {event.kind for event in world.news}


def test_each_endpoint_has_its_own(world: World) -> None:
    world.add(stream(1))
    world.add(stream(2))
    found = world.survey(f"{world.url}?idcode=2", world.url)
    assert [[one.inventory.idcode for one in endpoint.streams] for endpoint in found.endpoints] == [[2], [1]]


def test_a_stream_whose_configuration_changes_is_looked_at_anew(world: World) -> None:
    world.add(stream(1))
    world.add(stream(1, phasors=3), from_s=3)
    (one,) = world.survey(duration_ns=5 * NS).streams
    assert len(one.phasors) in (1, 3)
    assert one.inventory.config_changes > 0
    assert len(one.senders) == 2


def test_what_a_device_sends_over_two_connections_is_one_stream() -> None:
    """Its configuration over TCP, its data over UDP, perhaps from another address."""
    config = stream(7)
    surveyor = Surveyor([parse_endpoint("tcp+udp://192.0.2.1:4712?data=4713")], 0)
    tcp, udp = Flow("tcp", "192.0.2.1:4712", "192.0.2.9:5000"), Flow("udp", "192.0.2.2:999", "192.0.2.9:4713")
    surveyor.hear(LinkEvent(LinkKind.NO_CONFIG, "", (0,), "", 7, udp))
    opening, *data = recording(config, 10)
    surveyor.take(opening._replace(flow=tcp), lambda flow, idcode: (0,), 0)
    for block in gather(message._replace(flow=udp) for message in data):
        assert isinstance(block, Block)
        surveyor.take(block, lambda flow, idcode: (0,), 0)
    (one,) = surveyor.endpoints[0].streams
    assert (one.host, list(one.senders), one.inventory.frames) == ("192.0.2.1", ["192.0.2.2:999"], 10)
    assert not surveyor.settled(LOOK_NS - 1)
    assert surveyor.settled(LOOK_NS)


def test_a_connection_that_has_ended_has_told_whose_it_was() -> None:
    surveyor = Surveyor([parse_endpoint("tcp://192.0.2.1:4712")], 0)
    opening, *_ = recording(stream(7), 0)
    surveyor.take(opening, lambda flow, idcode: (), 0)
    assert surveyor.endpoints[0].streams == []
    surveyor.hear(LinkEvent(LinkKind.CONFIGURED, "", (0,), "", 7, opening.flow))
    surveyor.take(opening, lambda flow, idcode: (), 0)
    assert len(surveyor.endpoints[0].streams) == 1


def test_it_stops_when_told_to(world: World) -> None:
    world.add(stream(1))
    found = world.survey(stop=lambda: world.turn() or world.took_s > 1)
    assert told(found) == [(1, True)]
    assert world.took_s < 2
