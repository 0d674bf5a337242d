"""The edge of the watchdog, its clock, sockets, files and arguments, with every operator flipped and every constant
changed, as test_watchdog_mutants.py does with its core.

Each scene is a course of a few calls, on a clock, a thread and a system that are the test's own; a mutant that passes
all scenes of its module is either equivalent, and listed with the reason, or a scene is missing.
"""

from __future__ import annotations

import argparse
import importlib
import io
import json
import math
import os
import pkgutil
import socket
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import test_watchdog_mutants as core_trial
from support.guarded import RELEASED
from support.mutation import functions_of, mutants, survivors
from support.standins import T0_NS, UTC_NS, Calls, Instead, Threads, decided, folder, kennel
from test_watchdog_mutants import passes, sealed

import dcon.watchdog
from dcon.link import beats, command
from dcon.watchdog import __main__ as entry
from dcon.watchdog import codec, core, files, latch, limits, links, loop, memory, notify, report, rules, system
from dcon.watchdog.codec import Beat, Malformed
from dcon.watchdog.core import Event, Forward
from dcon.watchdog.files import Lines
from dcon.watchdog.limits import Limits, Rules
from dcon.watchdog.loop import Config
from dcon.watchdog.memory import MS, Contact, Driven, State
from dcon.watchdog.rules import BIT, Finding


def error_of(call: Callable[..., Any], *arguments: Any) -> str:
    """What a call is refused with; "" where it is not."""
    try:
        call(*arguments)
    except (links.Refused, argparse.ArgumentTypeError) as error:
        return str(error)
    return ""


# --- the loop ----------------------------------------------------------------------------------------------------


def it_begins_with_the_latch_that_is_there_and_open_relays() -> None:
    for latched in (0, BIT["late"], BIT["estop_software"], BIT["late"] | BIT["estop_software"]):
        with kennel(latched) as dog:
            sequence = (UTC_NS + T0_NS) // MS % 2**32
            assert dog.it._memory == memory.begun(T0_NS, sequence, latched, bool(latched & BIT["estop_software"]))
            assert dog.it._latch.causes == latched
            assert dog.wires.drive == [(False, False, 0)]


