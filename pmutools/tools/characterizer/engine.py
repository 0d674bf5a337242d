"""All streams of a run under measurement: blocks, losses and news of connections in, gauges out.

No clock and no socket: whoever reads them hands over what came, and the time. What comes is measured at once; what
belongs to no stream alone is counted in ``host``.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import groupby

import numpy as np

from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.framer import SkipReason
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.host import ClockStep, Stall
from pmutools.measure.clockquality import ClockLog, ClockQuality
from pmutools.measure.completeness import Alignment
from pmutools.measure.quality import Events
from pmutools.measure.stream import WAIT_NS, Identity, Seen, StreamMeter, StreamResult
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.tools.characterizer.chronicle import Chronicle
from pmutools.tools.characterizer.gauge import Gauge, Seat
from pmutools.tools.characterizer.naming import Owners, identity_of, key_of, nobody, silent_identity
from pmutools.tools.characterizer.wanted import Wanted
from pmutools.tools.news import USUAL, host_told, told

MAX_STREAMS = 4096
"""So many are measured, at some 600 KiB each; frames of more are counted in ``unmeasured``."""
_FLOWS = 1 << 14
_MS = 1_000_000
Sink = Callable[[Gauge, Seen], None]


class Engine:
    """See the module's text.

    Parameters
    ----------
    wanted
        What the user asked for; ``owners`` tells whose a flow's IDCODE is, by place in it.
    wait_ns, phase_ns
        As of :class:`~pmutools.measure.stream.StreamMeter`.
    begin_ns
        UTC when the measurement began; None: when the first thing came.
    """

    def __init__(
        self,
        wanted: Sequence[Wanted] = (),
        owners: Owners = nobody,
        *,
        wait_ns: int = WAIT_NS,
        phase_ns: int = 0,
        begin_ns: int | None = None,
        max_streams: int = MAX_STREAMS,
    ) -> None:
        self.wanted, self.wait_ns, self.begin_ns = tuple(wanted), wait_ns, begin_ns
        self.gauges: list[Gauge] = []
        self.alignments: dict[Fraction, Alignment] = {}
        self.clock = ClockLog()
        self.host = Events()
        """What belongs to no stream, and all drops of this machine's sockets."""
        self.chronicle = Chronicle()
        self.skipped: dict[str, int] = {}
        """Bytes that are in no frame, by reason."""
        self.unmeasured = 0
        """Frames of streams beyond the most that are measured."""
        self.last_ns = NO_TIME
        """The newest arrival, or stamp where nobody saw any."""
        self.sinks: list[Sink] = []
        self.cut: Callable[[Gauge, Batch], Iterable[Batch]] | None = None
        """Cuts the frames of a stream into pieces that are measured one after the other."""
        self._owners, self._phase_ns, self._most = owners, phase_ns, max_streams
        self._by_key: dict[Hashable, Gauge] = {}
        self._by_flow: dict[Flow, dict[int, Gauge | None]] = {}
        self._flow_owners: dict[Flow, tuple[int, ...]] = {}
        self._unclaimed: dict[Flow, Events] = {}
        self._links: dict[int, Events] = {}
        """Connections of endpoints, by place, as told; those of gauges are in these and in theirs."""
        self._begun: dict[str, set[int] | None] = {}
        """IDCODEs that were configured, by where; None where there was trouble, so that all is news."""
        self._drained = 0

    def name(self, flow: Flow, config: StreamConfig) -> str | None:
        """What a stream is called; None for one that is not measured yet."""
        gauge = self._by_flow.get(flow, {}).get(config.idcode)
        return None if gauge is None else gauge.name

    # --- what comes

    def take(self, items: Iterable[Block | Message | Loss]) -> None:
        """Measure what came, in order; blocks of one stream by several flows are merged by their arrivals."""
        for blocks, group in groupby(items, lambda item: isinstance(item, Block)):
            if blocks:
                self._take_blocks(group)  # type: ignore[arg-type]
                continue
            for item in group:
                if isinstance(item, Loss):
                    self._lose(item)
                elif isinstance(item, Message) and item.config is not None and item.frame.type.is_config:
                    self._configure(item, item.config)

    def _take_blocks(self, blocks: Iterable[Block]) -> None:
        found: dict[int, list[Block]] = {}
        whole = [block for block in blocks if len(block.batch)]
        if self.begin_ns is None and whole:
            self.begin_ns = min(_first_ns(block.batch) for block in whole)
        for block in whole:
            batch = block.batch
            gauge = self._gauge(block.flow, batch.config)
            if gauge is None:
                self.unmeasured += len(batch)
            else:
                found.setdefault(gauge.number, []).append(block)
        for number, mine in found.items():
            flows = {block.flow for block in mine}
            gauge = self.gauges[number]
            for flow, batch in mine if len(flows) == 1 else merged(mine):
                for piece in (batch,) if self.cut is None else self.cut(gauge, batch):
                    self._measure(gauge, flow, piece)

    def _measure(self, gauge: Gauge, flow: Flow, batch: Batch) -> None:
        if not gauge.frames:
            assert self.begin_ns is not None
            gauge.meter.events.first_data_ms = max(0.0, (_first_ns(batch) - self.begin_ns) / _MS)
        linked = any(place in self._links for place in gauge.owners)
        self._emit(gauge, gauge.add(batch, flow, linked=linked))
        self.last_ns = max(self.last_ns, gauge.last_ns)

    def _configure(self, message: Message, config: StreamConfig) -> None:
        gauge = self._gauge(message.flow, config)
        arrival_ns = message.frame.arrival_ns
        if gauge is None or arrival_ns is None or gauge.config_ns is not None:
            return
        if self.begin_ns is None:
            self.begin_ns = arrival_ns
        gauge.config_ns = arrival_ns
        gauge.meter.events.first_config_ms = max(0.0, (arrival_ns - self.begin_ns) / _MS)

    def _lose(self, loss: Loss) -> None:
        """Count bytes that are no frame for the stream that they claim, or the only one of their flow."""
        reason, _, nbytes, idcode = loss.skipped
        self.skipped[str(reason)] = self.skipped.get(str(reason), 0) + nbytes
        of_flow = self._by_flow.get(loss.flow, {})
        gauge = of_flow.get(idcode) if idcode is not None else None
        if gauge is None and len(of_flow) == 1:
            gauge = next(iter(of_flow.values()))
        count = 1
        if gauge is not None:
            events = gauge.meter.events
            count = max(1, nbytes // gauge.meter.config.frame_size)  # on a connection one run may be several frames
        elif not of_flow and (loss.flow in self._unclaimed or len(self._unclaimed) < _FLOWS):
            events = self._unclaimed.setdefault(loss.flow, Events())
        else:
            events = self.host
        events.skipped_bytes += nbytes
        events.corrupt += count * (reason is SkipReason.BAD_CHK)
        events.bad_size += reason is SkipReason.BAD_SIZE
        events.before_config += reason is SkipReason.NO_CONFIG

    # --- news

    def hear(self, event: LinkEvent, now_ns: int) -> None:
        """Take note of news of connections."""
        if self._is_news(event):
            self.chronicle.add(now_ns, f"{event.label or event.where}: {told(event)}")
        if event.flow is not None and event.owners and len(self._flow_owners) < _FLOWS:
            self._flow_owners[event.flow] = event.owners
        over_tcp = event.flow is not None and event.flow.transport == "tcp"
        if event.kind is LinkKind.OWN_DROPS:
            self.host.own_drops += event.datagrams
            for gauge in self._of(event.owners):
                gauge.meter.events.own_drops += event.datagrams
        elif over_tcp and event.kind in (LinkKind.CONNECTED, LinkKind.LOST):
            found = [gauge.meter.events for gauge in self._of(event.owners)]
            for events in (*found, *(self._links.setdefault(place, Events()) for place in event.owners)):
                events.connects += event.kind is LinkKind.CONNECTED
                events.disconnects += event.kind is LinkKind.LOST

    def _is_news(self, event: LinkEvent) -> bool:
        """Whether it is out of the ordinary: how a connection begins is, but for the first time."""
        known = self._begun.get(event.where)
        if event.kind not in USUAL:
            self._begun[event.where] = None
            return True
        if event.kind is LinkKind.CONFIGURED and known is not None and event.idcode in known:
            return True
        if event.where not in self._begun and len(self._begun) < _FLOWS:
            known = self._begun[event.where] = set()
        if known is not None and event.idcode is not None and event.kind is LinkKind.CONFIGURED:
            known.add(event.idcode)
        return event.where in self._begun and known is None and event.kind is not LinkKind.BOUND

    def clock_stepped(self, step_ns: int, now_ns: int) -> None:
        """The receiver's clock was set by so much."""
        self.clock.stepped(step_ns)
        self.chronicle.add(now_ns, host_told(ClockStep(0, now_ns, step_ns)))
        for gauge in self.gauges:
            self._emit(gauge, gauge.meter.clock_stepped())

    def stalled(self, length_ns: int, now_ns: int) -> None:
        """The measuring host stood still for so long: a matter of all streams."""
        self.chronicle.add(now_ns, host_told(Stall(0, now_ns, length_ns)))
        for events in (self.host, *(gauge.meter.events for gauge in self.gauges)):
            events.stalls += 1
            events.longest_stall_ms = max(events.longest_stall_ms, length_ns / _MS)

    def resent(self, owners: Sequence[int], retransmits: int, out_of_order: int) -> None:
        """TCP of the endpoints at these places sent so many segments again, and got so many out of order."""
        for gauge in self._of(owners) if retransmits or out_of_order else ():
            gauge.meter.events.retransmits += retransmits
            gauge.meter.events.out_of_order += out_of_order

    def sample_clock(self, quality: ClockQuality) -> None:
        """How good the receiver's clock is now."""
        if quality.disciplined != self.clock.last.disciplined and self.clock.samples:
            self.chronicle.add(self.last_ns if self.last_ns != NO_TIME else 0, quality.text)
        self.clock.add(quality)

    # --- what was measured

    def drain(self, most: int = 16) -> None:
        """Count what was gathered of some streams, in turn, so that none waits long for its sinks."""
        for _ in range(min(most, len(self.gauges))):
            self._drained = (self._drained + 1) % len(self.gauges)
            self.settle(self.gauges[self._drained])

    def settle(self, gauge: Gauge) -> None:
        """Count what was gathered of a stream."""
        self._emit(gauge, gauge.meter.drain())

    def close(self) -> None:
        """The end: settle all that is open. Nothing may come after."""
        for gauge in self.gauges:
            self._emit(gauge, gauge.meter.close())
        for alignment in self.alignments.values():
            alignment.close(self.wait_ns)
        for flow, events in self._unclaimed.items():
            if not any(place in self._flow_owners.get(flow, ()) for place in self.silent()):
                self.host.merge(events)

    def silent(self) -> list[int]:
        """Places of what was asked for and has not come."""
        came = {place for gauge in self.gauges for place in gauge.owners}
        return [place for place in range(len(self.wanted)) if place not in came]

    def silences(self, end_ns: int | None) -> Iterator[StreamResult]:
        """A result without a frame for each of :meth:`silent`."""
        taken = [gauge.name for gauge in self.gauges]
        for place in self.silent():
            identity = silent_identity(self.wanted[place], taken)
            taken.append(identity.name)
            meter = StreamMeter(identity, StreamConfig(identity.idcode, (), identity.wanted_hz or 0))
            for flow, events in self._unclaimed.items():
                if place in self._flow_owners.get(flow, ()):
                    meter.events.merge(events)
            if place in self._links:
                meter.events.merge(self._links[place])
            yield meter.result(end_ns)

    # --- within

    def _emit(self, gauge: Gauge, found: Sequence[Seen]) -> None:
        for seen in found:
            gauge.timeline.add(seen)
            if seen.rate:
                if gauge.seat is None or gauge.seat.rate != seen.rate:
                    self._seat(gauge, seen.rate)
                assert gauge.seat is not None
                gauge.seat.alignment.add(gauge.seat.place, *seen.unique())
            for sink in self.sinks:
                sink(gauge, seen)

    def _seat(self, gauge: Gauge, rate: Fraction) -> None:
        if gauge.seat is not None:
            gauge.seat.alignment.leave(gauge.seat.place)
        if rate not in self.alignments:
            self.alignments[rate] = Alignment((), rate)
        gauge.seat = Seat(self.alignments[rate], gauge.name)

    def _of(self, owners: Sequence[int]) -> list[Gauge]:
        wanted = set(owners)
        return [gauge for gauge in self.gauges if not wanted.isdisjoint(gauge.owners)]

    def _gauge(self, flow: Flow, config: StreamConfig) -> Gauge | None:
        of_flow = self._by_flow.get(flow)
        if of_flow is None:
            if len(self._by_flow) >= _FLOWS:
                del self._by_flow[next(iter(self._by_flow))]
            of_flow = self._by_flow[flow] = {}
        if config.idcode not in of_flow:
            of_flow[config.idcode] = self._find(flow, config)
        return of_flow[config.idcode]

    def _find(self, flow: Flow, config: StreamConfig) -> Gauge | None:
        owners = self._owners(flow, config.idcode) or self._flow_owners.get(flow, ())
        key = key_of(flow, config.idcode, owners)
        gauge = self._by_key.get(key)
        if gauge is None:
            if len(self.gauges) >= self._most:
                if not self.unmeasured:
                    self.chronicle.add(
                        max(self.last_ns, 0), f"more than {self._most} streams: the rest is not measured"
                    )
                return None
            gauge = self._by_key[key] = self._new(flow, config, owners)
        if (events := self._unclaimed.pop(flow, None)) is not None:
            gauge.meter.events.merge(events)
        return gauge

    def _new(self, flow: Flow, config: StreamConfig, owners: tuple[int, ...]) -> Gauge:
        identity: Identity = identity_of(flow, config, owners, self.wanted, [gauge.name for gauge in self.gauges])
        meter = StreamMeter(identity, config, wait_ns=self.wait_ns, phase_ns=self._phase_ns)
        gauge = Gauge(len(self.gauges), meter, owners)
        for place in owners:
            if place in self._links:
                links = self._links[place]
                meter.events.connects += links.connects
                meter.events.disconnects += links.disconnects
        self.gauges.append(gauge)
        return gauge


def merged(blocks: Sequence[Block]) -> Iterator[Block]:
    """Blocks of several flows as one order of arrivals: as many pieces as the flows take turns."""
    times = np.concatenate([_times(block.batch) for block in blocks])
    whose = np.repeat(np.arange(len(blocks)), [len(block.batch) for block in blocks])
    within = np.concatenate([np.arange(len(block.batch)) for block in blocks])
    order = np.argsort(times, kind="stable")
    whose, within = whose[order], within[order]
    turns = np.flatnonzero((np.diff(whose) != 0) | (np.diff(within) != 1)) + 1
    for rows in np.split(np.arange(len(order)), turns):
        first, last = rows[0], rows[-1]
        flow, batch = blocks[int(whose[first])]
        yield Block(flow, batch[int(within[first]) : int(within[last]) + 1])


def _times(batch: Batch) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """(N,) arrivals, or stamps where nobody saw a frame come; never going back."""
    known = batch.arrival_ns != NO_TIME
    times: np.ndarray[tuple[int], np.dtype[np.int64]] = np.maximum.accumulate(
        np.where(known, batch.arrival_ns, batch.time_ns)
    )
    return times


def _first_ns(batch: Batch) -> int:
    arrival_ns = int(batch.arrival_ns[0])
    return int(batch.time_ns[0]) if arrival_ns == NO_TIME else arrival_ns
