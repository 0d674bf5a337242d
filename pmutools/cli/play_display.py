"""``pmu play --interactive``: the screen and the keys, within the player's own loop.

The loop must not be held up by a terminal, so the screen is written to a descriptor of its own that does not block:
what a slow terminal does not take waits, and nothing is drawn meanwhile. The player is looked at four times a second,
a key is echoed at most twenty times a second, and only lines that have changed are written.
"""

from __future__ import annotations

import io
import os
import select
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from types import FrameType
from typing import Any

from rich.color import ColorSystem
from rich.console import Console
from rich.style import Style
from rich.text import Text

from pmutools.cli.play_keys import Ui, decode, foreseen, press
from pmutools.cli.play_screen import Title, lines, page_rows
from pmutools.errors import PmuError, SettingsError
from pmutools.impair.profile import Action
from pmutools.net.reactor import READ, WRITE, Reactor, Timer
from pmutools.timebase import NS
from pmutools.tools.player.control import Controlled
from pmutools.tools.player.status import PlayerStatus, PlayState

TICK_NS = NS // 8
DRAW_NS = NS // 4
"""At least this between two looks at the player."""
ECHO_NS = NS // 20
"""At least this between two pictures, when keys are pressed."""
ESCAPE_NS = NS // 20
"""How long after ESC its sequence may take to come; then it was the key itself."""
REACHED_S = 2.0
"""The speed reached is that of so many seconds."""
LAST_WORDS_S = 0.2
"""How long a terminal may take to be set back."""
READ_BYTES = 256
LINES_A_TURN = 12
"""Lines made at once, some 0.5 ms, before the player has its turn."""
TURN_NS = 1_000_000

_ENTER = b"\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J"
_LEAVE = b"\x1b[0m\x1b[?7h\x1b[?25h\x1b[?1049l"
_PLAIN_TEXT = str.maketrans("━─●→←↑↓×…▸", "=-o><^vx~>")
"""For terminals that are not UTF-8."""


def require_terminal(keyboard: int = 0, screen: int = 2, environment: Mapping[str, str] = os.environ) -> None:
    """Raise SettingsError unless these descriptors are a terminal: to be asked before anything that takes long."""
    if os.name != "posix":
        raise SettingsError("--interactive needs a POSIX terminal; use --control and pmu ctl")
    if not os.isatty(keyboard) or not os.isatty(screen) or environment.get("TERM", "dumb") in ("", "dumb"):
        raise SettingsError("--interactive needs a terminal; use --control and pmu ctl")


