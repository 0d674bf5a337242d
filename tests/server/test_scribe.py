"""A disk that hangs or is full: the log waits or counts, and nobody else does."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.disk import full_disk
from support.shipped import INI, FakeControl, eventually, free_port, recorder_in, same_ticks, tick_at

from dcon.household.ear import Ear
from dcon.link import paths
from dcon.link.bundle import Bundle, Kind, decode
from dcon.link.notify import Notifier
from dcon.link.paths import bind_datagram, prepare
from dcon.sections import Log
from dcon.server import scribe, server
from dcon.server.client import Client
from dcon.server.recorder import Recorder, Report
from dcon.server.scribe import Scribe
from dcon.server.server import Server
from dcon.session.reader import SessionReader
from dcon.settings import parse

BUNDLE = Bundle(Kind.TICK, 0, 7, tick_at(0).record.tick_ns)


class Stuck(Recorder):
    """A disk that takes nothing until ``free`` is set."""

    free = threading.Event()

    def take(self, bundle: Bundle) -> None:
        self.free.wait()
        super().take(bundle)


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    Stuck.free.clear()
    monkeypatch.setattr(server, "Recorder", Stuck)
    yield Stuck.free
    Stuck.free.set()


def test_a_scribe_takes_at_once_and_says_when_it_is_full(stuck: threading.Event, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    reports: list[Report] = []
    made = Scribe(Stuck(str(tmp_path / "s.mcap"), tmp_path / "run"), reports.append)
    size = scribe.WAITING_BYTES // 10 + 1
    for _ in range(10):
        assert made.has_room
        made.put(BUNDLE, size)
    assert not made.has_room and not made.close(patience_s=0.05)
    eventually(lambda: made.hangs(0.05), "it does not hang")
    stuck.set()
    eventually(lambda: made.waiting == 0 and bool(reports), "it does not go on")


def test_what_fails_in_the_thread_ends_it_not(tmp_path: Path) -> None:
    recorder = recorder_in(tmp_path)
    taken: list[Any] = []

    def take(bundle: Bundle) -> None:
        taken.append(bundle)
        raise RuntimeError("once")

    recorder.take = take  # type: ignore[method-assign]
    made = Scribe(recorder, lambda report: None)
    made.put(BUNDLE, 1)
    made.put(BUNDLE, 1)
    eventually(lambda: len(taken) == 2 and made.waiting == 0, "it ended")
    assert made.close()


@pytest.mark.realtime
def test_operators_are_served_while_the_disk_hangs(
    stuck: threading.Event, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "SILENT_S", 0.3)
    folder = prepare(tmp_path / "run")
    control_in = bind_datagram(folder, paths.CONTROL)
    settings = parse(f"{INI}[server]\nlisten = 127.0.0.1:{free_port()}\n", "test")
    ear = Ear(folder, "server")
    log = Log(path=str(tmp_path / "session.mcap"))
    made = Server(replace(settings, log=log), folder, notifier=Notifier({"NOTIFY_SOCKET": ear.path}))
    thread = threading.Thread(target=made.run)
    thread.start()
    control = FakeControl(folder)
    for _ in range(50):
        control.tick()

    def looked() -> dict[str, Any]:
        time.sleep(0.1)
        with Client(settings.server.listen) as client:
            return client.ask({"ask": "status"})

    try:
        control.until(lambda: looked()["log"]["hangs"], "the disk does not hang")
        control.until(lambda: looked()["tick_ns"] == tick_at(49).record.tick_ns, "the status stands still")
        assert len(control.shipper.ring) == 54  # all is kept: nothing was acknowledged
        with suppress(BlockingIOError):
            while True:
                control_in.recv(4096)
        ear.listen(0.0)
        time.sleep(1.1)
        ear.listen(1.1)
        assert ear.silent_s == 0.0  # who looks after it does not kill it: operators are served
        with pytest.raises(BlockingIOError):  # the controller is told by silence: nothing is recorded
            control_in.recv(4096)
        stuck.set()
        control.settled()
        control.until(lambda: not looked()["log"]["hangs"], "the disk hangs on")
    finally:
        stuck.set()
        made.stopping = True
        thread.join()
        control_in.close()
        ear.close()
    same_ticks(SessionReader(tmp_path / "session.mcap"), range(50))


def test_a_full_disk_counts_and_goes_on_where_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "run").mkdir()
    disk = full_disk(tmp_path / "logs", monkeypatch)
    recorder = Recorder(str(tmp_path / "logs" / "session.mcap"), tmp_path / "run")
    control = FakeControl(tmp_path / "run")

    def move(ticks: int) -> Report:
        for _ in range(ticks):
            control.tick()
            control.shipper.service(take)
        report = recorder.flush()
        control.shipper.told(json.dumps({"ack": report.have}).encode())
        return report

    def take(data: bytes) -> bool:
        bundle = decode(data)
        assert bundle is not None
        recorder.take(bundle)
        return True

    control.shipper.told(b'{"session": null, "have": -1}')
    assert move(60).unlogged == 0
    disk.capacity = disk.used
    report = move(60)
    assert report.refused and report.unlogged == 60 and report.have == 123  # it is dealt with: counted
    disk.capacity = float("inf")
    report = move(700)
    recorder.close()
    reader = SessionReader(tmp_path / "logs" / "session.mcap")
    assert not report.refused and 60 < report.unlogged < 760
    same_ticks(reader, [*range(60), *range(60 + report.unlogged, 820)])
    (event,) = [event for tick in reader.ticks() for event in tick.record.events]
    assert event.detail == f"{report.unlogged} ticks were not logged: No space left on device"
