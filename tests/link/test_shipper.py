"""What is kept for the server, and what it is sent: nothing twice, nothing out of order, gaps where they must be."""

from __future__ import annotations

import json
import random
import socket
import time
from pathlib import Path

import pytest
from support.shipped import FakeControl

from dcon.link.bundle import Bundle, Entry, Kind, decode
from dcon.link.paths import SERVER, listen, prepare, release
from dcon.link.shipper import Ring, Shipper

S = 1_000_000_000


def hello(shipper: Shipper, session: int | None, have: int) -> None:
    shipper.told(json.dumps({"session": session, "have": have}).encode())


def shipper(span_s: float = 60, most_bytes: int = 1 << 20) -> Shipper:
    return Shipper(9, [b"head"], Ring(round(span_s * S), most_bytes))


class Wire:
    """Takes what is sent, as long as there is room."""

    def __init__(self, room: int = 1 << 30) -> None:
        self.room = room
        self.calls = 0
        self.got: list[bytes] = []

    def send(self, data: bytes) -> bool:
        self.calls += 1
        if self.room == 0:
            return False
        self.room -= 1
        self.got.append(data)
        return True

    def numbers(self) -> list[int | str]:
        bundles = [decode(data) for data in self.got]
        return ["head" if b is None else b.sequence if b.is_numbered else "config" for b in bundles]


def filled(made: Shipper, count: int, now_ns: int = 0) -> None:
    for number in range(count):
        made.tick(S + number, [Entry("Tick", "", b"x" * 100, 1, 1)], now_ns)


def test_nothing_is_sent_before_the_server_has_spoken() -> None:
    made, wire = shipper(), Wire()
    filled(made, 3)
    assert made.service(wire.send) == 0
    hello(made, None, -1)
    assert made.service(wire.send) == 4 and wire.numbers() == ["head", 0, 1, 2]
    assert made.service(wire.send) == 0


def test_a_server_that_knows_the_session_is_sent_the_rest_and_the_configurations_it_may_lack() -> None:
    made, wire = shipper(), Wire()
    made.config("N1", b"old", 5, 0)
    made.config("N1", b"new", 6, 0)
    filled(made, 3)
    made.config("S1", b"later", 7, 0)
    hello(made, 9, 3)
    made.service(wire.send)
    assert wire.numbers() == ["head", "config", 4, 5]
    config = decode(wire.got[1])
    assert config is not None and config.entries == (Entry("config", "N1", b"new", 6, 6),)


@pytest.mark.parametrize("said", [b"", b"{}", b"[]", b'{"have": "x"}', b'{"ack": 1}', b"\xff", b"[" * 100_000])
def test_words_without_sense_change_nothing(said: bytes) -> None:
    made, wire = shipper(), Wire()
    filled(made, 3)
    made.told(said)
    assert made.service(wire.send) == 0 and len(made.ring) == 3


def test_another_session_at_the_server_is_sent_everything() -> None:
    made, wire = shipper(), Wire()
    filled(made, 2)
    hello(made, 8, 99)
    made.service(wire.send)
    assert wire.numbers() == ["head", 0, 1]


def test_what_fell_out_of_the_ring_leaves_a_gap_and_its_configuration_is_told() -> None:
    made, wire = shipper(span_s=1), Wire()
    made.config("N1", b"c", 5, 0)
    filled(made, 3)
    filled(made, 2, now_ns=2 * S)
    assert made.ring.unsafe_ticks == 5 and made.ring.first == 4
    hello(made, None, -1)
    made.service(wire.send)
    assert wire.numbers() == ["head", "config", 4, 5]


def test_no_more_than_eight_bundles_a_call_and_none_twice() -> None:
    made, wire = shipper(), Wire(room=11)
    filled(made, 30)
    hello(made, None, -1)
    assert made.service(wire.send) == 8 and made.service(wire.send) == 3
    calls = wire.calls
    assert made.service(wire.send) == 0 and wire.calls == calls + 1  # asked once, and left alone
    wire.room = 100
    while made.service(wire.send):
        pass
    assert wire.numbers() == ["head", *range(30)]


def test_an_acknowledgement_frees_and_none_of_what_was_not_sent() -> None:
    made, wire = shipper(), Wire(room=3)
    filled(made, 10)
    hello(made, None, -1)
    made.service(wire.send)
    made.told(b'{"ack": 5}')
    assert len(made.ring) == 10
    made.told(b'{"ack": 1}')
    assert len(made.ring) == 8 and made.ring.first == 2 and made.ring.size == 8 * len(made.ring.at(2) or b"")


