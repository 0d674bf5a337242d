"""Pseudo terminals, and what is on them."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable

import pytest

termios = pytest.importorskip("termios")
fcntl = pytest.importorskip("fcntl")
pty = pytest.importorskip("pty")

ENVIRONMENT = {"TERM": "xterm", "LANG": "C.UTF-8"}


def resize(fd: int, columns: int, lines: int) -> None:
    fcntl.ioctl(
        fd, termios.TIOCSWINSZ, lines.to_bytes(2, sys.byteorder) + columns.to_bytes(2, sys.byteorder) + bytes(4)
    )


class Screen:
    """As much of a terminal as the display needs: what is on each line."""

    def __init__(self) -> None:
        self.raw = b""
        self.lines: dict[int, str] = {}

    def hear(self, data: bytes) -> None:
        self.raw += data
        text = self.raw.decode("utf-8", "ignore").rpartition("\x1b[2J")[2]
        self.lines = {}
        for number, line in re.findall(r"\x1b\[(\d+);1H(.*?)\x1b\[K", text, re.DOTALL):
            self.lines[int(number)] = re.sub(r"\x1b\[[\d;]*m", "", line)

    def __contains__(self, text: str) -> bool:
        return any(text in line for line in self.lines.values())


class Terminal:
    """A pseudo terminal of 80 by 24: the slave for what draws on it, the other end here."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        resize(self.slave, 80, 24)
        os.set_blocking(self.master, False)
        self.before = termios.tcgetattr(self.slave)
        self.shown = Screen()

    def run_until(self, done: Callable[[], bool], work: Callable[[], object], limit_s: float) -> None:
        """Repeat ``work``, and look at what it draws, until ``done``."""
        end = time.monotonic() + limit_s
        while not done():
            assert time.monotonic() < end, self.shown.lines
            work()
            self.hear()

    def hear(self) -> None:
        while True:
            try:
                self.shown.hear(os.read(self.master, 1 << 16))
            except OSError:
                return

    def type(self, data: bytes) -> None:
        os.write(self.master, data)

    def close(self) -> None:
        os.close(self.slave)
        os.close(self.master)