def it_waits_for_the_tick_and_a_millisecond_between_rounds() -> None:
    rounds, timeouts, ended = [], [], []
    waits_ns = [0, MS // 2, MS, 7 * MS, MS - 1, 30 * MS, 0, 9 * MS - 1, 0, 0]
    with kennel() as dog:
        dog.clock.now_ns += 40 * MS

        def poll(timeout_ms: float) -> None:
            timeouts.append(timeout_ms)
            dog.clock.now_ns += waits_ns[len(timeouts) - 1]
            if len(timeouts) == len(waits_ns):
                dog.it.stop(None)

        def turn(tick: bool) -> None:
            rounds.append((dog.clock.now_ns - T0_NS - 40 * MS, tick))
            dog.it._memory = dog.it._memory._replace(now_ns=dog.clock.now_ns)
            dog.clock.now_ns += 15 * MS * (len(rounds) == 9)  # a round that takes long

        dog.it._round, dog.it._end = turn, lambda: ended.append(True)
        poller = SimpleNamespace(poll=poll, register=Calls())
        with patch.multiple(loop, time=dog.clock, select=SimpleNamespace(poll=lambda: poller, POLLIN=1)):
            dog.it.run()
        assert poller.register == [(dog.it._inbox, 1)] and ended == [True]
    assert rounds == [
        (MS, True),
        (2 * MS, False),
        (3 * MS, False),
        (10 * MS, True),
        (11 * MS, False),
        (41 * MS, True),
        (42 * MS, True),
        (51 * MS - 1, False),
        (52 * MS - 1, True),
        (67 * MS - 1, True),
    ]
    assert timeouts == [0.0, 9.0, 8.0, 7.0, 10.0, 9.0, 0.0, 9.0, 1e-6, 0.0]
    assert dog.clock.slept == [0.001, 0.0005, 1 / 1e9, 0.001, 0.001]


def it_ends_where_a_round_fails() -> None:
    with kennel() as dog:
        ended = []
        dog.it._round, dog.it._end = Calls(OSError()), lambda: ended.append(True)
        with patch.multiple(loop, time=dog.clock):
            assert not passes(dog.it.run)
        assert ended == [True]


def relays_are_driven_each_tick_and_when_the_state_changes() -> None:
    with kennel() as dog, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        assert dog.round(True, decided()) == [RELEASED, Driven(True)]
        assert dog.round(False, decided()) == []
        dog.round(False, decided(State.CLOSED, True, False))
        for name in (b"udp", b"gps"):
            sender.sendto(sealed(core_trial.beat(name)), str(dog.path / links.INBOX))
        assert dog.round(False, decided(State.TRIPPED)) == [Beat(1, 9, 1), Beat(3, 9, 1)]
        dog.wires.drive.results = [Driven(False)]
        dog.round(True, decided(State.TRIPPED))
        dog.wires.drive.results = [Driven(True)]
        assert dog.round(True, decided(State.CLOSED, False, True)) == [RELEASED, Driven(False)]
        assert dog.wires.drive == [
            (False, False, 0),
            (False, False, 1),
            (True, False, 1),
            (False, False, 1),
            (False, False, 2),
            (False, True, 3),
        ]
        assert len(dog.it._latch.hold) == 6
        end = dog.end()
        assert (end["rounds"], end["datagrams"], end["relays_opened"]) == (6, 2, True)


def the_worst_lateness_of_the_last_second_is_told() -> None:
    warning = decided(events=(Event("warning"),))
    with kennel() as dog:
        for at_ns, late_ms in (
            (0, 0.25),
            (MS, 5.12349),
            (600 * MS, 5.12349),
            (1100 * MS, 1.0),
            (1600 * MS, 1.0),
            (1600 * MS + 1, 1.0),
            (1601 * MS, 0.5),
        ):
            dog.round(False, warning, at_ns, late_ms)
        assert [line["late_ms"] for line in dog.it._report.lines] == [0.25, 5.123, 5.123, 5.123, 5.123, 1.0, 1.0]


def what_leaves_and_what_is_told() -> None:
    with kennel() as dog:
        dog.round(False, decided(forward=Forward(7, None, 1.0, 12.5, 3)), MS)
        dog.round(False, decided(forward=Forward(8, 99, 2.0, 25.0, 3)), MS)
        dog.round(False, decided(), MS)
        assert dog.commands() == [
            command.CommandOut(7, UTC_NS + T0_NS + MS, 12.5, 1.0, 3),
            command.CommandOut(8, 99, 25.0, 2.0, 3),
        ]
        assert dog.statuses() == []
        relays = [(False, False), (True, False), (False, True), (True, True)]
        for a, b in relays:
            dog.round(False, decided(a=a, b=b, tell=True), 2 * MS)
        statuses = dog.statuses()
        assert [(status.relay_a, status.relay_b) for status in statuses] == relays
        assert [status.counter for status in statuses] == [0, 1, 2, 3]
        assert {status.monotonic_ns for status in statuses} == {T0_NS + 2 * MS} and dog.commands() == []


def systemd_is_told_each_second() -> None:
    with kennel() as dog:
        for at_ns in (0, 1, 1000 * MS - 1, 1000 * MS, 1999 * MS, 2000 * MS):
            dog.round(False, decided(causes=BIT["late"]), at_ns)
        alive = ("WATCHDOG=1", "STATUS=OPEN late")
        assert dog.it._notify.tell == [("READY=1", *alive), alive, alive]


def trouble_with_the_latch_is_told_once() -> None:
    with kennel() as dog:
        for trouble in ("", "full", "full", "gone", ""):
            dog.it._latch.trouble = trouble
            dog.round(False, decided())
        assert [line["text"] for line in dog.it._report.lines] == [
            "the latch cannot be kept: full",
            "the latch cannot be kept: gone",
            "the latch is kept again",
        ]


def an_event_is_a_line() -> None:
    rule = core_trial.BY_NAME["late"]
    trip = Event("trip", "op", (Finding(rule, math.inf, 50.0), Finding(rule, 51.23456789, 50.0)))
    with kennel() as dog:
        dog.round(False, decided(State.TRIPPED, events=(trip, Event("open"))), MS, 2.0)
        usual = {"monotonic_ns": T0_NS + MS, "state": "TRIPPED", "late_ms": 2.0}
        causes = [
            {"rule": "late", "value": value, "limit": 50.0, "unit": rule.unit, "text": rule.text}
            for value in (None, 51.234568)
        ]
        assert dog.it._report.lines == [
            {"event": "trip", "who": "op", "causes": causes, **usual},
            {"event": "open", **usual},
        ]


def it_ends_with_open_relays_and_0_v() -> None:
    with kennel(BIT["late"]) as dog:
        dog.round(True, decided(State.CLOSED, True, True, tell=True), MS)
        dog.statuses()
        sequence = dog.it._memory.sequence
        dog.wires.drive.results = [Driven(False)]
        end = dog.end()
        assert dog.wires.drive[-2:] == [(True, True, 1), (False, False, 0)] and end["relays_opened"] is False
        assert dog.commands() == [command.CommandOut(sequence, UTC_NS + T0_NS + MS, 0.0, 0.0, 0)]
        (status,) = dog.statuses()
        assert (status.counter, status.closed, status.relay_a, status.relay_b, status.healthy) == (1, *(False,) * 4)
        assert status.estop_software and status.causes == ("late",) and status.state == beats.WatchdogState.CLOSED
        assert dog.it._notify.tell[-1] == ("STOPPING=1",) and dog.it._latch.close == dog.it._report.close == [()]
        assert not (dog.path / links.INBOX).exists()


def no_infinity_is_written() -> None:
    assert [loop._plain(value) for value in (1.23456789, math.inf, -math.inf, 0.0)] == [1.234568, None, None, 0.0]


def its_periods() -> None:
    """What no function holds."""
    assert (loop.TICK_NS, loop.ROUND_NS, loop.ALIVE_NS) == (10 * MS, MS, 1000 * MS)
    assert (links.MOST, report.QUEUED, files.LONGEST, latch.RETRY_S) == (64, 256, 4, 1.0)
    assert Config("d") == Config("d", "output.in", ("control.in",), Rules(), Lines(), "", 10_000_000, True)
    assert Lines() == Lines("", "", "", "", "", "", False)


# --- sockets -----------------------------------------------------------------------------------------------------


def the_run_folder_is_its_own() -> None:
    with folder() as path:
        new = path / "run"
        links.run_folder(str(new))
        assert new.stat().st_mode & 0o777 == 0o700
        for mode in (0o700, 0o755, 0o711, 0o744):
            new.chmod(mode)
            assert error_of(links.run_folder, str(new)) == ""
        for mode in (0o720, 0o702):
            new.chmod(mode)
            assert "others may write into it" in error_of(links.run_folder, str(new))
        assert "No such file" in error_of(links.run_folder, str(path / "no" / "such"))


def the_inbox_is_bound_once() -> None:
    with folder() as path:
        for _ in range(2):  # the second finds what one that died has left
            os.umask(0o022)
            inbox = links.bind_inbox(str(path))
            with inbox:
                assert not inbox.getblocking() and os.umask(0) == 0o022
                assert (path / links.INBOX).stat().st_mode & 0o777 == 0o700
                assert "another watchdog runs there" in error_of(links.bind_inbox, str(path))
        missing, long = str(path / "no"), str(path / ("x" * 120))
        where = f"{missing}/{links.INBOX}"
        assert error_of(links.bind_inbox, missing) == f"{where}: No such file or directory; name another run folder"
        assert "AF_UNIX path too long" in error_of(links.bind_inbox, long)


def a_round_takes_64_datagrams() -> None:
    for waiting, taken in ((0, 0), (63, 63), (64, 64), (70, 64)):
        recv = Calls(*(b"x",) * waiting, BlockingIOError())
        assert links.drain(SimpleNamespace(recv=recv)) == [Malformed("magic")] * taken  # type: ignore[arg-type]
        assert set(recv) == {(codec.LONGEST,)}


def what_is_refused_is_tried_twice_over_udp_and_counted() -> None:
    post: Any = links.Post(socket.AF_INET, ("127.0.0.1", 9))
    with post._sock as real:
        assert not real.getblocking() and post.failed == 0
        for failed, sent, *results in (
            (0, 1, 1),
            (0, 2, ConnectionRefusedError(), 1),
            (1, 2, ConnectionRefusedError(), ConnectionRefusedError(), 1),
            (2, 1, BlockingIOError(), 1),
        ):
            post._sock = SimpleNamespace(sendto=Calls(*results))
            post.send(b"x")
            assert post._sock.sendto == [(b"x", ("127.0.0.1", 9))] * sent and post.failed == failed


def the_command_leaves_by_an_address() -> None:
    found = [
        (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", 5, 0, 0)),
        (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", 5)),
        (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.2", 5)),
    ]
    getaddrinfo, post = Calls(found), Calls("a post")
    with patch.multiple(links, socket=Instead(socket, getaddrinfo=getaddrinfo), Post=post):
        for url in ("tcp://h:5", "udp://:5", "udp://h", "udp://h:0", "udp://h:99999", "x://"):
            assert error_of(links.output, url, "d") == f"{url}: no output; write udp://HOST:PORT", url
        assert getaddrinfo == []
        assert links.output("udp://h:5", "d") == "a post"  # type: ignore[comparison-overlap]
        assert links.output("output.in", "d") == "a post"  # type: ignore[comparison-overlap]
        assert getaddrinfo == [("h", 5, socket.SOCK_DGRAM)]
        assert post == [(socket.AF_INET, ("127.0.0.1", 5)), (socket.AF_UNIX, "d/output.in")]
        getaddrinfo.results = [OSError()]
        assert error_of(links.output, "udp://h:5", "d").startswith("udp://h:5: unknown host 'h'")


# --- lines, the latch, the log -----------------------------------------------------------------------------------


def a_file_is_opened_without_waiting() -> None:
    waitless = os.O_NONBLOCK | os.O_CLOEXEC
    opened = Calls(OSError())
    with patch.object(files, "os", Instead(os, open=opened)):
        assert (files.read_line("a"), files.write_line("b", True)) == (b"", False)
    assert opened == [("a", os.O_RDONLY | waitless), ("b", os.O_WRONLY | waitless)]
    opened = Calls(7)
    with patch.object(report, "os", Instead(os, open=opened)):
        assert report._opened("c") == 7
    assert opened == [("c", os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)]


def a_line_says_1_or_0() -> None:
    with folder() as path:
        line = str(path / "line")
        for text, is_released, shows in (
            ("1\n", True, Contact.CLOSED),
            ("0\n", False, Contact.OPEN),
            ("1\n\n", False, Contact.UNKNOWN),
        ):
            Path(line).write_text(text)
            assert (files.released(line), files.contact(line)) == (is_released, shows)
        assert files.released("") is None and files.contact("") is None
        for level, written in ((True, "1\n"), (False, "0\n")):
            assert files.write_line(line, level) is True and Path(line).read_text()[:2] == written
        for count in (1, 3):
            with patch.object(files, "os", Instead(os, write=lambda *_, count=count: count)):
                assert files.write_line(line, True) is False


def a_pulse_turns_each_tick() -> None:
    for pulse, levels in ((False, [True] * 6), (True, [False, True] * 3)):
        lines, write = Lines(relay_a="a", relay_b="b", pulse=pulse), Calls(True)
        with patch.object(files, "write_line", write):
            for tick in range(6):
                assert lines.drive(True, False, tick) == Driven(True)
        assert write == [call for level in levels for call in (("a", level), ("b", False))]
    with patch.object(files, "write_line", Calls(True, False)):
        assert Lines(relay_a="a", relay_b="b").drive(True, True, 1) == Driven(False)


def run(it: Any, *script: Callable[[], object]) -> None:
    """The thread of a latch or report, with what happens at each of its waits; then it has ended."""
    it._wake.script = list(script)
    it._run()
    assert it._wake.script == []


def a_latch_is_kept_as_the_newest_says() -> None:
    threads = Threads()
    with folder() as path, patch.object(latch, "threading", threads):
        file = path / "latch"
        it = latch.Latch(str(file), 1)
        assert threads.Thread == [(it._run, True)] and threads.start == [()]
        texts: list[bytes] = []

        def look() -> None:
            texts.append(file.read_bytes() if file.exists() else b"")

        def say(causes: int) -> None:
            look()
            it.hold(causes)

        run(it, partial(say, 1), partial(say, 3), partial(say, 2), partial(say, 2), partial(say, 0), it.close)
        look()
        assert texts == [b"", b"", latch.text_of(3), latch.text_of(2), latch.text_of(2), b""]
        assert len(it._wake.set) == 4 and it._wake.waits == [(None,)] * 6 and threads.join == [(0.5,)]
        it = latch.Latch(str(path / "no" / "latch"), 0)
        run(it, partial(it.hold, 3), it.close)
        assert it._wake.waits == [(None,), (1.0,)] and "No such file" in it.trouble


def a_report_writes_what_waits() -> None:
    threads = Threads()
    with folder() as path, patch.object(report, "threading", threads):
        it = report.Report(str(path / "log"))
        assert threads.Thread == [(it._run, True)] and threads.start == [()] and threads.stack_size == [(262_144,)]
        run(it, lambda: [it.line(n=1), it.line(n=2)], lambda: it.line(n=3), it.close)
        os.close(it._handle)
        lines = [json.loads(line) for line in (path / "log").read_text().splitlines()]
        assert [line["n"] for line in lines] == [1, 2, 3] and threads.join == [(0.5,)]


def what_finds_no_room_is_counted() -> None:
    with patch.object(report, "threading", Threads()):
        it: Any = report.Report()
        for _ in range(256):
            it.line(event="x")
        assert it.dropped == 0
        for dropped in (1, 2):
            it.line(event="x")
            assert it.dropped == dropped and len(it._lines) == 256
        it._lines.popleft()
        it.line(event="y")
        assert [line for line in it._lines if "dropped" in line] == [{"event": "y", "dropped": 2}]
        write = Calls(3, 2)
        with patch.object(report, "os", Instead(os, write=write)):
            it._write(b"abcde")
        assert write == [(2, b"abcde"), (2, b"de")]


def a_log_has_its_bound() -> None:
    with folder() as path, patch.object(report, "threading", Threads()):
        log, old = path / "log", path / "log.1"

        def sizes() -> tuple[int, ...]:
            return tuple(file.stat().st_size for file in (log, old) if file.exists())

        it: Any = report.Report(str(log), 100)
        for size, want in ((150, (150,)), (60, (60, 150)), (40, (100, 150)), (1, (1, 100)), (99, (100, 100))):
            it._write(b"x" * size)
            assert sizes() == want
        it._write(b"x" * 30)
        os.close(it._handle)
        assert sizes() == (30, 100)
        it = report.Report(str(log), 100)
        it._write(b"x" * 70)
        assert sizes() == (100, 100)
        it._write(b"x")
        assert sizes() == (1, 100) and it.dropped == 0
        os.close(it._handle)
        with patch.object(report, "os", Instead(os, write=Calls(OSError()))):
            for dropped in (1, 2):
                it._write(b"x")
                assert it.dropped == dropped


def a_line_has_its_time() -> None:
    with patch.object(report, "time", Instead(report.time, time_ns=lambda: UTC_NS)):
        assert report._utc() == "2023-11-14T22:13:20.123Z"


# --- systemd, the system, the arguments --------------------------------------------------------------------------


def systemd_is_told_where_it_has_asked() -> None:
    for name, address in (("/run/n", "/run/n"), ("@name", "\0name")):
        post = SimpleNamespace(send=Calls())
        made = Calls(post)
        with patch.object(notify, "Post", made):
            notify.Notify({"NOTIFY_SOCKET": name}).tell("A=1", "B=2")
        assert made == [(socket.AF_UNIX, address)] and post.send == [(b"A=1\nB=2",)]
    notify.Notify({}).tell("A=1")


def real_time(platform: str, fifo: bool, locked: int, scheduled: Any) -> tuple[list[str], SimpleNamespace]:
    """What could not be had, and the calls that were made."""
    seen = SimpleNamespace(prctl=Calls(0), mlockall=Calls(locked), schedule=Calls(scheduled), freeze=Calls())
    ctypes = Instead(system.ctypes, CDLL=Calls(seen), get_errno=lambda: 12)
    seen.cdll, seen.disable, seen.collect = ctypes.CDLL, Calls(), Calls()
    with patch.multiple(
        system,
        ctypes=ctypes,
        gc=SimpleNamespace(collect=seen.collect, freeze=seen.freeze, disable=seen.disable),
        os=Instead(os, sched_setscheduler=seen.schedule, SCHED_FIFO=1, sched_param=lambda number: number),
        sys=SimpleNamespace(platform=platform),
    ):
        return system.go_realtime(fifo=fifo), seen


def the_process_is_made_fit_for_its_rhythm() -> None:
    shortfalls, seen = real_time("linux", True, 0, None)
    assert shortfalls == [] and seen.collect == seen.freeze == seen.disable == [()]
    option, slack_ns, *zeros = seen.prctl[0]  # PR_SET_TIMERSLACK; MCL_CURRENT | MCL_ONFAULT
    assert (option, slack_ns.value, *zeros) == (29, 1, 0, 0, 0) and seen.mlockall == [(5,)]
    assert seen.schedule == [(0, 1, 20)] and seen.cdll == [(None, True)]
    shortfalls, seen = real_time("linux", False, -1, None)
    assert shortfalls == ["memory is not locked: Cannot allocate memory; raise RLIMIT_MEMLOCK for it"]
    assert seen.schedule == []
    shortfalls, _ = real_time("linux", True, 0, PermissionError(1, "no"))
    assert shortfalls == ["SCHED_FIFO: no; run as root or with CAP_SYS_NICE for it"]
    shortfalls, seen = real_time("darwin", True, 0, None)
    assert len(shortfalls) == 1 and seen.cdll == seen.schedule == [] and seen.disable == [()]


def arguments_are_read() -> None:
    assert entry._limit("late_max_ms=20") == ("late_max_ms", 20.0)
    assert error_of(entry._limit, "late_max_ms") == "'late_max_ms': write NAME=NUMBER"
    assert error_of(entry._limit, "late_max_ms=1") == limits.refusal("late_max_ms", 1.0)
    assert entry._names(" a, ,b") == ("a", "b") and entry._loops("udp,gps") == ("udp", "gps")
    assert error_of(entry._loops, "udp,x,y").startswith("'x' is no loop; there are control, udp")


def config_refused(*arguments: str) -> str:
    stderr = io.StringIO()
    try:
        with redirect_stderr(stderr):
            entry.config_of(list(arguments))
    except SystemExit:
        return stderr.getvalue()
    return ""


def a_command_line_is_a_configuration() -> None:
    assert entry.config_of(["--run-dir", "d"]) == Config("d")
    assert "required: --run-dir" in config_refused() and "required: --run-dir" in config_refused("--run-d", "d")
    words = "--run-dir d --output udp://h:5 --status a,b --beats udp --readback-required --limit late_max_ms=20"
    words += " --limit close_max_v=0 --estop-a 1 --estop-b 2 --contact-a 3 --contact-b 4 --relay-a 5 --relay-b 6"
    words += " --pulse --log l --log-mb 2.5 --no-fifo"
    judged = Rules(Limits(late_max_ms=20.0, close_max_v=0.0), ("udp",), True)
    lines = Lines("1", "2", "3", "4", "5", "6", True)
    want = Config("d", "udp://h:5", ("a", "b"), judged, lines, "l", 2_500_000, False)
    assert entry.config_of(words.split()) == want
    assert [entry.config_of(["--run-dir", "d", "--log-mb", mb]).log_bytes for mb in ("0", "-1", "1e-6")] == [1, 1, 1]
    assert "unrecognized arguments: --pulses" in config_refused("--run-dir", "d", "--pulses")


# --- the trial ---------------------------------------------------------------------------------------------------

SCENES: dict[ModuleType, list[Callable[[], None]]] = {
    loop: [
        it_begins_with_the_latch_that_is_there_and_open_relays,
        it_waits_for_the_tick_and_a_millisecond_between_rounds,
        it_ends_where_a_round_fails,
        relays_are_driven_each_tick_and_when_the_state_changes,
        the_worst_lateness_of_the_last_second_is_told,
        what_leaves_and_what_is_told,
        systemd_is_told_each_second,
        trouble_with_the_latch_is_told_once,
        an_event_is_a_line,
        it_ends_with_open_relays_and_0_v,
        no_infinity_is_written,
        its_periods,
    ],
    links: [
        the_run_folder_is_its_own,
        the_inbox_is_bound_once,
        a_round_takes_64_datagrams,
        what_is_refused_is_tried_twice_over_udp_and_counted,
        the_command_leaves_by_an_address,
    ],
    files: [a_file_is_opened_without_waiting, a_line_says_1_or_0, a_pulse_turns_each_tick],
    latch: [a_latch_is_kept_as_the_newest_says],
    report: [
        a_file_is_opened_without_waiting,
        a_report_writes_what_waits,
        what_finds_no_room_is_counted,
        a_log_has_its_bound,
        a_line_has_its_time,
    ],
    notify: [systemd_is_told_where_it_has_asked],
    system: [the_process_is_made_fit_for_its_rhythm],
    entry: [arguments_are_read, a_command_line_is_a_configuration],
}
FUNCTIONS = {
    function: scenes
    for module, scenes in SCENES.items()
    for function in functions_of(module)
    if function not in core_trial.FUNCTIONS
}
EQUIVALENT = {
    "Report.__init__ line 5: 0 + 1": "what goes to stderr has no bound, and its size is not asked for",
    "go_realtime line 10: 4 + 1": "1 | 5 is 1 | 4",
}
"""Mutants that do what the original does, and why."""


def named(function: FunctionType) -> str:
    return f"{function.__module__}.{function.__qualname__}"


@pytest.mark.parametrize("scene", sorted({scene for scenes in SCENES.values() for scene in scenes}, key=named))  # type: ignore[arg-type]
def test_the_scenes_hold(scene: Callable[[], None]) -> None:
    scene()


@pytest.mark.parametrize("function", FUNCTIONS, ids=named)
def test_no_mutant_of_the_edge_survives(function: FunctionType) -> None:
    left = survivors(function, lambda: all(map(passes, FUNCTIONS[function])))
    assert [what for what in left if what not in EQUIVALENT] == []
    assert {what for what in EQUIVALENT if what.startswith(f"{function.__qualname__} ")} <= set(left)


def test_all_of_the_watchdog_is_tried() -> None:
    names = [found.name for found in pkgutil.iter_modules(dcon.watchdog.__path__)]
    modules = [importlib.import_module(f"dcon.watchdog.{name}") for name in names]
    assert {codec, memory, rules, latch, limits, core, *SCENES} == set(modules)
    tried = {*core_trial.FUNCTIONS, *FUNCTIONS}
    left_out = {function for module in modules for function in functions_of(module)} - tried
    assert [what for function in left_out for what, _ in mutants(function)] == []
    assert sum(len(list(mutants(function))) for function in tried) > 400
