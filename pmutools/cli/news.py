"""The news of live endpoints for a person, as they come."""

from __future__ import annotations

from collections.abc import Callable

from pmutools.net.dialogue import LinkEvent
from pmutools.tools.news import USUAL, Reasons, told

PLACES = 10_000
"""So many places are remembered for what was said of them; more come from a flood only."""


class News:
    """Has ``say`` say what is out of the ordinary, and once what is said again; with ``verbose`` everything.

    ``reasons`` are what it has heard.
    """

    def __init__(self, say: Callable[[str], None], verbose: int) -> None:
        self.reasons = Reasons()
        self._say, self._verbose = say, verbose
        self._said: dict[str, str] = {}

    def __call__(self, event: LinkEvent) -> None:
        self.reasons.hear(event)
        text = told(event)
        if self._verbose or (event.kind not in USUAL and self._said.get(event.where) != text):
            self._say(f"{event.where}: {text}")
        if event.where in self._said or len(self._said) < PLACES:
            self._said[event.where] = text
