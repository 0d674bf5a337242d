"""``--live`` of a command: a watch, the clock and a screen, put together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Loss, Message
from pmutools.cli.herald import Herald
from pmutools.cli.shell import Talk
from pmutools.cli.watch_display import WatchScreen
from pmutools.cli.watch_keys import Command
from pmutools.clocksources.watch import ClockWatch
from pmutools.flow import Flow
from pmutools.formats import JOURNAL
from pmutools.formats.source import Block
from pmutools.measure.stream import WAIT_NS
from pmutools.net.dialogue import LinkEvent
from pmutools.timebase import NS
from pmutools.tools.live import LiveSource
from pmutools.tools.watch import Watch


class LiveShow:
    """From ``with`` to its end: give it the news (:meth:`hear`) and the rounds (:meth:`each_round`) of ``source``.

    ``out`` names what is written, ``paths`` gives its files, whose size is told. ``more`` gives facts of the command's
    own, ``clock`` looks after this machine's clock (None: a watch of its own), ``name`` names those streams (None: as
    the source does).
    """

    def __init__(
        self,
        source: LiveSource,
        title: str,
        *,
        talk: Talk,
        view: str = "frequency",
        out: str | Path | None = None,
        paths: Callable[[], Sequence[Path]] = tuple,
        more: Callable[[], Sequence[str]] = tuple,
        commands: Sequence[Command] = (),
        wait_ns: int = WAIT_NS,
        clock: ClockWatch | None = None,
        name: Callable[[Flow, StreamConfig], str | None] | None = None,
    ) -> None:
        self._source, self._more = source, more
        self._paths = paths
        self._out = None if out is None or str(out) == "-" else Path(out)
        self.watch = Watch(name=name or source.name, wait_ns=wait_ns)
        self.screen = WatchScreen(title=title, view=view, commands=commands, herald=Herald(talk))
        self._facts: tuple[str, ...] = ()
        self._facts_due_ns = 0
        self._clock = clock
        self._stack = ExitStack()

    def __enter__(self) -> LiveShow:
        if self._clock is None:
            self._clock = self._stack.enter_context(ClockWatch())
        self._stack.enter_context(self.screen)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def hear(self, event: LinkEvent) -> None:
        """News of the source."""
        self.watch.hear(event, self._source.clock.monotonic_ns())

    def each_round(self, items: Sequence[Block | Message | Loss], now_ns: int) -> None:
        """What came; ``now_ns`` is monotonic."""
        self.watch.add(items, now_ns)
        if now_ns >= self._facts_due_ns:
            self._facts_due_ns, self._facts = now_ns + NS, tuple(self._look())
        self.screen.update(self.watch, now_ns, self._facts)

    def _look(self) -> Iterator[str]:
        if self._clock is not None:
            yield self._clock.quality.short
        if self._out is not None:
            yield f"{self._out.name} {_size(self._paths()) / 1e6:.1f} MB"
        yield from self._more()


def _size(paths: Iterable[Path]) -> int:
    """Of a recording, with its journal, which holds what unfinished tables do not yet: beside one, in their folder."""
    files: set[Path] = set()
    for path in paths:
        files |= {path, path.with_name(path.name + JOURNAL), path.with_name(path.parent.name + path.suffix + JOURNAL)}
    size = 0
    for file in files:
        with suppress(OSError):  # not there yet, or not any more
            size += file.stat().st_size
    return size
