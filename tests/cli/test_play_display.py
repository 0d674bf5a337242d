"""The interactive player on a pseudo terminal: keys in, pictures out, and the terminal set back whatever happens."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from support.controlled import FakePlayer
from support.terminals import ENVIRONMENT, Terminal, fcntl, pty, resize, termios

from pmutools.cli.play_display import Display
from pmutools.cli.play_screen import Title
from pmutools.clock import SystemClock
from pmutools.errors import SettingsError
from pmutools.net.reactor import Reactor

pytestmark = pytest.mark.realtime
TITLE = Title("x.pcap", ("udp://127.0.0.1:4713",))
MS = 1_000_000
ROOT = Path(__file__).parents[2]


class Stage(Terminal):
    """A display on a pseudo terminal."""

    def __init__(self, streams: int = 8, environment: dict[str, str] | None = None) -> None:
        super().__init__()
        self.player, self.reactor = FakePlayer(streams), Reactor(SystemClock())
        self.display = Display(
            self.player,
            self.reactor,
            TITLE,
            keyboard=self.slave,
            screen=self.slave,
            environment=environment or ENVIRONMENT,
        )

    def until(self, done: Callable[[], bool], limit_s: float = 10) -> None:
        self.run_until(done, lambda: self.reactor.run(5 * MS), limit_s)

    def close(self) -> None:
        super().close()
        self.reactor.close()


@contextmanager
def stage(streams: int = 8, environment: dict[str, str] | None = None) -> Iterator[Stage]:
    made = Stage(streams, environment)
    try:
        with made.display:
            yield made
    finally:
        made.hear()
        made.close()


def test_keys_reach_the_player_and_the_screen_follows() -> None:
    with stage() as on:
        on.until(lambda: "PLAYING" in on.shown)
        on.type(b" ")
        on.until(lambda: "PAUSED" in on.shown)
        on.type(b"\x1b[C")
        on.until(lambda: on.player.done == ["pause", "step"])
        on.type(b"]]]")
        on.until(lambda: len(on.player.done) == 5)
        assert on.player.done[2:] == ["seek 13.5", "seek 14.5", "seek 15.5"]
        on.type(b"nf")
        on.until(lambda: "fault of N2:" in on.shown)
        on.type(b"loss=5%\r")
        on.until(lambda: on.player.done[-1] == "fault N2")
        on.type(b":enable N9\r")
        on.until(lambda: "enable N9: no such stream" in on.shown)
        on.display.note("127.0.0.1:5000 started 101")
        on.until(lambda: "127.0.0.1:5000 started 101" in on.shown)
        resize(on.slave, 120, 40)
        on.until(lambda: 40 in on.shown.lines)
        on.type(b"q")
        on.until(lambda: on.display.quit)


def test_escape_alone_leaves_a_prompt() -> None:
    with stage() as on:
        on.until(lambda: "PLAYING" in on.shown)
        on.type(b":x")
        on.until(lambda: on.display.ui.prompt is not None)
        on.type(b"\x1b")
        on.until(lambda: on.display.ui.prompt is None)


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, RuntimeError])
def test_the_terminal_is_set_back(error: type[BaseException] | None) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGTSTP, signal.SIGCONT, signal.SIGHUP)]
    on = Stage()
    try:
        with on.display:
            on.until(lambda: "PLAYING" in on.shown)
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
    with stage(2000) as on:
        resize(on.slave, 200, 200)
        end, slowest = time.monotonic() + 2, 0.0
        events = 0
        while time.monotonic() < end:
            on.display.note(f"event {events} {'x' * 150}")
            events += 1
            on.player.now = replace(on.player.now, position_s=events % 30)
            on.type(b"n")
            began = time.monotonic()
            on.reactor.run(5 * MS)
            slowest = max(slowest, time.monotonic() - began)
        assert slowest < 0.5
        assert len(on.display.terminal.queue) < 200_000


def test_a_terminal_that_is_gone_ends_the_player() -> None:
    on = Stage()
    with on.display:
        on.until(lambda: "PLAYING" in on.shown)
        os.close(on.master)
        end = time.monotonic() + 5
        while not on.display.quit:
            assert time.monotonic() < end
            on.reactor.run(5 * MS)
    os.close(on.slave)
    on.reactor.close()


@pytest.mark.parametrize("environment", [{}, {"TERM": "dumb"}, {"TERM": ""}])
def test_what_is_no_terminal(environment: dict[str, str]) -> None:
    with pytest.raises(SettingsError, match="--interactive needs a terminal; use --control"):
        Stage(environment=environment or {"LANG": "C"})


def test_a_pipe_is_no_terminal() -> None:
    read, write = os.pipe()
    try:
        with pytest.raises(SettingsError, match="needs a terminal"):
            Display(FakePlayer(), Reactor(SystemClock()), TITLE, keyboard=read, screen=write, environment=ENVIRONMENT)
    finally:
        os.close(read)
        os.close(write)


@pytest.mark.parametrize(("name", "value"), [("NO_COLOR", "1"), ("LANG", "C")])
def test_poor_terminals(name: str, value: str) -> None:
    with stage(environment=ENVIRONMENT | {name: value}) as on:
        on.until(lambda: "PLAYING" in on.shown and 24 in on.shown.lines)
        if name == "NO_COLOR":
            assert not re.search(rb"\x1b\[[\d;]*3\dm", on.shown.raw)
        else:
            assert on.shown.raw.isascii()


CHILD = """
import os, signal, sys
sys.path[:0] = [{root!r}, {tests!r}]
from support.controlled import FakePlayer
from pmutools.cli.play_display import Display
from pmutools.cli.play_screen import Title
from pmutools.clock import SystemClock
from pmutools.net.reactor import Reactor