class Terminal:
    """A terminal in one-key-at-a-time mode and on its other screen, from :meth:`enter` to :meth:`leave`.

    ``keyboard`` and ``screen`` are descriptors. Raises SettingsError where they are no terminal that can be drawn on.
    """

    def __init__(self, keyboard: int, screen: int, environment: Mapping[str, str]) -> None:
        require_terminal(keyboard, screen, environment)
        import termios

        self.keyboard, self._screen = keyboard, screen
        self._termios: Any = termios
        try:  # a description of its own: the shell's would not like to be non-blocking
            self._out = os.open(os.ttyname(screen), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
        except OSError as error:
            raise SettingsError(f"--interactive needs a terminal ({error.strerror}); use --control") from None
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


class Display:
    """The player on a terminal, from ``with`` to its end. Keys reach the player from within ``reactor``.

    Keys come from ``keyboard`` (standard input), the screen is ``screen`` (standard error, so that standard output is
    data). Raises SettingsError, before anything is changed, where there is no terminal.
    """

    def __init__(
        self,
        player: Controlled,
        reactor: Reactor,
        title: Title,
        *,
        keyboard: int = 0,
        screen: int = 2,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._player, self._reactor, self._title = player, reactor, title
        self._terminal = Terminal(keyboard, screen, environment)
        self.ui = Ui()
        self.quit = False
        """Whether the person, or a hang-up, asked for the end."""
        self._status: PlayerStatus | None = None
        self._seen_ns = self._as_of_ns = self._drawn_ns = -DRAW_NS
        self._dirty = True
        self._shown: list[str] = []
        """Lines as they are on the screen, or in the queue for it."""
        self._picture: Iterator[tuple[int, Text]] | None = None
        self._size = (0, 0)
        self._pending = b""
        self._escape: Timer | None = None
        self._tick: Timer | None = None
        self._course = deque[tuple[float, float]](maxlen=64)
        self._stop_asked = self._continued = self._gone = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Display:
        for number, handler in self._signals():
            self._handlers[number] = signal.signal(number, handler)
        try:
            self._enter()
            self._on_tick()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for timer in (self._tick, self._escape):
            if timer is not None:
                timer.cancelled = True
        self._leave()
        self._terminal.close()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()
        self._gone = True

    def note(self, event: str) -> None:
        """Something has happened: shown from the next picture on."""
        self.ui = self.ui.noted(event)
        self._dirty = True

    # --- the terminal comes and goes

    def _signals(self) -> list[tuple[int, Callable[[int, FrameType | None], None]]]:
        """Handlers only note: what follows is done in the loop, where the player is in one piece."""

        def stop(signum: int, frame: FrameType | None) -> None:
            self._stop_asked = True

        def go_on(signum: int, frame: FrameType | None) -> None:
            self._continued = True

        def hang_up(signum: int, frame: FrameType | None) -> None:
            self.quit = True

        return [(signal.SIGTSTP, stop), (signal.SIGCONT, go_on), (signal.SIGHUP, hang_up)]

    def _enter(self) -> None:
        if not self._terminal.foreground():
            return
        self._terminal.enter()
        self._shown.clear()
        self._reactor.watch(_Fd(self._terminal.keyboard), READ, self._on_keys)
        self._dirty = True

    def _leave(self) -> None:
        self._picture = None
        self._reactor.forget(_Fd(self._terminal.keyboard))
        self._reactor.forget(self._terminal)
        self._terminal.leave()

    def _suspend(self) -> None:
        """Stop, as ^Z wants; the source's time stops too, else all that is missed would follow in a burst."""
        playing = self._player.status().state is PlayState.PLAYING
        if playing:
            self._act(Action("pause"))
        self._leave()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)  # back here with SIGCONT
        signal.signal(signal.SIGTSTP, dict(self._signals())[signal.SIGTSTP])
        if playing:
            self._act(Action("resume"))

    def _lost(self) -> None:
        """The terminal is gone: so is the person."""
        self._gone = self.quit = True
        self._leave()

    # --- the loop's calls

    def _on_tick(self) -> None:
        if self._gone:
            return
        if self._stop_asked:
            self._stop_asked = False
            self._suspend()
        if self._continued or not self._terminal.entered:  # stopped by others, or until now in the background
            self._continued = False
            if self._terminal.entered:
                self._leave()
            self._enter()
        if self._terminal.entered:
            self._draw()
        self._tick = self._reactor.call_in(TICK_NS, self._on_tick)

    def _on_keys(self, _events: int) -> None:
        try:
            data = os.read(self._terminal.keyboard, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        if not data:
            self._lost()
            return
        self._hear(data, final=False)

    def _hear(self, data: bytes, *, final: bool) -> None:
        if self._escape is not None:
            self._escape.cancelled, self._escape = True, None
        keys, self._pending = decode(self._pending + data, final=final)
        if self._pending:
            self._escape = self._reactor.call_in(ESCAPE_NS, self._on_escape)
        for key in keys:
            step = press(self.ui, key, self._now())
            self.ui = step.ui
            self.quit |= step.quit
            for action in step.do:
                self._act(action)
        self._dirty = True
        self._draw()

    def _on_escape(self) -> None:
        self._escape = None
        if not self._gone:
            self._hear(b"", final=True)

    def _act(self, action: Action) -> None:
        status = self._now()
        try:
            self._player.act(action)
        except (PmuError, ValueError) as error:
            self.ui = self.ui.said(str(error), error=True)
            return
        self._status = None if action.verb in ("pause", "step") else foreseen(status, action)  # stands still: ask
        self._course.clear()

    def _now(self) -> PlayerStatus:
        """The player's state as of the last look, its position as of now."""
        status, now_ns = self._look(), self._reactor.clock.monotonic_ns()
        if status.state is PlayState.PLAYING:
            position_s = status.position_s + status.speed * (now_ns - self._as_of_ns) / NS
            status = replace(status, position_s=min(position_s, max(status.length_s, status.position_s)))
        self._as_of_ns, self._status = now_ns, status
        return status

    def _look(self) -> PlayerStatus:
        """The player's state, not older than :data:`DRAW_NS`."""
        now_ns = self._reactor.clock.monotonic_ns()
        if self._status is None or now_ns - self._seen_ns >= DRAW_NS:
            self._status, self._seen_ns, self._as_of_ns, self._dirty = self._player.status(), now_ns, now_ns, True
            here_s = self._status.position_s
            if self._status.state is not PlayState.PLAYING or (self._course and here_s < self._course[-1][1]):
                self._course.clear()
            self._course.append((now_ns / NS, here_s))
        return self._status

    def _reached(self) -> float | None:
        """Source seconds per second, over the last :data:`REACHED_S`."""
        while len(self._course) > 2 and self._course[-1][0] - self._course[0][0] > REACHED_S:
            self._course.popleft()
        if len(self._course) < 2 or self._course[-1][0] <= self._course[0][0]:
            return None
        (first_s, from_s), (last_s, to_s) = self._course[0], self._course[-1]
        return (to_s - from_s) / (last_s - first_s)

    def _draw(self) -> None:
        """Begin a picture, if one is due and the last one has been taken."""
        now_ns = self._reactor.clock.monotonic_ns()
        if not self._terminal.entered or self._picture is not None or now_ns - self._drawn_ns < ECHO_NS:
            return
        status = self._look()
        size = self._terminal.size()
        if (self._terminal.queue and self._shown) or not (self._dirty or size != self._size):
            return
        if size != self._size:
            self._size, self._shown = size, []
            self._terminal.queue += b"\x1b[2J"
        self._drawn_ns, self._dirty = now_ns, False
        self.ui = replace(self.ui, rows=page_rows(size[1]))
        self._picture = enumerate(lines(status, self.ui, self._title, *size, self._reached()))
        self._paint()

    def _paint(self) -> None:
        """Some more lines of the picture: those that differ from what is on the screen."""
        if self._picture is None:
            return
        for _ in range(LINES_A_TURN):
            number, made = next(self._picture, (0, None))
            if made is None:
                self._picture = None
                break
            line = self._terminal.ansi(made)
            if number == len(self._shown):
                self._shown.append("")
            if self._shown[number] != line:
                self._shown[number] = line
                self._terminal.queue += f"\x1b[{number + 1};1H{line}\x1b[0m\x1b[K".encode()
        if self._picture is not None:
            self._reactor.call_in(TURN_NS, self._paint)
        self._on_writable(0)

    def _on_writable(self, _events: int) -> None:
        try:
            self._terminal.write()
        except OSError:
            self._lost()
            return
        if self._terminal.queue:
            self._reactor.watch(self._terminal, WRITE, self._on_writable)
        else:
            self._reactor.forget(self._terminal)


class _Fd:
    """A bare descriptor, for the reactor."""

    def __init__(self, number: int) -> None:
        self._number = number

    def fileno(self) -> int:
        return self._number
