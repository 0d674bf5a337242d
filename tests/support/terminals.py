"""Pseudo terminals, and what is on them."""

from __future__ import annotations

import re
import sys

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
