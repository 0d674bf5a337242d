"""Where the news of a command with live streams go: to stderr, or to its ``--live`` display while there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pmutools.cli.herald import Herald
from pmutools.cli.news import News
from pmutools.cli.shell import Talk

if TYPE_CHECKING:
    from pmutools.c37118.demux import Loss, Message
    from pmutools.cli.live_show import LiveShow
    from pmutools.formats.source import Block
    from pmutools.host import ClockStep, Stall
    from pmutools.net.dialogue import LinkEvent
    from pmutools.tools.live import LiveSource


class Stage:
    """Made before the source, which is given :meth:`hear`, :meth:`hear_host` and :meth:`over`.

    :meth:`open` begins the display.
    """

    def __init__(self, talk: Talk, verbose: int, stop: Callable[[], bool]) -> None:
        self._talk, self._herald, self._stop = talk, Herald(talk), stop
        self._news = News(self.say, verbose)
        self._show: LiveShow | None = None
        self.reasons = self._news.reasons

    @contextmanager
    def open(self, source: LiveSource, title: str, **how: Any) -> Iterator[LiveShow]:
        """The display of ``source``; ``how`` as :class:`~pmutools.cli.live_show.LiveShow` takes it."""
        from pmutools.cli.live_show import LiveShow  # which needs rich

        with LiveShow(source, title, talk=self._talk, **how) as self._show:
            try:
                yield self._show
            finally:
                self._show = None

    def hear(self, event: LinkEvent) -> None:
        """News of the source."""
        self._news(event)
        if self._show is not None:
            self._show.hear(event)

    def hear_host(self, event: Stall | ClockStep) -> None:
        """News of this machine, as the source tells them."""
        self._news.host(event)

    def over(self) -> bool:
        """Whether the end was asked for, by a signal or in the display."""
        return self._stop() or (self._show is not None and self._show.screen.quit_asked)

    def look(self, found: Sequence[Block | Message | Loss], now_ns: int) -> None:
        """A round of the source's; ``now_ns`` is monotonic."""
        if self._show is not None:
            self._show.each_round(found, now_ns)

    def say(self, text: str) -> None:
        """A line for the person."""
        (self._herald.say if self._show is None else self._show.screen.note)(text)

    def progress(self, line: Callable[[], str]) -> None:
        """How far it is; the display tells that itself."""
        if self._show is None:
            self._herald.progress(line)
