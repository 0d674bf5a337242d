"""One stream and all that measures it."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.flow import Flow
from pmutools.measure.completeness import Alignment
from pmutools.measure.stream import Seen, StreamMeter
from pmutools.measure.timeline import Timeline
from pmutools.timebase import NS

AT_ONCE_NS = 10 * NS
"""Senders that take turns within this time send at once."""
_FLOWS = 16


class Seat:
    """A stream's place in the alignment of its rate."""

    __slots__ = ("alignment", "place")

    def __init__(self, alignment: Alignment, name: str) -> None:
        self.alignment, self.place = alignment, alignment.join(name)

    @property
    def rate(self) -> Fraction:
        return self.alignment.rate


@dataclass
class Gauge:
    """A stream's meter, its course, its seat in an alignment, and whom its frames came from."""

    number: int
    meter: StreamMeter
    owners: tuple[int, ...] = ()
    timeline: Timeline = field(default_factory=Timeline)
    frames: int = 0
    config_ns: int | None = None
    """Arrival of the first configuration."""
    seat: Seat | None = None
    last_ns: int = NO_TIME
    """Arrival of the newest frame, or its stamp where nobody saw it come."""
    _flow: Flow | None = None
    _heard: dict[Flow, int] = field(default_factory=dict)
    """When each flow was last heard; the newest :data:`_FLOWS`."""
    _gone: set[Flow] = field(default_factory=set)

    @property
    def name(self) -> str:
        return self.meter.identity.name

    def add(self, batch: Batch, flow: Flow, *, linked: bool) -> list[Seen]:
        """Measure frames of a flow. ``linked``: connections are told of, and need not be found in the flows."""
        times = batch.time_ns if batch.arrival_ns[-1] == NO_TIME else batch.arrival_ns
        self._hear(flow, int(times[0]), int(times[-1]), linked or flow.transport == "file")
        if not self.frames and self.config_ns is not None:
            early = (batch.arrival_ns < self.config_ns) & (batch.arrival_ns != NO_TIME)
            self.meter.events.before_config += int(np.count_nonzero(early))
        self.frames += len(batch)
        self.last_ns = int(times[-1])
        return self.meter.add(batch)

    def _hear(self, flow: Flow, first_ns: int, last_ns: int, linked: bool) -> None:
        if flow != self._flow:
            self._switch(flow, first_ns, linked)
            self._flow = flow
        self._heard[flow] = last_ns
        if len(self._heard) > _FLOWS:
            oldest = min(self._heard, key=self._heard.__getitem__)
            del self._heard[oldest]
            self._gone.discard(oldest)

    def _switch(self, flow: Flow, now_ns: int, linked: bool) -> None:
        """Another flow than the last one: the sender began anew, unless the last one is heard again."""
        events = self.meter.events
        heard_ns = self._heard.get(flow)
        if heard_ns is None:
            if not linked:
                events.connects += 1
                if self._flow is not None:
                    events.disconnects += 1
                    self._gone.add(self._flow)
        elif now_ns - heard_ns < AT_ONCE_NS:
            events.senders = max(events.senders, sum(now_ns - at < AT_ONCE_NS for at in self._heard.values()))
            if flow in self._gone:
                self._gone.remove(flow)
                events.disconnects -= 1
