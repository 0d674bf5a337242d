"""Telling a person what happens while something runs on time: never much at once, and never waiting to be read."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable

from pmutools.cli.shell import Talk

LINES_PER_S = 10
BURST = 40


class Herald:
    """Says lines, a burst of :data:`BURST` and :data:`LINES_PER_S` after that; what is more is counted, and told so.

    A terminal that is stopped, or a pipe that nobody reads, costs lines and no time.
    """

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        self._allowed, self._then_s = float(BURST), time.monotonic()
        self._unsaid = 0

    def say(self, text: str) -> None:
        now_s = time.monotonic()
        self._allowed = min(BURST, self._allowed + (now_s - self._then_s) * LINES_PER_S)
        self._then_s = now_s
        if self._allowed < 1 or not _taken():
            self._unsaid += 1
            return
        self._allowed -= 1
        if self._unsaid:
            self._talk.say(f"({self._unsaid} lines left out)")
            self._unsaid = 0
        self._talk.say(text[:LINE_CHARACTERS])

    def progress(self, line: Callable[[], str]) -> None:
        """A line that the next one overwrites; it is not made where nobody would see it."""
        if not self._talk.quiet and sys.stderr.isatty() and _taken():
            self._talk.progress(line()[:LINE_CHARACTERS])


LINE_CHARACTERS = 1000
"""What is ready to be written to takes a line of this length at once."""


def _taken() -> bool:
    """Whether a line to stderr would be taken without waiting."""
    if sys.platform == "win32":
        return True
    try:
        return bool(select.select([], [sys.stderr], [], 0)[1])
    except (OSError, ValueError):  # it is no descriptor
        return True
