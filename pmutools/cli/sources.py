"""Opening what the user named: a file, or the URL of a live stream."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import click

from pmutools import parsers
from pmutools.cli.shell import Parsed, Talk, interruptible
from pmutools.errors import SettingsError
from pmutools.timebase import NS

if TYPE_CHECKING:
    from pmutools.c37118.demux import Loss, Message
    from pmutools.formats.source import Block, Source

T = TypeVar("T")
TOLD_FRAMES = 10_000
TARGET = str
"""A path, or an endpoint URL."""


IDCODES = click.option(
    "--idcode",
    "idcodes",
    type=Parsed(parsers.integer(0, 0xFFFF)),
    multiple=True,
    metavar="N",
    help="Only this stream; repeatable.",
)
START = click.option(
    "--start", type=Parsed(parsers.parse_place), metavar="T", help="From T: seconds into the source, or ISO-8601 UTC."
)
END = click.option("--end", type=Parsed(parsers.parse_place), metavar="T", help="Up to T, exclusive.")
DURATION = click.option(
    "--duration",
    "duration_ns",
    type=Parsed(parsers.duration_ns(NS, 0.001)),
    metavar="S",
    help="Stop after S seconds: wall time for a live stream, stream time for a file.",
)


def is_live(target: str) -> bool:
    """Whether the user named an endpoint, not a file."""
    return "://" in target


class Opened(NamedTuple):
    """What the user named, open for reading."""

    source: Source
    why: Callable[[], str]
    """Why it has given no frames, as part of a sentence."""
    stopped: Callable[[], bool] = lambda: False
    """Whether the user has stopped it: reading then ends."""


@contextmanager
def open_target(target: str, duration_ns: int | None, talk: Talk, verbose: int = 0) -> Iterator[Opened]:
    """A file, cut to ``duration_ns`` of stream time, or an endpoint, read for that wall time or until Ctrl-C.

    The news of an endpoint are told as they come.
    """
    if is_live(target):
        from pmutools.cli.herald import Herald
        from pmutools.cli.news import News
        from pmutools.tools.live import LiveSource

        news = News(Herald(talk).say, verbose)
        with interruptible() as stop, LiveSource([target], duration_ns=duration_ns, tell=news, stop=stop) as live:
            yield Opened(live, news.reasons.why, stop)
        return
    from pmutools.formats import open_source

    source = open_source(target)
    cut = source if duration_ns is None else Cut(source, duration_ns)
    yield Opened(cut, lambda: f"no C37.118 frames found in {source.tally.fed} bytes of payload")


class _Through:
    """A source seen through something; ``tally``, ``defects`` and the like are its own."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)


class Cut(_Through):
    """A source whose data frames end ``duration_ns`` after the first."""

    def __init__(self, source: Source, duration_ns: int) -> None:
        super().__init__(source)
        self._duration_ns = duration_ns

    def items(self) -> Iterator[Message | Loss]:
        from pmutools.tools.window import Window

        return Window(duration_ns=self._duration_ns).items(self.source.items())

    def blocks(self) -> Iterator[Block | Message | Loss]:
        from pmutools.tools.window import Window

        return Window(duration_ns=self._duration_ns).blocks(self.source.blocks())


class Watched(_Through):
    """A source whose progress is shown while it is read; ``name`` is what the user calls it."""

    def __init__(self, source: Source, talk: Talk, name: str = "") -> None:
        super().__init__(source)
        self._talk, self._name = talk, name or str(source.path)

    def items(self) -> Iterator[Message | Loss]:
        return self._watched(self.source.items())

    def blocks(self) -> Iterator[Block | Message | Loss]:
        return self._watched(self.source.blocks())

    def _watched(self, items: Iterator[T]) -> Iterator[T]:
        frames = told = 0
        try:
            for item in items:
                yield item
                frames += len(item.batch) if hasattr(item, "batch") else 1
                if frames >= told + TOLD_FRAMES:
                    told = frames
                    self._talk.progress(f"{self._name}: {frames} frames")
        finally:
            self._talk.progress("")


def spare(output: str | Path, inputs: Sequence[str]) -> None:
    """Raise SettingsError if ``output`` is one of the inputs, which opening it for writing would destroy."""
    out = Path(output)
    if out.exists() and any(Path(name).exists() and out.samefile(name) for name in inputs):
        raise SettingsError(f"{output} is an input, and would be overwritten; write to another file")
