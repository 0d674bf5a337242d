"""Receiving in bulk gives what receiving one by one gives: the same datagrams go both ways, and nothing may differ."""

from __future__ import annotations

import random
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace

import pytest
from support.live import CLOCK, data_frame, stream

from pmutools import linux
from pmutools.c37118 import Command, StreamConfig, encode_command, encode_config, encode_header
from pmutools.c37118.demux import DataRun, Loss, Message, Tally
from pmutools.clock import SystemClock
from pmutools.flow import Flow, StampSource
from pmutools.net import sorting
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.receiver import Receivers

pytestmark = [pytest.mark.realtime, pytest.mark.skipif(not linux.NATIVE, reason="needs 64-bit Linux")]
PATIENCE_S = 5.0


@dataclass
class Outcome:
    """What came out of a front end, whatever its own port is."""

    receivers: Receivers
    frames: defaultdict[tuple[str, int], list[tuple[bytes, StreamConfig | None]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    """By sender and IDCODE, in order."""
    losses: defaultdict[str, list[tuple[str, int]]] = field(default_factory=lambda: defaultdict(list))
    news: Counter[tuple[LinkKind, int | None]] = field(default_factory=Counter)
    in_runs: int = 0
    """Data frames that came in runs."""
    arrivals_ns: list[int] = field(default_factory=list)

    def add(self, item: Message | Loss | DataRun | LinkEvent) -> None:
        if isinstance(item, LinkEvent):
            self.news[item.kind, item.idcode] += 1
        elif isinstance(item, Loss):
            self.losses[item.flow.source].append((str(item.skipped.reason), item.skipped.nbytes))
        elif isinstance(item, DataRun):
            self.in_runs += len(item.train.arrivals_ns)
            assert item.train.stamp_source is StampSource.KERNEL
            for chunk in item.train.chunks():
                self._add(item.train.flow, chunk.data, item.config, chunk.arrival_ns)
        else:
            self._add(item.flow, item.frame.data, item.config, item.frame.arrival_ns)

    def _add(self, flow: Flow, data: bytes, config: StreamConfig | None, arrival_ns: int | None) -> None:
        self.frames[flow.source, data[4] << 8 | data[5]].append((data, config))
        self.arrivals_ns.append(arrival_ns or 0)

    @property
    def tally(self) -> Tally:
        return self.receivers.demux.tally

    def states(self) -> dict[tuple[str, int], tuple[str, bool] | None]:
        """What the roles know of each stream."""
        routes = self.receivers.routes._routes
        return {
            (flow.source, idcode): (str(route.role.state), route.role.announced) if route is not None else None
            for flow, by_idcode in routes.items()
            for idcode, route in by_idcode.items()
        }


def one_by_one(outcome: Outcome, until: int) -> None:
    """Poll and parse until so many bytes have been taken."""
    receivers, end_s = outcome.receivers, time.monotonic() + PATIENCE_S
    while receivers.demux.tally.fed < until:
        assert time.monotonic() < end_s
        for item in receivers.poll(1_000_000):
            if isinstance(item, LinkEvent):
                outcome.add(item)
            for found in receivers.parse(item):
                outcome.add(found)


def in_bulk(outcome: Outcome, until: int) -> None:
    """The same by soaking, all in one round unless the datagrams come late."""
    receivers, end_s = outcome.receivers, time.monotonic() + PATIENCE_S
    while receivers.demux.tally.fed < until:
        assert time.monotonic() < end_s
        receivers.soak(0)
        for item in receivers.collect():
            outcome.add(item)


class FrozenClock(SystemClock):
    """No timer runs out: what both ways tell depends on what came alone, not on how long it took."""

    def monotonic_ns(self) -> int:
        return 0


@contextmanager
def both(*queries: str) -> Iterator[tuple[Outcome, Outcome]]:
    """Two front ends on ports of their own, with the same endpoints but for the port."""
    with ExitStack() as stack:
        outcomes = []
        for _ in range(2):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("0.0.0.0", 0))
                port = probe.getsockname()[1]
            endpoints = [parse_endpoint(f"udp://0.0.0.0:{port}{query}") for query in queries]
            outcomes.append(Outcome(stack.enter_context(Receivers(endpoints, FrozenClock()))))
        one_by_one(outcomes[0], 0)
        outcomes[1].receivers.soak(0)  # from here on in bulk
        yield outcomes[0], outcomes[1]


class World:
    """Senders and streams with a life of their own: what comes next is drawn."""

    def __init__(self, rng: random.Random, senders: int) -> None:
        self.rng = rng
        self.senders = senders
        self.configs = [
            {idcode: self._config(idcode) for idcode in rng.sample(range(1, 7), rng.randint(1, 4))}
            for _ in range(senders)
        ]
        self.time_ns = 10**18
        self.stats: Counter[tuple[int, int]] = Counter()

    def _config(self, idcode: int) -> StreamConfig:
        phasors = self.rng.choice((1, 1, 1, 2, 400))  # the last one's frames are longer than a row
        config = stream(idcode, phasors=phasors, cfgcnt=self.rng.randint(0, 3))
        return replace(config, data_rate=self.rng.choice((50, 60)))

    def next(self) -> tuple[int, bytes]:
        """A sender and its datagram."""
        sender = self.rng.randrange(self.senders)
        configs, kind = self.configs[sender], self.rng.random()
        idcode = self.rng.choice(list(configs))
        if kind < 0.80:
            return sender, self._data(sender, idcode)
        if kind < 0.84:
            return sender, encode_config(configs[idcode])
        if kind < 0.86:  # another one: of other size, or of the same
            configs[idcode] = self._config(idcode)
            return sender, encode_config(configs[idcode])
        if kind < 0.88:
            return sender, b"".join(self._data(sender, self.rng.choice(list(configs))) for _ in range(2))
        if kind < 0.90:
            return sender, encode_config(configs[idcode]) + self._data(sender, idcode)
        if kind < 0.92:
            return sender, self._broken(self._data(sender, idcode))
        if kind < 0.94:  # a frame hidden in one whose CHK is wrong
            inner = self._data(sender, self.rng.choice(list(configs)))
            outer = self._data(sender, idcode)[:6] + inner + b"\0\0"
            return sender, outer[:2] + len(outer).to_bytes(2, "big") + outer[4:]
        if kind < 0.95:
            self.stats[sender, idcode] ^= 0x0400
            return sender, self._data(sender, idcode)
        odd = (
            b"",
            b"\xaa",
            self.rng.randbytes(self.rng.randint(1, 80)),
            self.rng.randbytes(5000),
            encode_command(idcode, Command.START_DATA, soc=1),
            encode_header(idcode, "a header"),
            data_frame(stream(77), self.time_ns),  # nobody has described it
            encode_config(stream(88)),
            data_frame(stream(88), self.time_ns),
        )
        return sender, self.rng.choice(odd)

    def _data(self, sender: int, idcode: int) -> bytes:
        self.time_ns += 20_000_000
        value, stat = self.rng.randint(-999, 999), self.stats[sender, idcode]
        return data_frame(self.configs[sender][idcode], self.time_ns, stat=stat, value=value)

    def _broken(self, frame: bytes) -> bytes:
        at = self.rng.randrange(len(frame))
        return frame[:at] + bytes((frame[at] ^ 1 << self.rng.randrange(8),)) + frame[at + 1 :]


@pytest.mark.parametrize("seed", range(40))
def test_the_same_comes_out_whichever_way_it_is_received(seed: int) -> None:
    rng = random.Random(seed)
    queries = rng.choice((("",), ("?idcode=1", "?idcode=2", "?idcode=3"), ("?source=127.0.0.2", "?idcode=4")))
    sources = rng.choice((("127.0.0.1",), ("127.0.0.1", "127.0.0.1"), ("127.0.0.1", "127.0.0.2", "127.0.0.2")))
    world = World(rng, len(sources))
    with both(*queries) as (plain, bulk), ExitStack() as stack:
        socks = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in sources]
        for sock, host in zip(socks, sources, strict=True):
            sock.bind((host, 0))
        ports = [outcome.receivers.local(0) for outcome in (plain, bulk)]
        fed = 0
        for _ in range(12):
            for _ in range(rng.choice((1, 10, 60))):
                sender, datagram = world.next()
                for port in ports:
                    assert port is not None
                    socks[sender].sendto(datagram, ("127.0.0.1", port.port))
                fed += len(datagram)
            one_by_one(plain, fed)
            in_bulk(bulk, fed)
        for outcome in (plain, bulk):
            for found in outcome.receivers.finish():
                outcome.add(found)
        for outcome, late in ((plain, plain.receivers.poll(0)), (bulk, bulk.receivers.collect())):
            for event in late:  # news that parsing has made
                assert isinstance(event, LinkEvent)
                outcome.add(event)
    assert plain.in_runs == 0
    assert bulk.frames == plain.frames
    assert bulk.losses == plain.losses
    assert bulk.tally == plain.tally
    assert bulk.receivers.unwanted == plain.receivers.unwanted
    assert bulk.news == plain.news
    assert bulk.states() == plain.states()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_most_frames_go_the_short_way(host: str) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    endpoint = parse_endpoint(f"udp://{f'[{host}]' if ':' in host else host}:0")
    with Receivers([endpoint], CLOCK) as receivers, socket.socket(family, socket.SOCK_DGRAM) as sock:
        outcome, sent = Outcome(receivers), 0
        address = receivers.local(0)
        assert address is not None

        def send(datagram: bytes) -> None:
            nonlocal sent
            sock.sendto(datagram, address.sockaddr)
            sent += len(datagram)

        configs = [stream(idcode, phasors=1 + idcode % 3) for idcode in range(1, 101)]
        for config in configs:
            send(encode_config(config))
            send(data_frame(config, 10**18))
        in_bulk(outcome, sent)
        before_ns = time.time_ns()
        for slot in range(20):
            for config in configs:
                send(data_frame(config, 10**18 + slot * 20_000_000, value=slot))
        in_bulk(outcome, sent)
        assert outcome.in_runs == 2000
        assert all(len(frames) == 22 for frames in outcome.frames.values())
        assert all(before_ns < at_ns < time.time_ns() for at_ns in outcome.arrivals_ns[-2000:])


