"""Recordings for tests of formats: messages made from :mod:`support.frames`, poured from sources into sinks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from support.frames import Described

from pmutools.c37118 import Frame, FrameType, Message, StreamConfig, decode_config
from pmutools.flow import Flow, StampSource
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block, Source, gather

FLOW = Flow("udp", "192.0.2.11:4713", "192.0.2.1:4801")
STEP_NS = 20_000_000


def messages_of(
    stream: Described, kind: str = "cfg2", *, flow: Flow = FLOW, first_ns: int | None = 1_700_000_000 * 10**9
) -> list[Message]:
    """The stream's configuration and data frames, arriving 20 ms apart (``first_ns`` None: nobody knows when)."""
    opening = stream.config(kind)
    config = decode_config(opening)[1]
    return [
        Message(
            Frame(
                data,
                None if first_ns is None else first_ns + number * STEP_NS,
                StampSource.CAPTURE if first_ns is None else StampSource.KERNEL,
                0,
            ),
            flow,
            config,
        )
        for number, data in enumerate((opening, *stream.data))
    ]


def write(path: Path, items: Iterable[Message | Block | Any], **options: Any) -> list[Path]:
    """A file of ``items``, in the form its sink wants; returns what was written."""
    with open_sink(path, **options) as sink:
        wanted = gather(items) if sink.wants == "blocks" else items
        for item in wanted:
            if isinstance(item, (Message, Block)):
                sink.write(item)
    return sink.paths


def written(path: Path) -> Path:
    """Where the sink of ``path`` put its tables: there, or in the folder named without the suffix."""
    return path if path.exists() else path.with_name(path.name.partition(".")[0])


def read(path: Path, configs: Sequence[StreamConfig] = ()) -> list[Message]:
    """Every message of a recording that must have no losses and no defects."""
    source = open_source(path, configs=configs)
    items = list(source.items())
    assert source.defects() == {}
    assert all(isinstance(item, Message) for item in items), "no bytes are lost"
    assert source.tally.fed == source.tally.framed
    return [item for item in items if isinstance(item, Message)]


def blocks_of(source: Source) -> list[Block]:
    return [item for item in source.blocks() if isinstance(item, Block)]


def data_of(messages: Iterable[Message]) -> list[bytes]:
    """Wire bytes of the data frames."""
    return [message.frame.data for message in messages if message.frame.type is FrameType.DATA]
