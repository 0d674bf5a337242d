"""The player and its clients over real sockets: each has its own start and stop, and none delays another."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from support.chain import EarlyClock, playing
from support.frames import command_frame
from support.playing import MS, START_NS, number, recording, reel_of, stream
from support.recordings import FLOW

from pmutools.c37118 import (
    Format,
    Frame,
    Framer,
    FrameType,
    Message,
    PhasorChannel,
    Prefix,
    Station,
    StreamConfig,
    decode_config,
    encode_data,
)
from pmutools.c37118.frames import wire_values
from pmutools.flow import StampSource
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import from_ns
from pmutools.tools.player.cast import as_recorded
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.play import Options, Player

pytestmark = pytest.mark.realtime

STOP, START, CFG2 = 1, 2, 5
PATIENCE_S = 5.0


class Client:
    """A TCP client that says what it is told to, and keeps what it hears."""

    def __init__(self, port: int, rcvbuf: int | None = None, idcode: int = 7) -> None:
        self.socket = socket.socket()
        if rcvbuf is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, rcvbuf)
        self.socket.settimeout(PATIENCE_S)
        self.socket.connect(("127.0.0.1", port))
        self.idcode = idcode
        self.frames: list[Frame] = []
        self._framer = Framer(streaming=True)

    def say(self, code: int) -> None:
        self.socket.sendall(command_frame(self.idcode, code))

    def hear(self, seconds: float) -> None:
        """Read for a while, or until the end of the connection."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.socket.settimeout(left)
            try:
                data = self.socket.recv(1 << 16)
            except TimeoutError:
                return
            if not data:
                return
            self.frames += [item for item in self._framer.feed(data) if isinstance(item, Frame)]

    def hear_until(self, count: int) -> None:
        end = time.monotonic() + PATIENCE_S
        while len(self.frames) < count and time.monotonic() < end:
            self.hear(0.02)
        assert len(self.frames) >= count

    @property
    def numbers(self) -> list[int]:
        return [number(frame.data) for frame in self.frames if frame.type is FrameType.DATA]

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


@contextmanager
def serving(messages: list[Message], ledger: Path | None = None, **options: Any) -> Iterator[tuple[Player, int]]:
    """A player that listens on a TCP port of loopback; told to stop when left."""
    reel = reel_of(messages)
    over = threading.Event()
    chosen = Options(listen=[parse_endpoint("tcp://127.0.0.1:0")], **options)
    player = Player(as_recorded(reel), chosen, EarlyClock(reel.first_due_ns), stop=over.is_set)
    address = player.senders.local(0)
    assert address is not None
    rows = LedgerWriter(ledger) if ledger else None
    with playing(player, over, rows):
        yield player, address.port
        over.set()


def test_each_client_has_its_own_start_and_stop() -> None:
    with serving(recording(stream(), 5000), speed=Fraction(4)) as (_, port), Client(port) as one, Client(port) as two:
        one.say(CFG2)
        one.hear_until(1)
        assert one.frames[0].type is FrameType.CFG2
        two.say(CFG2)
        two.hear_until(1)
        one.say(START)
        one.hear_until(20)
        assert [frame.type for frame in two.frames] == [FrameType.CFG2], "nobody asked for its data"
        two.say(START)
        two.hear_until(20)
        one.say(STOP)
        one.hear(0.3)
        stopped = len(one.frames)
        one.hear(0.2)
        assert len(one.frames) == stopped
        before = len(two.frames)
        two.hear(0.2)
        assert len(two.frames) > before, "the other one goes on"
        one.say(START)
        one.hear_until(stopped + 10)
    for client in (one, two):
        numbers = client.numbers
        assert numbers == sorted(set(numbers))
    assert one.numbers[0] == 0
    assert two.numbers[0] > 0
    assert one.numbers != [*range(one.numbers[0], one.numbers[-1] + 1)], "what it did not want is missing"
    assert two.numbers == [*range(two.numbers[0], two.numbers[-1] + 1)]


def wide_recording(frames: int) -> list[Message]:
    """A stream of 4 KiB frames."""
    channels = tuple(PhasorChannel(f"V{k}") for k in range(100))
    stations = tuple(Station(f"P{k}", k, Format.PHASOR_FLOAT, channels) for k in range(5))
    config = StreamConfig(7, stations, 50)
    messages = []
    for k in range(frames):
        soc, fracsec = from_ns(START_NS + k * 20 * MS, config.time_base)
        prefix = Prefix(FrameType.DATA.sync, config.frame_size, 7, soc, 0, fracsec)
        data = encode_data(wire_values(config, prefix, [[0, *[1.0] * 200, 0, k]] * 5))
        messages.append(Message(Frame(data, None, StampSource.CAPTURE, 0), FLOW, config))
    return messages


def test_a_slow_client_delays_nobody() -> None:
    """It takes nothing at all, while more goes to it than all buffers between hold."""
    messages = wide_recording(1000)
    with serving(messages, speed=Fraction(20)) as (player, port), Client(port, 4096) as slow, Client(port) as quick:
        slow.say(START)
        quick.say(START)
        quick.hear_until(900)
        quick.hear(0.3)
    assert len(quick.frames) >= 995, "it may have come a few frames after the other one"
    assert {len(frame.data) for frame in quick.frames} == {len(messages[0].frame.data)}
    (result,) = player.results
    assert result.fates == {"sent": 1000}, "one of two took each"
    assert result.late.p99_ns < 100 * MS, "a second would be the slow one's doing"


def test_a_client_that_comes_late_gets_what_is_sent_from_then_on(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    ledger = tmp_path / "ledger.parquet"
    with serving(recording(stream(), 400), ledger, speed=Fraction(4)) as (_, port):
        with Client(port) as first:
            first.say(START)
            first.hear_until(10)
            first.say(STOP)
        time.sleep(0.2)  # while nobody listens
        with Client(port) as second:
            second.say(START)
            second.hear_until(10)
    rows = pq.read_table(ledger).to_pylist()
    fates = [row["fate"] for row in rows]
    assert {"sent", "skipped"} == set(fates)
    skipped = [row["index"] for row in rows if row["fate"] == "skipped"]
    assert skipped[0] >= 10
    assert second.numbers[0] > skipped[0]
    assert all(row["sent_ns"] is None for row in rows if row["fate"] == "skipped")


def test_a_client_is_told_of_another_configuration_before_its_data() -> None:
    plain, renamed = stream(), stream(name="RENAMED", cfgcnt=1)
    flow = recording(plain, 0)[0].flow
    source = recording(plain, 20) + recording(renamed, 200, first_slot=20, flow=flow)
    with serving(source, speed=Fraction(2)) as (_, port), Client(port) as client:
        client.say(CFG2)
        client.say(START)
        client.hear_until(42)
        client.say(CFG2)
        client.hear_until(80)
    kinds = [frame.type for frame in client.frames]
    assert kinds[:42] == [FrameType.CFG2, *[FrameType.DATA] * 20, FrameType.CFG2, *[FrameType.DATA] * 20]
    configs = [decode_config(frame.data)[1] for frame in client.frames if frame.type is FrameType.CFG2]
    assert [config.stations[0].name for config in configs] == ["PMU 7", "RENAMED", "RENAMED"]


def test_the_last_frames_reach_a_client_that_is_behind() -> None:
    """Two seconds' worth of frames wait in queues when the script ends; the player closes after they are taken."""
    with serving(recording(stream(), 500), speed=Fraction(1000)) as (_, port), Client(port) as client:
        client.say(START)
        time.sleep(0.5)
        client.hear_until(500)
    assert client.numbers == [*range(500)]
