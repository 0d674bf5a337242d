"""All that is measured of one stream: batches in order of arrival go in, counts come out."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.config import StreamConfig
from pmutools.measure.clockstep import ClockStep
from pmutools.measure.columns import Frames, Gist, Ints, frames_of, gathered, gist_of
from pmutools.measure.counts import Counts
from pmutools.measure.delay import DelayCounts, DelayMeter
from pmutools.measure.evenness import RateCounts, RateMeter
from pmutools.measure.floor import FloorCourse
from pmutools.measure.hours import HourCounts
from pmutools.measure.quality import Events, QualityCounts, QualityMeter
from pmutools.measure.sequence import LossCounts, OrderCounts
from pmutools.measure.slotmeter import Part, SlotMeter
from pmutools.measure.slots import HORIZON_S, OFF_GRID_SHARE, Placed, SlotCounts, Verdict
from pmutools.measure.standstill import NO_STANDSTILL, Standstill, StandstillMeter
from pmutools.measure.windows import WindowCounts, WindowMeter

WAIT_NS = 200_000_000
"""A concentrator's customary wait: what comes later is late."""
SILENCE_NS = 10 * timebase.NS
"""Arrivals further apart than this are a silence to remember."""
SILENCES = 32
GATHER = 512
"""So many frames are counted at once where batches are small."""


class Identity(NamedTuple):
    """Which stream it is."""

    name: str
    idcode: int
    transport: str = ""
    multicast: bool = False
    where: str = ""
    """Where its frames come from, for people."""
    wanted_hz: int | None = None
    """The rate that the user expects."""
    others: tuple[str, ...] = ()
    """More names that it goes by: sites, stations."""


class Silence(NamedTuple):
    """Nothing came for ``length_ns``, from ``after_ns`` after the first arrival on."""

    after_ns: int
    length_ns: int


@dataclass
class StreamCounts(Counts):
    """What is counted of a stream; the counts of an interval add up to those of the run."""

    slots: SlotCounts = field(default_factory=SlotCounts)
    order: OrderCounts = field(default_factory=OrderCounts)
    losses: LossCounts = field(default_factory=LossCounts)
    delays: DelayCounts = field(default_factory=DelayCounts)
    windows: WindowCounts = field(default_factory=WindowCounts)
    rates: RateCounts = field(default_factory=RateCounts)
    hours: HourCounts = field(default_factory=HourCounts)
    quality: QualityCounts = field(default_factory=QualityCounts)
    events: Events = field(default_factory=Events)

    @property
    def own_lost(self) -> int:
        """Lost frames that may be this host's own drops: all of them at most, a frame a datagram."""
        return min(self.slots.lost, self.events.own_drops)


@dataclass(frozen=True)
class StreamResult:
    """A stream's counts with what does not add up: its identity, its times, the course of its floor."""

    identity: Identity
    config: StreamConfig
    counts: StreamCounts
    rate: Fraction
    """Frames/s by the configuration; 0 where that names none."""
    wait_ns: int
    horizon_ns: int
    """Tmax: what comes later is lost, and stale when it comes."""
    first_ns: int | None
    """Time stamp of the first frame in order of arrival, and of the last."""
    last_ns: int | None
    first_arrival_ns: int | None
    last_arrival_ns: int | None
    silences: tuple[Silence, ...]
    floor: FloorCourse
    end_ns: int | None = None
    """When the measurement ended."""
    last_new_ns: int | None = None
    """Arrival of the last frame that was the first of its slot: copies and old stamps bring nothing new."""
    standstill: Standstill = NO_STANDSTILL
    """The most frames in a row with one stamp."""
    clock_steps: tuple[ClockStep, ...] = ()
    """The times that the sender's clock was set, each of which began an epoch."""

    @property
    def period_ns(self) -> float:
        return timebase.NS / float(self.rate) if self.rate else 0.0

    @property
    def silent_ns(self) -> int:
        """Since anything new came, at the end: not loss."""
        last_ns = self.last_arrival_ns if self.last_new_ns is None else self.last_new_ns
        return 0 if self.end_ns is None or last_ns is None else max(0, self.end_ns - last_ns)


class State(StrEnum):
    """What became of a frame, the gravest that applies."""

    ON_TIME = "on-time"
    OFF_GRID = "off-grid"
    REORDERED = "reordered"
    LATE = "late"
    DUPLICATE = "duplicate"
    CONFLICTING = "conflicting"
    STALE = "stale"
    LOST = "lost"


STATES = tuple(State)
_FIRSTS = STATES.index(State.LATE)