def end(number, frame):
    raise KeyboardInterrupt

signal.signal(signal.SIGTERM, end)
with open({pid!r}, "w") as file:
    file.write(str(os.getpid()))
player, reactor = FakePlayer(), Reactor(SystemClock())
try:
    with Display(player, reactor, Title("x")) as display:
        while not display.quit:
            reactor.run(50_000_000)
except KeyboardInterrupt:
    pass
print("DONE", player.done, flush=True)
"""


def test_suspend_and_continue_under_a_shell(tmp_path: Path) -> None:
    """^Z, `fg`, SIGTERM, in a shell with job control: its prompt works in between."""
    shell = "/bin/bash"
    if not os.path.exists(shell):
        pytest.skip("needs bash")
    script = tmp_path / "child.py"
    script.write_text(CHILD.format(root=str(ROOT), tests=str(ROOT / "tests"), pid=str(tmp_path / "pid")))
    master, slave = pty.openpty()
    resize(slave, 80, 24)
    process = subprocess.Popen(
        [shell, "--norc", "--noprofile", "-i"],
        stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
        env=os.environ | ENVIRONMENT | {"PS1": "PROMPT> "},
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    heard = b""

    def wait_for(text: bytes) -> None:
        nonlocal heard
        end = time.monotonic() + 20
        while text not in heard:
            assert time.monotonic() < end, heard[-2000:]
            if select.select([master], [], [], 0.1)[0]:
                heard += os.read(master, 1 << 16)
        heard = heard.partition(text)[2]

    try:
        wait_for(b"PROMPT> ")
        os.write(master, f"{sys.executable} {script}\n".encode())
        wait_for(b"PLAYING")
        os.write(master, b"\x1a")
        wait_for(b"\x1b[?1049l")
        wait_for(b"PROMPT> ")
        os.write(master, b"echo a''live\n")
        wait_for(b"alive")
        wait_for(b"PROMPT> ")
        os.write(master, b"bg\n")
        wait_for(b"PROMPT> ")
        time.sleep(0.5)
        assert termios.tcgetattr(slave)[3] & termios.ICANON or b"1049h" not in heard
        os.write(master, b"fg\n")
        wait_for(b"\x1b[?1049h")
        wait_for(b"PLAYING")
        os.write(master, b".")
        wait_for(b"PAUSED")
        os.write(master, b"q")
        wait_for(b"\x1b[?1049l")
        wait_for(b"DONE ['pause', 'resume', 'pause', 'step']")
        wait_for(b"PROMPT> ")
        os.write(master, f"{sys.executable} {script} & sleep 2; kill %1; wait; fg\n".encode())
        wait_for(b"DONE []")
        wait_for(b"PROMPT> ")
        os.write(master, f"{sys.executable} {script}\n".encode())
        wait_for(b"PLAYING")
        os.kill(int((tmp_path / "pid").read_text()), signal.SIGTERM)
        wait_for(b"\x1b[?1049l")
        wait_for(b"DONE []")
        os.write(master, b"exit\n")
        process.wait(20)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        os.close(master)
        os.close(slave)
