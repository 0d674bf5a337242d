"""The latch of a trip as a file: what it holds, whatever is found in its place, and a watchdog that is started anew."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from support.dogs import closed, until, watchdog
from support.guarded import TICK_NS, Bench

from dcon.link.beats import Verb, WatchdogState, encode_word
from dcon.link.command import CommandOut, encode
from dcon.watchdog import latch
from dcon.watchdog.codec import Word
from dcon.watchdog.latch import NAME, UNREADABLE, Latch, causes_in, found, keep, text_of
from dcon.watchdog.memory import State, begun
from dcon.watchdog.rules import BIT, CAUSES

CALM = ("--limit", "late_max_ms=1000")
"""A machine that is shared pauses now and then: what is not judged here shall not trip."""
ALL = (1 << len(CAUSES)) - 1


# --- the file ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("causes", [*BIT.values(), ALL, BIT["late"] | 1])
def test_what_is_kept_is_found(causes: int, tmp_path: Path) -> None:
    path = str(tmp_path / NAME)
    assert found(path) == 0
    assert keep(path, causes) == "" and found(path) == causes
    assert os.stat(path).st_mode & 0o777 == 0o600 and os.listdir(tmp_path) == [NAME]
    assert keep(path, 0) == "" and found(path) == 0 and os.listdir(tmp_path) == []
    assert keep(path, 0) == ""


@pytest.mark.parametrize(
    "text",
    [
        *(b"", b"\n", b"{}", b"null", b"5", b"[]", b'["late"]', b"\xff\xfe", b"[" * 4000, b"\0" * 64),
        *(b'{"causes": []}', b'{"causes": "late"}', b'{"causes": 5}', b'{"causes": [5]}', b'{"causes": [["late"]]}'),
        *(b'{"causes": ["late", "nothing"]}', b'{"causes": ["late"', text_of(ALL)[:-3], text_of(ALL) * 9),
    ],
    ids=lambda text: repr(text[:24]),
)
def test_a_file_that_makes_no_sense_is_a_trip(text: bytes, tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(text)
    assert causes_in(text) == found(str(tmp_path / NAME)) == UNREADABLE


def pipe(path: Path) -> None:
    os.mkfifo(path)


def link_to_nothing(path: Path) -> None:
    path.symlink_to(path.parent / "nothing")


def link_to_a_file(path: Path) -> None:
    (path.parent / "other").write_bytes(text_of(1))
    path.symlink_to(path.parent / "other")


@pytest.mark.parametrize("make", [Path.mkdir, pipe, link_to_nothing, link_to_a_file])
def test_what_is_no_file_is_a_trip_too_and_holds_nothing_up(make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / NAME)
    assert found(str(tmp_path / NAME)) == UNREADABLE


def test_a_name_twice_is_one_cause() -> None:
    assert causes_in(b'{"causes": ["udp", "udp"]}') == BIT["udp"]


def test_why_it_cannot_be_written_or_removed(tmp_path: Path) -> None:
    path = tmp_path / "gone" / NAME
    assert keep(str(path), 1) == f"{path}: No such file or directory"
    (tmp_path / NAME).mkdir()
    assert keep(str(tmp_path / NAME), 1) != "" and keep(str(tmp_path / NAME), 0) != ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a file that is always full is Linux's")
def test_on_a_full_disk_a_trip_is_kept_without_its_causes(tmp_path: Path) -> None:
    path = str(tmp_path / NAME)
    os.symlink("/dev/full", path + ".new")
    assert keep(path, 1) == f"{path}: No space left on device"
    assert found(path) == UNREADABLE and os.listdir(tmp_path) == [NAME]
    assert keep(path, 1) == "" and found(path) == 1, "once there is room"


# --- the thread --------------------------------------------------------------------------------------------------


def test_the_newest_counts_and_the_end_waits_for_it(tmp_path: Path) -> None:
    path = str(tmp_path / NAME)
    held = Latch(path, 0)
    for causes in (*range(1, 200), 7):
        held.hold(causes)
    held.close(20)
    assert found(path) == 7
    again = Latch(path, 7)
    again.hold(0)
    again.close(20)
    assert found(path) == 0


def test_what_is_there_already_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / NAME
    path.write_bytes(b"?")
    held = Latch(str(path), UNREADABLE)
    held.hold(UNREADABLE)
    held.close(20)
    assert path.read_bytes() == b"?"


def test_what_cannot_be_written_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latch, "RETRY_S", 0.01)
    path = tmp_path / "later" / NAME
    held = Latch(str(path), 0)
    held.hold(BIT["late"])
    until(lambda: held.trouble)
    path.parent.mkdir()
    until(lambda: not held.trouble)
    assert found(str(path)) == BIT["late"]
    held.close(20)


# --- a watchdog that begins with it ------------------------------------------------------------------------------


def begun_tripped(*names: str) -> Bench:
    bench = Bench()
    bench.memory = begun(bench.now_ns, 0, sum(BIT[name] for name in names), "estop_software" in names)
    return bench


def test_it_stays_tripped_whatever_is_asked_until_a_reset_and_a_new_request() -> None:
    bench = begun_tripped("udp", "late")
    for relays in (False, True, False, True):
        bench.relays = relays
        bench.tick()
        decision = bench.decision
        assert decision is not None and decision.state is State.TRIPPED and not decision.healthy
        assert bench.causes == ("udp", "late") and not (decision.relay_a or decision.relay_b)
    bench.reset()
    assert bench.state is State.OPEN and bench.causes == () and bench.named == ["reset"]
    bench.tick()
    assert bench.state is State.OPEN  # the request is the old one
    bench.relays = False
    bench.tick()
    bench.relays = True
    bench.tick()
    assert bench.state is State.CLOSED


def test_what_comes_later_is_added_and_nothing_is_forgotten() -> None:
    bench = begun_tripped("latch_unreadable")
    bench.tick(after_ns=TICK_NS * 20)
    assert bench.causes == ("late", "latch_unreadable")
    assert bench.memory.latched == BIT["late"] | UNREADABLE


def test_an_emergency_stop_by_word_must_be_released_again() -> None:
    bench = begun_tripped("estop_software")
    assert bench.tick().estop == 6
    bench.reset()
    assert bench.state is State.TRIPPED and bench.named == ["refused"]
    bench.tick(Word("estop_release", "op"), Word("reset", "op"))
    assert bench.state is State.OPEN and bench.decision is not None and bench.decision.estop == 7


# --- as a process ------------------------------------------------------------------------------------------------


def kill(dog: subprocess.Popen[bytes], number: signal.Signals = signal.SIGKILL) -> None:
    dog.send_signal(number)
    dog.wait(timeout=20)


def clear(folder: Path) -> None:
    """What a watchdog that was looked at leaves here."""
    (folder.parent / "watchdog.log").unlink()
    (folder / "status.in").unlink()


@pytest.mark.realtime
def test_a_trip_outlives_the_watchdog_and_a_reset_ends_it(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    path = folder / NAME
    with closed(folder, *CALM) as (dog, _):
        assert dog.event("start")["state"] == "OPEN" and not path.exists()
        dog.send(b"x" * 40)
        dog.event("trip")
        until(path.exists, "no latch is kept")
        until(lambda: "malformed" in json.loads(path.read_bytes())["causes"])
        kill(dog.process)
    for number in (signal.SIGKILL, signal.SIGTERM):  # however it ends, and as often as it likes
        clear(folder)
        with watchdog(folder, *CALM) as dog:
            begun_with = dog.event("start")
            assert begun_with["state"] == "TRIPPED" and "malformed" in begun_with["causes"]
            status = dog.see(lambda status: "malformed" in status.causes)
            assert status.state is WatchdogState.TRIPPED and not (status.relay_a or status.relay_b or status.healthy)
            kill(dog.process, number)
            assert path.exists()
    clear(folder)
    with watchdog(folder, *CALM, "--beats", "", "--limit", "command_timeout_ms=1000") as dog:
        until(lambda: (dog.send(encode_word(Verb.RESET, "op"), command()), dog.listen(), not path.exists())[2])
        dog.event("reset")
        dog.see(lambda status: status.state is WatchdogState.OPEN)
        kill(dog.process)
    clear(folder)
    with watchdog(folder, *CALM) as dog:
        assert dog.event("start")["state"] == "OPEN" and dog.event("start")["causes"] == []


def command() -> bytes:
    """0 V, and no relays."""
    now_ns = time.time_ns()
    return encode(CommandOut(now_ns // 1000 % 2**32, now_ns, 0.0, 0.0, 0))


@pytest.mark.realtime
def test_a_watchdog_that_is_killed_while_its_relays_are_closed_begins_open(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with closed(folder, *CALM) as (dog, _):
        kill(dog.process)
    assert not (folder / NAME).exists()
    clear(folder)
    with watchdog(folder, *CALM) as dog:
        assert dog.event("start")["state"] == "OPEN"


@pytest.mark.realtime
def test_a_latch_that_cannot_be_read_is_a_trip_with_a_cause_of_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    (folder / NAME).write_bytes(b"half a li")
    with watchdog(folder, *CALM) as dog:
        assert dog.event("start")["causes"] == ["latch_unreadable"]
        status = dog.see(lambda status: "latch_unreadable" in status.causes)
        assert status.state is WatchdogState.TRIPPED


@pytest.mark.realtime
def test_a_latch_that_cannot_be_written_is_a_warning_and_trips_all_the_same(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with watchdog(folder, *CALM) as dog:
        (folder / f"{NAME}.new").mkdir()
        dog.send(encode_word(Verb.ESTOP, "op"))
        dog.see(lambda status: status.state is WatchdogState.TRIPPED)
        texts = lambda: [event.get("text") for event in dog.events()]  # noqa: E731
        until(lambda: f"the latch cannot be kept: {folder / NAME}: Is a directory" in texts())
        (folder / f"{NAME}.new").rmdir()
        until(lambda: "the latch is kept again" in texts())
        assert found(str(folder / NAME)) & BIT["estop_software"]


@pytest.mark.realtime
def test_a_log_that_nobody_reads_does_not_keep_the_latch_from_being_written(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    try:
        while True:
            os.write(writer, b"x")
    except BlockingIOError:
        os.set_blocking(writer, True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(folder / "control.in"))
        told.settimeout(20)
        process = subprocess.Popen([sys.executable, "-m", "dcon.watchdog", "--run-dir", str(folder)], stderr=writer)
        try:
            told.recv(64)
            told.sendto(encode_word(Verb.ESTOP, "op"), str(folder / "watchdog.in"))
            until(lambda: found(str(folder / NAME)) & BIT["estop_software"])
        finally:
            process.kill()
            process.wait()
            os.close(reader)
            os.close(writer)
