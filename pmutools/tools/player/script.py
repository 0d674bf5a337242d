"""What a source plays: its streams, and each data frame with the time at which it is due.

Due times are ns of stream time from the first frame due, at speed 1. A source is read twice: once to know its streams
before anything is sent, once to play; a loop reads it again. Memory holds a window of it.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from pmutools import timebase
from pmutools.c37118 import frames
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.framer import Frame
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Flow
from pmutools.formats.columns import unique
from pmutools.tools.window import FOREVER, Window

LATENCY_MAX_NS = timebase.NS
"""A recorded latency outside 0..1 s is a clock's doing, and counts as 0."""
LOOKAHEAD_NS = 2 * timebase.NS
"""Frames are put in order of their due times within a window of this length."""


@dataclass
class StreamScript:
    """One stream of the source: its name, first configuration, and what is played of it; times POSIX UTC ns."""

    name: str
    flow: Flow
    config: StreamConfig
    total: int = 0
    """Data frames in the source."""
    frames: int = 0
    """Those of them that are played, from ``first_ns`` to ``last_ns``; the first is due at ``first_due_ns``."""
    first_ns: int = FOREVER
    last_ns: int = -FOREVER
    first_due_ns: int = FOREVER
    last_due_ns: int = -FOREVER

    @property
    def names(self) -> tuple[str, ...]:
        """What patterns may call it: its name, its IDCODE, its stations."""
        return (self.name, str(self.config.idcode), *(station.name for station in self.config.stations))

    def add(self, stamp_ns: int, due_ns: int) -> None:
        """Take note of a frame that is played."""
        self.frames += 1
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)
        self.first_due_ns, self.last_due_ns = min(self.first_due_ns, due_ns), max(self.last_due_ns, due_ns)


class Cue(NamedTuple):
    """A data frame as recorded.

    ``number`` counts the data frames of its stream in the source, ``place`` those of them that are played.
    """

    due_ns: int
    stream: int
    number: int
    place: int
    stamp_ns: int
    latency_ns: int
    data: bytes
    config: StreamConfig


@dataclass(frozen=True)
class Script:
    """Everything known before the first frame is sent. Stamps from ``low_ns`` to below ``high_ns`` are played."""

    streams: tuple[StreamScript, ...]
    by_arrival: bool
    low_ns: int = -FOREVER
    high_ns: int = FOREVER

    @property
    def first_ns(self) -> int:
        return min(stream.first_ns for stream in self.streams)

    @property
    def first_due_ns(self) -> int:
        return min(stream.first_due_ns for stream in self.streams)

    @property
    def loop_ns(self) -> int:
        """From one loop to the next: whole seconds, so that FRACSEC keeps its phase."""
        rates = [stream.config.rate for stream in self.streams if stream.config.rate]
        period_ns = max((round(timebase.NS / rate) for rate in rates), default=timebase.NS)
        span_ns = max(stream.last_due_ns for stream in self.streams) - self.first_due_ns + period_ns
        return -(-span_ns // timebase.NS) * timebase.NS


def study(
    items: Iterable[Message | Loss],
    timing: str | None = None,
    window: Window | None = None,
    select: Collection[str] = (),
    exclude: Collection[str] = (),
) -> Script:
    """Read a source to its end and say what it plays.

    ``timing`` is ``stamp``, ``arrival``, or None: by arrival where the source has arrivals (without any, the two are
    the same). ``window`` says from when to when; ``select`` and ``exclude`` hold stream names or IDCODEs. Raises
    SourceError where nothing is left to play, SettingsError for a name that fits no stream.
    """
    window = window or Window()
    by_arrival = timing != "stamp"
    found: dict[tuple[Flow, int], StreamScript] = {}
    low, high = -FOREVER, FOREVER
    for frame, flow, config in _data(items):
        stamp_ns = frames.stamp_ns(frame.data, config)
        low, high = window.bounds(stamp_ns)
        stream = found.get((flow, config.idcode))
        if stream is None:
            stream = found[flow, config.idcode] = StreamScript("", flow, config)
        stream.total += 1
        if low <= stamp_ns < high:
            stream.add(stamp_ns, stamp_ns + (latency_of(stamp_ns, frame.arrival_ns) if by_arrival else 0))
    if not found:
        raise SourceError("there are no data frames to play")
    kept = [stream for stream in _chosen(_named(list(found.values())), select, exclude) if stream.frames]
    if not kept:
        raise SourceError("nothing is left to play; widen --start and --end, or --select and --exclude")
    return Script(tuple(kept), by_arrival, low, high)


def cues(script: Script, items: Iterable[Message | Loss]) -> Iterator[Cue]:
    """The source's data frames in order of their due times; ``due_ns`` counts from the first."""
    index = {(stream.flow, stream.config.idcode): number for number, stream in enumerate(script.streams)}
    counts, places = [0] * len(index), [0] * len(index)
    zero_ns = script.first_due_ns
    waiting: list[tuple[int, int, Cue]] = []
    latest, order = -FOREVER, 0
    for frame, flow, config in _data(items):
        stream = index.get((flow, config.idcode))
        if stream is None:
            continue
        stamp_ns, number = frames.stamp_ns(frame.data, config), counts[stream]
        counts[stream] += 1
        if not script.low_ns <= stamp_ns < script.high_ns:
            continue
        latency_ns = latency_of(stamp_ns, frame.arrival_ns) if script.by_arrival else 0
        due_ns = stamp_ns + latency_ns - zero_ns
        cue = Cue(due_ns, stream, number, places[stream], stamp_ns, latency_ns, frame.data, config)
        places[stream] += 1
        heapq.heappush(waiting, (due_ns, order, cue))
        order += 1
        latest = max(latest, due_ns)
        while waiting and waiting[0][0] <= latest - LOOKAHEAD_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


def latency_of(stamp_ns: int, arrival_ns: int | None) -> int:
    """Recorded latency, 0 where there is none or it cannot be true."""
    if arrival_ns is None or not 0 <= arrival_ns - stamp_ns <= LATENCY_MAX_NS:
        return 0
    return arrival_ns - stamp_ns


def _data(items: Iterable[Message | Loss]) -> Iterator[tuple[Frame, Flow, StreamConfig]]:
    for item in items:
        if isinstance(item, Message) and item.frame.type is FrameType.DATA and item.config is not None:
            yield item.frame, item.flow, item.config


def _named(streams: list[StreamScript]) -> list[StreamScript]:
    """Names that tell the streams apart: the only station's, else the IDCODE; repeated ones get ``#2``."""
    names = []
    for stream in streams:
        stations = stream.config.stations
        names.append(stations[0].name if len(stations) == 1 and stations[0].name else str(stream.config.idcode))
    for stream, name in zip(streams, unique(names), strict=True):
        stream.name = name
    return streams


def _chosen(streams: list[StreamScript], select: Collection[str], exclude: Collection[str]) -> list[StreamScript]:
    for option, wanted in (("--select", select), ("--exclude", exclude)):
        for name in wanted:
            if not any(name in stream.names for stream in streams):
                there = ", ".join(f"{stream.name} ({stream.config.idcode})" for stream in streams)
                raise SettingsError(f"{option} {name}: no such stream; there are {there}")
    kept = [stream for stream in streams if not select or any(name in select for name in stream.names)]
    return [stream for stream in kept if not any(name in exclude for name in stream.names)]