def test_groups_that_look_alike_by_chance_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if all streams of one size had the same hash."""
    monkeypatch.setattr(sorting, "_FACTORS", sorting._FACTORS * 0)
    with both("") as (plain, bulk), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        ports, sent = [outcome.receivers.local(0) for outcome in (plain, bulk)], 0
        for frames in (
            [encode_config(stream(idcode)) for idcode in (1, 2, 3)],
            [data_frame(stream(idcode), 10**18 + slot) for slot in range(3) for idcode in (1, 2, 3)],
            [data_frame(stream(idcode), 2 * 10**18 + slot) for slot in range(3) for idcode in (1, 2, 3)],
        ):
            for frame in frames:
                for port in ports:
                    assert port is not None
                    sock.sendto(frame, ("127.0.0.1", port.port))
                sent += len(frame)
            one_by_one(plain, sent)
            in_bulk(bulk, sent)
    assert bulk.in_runs == 0
    assert bulk.frames == plain.frames


@pytest.mark.parametrize("seed", range(4))
def test_a_connection_gives_the_same_however_its_bytes_come(seed: int) -> None:
    """Split and merged at random; where a read is a whole frame it goes the short way."""
    rng, config, frames = random.Random(seed), stream(7, phasors=2), list[bytes]()
    for slot in range(400):
        frames.append(data_frame(config, 10**18 + slot * 20_000_000, value=slot))
        if rng.random() < 0.02:
            config = replace(config, data_rate=rng.choice((25, 50)))
            frames.append(encode_config(config))
        if rng.random() < 0.02:
            frames.append(rng.randbytes(30))
    pieces, rest = list[bytes](), b""
    for frame in frames:
        cut = rng.choice((0, 0, 0, 0, rng.randrange(len(frame))))
        pieces.append(rest + frame[: len(frame) - cut])
        rest = frame[len(frame) - cut :]
    pieces.append(rest)
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        endpoint = parse_endpoint(f"tcp://127.0.0.1:{server.getsockname()[1]}?idcode=7")
        plain, bulk = (Outcome(stack.enter_context(Receivers([endpoint], CLOCK))) for _ in range(2))
        bulk.receivers.soak(0)
        clients = [stack.enter_context(server.accept()[0]) for _ in range(2)]
        sent = 0
        for piece in (encode_config(config), *pieces):
            for client in clients:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.sendall(piece)
            sent += len(piece)
            if rng.random() < 0.7:
                one_by_one(plain, sent)
            if rng.random() < 0.7:
                in_bulk_of_a_connection(bulk, sent, collect=rng.random() < 0.3)
        one_by_one(plain, sent)
        in_bulk(bulk, sent)
    assert bulk.frames == plain.frames
    assert bulk.tally == plain.tally, "runs of losses may be cut where reads end"
    assert bulk.in_runs > 20


def in_bulk_of_a_connection(outcome: Outcome, until: int, *, collect: bool) -> None:
    """Read what was sent, and perhaps look at it."""
    receivers, end_s = outcome.receivers, time.monotonic() + PATIENCE_S
    intake = receivers._plumbing.intake
    assert intake is not None
    while receivers.demux.tally.fed + int(intake.columns.look().sizes.sum()) < until:
        assert time.monotonic() < end_s
        receivers.soak(0)
    if collect:
        in_bulk(outcome, until)
