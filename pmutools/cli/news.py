"""The news of live endpoints for a person, as they come."""

from __future__ import annotations

from collections.abc import Callable

from pmutools.host import ClockStep, Stall
from pmutools.net.dialogue import LinkEvent
from pmutools.timebase import NS
from pmutools.tools.news import USUAL, Reasons, host_told, told

PLACES = 10_000
"""So many places are remembered for what was said of them; more come from a flood only."""


LONG_STALL_NS = NS
"""Shorter ones come with any load: they hold up what is shown, and lose nothing."""


class News:
    """Has ``say`` say what is out of the ordinary, and once what is said again; with ``verbose`` everything.

    ``reasons`` are what it has heard.
    """

    def __init__(self, say: Callable[[str], None], verbose: int) -> None:
        self.reasons = Reasons()
        self._say, self._verbose = say, verbose
        self._said: dict[str, str] = {}

    def host(self, event: Stall | ClockStep) -> None:
        """Of this machine: that its clock was set, and long stalls; with ``verbose`` all of them."""
        if self._verbose or isinstance(event, ClockStep) or event.length_ns >= LONG_STALL_NS:
            self._say(host_told(event))

    def __call__(self, event: LinkEvent) -> None:
        self.reasons.hear(event)
        text = told(event)
        if self._verbose or (event.kind not in USUAL and self._said.get(event.where) != text):
            self._say(f"{event.label or event.where}: {text}")
        if event.where in self._said or len(self._said) < PLACES:
            self._said[event.where] = text
