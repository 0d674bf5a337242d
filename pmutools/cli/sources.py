"""Opening what the user named: a file, or the URL of a live stream."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pmutools import parsers
from pmutools.cli.shell import Parsed, Talk
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


@contextmanager
def open_target(target: str, duration_ns: int | None) -> Iterator[Source]:
    """A file's source, cut to ``duration_ns`` of stream time, or a live one that ends after that wall time."""
    if "://" in target:
        from pmutools.tools.live import LiveSource

        with LiveSource([target], duration_ns=duration_ns) as live:
            yield live
        return
    from pmutools.formats import open_source

    source = open_source(target)
    yield source if duration_ns is None else _Cut(source, duration_ns)


class _Through:
    """A source seen through something; ``tally``, ``defects`` and the like are its own."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)


class _Cut(_Through):
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
    """A source whose progress is shown while it is read."""

    def __init__(self, source: Source, talk: Talk) -> None:
        super().__init__(source)
        self._talk = talk

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
                    self._talk.progress(f"{self.source.path}: {frames} frames")
        finally:
            self._talk.progress("")


def spare(output: str | Path, inputs: Sequence[str]) -> None:
    """Raise SettingsError if ``output`` is one of the inputs, which opening it for writing would destroy."""
    out = Path(output)
    if out.exists() and any(Path(name).exists() and out.samefile(name) for name in inputs):
        raise SettingsError(f"{output} is an input, and would be overwritten; write to another file")
