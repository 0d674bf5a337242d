"""Rounds into one recording: tables are given blocks, recordings of frames every frame in order of arrival."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Protocol

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import FLOWS, Loss, Message
from pmutools.flow import Flow
from pmutools.formats import Sink
from pmutools.formats.source import Block, frames_of
from pmutools.tools.reader.reading import Round

Shown = dict[tuple[Flow, int], StreamConfig]
_Keyed = tuple[int, Message]


class Recorder(Protocol):
    """Takes rounds. Every method raises SourceError where the system refuses to write."""

    @property
    def undecoded(self) -> int:
        """Frames recorded as they came, because no configuration came for them."""

    @property
    def paths(self) -> list[Path]:
        """The files written so far; may be asked by another thread."""

    def take(self, found: Round) -> None:
        """Record a round."""

    def flush(self) -> None:
        """Make what was taken readable, whatever happens afterwards."""

    def close(self) -> None:
        """Finish; may be called again."""


class Log:
    """One recording, complete in itself: every configuration comes before the data that it rules."""

    def __init__(self, sink: Sink) -> None:
        self.sink = sink
        self.undecoded = 0
        self._shown: Shown = {}

    @property
    def paths(self) -> list[Path]:
        return self.sink.paths

    def take(self, found: Round) -> None:
        if self.sink.wants == "blocks":
            for item in found:
                if isinstance(item, Block):
                    self.sink.write(item)
            return
        for message in messages_of(found, self._shown):
            self.sink.write(message)
            self.undecoded += message.config is None and message.frame.type is FrameType.DATA
        if len(self._shown) > FLOWS:  # connections made anew and anew: configurations are written once more
            self._shown.clear()

    def flush(self) -> None:
        self.sink.flush()

    def close(self) -> None:
        self.sink.close()


def messages_of(found: Round, shown: Shown) -> Iterable[Message]:
    """A round's frames in order of arrival, none before its configuration, those that none came for without one.

    ``shown`` are the configurations that have been given out; one that lacks is made up before the first frame that
    needs it. Memory: the frames of the round.
    """
    keyed: list[_Keyed] = []
    since: dict[tuple[Flow, int], int] = {}
    for item in found:
        if isinstance(item, Loss):
            if item.undecoded is None:
                continue
            item = Message(item.undecoded, item.flow, None)
        if isinstance(item, Block):
            key = item.flow, item.batch.config.idcode
            keyed += _keyed(frames_of(item, shown), since.get(key, NO_TIME))
            continue
        frame, flow, config = item
        arrival_ns = NO_TIME if frame.arrival_ns is None else frame.arrival_ns
        if config is not None and frame.type.rules_data:
            shown[flow, config.idcode] = config
            since[flow, config.idcode] = arrival_ns
        keyed.append((arrival_ns, item))
    keyed.sort(key=itemgetter(0))  # which leaves equal ones in their order
    return map(itemgetter(1), keyed)


def _keyed(messages: Iterable[Message], since_ns: int) -> Iterator[_Keyed]:
    """With the time that each is sorted by: its arrival, or the latest before it, not before ``since_ns``."""
    latest_ns = since_ns
    for message in messages:
        if message.frame.arrival_ns is not None:
            latest_ns = max(latest_ns, message.frame.arrival_ns)
        yield latest_ns, message