def test_ticks_that_nobody_has_acknowledged_are_counted_and_nothing_else() -> None:
    made, wire = shipper(span_s=1, most_bytes=1 << 24), Wire()
    made.config("N1", b"c", 5, 0)
    filled(made, 3)
    made.tick(S, [Entry("PmuFrame", "N1", bytes(50_000), 1, 1)] * 6, 0)
    assert (made.ring.next, made.ring.unsafe_ticks) == (7, 4)
    hello(made, None, -1)
    made.service(wire.send)
    made.told(b'{"ack": 1}')  # a configuration and a tick
    assert made.ring.unsafe_ticks == 3
    filled(made, 2, now_ns=2 * S)
    assert (made.ring.first, made.ring.unsafe_ticks) == (7, 5)  # what fell out, nobody will acknowledge
    made.end(2 * S)
    made.service(wire.send)
    made.told(b'{"ack": 9}')
    assert len(made.ring) == 0 and made.ring.unsafe_ticks == 3
    bundles = [bundle for data in wire.got[1:] if isinstance(bundle := decode(data), Bundle)]
    assert [bundle.tick for bundle in bundles if bundle.is_numbered] == [0, 0, 1, 2, 3, 3, 3, 4, 5, 6]
    assert [bundle.goes_on for bundle in bundles if bundle.tick == 3] == [False, True, True]


def test_a_ring_holds_its_bounds_whatever_comes() -> None:
    rng = random.Random(3)
    ring, now_ns = Ring(5 * S, 10_000), 0
    for number in range(3000):
        now_ns += rng.randrange(S // 50)
        ring.push(bytes(rng.randrange(1, 900)), now_ns)
        if rng.random() < 0.05:
            ring.acknowledge(rng.randrange(number + 1))
        kept = [ring.at(sequence) for sequence in range(ring.first, ring.next)]
        assert None not in kept and sum(map(len, filter(None, kept))) == ring.size <= 10_000
        assert ring.at(ring.first - 1) is None and ring.at(ring.next) is None


def test_random_lives_of_a_connection_deliver_every_bundle_once() -> None:
    rng = random.Random(4)
    for _ in range(40):
        made, have = shipper(), -1
        got: list[int] = []
        for _ in range(200):
            filled(made, rng.randrange(3))
            match rng.randrange(6):
                case 0:
                    made.lost()
                case 1:
                    hello(made, 9 if have >= 0 else None, have)
                case 2:
                    made.told(json.dumps({"ack": rng.randint(-1, have)}).encode())
            wire = Wire(rng.randrange(12))
            made.service(wire.send)
            for number in wire.numbers():
                if isinstance(number, int) and number > have:
                    got.append(number)
                    have = number
        assert got == list(range(len(got)))


def test_a_large_tick_takes_several_bundles() -> None:
    made, wire = shipper(most_bytes=1 << 24), Wire()
    entries = [Entry("PmuFrame", "N1", bytes(50_000), 1, 1)] * 6
    made.tick(S, entries, 0)
    hello(made, None, -1)
    made.service(wire.send)
    bundles = [bundle for data in wire.got[1:] if isinstance(bundle := decode(data), Bundle)]
    assert [bundle.kind for bundle in bundles] == [Kind.MORE, Kind.MORE, Kind.TICK]
    assert [entry for bundle in bundles for entry in bundle.entries] == entries


def test_a_server_that_stands_still_holds_up_nothing(tmp_path: Path) -> None:
    """By counting: while nobody reads, a call sends what the system takes, then tries once and comes back."""
    folder = prepare(tmp_path / "run")
    listener = listen(folder, SERVER)
    control = FakeControl(folder)
    control.tick()
    peer, _ = listener.accept()
    peer.send(b'{"session": null, "have": -1}')
    sent: list[int] = []
    for _ in range(400):
        before = control.shipper.sent
        control.tick()
        sent.append(control.shipper.sent - before)
    assert max(sent) <= 8 and sent[-100:] == [0] * 100 and control.shipping.is_connected
    assert control.shipper.behind > 200
    peer.setblocking(False)
    got = []
    for _ in range(300):
        try:
            while True:
                got.append(decode(peer.recv(1 << 18)))
        except BlockingIOError:
            control.shipping.service(time.monotonic_ns())
    numbered = [bundle.sequence for bundle in got if bundle is not None and bundle.is_numbered]
    assert numbered == list(range(control.shipper.ring.next)) and control.shipper.behind == 0
    peer.close()
    release(listener)


def test_no_server_and_one_that_hangs_up(tmp_path: Path) -> None:
    folder = prepare(tmp_path / "run")
    control = FakeControl(folder)
    for _ in range(5):
        control.tick()
    assert not control.shipping.is_connected and control.shipper.behind == control.shipper.ring.next
    listener = listen(folder, SERVER)
    control.until(lambda: control.shipping.is_connected, "not connected")
    peer, _ = listener.accept()
    peer.close()
    control.until(lambda: not control.shipping.is_connected, "the end was not seen")
    with pytest.raises(BlockingIOError):
        listener.accept()
    control.shipping.close()
    release(listener)
    assert not (folder / SERVER).exists() and isinstance(listener, socket.socket)
