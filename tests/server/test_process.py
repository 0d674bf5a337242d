"""``dcon server`` as a process: killed, stopped, fed with garbage, restarted. The log is whole to the stated bound."""

from __future__ import annotations

import json
import random
import signal
import socket
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from support.shipped import FakeControl, ServerProcess, eventually, same_ticks

from dcon.link import paths
from dcon.link.paths import bind_datagram, prepare
from dcon.session.reader import SessionReader

pytestmark = pytest.mark.realtime
PERIOD_S = 1 / 240
"""Four times the pace of a controller."""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ServerProcess]:
    made = ServerProcess(tmp_path)
    made.listens()
    yield made
    if made.process.poll() is None:
        made.kill()


def pace(control: FakeControl, seconds: float) -> None:
    """Tick at a steady pace."""
    due = time.monotonic()
    end = due + seconds
    while due < end:
        control.tick()
        due += PERIOD_S
        time.sleep(max(due - time.monotonic(), 0))


def test_kill_9_at_random_instants_loses_nothing(server: ServerProcess) -> None:
    rng = random.Random(1)
    control = FakeControl(server.run_dir)
    for _ in range(6):
        pace(control, rng.uniform(0.05, 0.9))
        server.kill()
        pace(control, rng.uniform(0.0, 0.1))
        server.again()
        server.listens()
    control.shipper.end(time.monotonic_ns())
    control.settled()
    assert server.end() == 0
    reader = SessionReader(server.log)
    same_ticks(reader, range(control.ticks))
    assert not reader.damage and not any(tick.after_loss for tick in reader.ticks())
    assert len(reader.parts) >= 3


def test_when_both_die_at_once_no_more_is_lost_than_a_flush_and_what_was_under_way(server: ServerProcess) -> None:
    """The bound: what came in the last 0.5 s, and what had not come yet."""
    control = FakeControl(server.run_dir)
    control.until(lambda: control.shipping.is_connected, "not connected")
    for seconds in (0.9, 0.4, 0.7):
        pace(control, seconds)
        server.process.send_signal(signal.SIGSTOP)
        logged = sum(1 for _ in SessionReader(server.log).ticks())
        assert control.ticks - logged <= (0.5 + 0.25) / PERIOD_S
        server.process.send_signal(signal.SIGCONT)
    assert logged > 100
    server.kill()
    same_ticks(SessionReader(server.log), range(sum(1 for _ in SessionReader(server.log).ticks())))


def test_a_server_that_stands_still_is_backfilled(server: ServerProcess) -> None:
    control = FakeControl(server.run_dir)
    pace(control, 0.3)
    server.process.send_signal(signal.SIGSTOP)
    refused = 0
    for _ in range(2000):
        before = control.shipper.sent
        control.tick()
        refused += control.shipper.sent == before
    assert refused > 1000 and control.shipping.is_connected  # a call that cannot send tries once, and is back
    server.process.send_signal(signal.SIGCONT)
    control.settled()
    assert server.end() == 0
    same_ticks(SessionReader(server.log), range(control.ticks))


def test_a_new_controller_is_a_new_log(server: ServerProcess) -> None:
    first = FakeControl(server.run_dir, session=1)
    pace(first, 0.2)
    first.settled()
    first.shipping.close()  # as a process that is killed
    second = FakeControl(server.run_dir, session=2)
    pace(second, 0.2)
    second.settled()
    assert server.end() == 0 and "session-2.mcap" in server.said
    same_ticks(SessionReader(server.log), range(first.ticks))
    same_ticks(SessionReader(server.log.with_name("session-2.mcap")), range(second.ticks))


def test_garbage_on_the_controller_s_socket_harms_nothing(server: ServerProcess) -> None:
    control = FakeControl(server.run_dir)
    pace(control, 0.1)
    for garbage in (b"x", b"DCL1" + bytes(24), b"DCL1" + b"\xff" * 200, bytes(100_000)):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
            sock.connect(str(server.run_dir / paths.SERVER))
            sock.send(garbage)
            pace(control, 0.05)
    silent = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(30)]
    for sock in silent:
        sock.connect(str(server.run_dir / paths.SERVER))
        pace(control, 0.01)
    control.settled()
    for sock in silent:
        sock.close()
    assert server.end() == 0
    same_ticks(SessionReader(server.log), range(control.ticks))


def test_the_controller_and_the_watchdog_hear_it(tmp_path: Path) -> None:
    folder = prepare(tmp_path / "run")
    control_in, watchdog_in = (bind_datagram(folder, name) for name in (paths.CONTROL, paths.WATCHDOG))
    server = ServerProcess(tmp_path)
    server.listens()
    control = FakeControl(folder)
    news: list[dict[str, object]] = []
    beats: list[bytes] = []
    began = time.monotonic()

    def hear() -> None:
        for sock, take in ((control_in, lambda d: news.append(json.loads(d))), (watchdog_in, beats.append)):
            with suppress(BlockingIOError):
                take(sock.recv(4096))

    pace(control, 0.1)
    eventually(lambda: len(news) >= 4, "no news", 20, hear)
    took = time.monotonic() - began
    for _ in range(100):
        hear()
    assert 1.4 < took < 10
    assert {item["kind"] for item in news} == {"server"}
    free = news[-1]["disk_free_percent"]
    assert isinstance(free, float) and 0 < free <= 100 and news[-1]["response_gain"] is None
    assert len(beats) >= 10
    counters = []
    for beat in beats:
        assert len(beat) == 32 and beat[:12] == b"DCB1server\0\0" and beat[24] == 1
        assert zlib.crc32(beat[:-4]) == int.from_bytes(beat[-4:], "big")
        counters.append(int.from_bytes(beat[12:16], "big"))
    assert counters == list(range(counters[0], counters[0] + len(beats)))
    assert server.end() == 0
    hear_last = watchdog_in.recv(4096)
    while True:
        try:
            hear_last = watchdog_in.recv(4096)
        except BlockingIOError:
            break
    assert hear_last[24] == 2  # it says that it ends


def test_a_second_server_is_told_whose_folder_it_is(server: ServerProcess, tmp_path: Path) -> None:
    second = ServerProcess(tmp_path)
    assert second.process.wait(20) == 1
    _, said = second.process.communicate()
    assert said.startswith("dcon: ") and "another process that is running has it" in said and said.count("\n") == 1
    assert server.process.poll() is None
