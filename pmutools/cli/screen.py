"""A picture on a terminal, kept up to date within a reactor's loop.

The loop must not be held up by a terminal, so the screen is written to a descriptor of its own that does not block:
what a slow terminal does not take waits, and nothing is drawn meanwhile. A key is echoed at most twenty times a second,
and only lines that have changed are written.
"""

from __future__ import annotations

import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import FrameType
from typing import Any, Self

from rich.text import Text

from pmutools.cli.keys import decode
from pmutools.cli.terminal import Descriptor, Terminal
from pmutools.net.reactor import READ, WRITE, Reactor, Timer
from pmutools.timebase import NS

TICK_NS = NS // 8
ECHO_NS = NS // 20
"""At least this between two pictures, when keys are pressed."""
ESCAPE_NS = NS // 20
"""How long after ESC its sequence may take to come; then it was the key itself."""
READ_BYTES = 256
TURN_NS = 1_000_000


class Screen(ABC):
    """A picture on a terminal, from ``with`` to its end; keys and ticks come from within ``reactor``.

    Keys come from ``keyboard`` (standard input), the picture is on ``screen`` (standard error, so that standard output
    is data). Raises SettingsError, before anything is changed, where the terminal cannot be opened.
    """

    lines_a_turn = 12
    """Lines made at once, some 0.5 ms, before others have their turn."""

    def __init__(
        self,
        reactor: Reactor,
        *,
        keyboard: int = 0,
        screen: int = 2,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self.reactor = reactor
        self.terminal = Terminal(keyboard, screen, environment)
        self.quit = False
        """Whether the person, or a hang-up, asked for the end."""
        self.dirty = True
        """Whether the picture is no longer what is on the screen."""
        self._drawn_ns = -NS
        self._shown: list[str] = []
        """Lines as they are on the screen, or in the queue for it."""
        self._picture: Iterator[tuple[int, Text]] | None = None
        self._size = (0, 0)
        self._pending = b""
        self._escape: Timer | None = None
        self._tick: Timer | None = None
        self._stop_asked = self._continued = self._gone = False
        self._handlers: dict[int, Any] = {}

    # --- what it shows

    @abstractmethod
    def picture(self, width: int, height: int) -> Iterator[Text]:
        """The lines, ``height`` of them, each made when it is asked for."""

    @abstractmethod
    def press(self, key: str) -> None:
        """A key was pressed."""

    @abstractmethod
    def look(self) -> None:
        """Bring what is shown up to date; called before each picture."""

    def suspended(self) -> AbstractContextManager[None]:
        """What has to be done about a stop by ^Z, before it and after."""
        return nullcontext()

    def refresh(self) -> None:
        """Draw, if something has changed and the terminal has taken the last picture."""
        if self.terminal.entered:
            self._draw()

    # --- from its beginning to its end

    def __enter__(self) -> Self:
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
        self.terminal.close()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()
        self._gone = True

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
        if not self.terminal.foreground():
            return
        self.terminal.enter()
        self._shown.clear()
        self.reactor.watch(Descriptor(self.terminal.keyboard), READ, self._on_keys)
        self.dirty = True

    def _leave(self) -> None:
        self._picture = None
        self.reactor.forget(Descriptor(self.terminal.keyboard))
        self.reactor.forget(self.terminal)
        self.terminal.leave()

    def _suspend(self) -> None:
        """Stop, as ^Z wants."""
        with self.suspended():
            self._leave()
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTSTP)  # back here with SIGCONT
            signal.signal(signal.SIGTSTP, dict(self._signals())[signal.SIGTSTP])

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
        if self._continued or not self.terminal.entered:  # stopped by others, or until now in the background
            self._continued = False
            if self.terminal.entered:
                self._leave()
            self._enter()
        if self.terminal.entered:
            self._draw()
        self._tick = self.reactor.call_in(TICK_NS, self._on_tick)

    def _on_keys(self, _events: int) -> None:
        try:
            data = os.read(self.terminal.keyboard, READ_BYTES)
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
            self._escape = self.reactor.call_in(ESCAPE_NS, self._on_escape)
        for key in keys:
            self.press(key)
        self.dirty = True
        self._draw()

    def _on_escape(self) -> None:
        self._escape = None
        if not self._gone:
            self._hear(b"", final=True)

    def _draw(self) -> None:
        """Begin a picture, if one is due and the last one has been taken."""
        now_ns = self.reactor.clock.monotonic_ns()
        if not self.terminal.entered or self._picture is not None or now_ns - self._drawn_ns < ECHO_NS:
            return
        self.look()
        size = self.terminal.size()
        if (self.terminal.queue and self._shown) or not (self.dirty or size != self._size):
            return
        if size != self._size:
            self._size, self._shown = size, []
            self.terminal.queue += b"\x1b[2J"
        self._drawn_ns, self.dirty = now_ns, False
        self._picture = enumerate(self.picture(*size))
        self._paint()

    def _paint(self) -> None:
        """Some more lines of the picture: those that differ from what is on the screen."""
        if self._picture is None:
            return
        for _ in range(self.lines_a_turn):
            number, made = next(self._picture, (0, None))
            if made is None:
                self._picture = None
                break
            line = self.terminal.ansi(made)
            if number == len(self._shown):
                self._shown.append("")
            if self._shown[number] != line:
                self._shown[number] = line
                self.terminal.queue += f"\x1b[{number + 1};1H{line}\x1b[0m\x1b[K".encode()
        if self._picture is not None:
            self.reactor.call_in(TURN_NS, self._paint)
        self._on_writable(0)

    def _on_writable(self, _events: int) -> None:
        try:
            self.terminal.write()
        except OSError:
            self._lost()
            return
        if self.terminal.queue:
            self.reactor.watch(self.terminal, WRITE, self._on_writable)
        else:
            self.reactor.forget(self.terminal)
