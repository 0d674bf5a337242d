"""What a source plays: its streams, and each data frame with the time at which it is due.

Offsets are ns of stream time from the first frame due, at speed 1. A source is read twice: once to know its streams
before anything is sent, once to play; a loop reads it again. Memory holds a window of it.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from pmutools import timebase
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.prefix import decode_prefix
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Flow

Items = Callable[[], Iterable[Message | Loss]]
"""Opens the source anew."""

LATENCY_MAX_NS = timebase.NS
"""A recorded latency outside 0..1 s is a clock's doing, and counts as 0."""
LOOKAHEAD_NS = 2 * timebase.NS
"""Frames are put in order of their due times within a window of this length."""


@dataclass
class StreamScript:
    """One stream of the source: its name, first configuration, and the span of its stamps."""

    name: str
    flow: Flow
    config: StreamConfig
    first_ns: int = 0
    last_ns: int = 0
    frames: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """What patterns may call it: its name, its IDCODE, its stations."""
        return (self.name, str(self.config.idcode), *(station.name for station in self.config.stations))


class Cue(NamedTuple):
    """A data frame as recorded. ``index`` counts the stream's data frames; ``config`` is that of the frame."""

    due_ns: int
    stream: int
    number: int
    stamp_ns: int
    data: bytes
    config: StreamConfig


@dataclass(frozen=True)
class Script:
    """Everything known before the first frame is sent."""

    streams: tuple[StreamScript, ...]
    first_due_ns: int
    last_due_ns: int
    first_stamp_ns: int
    by_arrival: bool

    @property
    def period_ns(self) -> int:
        """Longest reporting period among the streams."""
        rates = [stream.config.rate for stream in self.streams if stream.config.rate]
        return max((round(timebase.NS / rate) for rate in rates), default=timebase.NS)

    @property
    def loop_ns(self) -> int:
        """From one loop to the next: whole seconds, so that FRACSEC keeps its phase."""
        span = self.last_due_ns - self.first_due_ns + self.period_ns
        return -(-span // timebase.NS) * timebase.NS


def study(items: Items, timing: str | None, select: Collection[str] = (), exclude: Collection[str] = ()) -> Script:
    """Read a source to its end and say what it plays.

    ``timing`` is ``stamp``, ``arrival``, or None: by arrival where the source has arrivals. ``select`` and ``exclude``
    hold stream names or IDCODEs. Raises SourceError where nothing is left to play, SettingsError for a name that fits
    no stream.
    """
    found: dict[tuple[Flow, int], StreamScript] = {}
    arrivals = False
    low_stamp, low_arrival, high = 1 << 62, 1 << 62, -(1 << 62)
    for message in _data(items()):
        frame, flow, config = message
        assert config is not None
        stamp_ns = stamp_of(frame.data, config)
        stream = found.get((flow, config.idcode))
        if stream is None:
            stream = found[flow, config.idcode] = StreamScript("", flow, config, stamp_ns, stamp_ns)
        stream.first_ns, stream.last_ns = min(stream.first_ns, stamp_ns), max(stream.last_ns, stamp_ns)
        stream.frames += 1
        arrivals |= frame.arrival_ns is not None
        due_ns = stamp_ns + latency_of(stamp_ns, frame.arrival_ns)
        low_stamp, low_arrival, high = min(low_stamp, stamp_ns), min(low_arrival, due_ns), max(high, due_ns)
    streams = _chosen(_named(list(found.values())), select, exclude)
    if not streams:
        raise SourceError("the source holds no data frames to play")
    by_arrival = arrivals if timing is None else timing == "arrival"
    return Script(tuple(streams), low_arrival if by_arrival else low_stamp, high, low_stamp, by_arrival)


def cues(script: Script, items: Iterable[Message | Loss]) -> Iterator[Cue]:
    """The source's data frames in order of their due times; ``due_ns`` counts from the first."""
    index = {(stream.flow, stream.config.idcode): number for number, stream in enumerate(script.streams)}
    counts = [0] * len(script.streams)
    waiting: list[tuple[int, int, Cue]] = []
    latest, order = -(1 << 62), 0
    for message in _data(items):
        frame, flow, config = message
        assert config is not None
        number = index.get((flow, config.idcode))
        if number is None:
            continue
        stamp_ns = stamp_of(frame.data, config)
        due_ns = stamp_ns + (latency_of(stamp_ns, frame.arrival_ns) if script.by_arrival else 0) - script.first_due_ns
        cue = Cue(due_ns, number, counts[number], stamp_ns, frame.data, config)
        counts[number] += 1
        heapq.heappush(waiting, (due_ns, order, cue))
        order += 1
        latest = max(latest, due_ns)
        while waiting and waiting[0][0] <= latest - LOOKAHEAD_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


def stamp_of(frame: bytes, config: StreamConfig) -> int:
    """Time of measurement of a data frame, POSIX UTC ns."""
    prefix = decode_prefix(frame)
    return timebase.to_ns(prefix.soc, prefix.fracsec, config.time_base)


def latency_of(stamp_ns: int, arrival_ns: int | None) -> int:
    """Recorded latency, 0 where there is none or it cannot be true."""
    if arrival_ns is None or not 0 <= arrival_ns - stamp_ns <= LATENCY_MAX_NS:
        return 0
    return arrival_ns - stamp_ns


def _data(items: Iterable[Message | Loss]) -> Iterator[Message]:
    for item in items:
        if isinstance(item, Message) and item.frame.type is FrameType.DATA and item.config is not None:
            yield item


def _named(streams: list[StreamScript]) -> list[StreamScript]:
    """Names that tell the streams apart: the only station's, else the IDCODE; repeated ones get ``#2``."""
    seen: dict[str, int] = {}
    for stream in streams:
        stations = stream.config.stations
        name = stations[0].name if len(stations) == 1 and stations[0].name else str(stream.config.idcode)
        seen[name] = seen.get(name, 0) + 1
        stream.name = name if seen[name] == 1 else f"{name}#{seen[name]}"
    return streams


def _chosen(streams: list[StreamScript], select: Collection[str], exclude: Collection[str]) -> list[StreamScript]:
    for option, wanted in (("--select", select), ("--exclude", exclude)):
        for name in wanted:
            if not any(name in stream.names for stream in streams):
                there = ", ".join(f"{stream.name} ({stream.config.idcode})" for stream in streams)
                raise SettingsError(f"{option} {name}: no such stream; there are {there}")
    kept = [stream for stream in streams if not select or any(name in select for name in stream.names)]
    return [stream for stream in kept if not any(name in exclude for name in stream.names)]
