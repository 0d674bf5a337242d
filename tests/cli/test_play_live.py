"""A player that is told what to do while it runs: by ``pmu ctl``, and by keys in a terminal."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.commands import Result, command, ended, run_here, started
from support.playing import interleaved, recording, stream
from support.recordings import write

pytestmark = pytest.mark.realtime

PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty seconds of N1 and S1."""
    monkeypatch.chdir(tmp_path)
    write(Path("two.c37118"), interleaved(recording(stream(7, name="N1"), 1000), recording(stream(8, name="S1"), 1000)))


def ctl(*words: object, code: int = 0) -> Result:
    result = run_here("ctl", "./x.sock", *words)
    assert result.code == code, result.err
    return result


def status() -> Any:
    return ctl("stats", "--json").json


def until(condition: Any) -> Any:
    """The status that fulfils it."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if condition(now := status()):
            return now
    pytest.fail(f"never came true: {now}")


def wait_for(path: Path) -> None:
    end = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_ctl_controls_a_real_player() -> None:
    arguments = ("two.c37118", "--to", "udp://127.0.0.1:9", "--loop", 0, "--stamp", "keep", "--control", "./x.sock")
    with started("play", *arguments) as player:
        wait_for(Path("x.sock"))
        assert until(lambda now: now["sent"] > 10)["state"] == "playing"
        ctl("pause")
        paused = status()
        assert paused["state"] == "paused"
        time.sleep(0.1)
        assert status()["sent"] - paused["sent"] <= 2
        ctl("seek", 10)
        assert status()["position_s"] == 10
        ctl("step", 3)
        assert until(lambda now: now["position_s"] >= 10.05)["state"] == "paused"
        assert 10.05 <= status()["position_s"] <= 10.07
        ctl("speed", 4)
        ctl("fault", "N1", "delay=constant(5)")
        ctl("disable", "S1")
        north, south = status()["streams"]
        assert (north["faults"], south["enabled"]) == ({"delay": "constant(5)"}, False)
        before = south["fates"]["sent"]
        ctl("resume")
        now = until(lambda now: now["position_s"] > 12)
        assert (now["state"], now["speed"]) == ("playing", 4.0)
        assert now["streams"][1]["fates"]["sent"] == before
        assert now["streams"][1]["fates"]["disabled"] > 20
        ctl("loop", 1, 2)
        until(lambda now: 1 <= now["position_s"] < 2.1 and now["loop"] > 1)
        ctl("enable", "S1")
        assert "no such stream; there are N1, S1" in ctl("disable", "N9", code=1).complaint
        assert "PLAYING" in ctl("stats").out
        player.send_signal(signal.SIGINT)
        result = ended(player)
    assert result.code == 130
    assert "control client: pause" in result.err
    assert not Path("x.sock").exists()


def test_resuming_is_heard_at_once() -> None:
    """Not only when the loop looks up of itself."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        sink.settimeout(PATIENCE_S)
        url = f"udp://127.0.0.1:{sink.getsockname()[1]}"
        arguments = (
            "two.c37118",
            "--to",
            url,
            "--stamp",
            "keep",
            "--control",
            "./x.sock",
            "--paused",
            "--cfg-period",
            0,
        )
        with started("play", *arguments) as player, socket.socket(socket.AF_UNIX) as client:
            wait_for(Path("x.sock"))
            client.connect("./x.sock")
            sink.recv(1 << 16)
            time.sleep(0.3)
            sink.setblocking(False)
            while select.select([sink], [], [], 0.05)[0]:
                sink.recv(1 << 16)
            took = []
            for _ in range(5):
                client.sendall(b"resume\n")
                began = time.monotonic()
                assert select.select([sink], [], [], PATIENCE_S)[0]
                took.append(time.monotonic() - began)
                client.sendall(b"pause\nseek 5\n")
                time.sleep(0.13)
                while select.select([sink], [], [], 0.05)[0]:
                    sink.recv(1 << 16)
            player.send_signal(signal.SIGINT)
            ended(player)
    assert sorted(took)[2] < 0.04


# --- in a terminal


class Terminal:
    """A player at a pseudo-terminal."""

    def __init__(self, *arguments: object) -> None:
        import pty
        import termios

        self.main, self._other = pty.openpty()
        self._termios = termios
        self.before = termios.tcgetattr(self._other)
        environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"}
        self.process = subprocess.Popen(
            command("play", *arguments, "--interactive"),
            stdin=self._other,
            stdout=subprocess.DEVNULL,
            stderr=self._other,
            env=environment,
            start_new_session=True,
        )
        self.seen = b""

    def read_until(self, text: bytes, after: int = 0) -> None:
        end = time.monotonic() + PATIENCE_S
        while text not in self.seen[after:]:
            left = end - time.monotonic()
            assert left > 0, self.seen[-3000:]
            if select.select([self.main], [], [], left)[0]:
                self.seen += os.read(self.main, 1 << 16)

    def type(self, keys: bytes) -> None:
        os.write(self.main, keys)

    def drain(self) -> int:
        """The end, with everything read."""
        while self.process.poll() is None or select.select([self.main], [], [], 0)[0]:
            if select.select([self.main], [], [], 0.05)[0]:
                self.seen += os.read(self.main, 1 << 16)
        return self.process.returncode

    @property
    def restored(self) -> bool:
        return bool(self._termios.tcgetattr(self._other) == self.before)


@contextmanager
def terminal(*arguments: object) -> Iterator[Terminal]:
    made = Terminal(*arguments)
    try:
        yield made
    finally:
        if made.process.poll() is None:
            made.process.kill()
            made.process.wait(PATIENCE_S)
        os.close(made.main)
        os.close(made._other)


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal")
def test_keys_pause_and_quit_and_the_terminal_is_as_it_was() -> None:
    arguments = ("two.c37118", "--to", "udp://127.0.0.1:9", "--loop", 0, "--stamp", "keep", "--control", "./x.sock")
    with terminal(*arguments) as screen:
        screen.read_until(b"PLAYING")
        assert not screen.restored
        screen.type(b" ")
        screen.read_until(b"PAUSED", len(screen.seen))
        assert status()["state"] == "paused"
        screen.type(b" ")
        until(lambda now: now["state"] == "playing")
        screen.type(b"q")
        assert screen.drain() == 0
        assert screen.restored
        assert b"\x1b[?1049l" in screen.seen, "the screen of before is back"
        assert b"late p50" in screen.seen.rpartition(b"\x1b[?1049l")[2], "and the results are on it"


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal")
def test_an_interrupted_screen_is_left_too() -> None:
    with terminal("two.c37118", "--to", "udp://127.0.0.1:9", "--stamp", "keep") as screen:
        screen.read_until(b"PLAYING")
        screen.process.send_signal(signal.SIGTERM)
        assert screen.drain() == 130
        assert screen.restored
