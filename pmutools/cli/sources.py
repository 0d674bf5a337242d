"""Opening what the user named: a file, or the URL of a live stream."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmutools import parsers
from pmutools.cli.shell import Parsed
from pmutools.errors import SettingsError
from pmutools.timebase import NS

if TYPE_CHECKING:
    from pmutools.c37118.demux import Loss, Message
    from pmutools.formats.source import Block, Source
    from pmutools.tools.window import Moment

TARGET = str
"""A path, or an endpoint URL."""


def _moment(text: str) -> Moment:
    from pmutools.tools.window import parse_moment

    return parse_moment(text)


IDCODES = click.option(
    "--idcode",
    "idcodes",
    type=Parsed(parsers.integer(0, 0xFFFF)),
    multiple=True,
    metavar="N",
    help="Only this stream; repeatable.",
)
START = click.option(
    "--start", type=Parsed(_moment), metavar="T", help="From T: seconds into the source, or ISO-8601 UTC."
)
END = click.option("--end", type=Parsed(_moment), metavar="T", help="Up to T, exclusive.")
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


class _Cut:
    """A source whose data frames end ``duration_ns`` after the first."""

    def __init__(self, source: Source, duration_ns: int) -> None:
        self._source, self._duration_ns = source, duration_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def items(self) -> Iterator[Message | Loss]:
        from pmutools.tools.window import Window

        return Window(duration_ns=self._duration_ns).items(self._source.items())

    def blocks(self) -> Iterator[Block | Message | Loss]:
        from pmutools.tools.window import Window

        return Window(duration_ns=self._duration_ns).blocks(self._source.blocks())


def spare(output: str | Path, inputs: Sequence[str]) -> None:
    """Raise SettingsError if ``output`` is one of the inputs, which opening it for writing would destroy."""
    out = Path(output)
    if out.exists() and any(Path(name).exists() and out.samefile(name) for name in inputs):
        raise SettingsError(f"{output} is an input, and would be overwritten; write to another file")
