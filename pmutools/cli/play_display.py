"""``pmu play --interactive``: the player's state on the screen, keys that control it, within the player's own loop.

The player is looked at four times a second.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from rich.text import Text

from pmutools.cli.play_keys import Ui, foreseen, press
from pmutools.cli.play_screen import Title, lines, page_rows
from pmutools.cli.screen import Screen
from pmutools.cli.terminal import is_terminal
from pmutools.errors import PmuError, SettingsError
from pmutools.impair.profile import Action
from pmutools.net.reactor import Reactor
from pmutools.timebase import NS
from pmutools.tools.player.control import Controlled
from pmutools.tools.player.status import PlayerStatus, PlayState

DRAW_NS = NS // 4
"""At least this between two looks at the player."""
REACHED_S = 2.0
"""The speed reached is that of so many seconds."""


def require_terminal(keyboard: int = 0, screen: int = 2, environment: Mapping[str, str] = os.environ) -> None:
    """Raise SettingsError unless these descriptors are a terminal: to be asked before anything that takes long."""
    if not is_terminal(keyboard, screen, environment):
        raise SettingsError("--interactive needs a terminal; use --control and pmu ctl")


class Display(Screen):
    """The player on a terminal. Raises SettingsError, before anything is changed, where there is no terminal."""

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
        require_terminal(keyboard, screen, environment)
        super().__init__(reactor, keyboard=keyboard, screen=screen, environment=environment)
        self._player, self._title = player, title
        self.ui = Ui()
        self._status: PlayerStatus | None = None
        self._seen_ns = self._as_of_ns = -DRAW_NS
        self._course = deque[tuple[float, float]](maxlen=64)

    def note(self, event: str) -> None:
        """Something has happened: shown from the next picture on."""
        self.ui = self.ui.noted(event)
        self.dirty = True

    def look(self) -> None:
        self._look()

    def picture(self, width: int, height: int) -> Iterator[Text]:
        self.ui = replace(self.ui, rows=page_rows(height))
        return lines(self._look(), self.ui, self._title, width, height, self._reached())

    def press(self, key: str) -> None:
        step = press(self.ui, key, self._now())
        self.ui = step.ui
        self.quit |= step.quit
        for action in step.do:
            self._act(action)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """The source's time stops too, else all that is missed would follow in a burst."""
        playing = self._player.status().state is PlayState.PLAYING
        if playing:
            self._act(Action("pause"))
        yield
        if playing:
            self._act(Action("resume"))

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
        status, now_ns = self._look(), self.reactor.clock.monotonic_ns()
        if status.state is PlayState.PLAYING:
            position_s = status.position_s + status.speed * (now_ns - self._as_of_ns) / NS
            status = replace(status, position_s=min(position_s, max(status.length_s, status.position_s)))
        self._as_of_ns, self._status = now_ns, status
        return status

    def _look(self) -> PlayerStatus:
        """The player's state, not older than :data:`DRAW_NS`."""
        now_ns = self.reactor.clock.monotonic_ns()
        if self._status is None or now_ns - self._seen_ns >= DRAW_NS:
            self._status, self._seen_ns, self._as_of_ns, self.dirty = self._player.status(), now_ns, now_ns, True
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
