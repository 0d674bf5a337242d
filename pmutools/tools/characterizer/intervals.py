"""``intervals.jsonl``: what was counted in each interval, a line an interval.

Live, an interval ends by the receiver's clock, stream after stream: where there are many, the last ones are counted
some tenths of a second later, and their frames of that time belong to this line. In a recording each stream's frames
are cut at the arrivals (or stamps) that end an interval, so that a line holds just what came in it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.measure.clockquality import ClockQuality
from pmutools.measure.stream import StreamCounts
from pmutools.measure.summary import interval_summary, safe
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.gauge import Gauge

KEPT = 64
"""Lines of a recording that wait for streams that are behind."""


class Intervals:
    """Writes lines by ``put``. ``period_ns`` is the length of an interval."""

    def __init__(self, engine: Engine, period_ns: int, put: Callable[[str], None]) -> None:
        self.period_ns = period_ns
        self._engine, self._put = engine, put
        self._drops = 0
        self._waiting: dict[int, _Line] = {}
        """Lines of a recording by the number of their interval."""
        self._reached: dict[int, int] = {}
        """The interval that each gauge is in."""

    def look(self, begin_ns: int, end_ns: int) -> Iterator[None]:
        """Live: take the counts since the last look, and write the line. A step a stream."""
        line = _Line()
        for gauge in list(self._engine.gauges):
            self._engine.settle(gauge)
            line.add(gauge, gauge.meter.take_interval(), self._engine.clock.last)
            yield
        self._write(line, begin_ns, end_ns, self._engine.clock.last)

    def pieces(self, gauge: Gauge, batch: Batch) -> Iterator[Batch]:
        """A recorded stream's frames up to the end of each interval; between two pieces their counts are taken."""
        times = np.where(batch.arrival_ns == NO_TIME, batch.time_ns, batch.arrival_ns)
        reached = self._reached.get(gauge.number, int(times[0]) // self.period_ns)
        numbers = np.maximum(np.maximum.accumulate(times // self.period_ns), reached)
        first = 0
        for row in [*(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(batch)]:
            number = int(numbers[first])
            if number > reached:
                self._take(gauge, reached)
            reached = self._reached[gauge.number] = number
            yield batch[first:row]
            first = row

    def write_ready(self) -> None:
        """Write the lines that no stream of the recording is in any more, or that have waited long."""
        if self._waiting:
            self._write_up_to(max(min(self._reached.values()) - 1, max(self._waiting) - KEPT))

    def finish(self) -> None:
        """Write all lines of the recording that are left."""
        for gauge in self._engine.gauges:
            if gauge.number in self._reached:
                self._take(gauge, self._reached[gauge.number])
        if self._waiting:
            self._write_up_to(max(self._waiting))

    def _take(self, gauge: Gauge, number: int) -> None:
        self._engine.settle(gauge)
        self._waiting.setdefault(number, _Line()).add(gauge, gauge.meter.take_interval(), self._clock)

    def _write_up_to(self, last: int) -> None:
        for number in sorted(number for number in self._waiting if number <= last):
            begin_ns = number * self.period_ns
            self._write(self._waiting.pop(number), begin_ns, begin_ns + self.period_ns, self._clock)

    @property
    def _clock(self) -> ClockQuality | None:
        """That of the recording, if the user vouches for it."""
        return self._engine.clock.last if self._engine.clock.samples else None

    def _write(self, line: _Line, begin_ns: int, end_ns: int, clock: ClockQuality | None) -> None:
        drops, self._drops = self._engine.host.own_drops - self._drops, self._engine.host.own_drops
        line.whole.events.own_drops = drops
        told = {
            "begin": timebase.format_utc(begin_ns),
            "end": timebase.format_utc(end_ns),
            "clock": None if clock is None else safe(clock.to_json()),
            "streams": line.streams,
            "all": interval_summary(line.whole),
        }
        self._put(json.dumps(told) + "\n")


class _Line:
    def __init__(self) -> None:
        self.whole = StreamCounts()
        self.streams: list[dict[str, Any]] = []

    def add(self, gauge: Gauge, counts: StreamCounts, clock: ClockQuality | None) -> None:
        identity, rate = gauge.meter.identity, gauge.meter.config.rate
        told = interval_summary(counts, clock, timebase.NS / float(rate) if rate else 0.0)
        self.streams.append({"name": identity.name, "idcode": identity.idcode, **told})
        self.whole.merge(counts)
