"""A terminal to draw on: entered, written to without waiting, and set back whatever happens."""

from __future__ import annotations

import io
import os
import select
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from rich.color import ColorSystem
from rich.console import Console
from rich.style import Style
from rich.text import Text

from pmutools.errors import SettingsError

LAST_WORDS_S = 0.2
"""How long a terminal may take to be set back."""

_ENTER = b"\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J"
_LEAVE = b"\x1b[0m\x1b[?7h\x1b[?25h\x1b[?1049l"
_PLAIN_TEXT = str.maketrans("━─●→←↑↓×…▸▲■✕▁▂▃▄▅▆▇█µ", "=-o><^vx~>^#x_.-:=+*#u")
"""For terminals that are not UTF-8."""


def is_terminal(keyboard: int = 0, screen: int = 2, environment: Mapping[str, str] = os.environ) -> bool:
    """Whether these descriptors are a terminal that can be drawn on."""
    return (
        os.name == "posix"
        and os.isatty(keyboard)
        and os.isatty(screen)
        and environment.get("TERM", "dumb") not in ("", "dumb")
    )


class Terminal:
    """A terminal in one-key-at-a-time mode and on its other screen, from :meth:`enter` to :meth:`leave`.

    ``keyboard`` and ``screen`` are descriptors for which :func:`is_terminal` holds. Raises SettingsError where the
    terminal cannot be opened.
    """

    def __init__(self, keyboard: int, screen: int, environment: Mapping[str, str]) -> None:
        import termios

        self.keyboard, self._screen = keyboard, screen
        self._termios: Any = termios
        try:  # a description of its own: the shell's would not like to be non-blocking
            self._out = os.open(os.ttyname(screen), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
        except OSError as error:
            raise SettingsError(f"the terminal cannot be drawn on: {error.strerror}") from None
        self._before: Any = None
        self._console = Console(file=io.StringIO())  # of which only the styles are used
        self._coloured = not environment.get("NO_COLOR")
        names = environment.get("LC_ALL") or environment.get("LC_CTYPE") or environment.get("LANG") or ""
        self._utf8 = "utf" in names.lower()
        self.queue = bytearray()

    def fileno(self) -> int:
        return self._out

    @property
    def entered(self) -> bool:
        return self._before is not None

    def size(self) -> tuple[int, int]:
        """Columns and lines."""
        try:
            size = os.get_terminal_size(self._screen)
        except OSError:
            return 80, 24
        return size.columns or 80, size.lines or 24

    def foreground(self) -> bool:
        """Whether this process may use the terminal; in the background it would be stopped."""
        try:
            return os.tcgetpgrp(self.keyboard) == os.getpgrp()
        except OSError:  # not our controlling terminal, so nobody would stop us
            return True

    def enter(self) -> None:
        termios = self._termios
        before = termios.tcgetattr(self.keyboard)
        mode = termios.tcgetattr(self.keyboard)
        mode[3] &= ~(termios.ECHO | termios.ICANON)  # signals of ^C and ^Z stay
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
        termios.tcsetattr(self.keyboard, termios.TCSANOW, mode)
        self._before = before
        self.queue[:] = _ENTER

    def leave(self) -> None:
        """Set everything back, as far as the terminal lets us within :data:`LAST_WORDS_S`."""
        if self._before is None:
            return
        before, self._before = self._before, None
        with suppress(OSError, self._termios.error):
            self._termios.tcsetattr(self.keyboard, self._termios.TCSANOW, before)
        self.queue += _LEAVE
        with suppress(OSError):
            while self.queue and select.select((), (self._out,), (), LAST_WORDS_S)[1]:
                self.write()
        self.queue.clear()

    def close(self) -> None:
        self.leave()
        os.close(self._out)

    def write(self) -> None:
        """What waits, as far as the terminal takes it; raises OSError where it is gone."""
        with suppress(BlockingIOError):
            while self.queue:
                del self.queue[: os.write(self._out, self.queue)]

    def ansi(self, line: Text) -> str:
        """One line with the terminal's own control sequences."""
        parts = []
        for text, style, _ in line.render(self._console):
            shown = text if self._utf8 else text.translate(_PLAIN_TEXT).encode("ascii", "replace").decode()
            used = style or Style.null()
            used = used if self._coloured else used.without_color
            parts.append(used.render(shown, color_system=ColorSystem.STANDARD))
        return "".join(parts)


class Descriptor:
    """A bare descriptor, for the reactor."""

    def __init__(self, number: int) -> None:
        self._number = number

    def fileno(self) -> int:
        return self._number
