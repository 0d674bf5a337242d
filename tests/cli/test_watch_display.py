"""The live displays on a pseudo terminal: what comes is shown, keys are heard, the terminal is set back."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.commands import command, started
from support.live import free_udp_port
from support.terminals import ENVIRONMENT, Screen, Terminal, fcntl, pty, resize, termios
from support.watched import ROUND_NS, watched

from pmutools.cli.herald import Herald
from pmutools.cli.shell import Talk
from pmutools.cli.watch_display import UPDATE_NS, WatchScreen
from pmutools.cli.watch_keys import Command
from pmutools.clock import SystemClock
from pmutools.errors import SettingsError
from pmutools.net.reactor import Reactor
from pmutools.tools.watch import Watch

pytestmark = pytest.mark.realtime
LIMIT_S = 20


class Stage(Terminal):
    """A display on a pseudo terminal."""

    def __init__(self, watch: Watch | None = None, **options: Any) -> None:
        super().__init__()
        self.watch, self.now_ns = watch or watched(), 60 * ROUND_NS
        environment = options.pop("environment", ENVIRONMENT)
        self.screen = WatchScreen(
            title="pmu read x.csv", keyboard=self.slave, screen=self.slave, environment=environment, **options
        )

    def until(self, done: Callable[[], bool]) -> None:
        self.run_until(done, self.update, LIMIT_S)

    def update(self) -> None:
        self.now_ns += UPDATE_NS
        self.screen.update(self.watch, self.now_ns, ("x.csv 1.0 MB",))
        time.sleep(0.01)


@contextmanager
def stage(**options: Any) -> Iterator[Stage]:
    made = Stage(**options)
    try:
        with made.screen:
            yield made
    finally:
        made.hear()
        made.close()


def test_keys_are_heard_and_the_screen_follows() -> None:
    with stage() as on:
        on.until(lambda: "7 of 8 streaming" in on.shown and "x.csv 1.0 MB" in on.shown)
        on.type(b"v")
        on.until(lambda: "cmpl%" in on.shown)
        on.type(b"/s1")
        on.until(lambda: "filter: s1" in on.shown and "1-1 of 1" in on.shown)
        on.type(b"\r\x1b")
        on.until(lambda: "1-8 of 8" in on.shown)
        on.type(b"w")
        on.until(lambda: "by worst" in on.shown)
        on.type(b" ")
        on.until(lambda: "FROZEN" in on.shown)
        on.type(b" ?")
        on.until(lambda: "any key goes back" in on.shown)
        on.type(b"x")
        on.screen.note("udp://x bound")
        on.until(lambda: "udp://x bound" in on.shown)
        resize(on.slave, 120, 40)
        on.until(lambda: 40 in on.shown.lines)
        assert not on.screen.quit_asked
        on.type(b"q")
        on.until(lambda: on.screen.quit_asked)


def test_what_is_frozen_stands_still() -> None:
    with stage(watch=watched(8, 20)) as on:
        on.until(lambda: "LIVE" in on.shown)
        on.type(b" ")
        on.until(lambda: "FROZEN" in on.shown)
        held = dict(on.shown.lines)
        on.watch.frames += 10**6
        on.watch.own_drops = 77
        for _ in range(5):
            on.until(lambda: True)
            on.now_ns += UPDATE_NS
            on.screen.update(on.watch, on.now_ns)
        on.hear()
        assert on.shown.lines[2] == held[2]
        on.type(b" ")
        on.until(lambda: "own drops 77" in on.shown)


def test_a_programs_own_key() -> None:
    done = []

    def trigger() -> str:
        if done:
            raise SettingsError("the buffer is empty")
        done.append("t")
        return "60 s written"

    with stage(commands=[Command("t", "t trigger", "Write.", trigger)]) as on:
        on.until(lambda: "t trigger" in on.shown)
        on.type(b"t")
        on.until(lambda: "60 s written" in on.shown)
        on.type(b"t")
        on.until(lambda: "the buffer is empty" in on.shown)
        on.type(b"/t")
        on.until(lambda: "filter: t" in on.shown)


def test_keys_come_from_a_reactor_too() -> None:
    reactor = Reactor(SystemClock())
    with stage(reactor=reactor) as on:
        on.screen.update(on.watch, on.now_ns)
        on.type(b"v")
        end = time.monotonic() + LIMIT_S
        while "cmpl%" not in on.shown:
            assert time.monotonic() < end
            reactor.run(20_000_000)
            on.hear()
    reactor.close()


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, RuntimeError])
def test_the_terminal_is_set_back(error: type[BaseException] | None) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGTSTP, signal.SIGCONT, signal.SIGHUP)]
    on = Stage()
    try:
        with on.screen:
            on.until(lambda: "LIVE" in on.shown)
            assert not termios.tcgetattr(on.slave)[3] & (termios.ECHO | termios.ICANON)
            if error is not None:
                raise error
    except (KeyboardInterrupt, RuntimeError):
        pass
    assert termios.tcgetattr(on.slave) == on.before
    on.hear()
    assert on.shown.raw.endswith(b"\x1b[?25h\x1b[?1049l")
    assert [signal.getsignal(number) for number in (signal.SIGTSTP, signal.SIGCONT, signal.SIGHUP)] == handlers
    on.close()


def test_a_terminal_that_takes_nothing_holds_up_nothing() -> None:
    with stage(watch=watched(500, 3)) as on:
        resize(on.slave, 200, 100)
        slowest, end = 0.0, time.monotonic() + 2
        while time.monotonic() < end:
            on.now_ns += UPDATE_NS
            on.type(b"jw")
            began = time.thread_time()
            on.screen.update(on.watch, on.now_ns, (str(on.now_ns),))
            slowest = max(slowest, time.thread_time() - began)
            on.screen.note("x" * 150)
        assert slowest < 0.5
        display = on.screen._display
        assert display is not None
        assert len(display.terminal.queue) < 200_000


def test_a_terminal_that_is_gone_ends_it() -> None:
    on = Stage()
    with on.screen:
        on.until(lambda: "LIVE" in on.shown)
        os.close(on.master)
        end = time.monotonic() + LIMIT_S
        while not on.screen.quit_asked:
            assert time.monotonic() < end
            on.now_ns += UPDATE_NS
            on.screen.update(on.watch, on.now_ns)
            time.sleep(0.01)
    os.close(on.slave)


def test_without_utf_8_and_colour() -> None:
    with stage(environment={"TERM": "xterm", "LANG": "C", "NO_COLOR": "1"}) as on:
        on.until(lambda: "7 of 8 streaming" in on.shown)
        assert on.shown.raw.isascii()
        assert b"\x1b[31m" not in on.shown.raw


def test_without_a_terminal_there_is_a_line_where_someone_sees_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = watched()
    read, write = os.pipe()
    try:
        with WatchScreen(title="x", herald=Herald(Talk(False, 0)), keyboard=read, screen=write) as screen:
            assert not screen.drawn
            for number in range(9):
                screen.update(watch, (60 + number) * ROUND_NS, ("x.csv 1.0 MB",))
            screen.note("udp://x bound")
            assert not screen.quit_asked
            assert capsys.readouterr().err == "udp://x bound\n", "standard error is no terminal: no progress"
            monkeypatch.setattr("sys.stderr.isatty", lambda: True)
            for number in range(9):
                screen.update(watch, (80 + number) * ROUND_NS, ("x.csv 1.0 MB",))
            lines = capsys.readouterr().err.split("\r\x1b[K")
            assert [line.split("  ")[0] for line in lines] == ["0 of 8 streaming"] * 3, "once a second"
            assert lines[0].endswith("x.csv 1.0 MB")
        with WatchScreen(title="x", keyboard=read, screen=write) as silent:
            silent.update(watch, 0)
            silent.note("nobody hears")
    finally:
        os.close(read)
        os.close(write)


@contextmanager
def on_a_terminal(arguments: list[str], folder: Path) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """A command on a terminal of its own; gives the other end."""
    master, slave = pty.openpty()
    resize(slave, 100, 30)
    with (folder / "out").open("wb") as out:
        process = subprocess.Popen(
            arguments, stdin=slave, stdout=out, stderr=slave, start_new_session=True, env=os.environ | ENVIRONMENT,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )  # fmt: skip
    os.close(slave)
    try:
        yield master, process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        os.close(master)


def said(master: int) -> bytes:
    """What is written on a terminal; nothing where it is hung up."""
    try:
        return os.read(master, 1 << 16) if select.select([master], [], [], 0.1)[0] else b""
    except OSError:
        return b""


def test_read_live(synthetic: Path, tmp_path: Path) -> None:
    """Opens, shows what comes, ends with q, sets the terminal back; standard output is data."""
    port, screen = free_udp_port(), Screen()
    url = f"udp://127.0.0.1:{port}"
    reading = command("read", url, "--out", tmp_path / "x.pcap", "--live", "--json")

    def wait_for(text: str, master: int) -> None:
        end = time.monotonic() + LIMIT_S
        while text not in screen:
            assert time.monotonic() < end, screen.lines
            screen.hear(said(master))

    with on_a_terminal(reading, tmp_path) as (master, process):
        wait_for("nothing has come yet", master)
        with started("play", synthetic, "--to", url, "--loop", 0, "--duration", 30, "--quiet"):
            wait_for("  8 streaming", master)
            wait_for("x.pcap 0.", master)
            os.write(master, b"v")
            wait_for("cmpl%", master)
            os.write(master, b"q")
            end = time.monotonic() + LIMIT_S
            while process.poll() is None:
                assert time.monotonic() < end
                screen.hear(said(master))
            screen.hear(said(master))
    assert process.returncode == 0, bytes(screen.raw)[-1500:]
    assert b"\x1b[?25h\x1b[?1049l" in screen.raw
    summary = json.loads((tmp_path / "out").read_bytes())
    assert len(summary["streams"]) == 8
    assert summary["frames"] > 0


def test_read_live_into_a_pipe(synthetic: Path, tmp_path: Path) -> None:
    """Without a terminal it reads all the same."""
    port = free_udp_port()
    url = f"udp://127.0.0.1:{port}"
    with (
        subprocess.Popen(
            command("read", url, "--out", tmp_path / "x.csv", "--live", "--duration", 3),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
        started("play", synthetic, "--to", url, "--loop", 0, "--duration", 5, "--quiet"),
    ):
        _, err = process.communicate(timeout=LIMIT_S * 2)
    assert process.returncode in (0, 3), err
    assert "8 streams" in err
    assert "\x1b" not in err
