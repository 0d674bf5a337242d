"""``--live``: all streams on the terminal while they are taken, or a line of progress where there is no terminal."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from rich.text import Text

from pmutools.cli.herald import Herald
from pmutools.cli.screen import Screen
from pmutools.cli.terminal import is_terminal
from pmutools.cli.watch_keys import Command, Ui, press
from pmutools.cli.watch_screen import around, lines, page_rows, status_line
from pmutools.clock import SystemClock
from pmutools.errors import PmuError
from pmutools.net.reactor import Reactor
from pmutools.timebase import NS
from pmutools.tools.watch import Snapshot, Watch

UPDATE_NS = NS // 4
"""At least this between two looks at the streams."""
LINE_NS = NS
"""... and between two lines of progress."""


class WatchScreen:
    """Shows a :class:`~pmutools.tools.watch.watch.Watch` from ``with`` to its end.

    ``view`` is ``frequency`` or ``delay``, the one to begin with; ``commands`` are keys of the program's own. Without a
    terminal on standard input and error, ``herald`` (if any) tells of it in one line. With a ``reactor`` keys are heard
    and pictures drawn as it runs; else whenever :meth:`update` or :meth:`poll` is called. Nothing here waits: what a
    slow terminal does not take is not drawn.
    """

    def __init__(
        self,
        *,
        title: str,
        view: str = "frequency",
        commands: Sequence[Command] = (),
        herald: Herald | None = None,
        reactor: Reactor | None = None,
        keyboard: int = 0,
        screen: int = 2,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._herald, self._own = herald, reactor is None
        self._next_ns: int | None = None
        self._display: _Display | None = None
        if is_terminal(keyboard, screen, environment):
            self._display = _Display(
                reactor or Reactor(SystemClock()),
                title,
                view,
                commands,
                keyboard=keyboard,
                screen=screen,
                environment=environment,
            )

    def __enter__(self) -> WatchScreen:
        if self._display is not None:
            self._display.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.__exit__()
            if self._own:
                self._display.reactor.close()
        elif self._herald is not None:
            self._herald.progress(lambda: "")

    @property
    def drawn(self) -> bool:
        """Whether there is a terminal: talk then belongs to :meth:`note`."""
        return self._display is not None

    @property
    def quit_asked(self) -> bool:
        """Whether the person, or a hang-up, asked for the end."""
        return self._display is not None and self._display.quit

    def note(self, event: str) -> None:
        """Something has happened: a line among the events, or of talk."""
        if self._display is not None:
            self._display.note(event)
        elif self._herald is not None:
            self._herald.say(event)

    def update(self, watch: Watch, now_ns: int, facts: Sequence[str] = ()) -> None:
        """Show how the streams are now, and some facts above them; at most four times a second, then it costs little.

        ``now_ns`` is monotonic, as ``watch`` knows it.
        """
        due = self._next_ns is None or now_ns >= self._next_ns
        if self._display is None:
            if due and self._herald is not None:
                self._next_ns = now_ns + LINE_NS
                self._herald.progress(lambda: "  ".join((status_line(watch.look(now_ns)), *facts)))
            return
        if due:
            self._next_ns = now_ns + UPDATE_NS
            self._display.show(watch.look(now_ns), facts)
        self.poll()

    def poll(self) -> None:
        """Hear keys and draw what is due; to be called often where there is no reactor of the program's."""
        if self._display is not None and self._own:
            self._display.reactor.run(0)


class _Display(Screen):
    lines_a_turn = 1000
    """All at once: nobody here has to be on time to the millisecond."""

    def __init__(
        self,
        reactor: Reactor,
        title: str,
        view: str,
        commands: Sequence[Command],
        *,
        keyboard: int,
        screen: int,
        environment: Mapping[str, str],
    ) -> None:
        super().__init__(reactor, keyboard=keyboard, screen=screen, environment=environment)
        self._title, self._commands = title, {command.key: command for command in commands}
        self.ui = Ui(view=view)
        self._snapshot: Snapshot | None = None
        self._shown_of: Snapshot | None = None
        self._facts: tuple[str, ...] = ()

    def show(self, snapshot: Snapshot, facts: Sequence[str]) -> None:
        self._snapshot, self._facts = snapshot, tuple(facts)
        if not self.ui.frozen or self._shown_of is None:
            self._shown_of, self.dirty = snapshot, True
            self.refresh()

    def note(self, event: str) -> None:
        self.ui = self.ui.noted(event)
        self.dirty = True

    def look(self) -> None:
        """What is shown was given."""

    def picture(self, width: int, height: int) -> Iterator[Text]:
        if self._shown_of is None:
            return iter([Text(self._title)])
        self.ui = replace(self.ui, rows=page_rows(height))
        commands = tuple(self._commands.values())
        return lines(self._shown_of, self.ui, self._title, self._facts, width, height, commands)

    def press(self, key: str) -> None:
        if self._shown_of is None:
            self.quit |= key == "q"
            return
        command = self._commands.get(key)
        if command is not None and not (self.ui.typing or self.ui.help):
            self._do(command)
            return
        step = press(self.ui, key, around(self._shown_of, self.ui))
        self.ui = step.ui
        self.quit |= step.quit
        if not self.ui.frozen and self._snapshot is not None:
            self._shown_of = self._snapshot

    def _do(self, command: Command) -> None:
        try:
            self.ui = self.ui.said(command.do())
        except (PmuError, ValueError, OSError) as error:
            self.ui = self.ui.said(str(error), error=True)
