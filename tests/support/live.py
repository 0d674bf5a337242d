"""Streams for tests of live endpoints, and a loop that runs both ends of a conversation in one thread."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from pmutools.c37118 import (
    Format,
    FrameType,
    Message,
    PhasorChannel,
    Prefix,
    Station,
    StreamConfig,
    encode_data,
)
from pmutools.c37118.demux import DataRun
from pmutools.c37118.framer import Frame
from pmutools.c37118.frames import wire_values
from pmutools.clock import SystemClock
from pmutools.flow import Chunk, Flow
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.outlet import ServerEvent
from pmutools.net.receiver import Receivers
from pmutools.net.server import Senders
from pmutools.timebase import from_ns

CLOCK = SystemClock()
PATIENCE_NS = 5_000_000_000
"""How long a condition may take to become true before a test fails: far beyond what any of them needs."""


def stream(idcode: int = 7, *, phasors: int = 1, rate: int = 60, cfgcnt: int = 0) -> StreamConfig:
    """A one-station stream of integer phasors."""
    channels = tuple(PhasorChannel(f"V{k}", 100) for k in range(phasors))
    return StreamConfig(idcode, (Station(f"STATION {idcode}", idcode, Format(0), channels, cfgcnt=cfgcnt),), rate)


def data_frame(config: StreamConfig, time_ns: int, *, stat: int = 0, value: int = 0) -> bytes:
    """One data frame of a :func:`stream`, or of one with analogs; ``value`` is its frequency deviation in mHz."""
    soc, fracsec = from_ns(time_ns, config.time_base)
    prefix = Prefix(FrameType.DATA.sync, config.frame_size, config.idcode, soc, 0, fracsec)
    station = config.stations[0]
    values = [stat, *[1000, -1000] * len(station.phasors), value, 0, *[5] * len(station.analogs)]
    return encode_data(wire_values(config, prefix, [values]))


def values(messages: list[Message]) -> list[int]:
    """The frequency deviations, in mHz, of data messages of :func:`stream`."""
    return [
        int.from_bytes(message.frame.data[-6:-4], "big", signed=True)
        for message in messages
        if message.frame.type is FrameType.DATA
    ]


def free_udp_port(host: str = "127.0.0.1") -> int:
    """A UDP port that was free a moment ago."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def free_ports(count: int) -> list[int]:
    """So many different ports of loopback that neither UDP nor TCP had in use a moment ago."""
    found: list[int] = []
    with contextlib.ExitStack() as stack:
        while len(found) < count:
            probe, other = (
                stack.enter_context(socket.socket(socket.AF_INET, kind))
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM)
            )
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
            with contextlib.suppress(OSError):
                other.bind(("127.0.0.1", port))
                found.append(port)
    return found


@dataclass
class Ear:
    """Everything that receivers have given, in order, polled or, where ``soaked``, received in bulk."""

    receivers: Receivers
    soaked: bool = False
    chunks: list[Chunk] = field(default_factory=list)
    news: list[LinkEvent] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)

    def listen(self, timeout_ns: int = 1_000_000) -> None:
        if self.soaked:
            self._soak(timeout_ns)
            return
        for item in self.receivers.poll(timeout_ns):
            if isinstance(item, Chunk):
                self.chunks.append(item)
            else:
                self.news.append(item)
            self.messages += [found for found in self.receivers.parse(item) if isinstance(found, Message)]

    def _soak(self, timeout_ns: int) -> None:
        self.receivers.soak(timeout_ns)
        intake = self.receivers._plumbing.intake
        if intake is not None:
            rows = intake.columns.look()
            self.chunks += [
                Chunk(intake.columns.datagram(row), int(rows.arrivals_ns[row]), Flow("", ""))
                for row in range(len(rows.sizes))
            ]
        else:
            self.chunks += [item for item in self.receivers._out if isinstance(item, Chunk)]
        for item in self.receivers.collect():
            if isinstance(item, LinkEvent):
                self.news.append(item)
            elif isinstance(item, DataRun):
                train, config = item
                for chunk in train.chunks():
                    frame = Frame(chunk.data, chunk.arrival_ns, chunk.stamp_source, 0)
                    self.messages.append(Message(frame, chunk.flow, config))
            elif isinstance(item, Message):
                self.messages.append(item)

    @property
    def kinds(self) -> list[LinkKind]:
        return [event.kind for event in self.news]

    def of(self, kind: LinkKind) -> list[LinkEvent]:
        return [event for event in self.news if event.kind is kind]

    def until(self, condition: Callable[[], bool], senders: Senders | None = None) -> list[ServerEvent]:
        """Run both ends until ``condition`` holds; fails the test if that takes too long."""
        events: list[ServerEvent] = []
        end_ns = CLOCK.monotonic_ns() + PATIENCE_NS
        while not condition():
            if CLOCK.monotonic_ns() > end_ns:
                pytest.fail(f"never came true; client: {self.news}; server: {events}; {len(self.messages)} messages")
            if senders is not None:
                events += senders.poll(0)
            self.listen()
        self.listen(0)  # news that parsing made come with the next poll
        return events