class Seen(NamedTuple):
    """Frames (N,) that were counted, in order of arrival, and slots (L,) found to be lost meanwhile.

    The slots of an outage are lost, too, but are not listed.
    """

    slot: Ints
    time_ns: Ints
    arrival_ns: Ints
    delay_ns: Ints
    stamp_source: npt.NDArray[np.uint8]
    state: npt.NDArray[np.uint8]
    """(N,) index into :data:`STATES`."""
    lost: Ints
    stat: npt.NDArray[np.uint16]
    """(N,) the bits of STAT that any of the stations sets."""
    rate: Fraction
    """By which slots are counted."""

    def unique(self) -> tuple[Ints, Ints]:
        """Slots and arrivals of the frames that were the first of their slots: what an alignment of streams takes."""
        first = self.state <= _FIRSTS
        return (self.slot, self.arrival_ns) if first.all() else (self.slot[first], self.arrival_ns[first])


class StreamMeter:
    """Measures one stream in constant memory: some 300 KiB, half as much again where intervals are taken.

    Frames of small batches are gathered, ``gather`` of them, before most of it is counted; :meth:`drain` does so at
    once, and :meth:`result` tells of all in any case.
    """

    def __init__(
        self,
        identity: Identity,
        config: StreamConfig,
        *,
        wait_ns: int = WAIT_NS,
        horizon_s: float = HORIZON_S,
        phase_ns: int = 0,
        gather: int = GATHER,
    ) -> None:
        self.identity, self.config = identity, config
        self._counts = StreamCounts()
        self._total = StreamCounts()
        self._slots = SlotMeter(config.rate, round(horizon_s * timebase.NS))
        self._quality = QualityMeter()
        self._windows, self._rates = WindowMeter(config.rate, phase_ns), RateMeter()
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._first_arrival_ns: int | None = None
        self._last_arrival_ns: int | None = None
        self._last_new_ns: int | None = None
        self._standstill = StandstillMeter()
        self._silences: list[Silence] = []
        self._counted, self._gather = 0, gather
        self._gathered: list[Gist] = []
        self._waiting = 0
        self._closed = False
        self._rate = config.rate
        self._delays = DelayMeter(self._slots.period_ns, wait_ns)
        self._quality.configured(config)
        self._begin_counts()

    @property
    def events(self) -> Events:
        """What happened around the frames: for the receiver to count up."""
        return self._counts.events

    def _begin_counts(self) -> None:
        counts, slots = self._counts, self._slots
        slots.counts, slots.order.counts, slots.losses.counts = counts.slots, counts.order, counts.losses
        self._delays.counts, self._windows.counts, self._rates.counts = counts.delays, counts.windows, counts.rates
        self._quality.counts = counts.quality

    def add(self, batch: Batch) -> list[Seen]:
        """Measure a batch that came after all before it; the frames counted by now, in parts."""
        if not len(batch):
            return []
        found = []
        if batch.config is not self.config and batch.config != self.config:
            found = self._reconfigure(batch.config)
        self._gathered.append(gist_of(batch))
        self._waiting += len(batch)
        return found + (self.drain() if self._waiting >= self._gather else [])

    def drain(self) -> list[Seen]:
        """Count the frames gathered so far, and tell of them."""
        if not self._gathered:
            return []
        gist, self._gathered, self._waiting = gathered(self._gathered), [], 0
        frames = frames_of(gist, self._rate, self._counted)
        self._counted += gist.frames
        self._quality.add(gist, frames)
        self._note_times(frames)
        return list(map(self._take, self._slots.feed(frames)))

    def clock_stepped(self) -> list[Seen]:
        """The receiver's clock was set: what came before says nothing of what is late, or between two arrivals."""
        found = self.drain()
        self._windows.restart(self._rate)
        self._rates.restart()
        self._delays.restart(self._slots.period_ns)
        self._last_arrival_ns = self._last_new_ns = None
        return found

    def _reconfigure(self, config: StreamConfig) -> list[Seen]:
        found = self.drain()
        rate, self.config = self.config.rate, config
        self._quality.configured(config)
        if config.rate == rate:
            return found
        found += self._flush()
        self._rate = config.rate
        self._slots.restart(self._rate)
        self._windows.restart(self._rate)
        self._delays.restart(self._slots.period_ns)
        return found

    def _flush(self) -> list[Seen]:
        """Settle all that is still open."""
        found = list(map(self._take, self._slots.flush()))
        nothing = np.zeros(0, np.int64)
        none = np.zeros(0, np.uint8)
        lost = self._slots.close()
        stat = np.zeros(0, np.uint16)
        return [*found, Seen(nothing, nothing, nothing, nothing, none, none, lost, stat, self._rate)]

    def _note_times(self, frames: Frames) -> None:
        if self._first_ns is None:
            self._first_ns = int(frames.time_ns[0])
        self._last_ns = int(frames.time_ns[-1])
        self._standstill.add(frames)
        arrivals = frames.arrival_ns
        if (unknown := arrivals == NO_TIME).any():
            arrivals = arrivals[~unknown]
        if not len(arrivals):
            return
        if self._first_arrival_ns is None:
            self._first_arrival_ns = int(arrivals[0])
        before = self._last_arrival_ns
        gaps = np.diff(arrivals) if before is None else np.diff(arrivals, prepend=before)
        if gaps.size and int(gaps.max()) >= SILENCE_NS:
            starts = arrivals[:-1] if before is None else np.concatenate(([before], arrivals[:-1]))
            for at in np.flatnonzero(gaps >= SILENCE_NS).tolist():
                self._silences.append(Silence(int(starts[at]) - self._first_arrival_ns, int(gaps[at])))
            if len(self._silences) > SILENCES:  # the first one tells most; of the others, the longest
                rest = sorted(self._silences[1:], key=lambda silence: -silence.length_ns)[: SILENCES - 1]
                self._silences = [self._silences[0], *sorted(rest)]
        self._last_arrival_ns = int(arrivals[-1])

    def _take(self, part: Part) -> Seen:
        verdict, frames, placed, lost = part
        if placed is None:
            return self._seen(frames, np.full(len(frames), STATES.index(State.STALE), np.uint8), lost)
        if verdict is Verdict.RESTART:
            self._delays.restart(self._slots.period_ns)
        firsts = frames if placed.first.all() else frames[placed.first]
        self._delays.add(firsts, placed.ipdv_ns)
        if self._rate and len(firsts):
            self._counts.hours.add(firsts.slot, self._rate)
        arrivals = firsts.arrival_ns
        if (unseen := arrivals == NO_TIME).any():
            arrivals = arrivals[~unseen]
        if len(arrivals):
            self._last_new_ns = int(arrivals[-1])
            self._windows.add(arrivals)
            self._rates.add(arrivals)
        return self._seen(frames, self._states(frames, placed), lost)

    def _seen(self, frames: Frames, state: npt.NDArray[np.uint8], lost: Ints) -> Seen:
        columns = (frames.slot, frames.time_ns, frames.arrival_ns, frames.delay_ns, frames.stamp_source)
        return Seen(*columns, state, lost, frames.stat, self._rate)

    def _states(self, frames: Frames, placed: Placed) -> npt.NDArray[np.uint8]:
        """(N,) the gravest state of each frame."""
        state = np.zeros(len(frames), np.uint8)
        state[np.abs(frames.off_grid_ns) > OFF_GRID_SHARE * self._slots.period_ns] = STATES.index(State.OFF_GRID)
        state[frames.slot < placed.before] = STATES.index(State.REORDERED)
        state[frames.delay_ns > self._delays.wait_ns] = STATES.index(State.LATE)
        if not placed.first.all():
            state[~placed.first] = STATES.index(State.STALE)
            if placed.again is not None and placed.conflicting is not None:
                state[placed.again] = STATES.index(State.DUPLICATE)
                state[placed.conflicting] = STATES.index(State.CONFLICTING)
        return state

    def take_interval(self) -> StreamCounts:
        """The counts since the last interval; what is gathered, or open (a loss period, a window) goes to the next."""
        counts, self._counts = self._counts, StreamCounts()
        self._total.merge(counts)
        self._begin_counts()
        return counts

    def close(self) -> list[Seen]:
        """The end of the stream: settle all that is open, and tell of it. Nothing may be added after."""
        found = self.drain() + self._flush()
        self._windows.close()
        self._delays.close()
        self.take_interval()
        self._closed = True
        return found

    def result(self, end_ns: int | None = None) -> StreamResult:
        """All so far, as if the stream ended here (``end_ns``: now, in the receiver's time). It may go on after."""
        if not self._closed:
            same = {id(config): config for config in (self.config, self._quality.config)}
            after = deepcopy(self, same)
            after.close()
            return after.result(end_ns)
        return StreamResult(
            self.identity,
            self.config,
            self._total,
            self._rate,
            self._delays.wait_ns,
            round(self._slots.reach * self._slots.period_ns),
            self._first_ns,
            self._last_ns,
            self._first_arrival_ns,
            self._last_arrival_ns,
            tuple(self._silences),
            self._delays.floor.course(),
            end_ns,
            self._last_new_ns,
            self._standstill.longest,
            tuple(self._slots.steps),
        )
