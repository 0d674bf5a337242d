"""Where recordings go: one interface for files of bytes and files of numbers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, Self

from pmutools.c37118.demux import Message
from pmutools.formats.naming import Namer, stream_name

if TYPE_CHECKING:
    from pmutools.c37118.config import StreamConfig
    from pmutools.flow import Flow
    from pmutools.formats.fields import Fields
    from pmutools.formats.source import Block

Wants = Literal["messages", "blocks"]


class SinkOptions(NamedTuple):
    """How a recording is written; ``phasors``, ``long`` and ``fields`` concern tables."""

    phasors: Literal["polar", "rect"] = "polar"
    """As magnitude and angle, or as two parts."""
    long: bool = False
    """One row a value of any stream, not a frame of one."""
    fields: Fields | None = None
    """The columns wanted; None: all."""
    per_stream: bool = False
    """One file a stream in a folder, from the first stream on."""
    name: Namer = stream_name
    """What a stream's file is called there."""
    suffix: str = ""
    """The suffix of what goes to standard output."""


PLAIN = SinkOptions()


class Sink(Protocol):
    """A recording being written. Every method raises SourceError where the system refuses to write."""

    @property
    def wants(self) -> Wants:
        """What the sink is to be given: every message (data frames too), or data frames in blocks."""

    @property
    def paths(self) -> list[Path]:
        """The files written so far."""

    def write(self, item: Message | Block) -> None:
        """Append. A sink that wants blocks passes over messages; one that wants messages encodes blocks itself."""

    def flush(self) -> None:
        """Hand on what the format can make readable before its end."""

    def close(self) -> None:
        """Finish the file; may be called again."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class FrameSink(ABC):
    """What sinks of frames have in common; each adds :meth:`put`."""

    wants: Wants = "messages"

    def __init__(self, path: Path) -> None:
        self.paths = [path]
        self._shown: dict[tuple[Flow, int], StreamConfig] = {}

    @abstractmethod
    def put(self, message: Message) -> None:
        """Append one frame."""

    @abstractmethod
    def flush(self) -> None: ...

    @abstractmethod
    def close(self) -> None: ...

    def write(self, item: Message | Block) -> None:
        if isinstance(item, Message):
            self.put(item)
            return
        from pmutools.formats.source import frames_of

        for message in frames_of(item, self._shown):
            self.put(message)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
