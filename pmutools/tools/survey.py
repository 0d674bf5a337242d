"""``pmu ini``: which streams come from live endpoints, and what they are like."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.config import Station
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.layout import layout_of
from pmutools.clock import Clock
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.measure.histogram import Histogram
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.timebase import NS
from pmutools.tools.guess import Guess, guess_voltage
from pmutools.tools.inventory import StreamInventory
from pmutools.tools.live import LiveSource
from pmutools.tools.news import Reasons

PATIENCE_NS = 10 * NS
"""How long is listened where the user does not say it, at most."""
LOOK_NS = 2 * NS
"""Data of every stream are looked at for so long, at least."""
STREAMS = 1000
"""So many streams are looked at; more are counted only."""
SENDERS = 16
"""So many ports of one stream's host are remembered."""


@dataclass(eq=False)
class SurveyedStream:
    """One stream: an IDCODE from one host, at one endpoint."""

    host: str
    inventory: StreamInventory
    since_ns: int | None = None
    """When its first data came, monotonic."""
    delay: Histogram = field(default_factory=Histogram)
    """Arrival less stamp."""
    senders: dict[str, None] = field(default_factory=dict)
    """Addresses that its data come from."""

    def __post_init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        layout = layout_of(self.inventory.config)
        self.good = np.zeros(len(layout.slots), np.int64)
        """(S,) frames whose data are valid."""
        self.phasors: npt.NDArray[np.complex128] = np.full(len(layout.phasors), np.nan, np.complex128)
        """(P,) of the latest frame that was valid."""

    def add(self, batch: Batch, now_ns: int) -> None:
        """Look at data frames that follow those before."""
        changed = batch.config != self.inventory.config
        self.inventory.add(batch)
        if changed:
            self._begin()
        if self.since_ns is None:
            self.since_ns = now_ns
        seen = batch.arrival_ns != NO_TIME
        self.delay.add((batch.arrival_ns - batch.time_ns)[seen])
        self.good += np.count_nonzero(batch.valid, axis=0)
        for number, slots in enumerate(layout_of(batch.config).slots):
            rows = np.flatnonzero(batch.valid[:, number])
            if len(rows):
                columns = slice(slots.phasor_columns.start, slots.phasor_columns.stop)
                self.phasors[columns] = batch.phasors[rows[-1], columns]

    def values(self, number: int) -> list[complex]:
        """Phasors of station ``number``, as last seen."""
        columns = layout_of(self.inventory.config).slots[number].phasor_columns
        found: list[complex] = self.phasors[columns.start : columns.stop].tolist()
        return found

    def guess(self, number: int) -> Guess:
        """The voltage channels of station ``number``."""
        return guess_voltage(self.stations[number], self.values(number))

    @property
    def stations(self) -> tuple[Station, ...]:
        return self.inventory.config.stations


@dataclass
class SurveyedEndpoint:
    """What came of one URL."""

    endpoint: Endpoint
    streams: list[SurveyedStream] = field(default_factory=list)
    reason: str = ""
    """Why nothing came, where there is no stream."""
    unconfigured: list[tuple[str, int]] = field(default_factory=list)
    """(host, IDCODE) of data that no configuration came for."""
    foreign: dict[int, str] = field(default_factory=dict)
    """Frames that were not asked for: IDCODE, host."""


@dataclass
class Survey:
    """What was seen of all endpoints."""

    endpoints: list[SurveyedEndpoint]
    began_ns: int
    """POSIX UTC."""
    listened_ns: int
    skipped: dict[str, int]
    """Bytes that are in no frame, by reason."""
    own_drops: int = 0
    unlisted: int = 0
    """Streams beyond the first :data:`STREAMS`."""

    @property
    def streams(self) -> list[SurveyedStream]:
        return [stream for endpoint in self.endpoints for stream in endpoint.streams]

    def to_json(self) -> dict[str, Any]:
        return {
            "began_ns": self.began_ns,
            "listened_s": self.listened_ns / NS,
            "endpoints": [_endpoint_json(endpoint) for endpoint in self.endpoints],
            "skipped": self.skipped,
            "own_drops": self.own_drops,
            "unlisted_streams": self.unlisted,
        }


def _endpoint_json(endpoint: SurveyedEndpoint) -> dict[str, Any]:
    return {
        "url": str(endpoint.endpoint),
        "reason": endpoint.reason or None,
        "streams": [_stream_json(stream) for stream in endpoint.streams],
        "unconfigured": [{"host": host, "idcode": idcode} for host, idcode in endpoint.unconfigured],
        "foreign": [{"host": host, "idcode": idcode} for idcode, host in endpoint.foreign.items()],
    }


def _stream_json(stream: SurveyedStream) -> dict[str, Any]:
    told = stream.inventory.to_json()
    for number, station in enumerate(told["stations"]):
        guess = stream.guess(number)
        station |= {"valid_frames": int(stream.good[number]), "voltage": list(guess.channels), "doubt": guess.doubt}
    return told | {"host": stream.host, "senders": list(stream.senders), "delay_ms": stream.delay.summary_ms()}


class Surveyor:
    """Puts together what comes, stream by stream; ``now_ns`` is monotonic."""

    def __init__(self, endpoints: Sequence[Endpoint], now_ns: int) -> None:
        self.endpoints = [SurveyedEndpoint(endpoint) for endpoint in endpoints]
        self.reasons = Reasons()
        self._began_ns = now_ns
        self._streams: dict[tuple[int, str, int], SurveyedStream] = {}
        self._unconfigured: dict[tuple[int, str, int], None] = {}
        self._unlisted: set[tuple[int, str, int]] = set()
        self._places: dict[tuple[Flow, int], int] = {}

    def hear(self, event: LinkEvent) -> None:
        """Take note of the news of a connection."""
        self.reasons.hear(event)
        if event.flow is None or event.idcode is None or not event.owners:
            return
        host, place = event.flow.host, event.owners[0]
        if event.kind is LinkKind.CONFIGURED and len(self._places) < STREAMS:
            self._places[event.flow, event.idcode] = place
        if event.kind is LinkKind.NO_CONFIG and len(self._unconfigured) < STREAMS:
            self._unconfigured[place, host, event.idcode] = None
        if event.kind is LinkKind.FOREIGN:
            for owner in event.owners:
                if len(self.endpoints[owner].foreign) < STREAMS:
                    self.endpoints[owner].foreign[event.idcode] = host

    def take(self, item: Block | Message, owners: Callable[[Flow, int], tuple[int, ...]], now_ns: int) -> None:
        """Look at what came; ``owners`` tells the places of the endpoints that a stream belongs to."""
        if isinstance(item, Block):
            config = item.batch.config
        elif item.config is not None and item.frame.type.rules_data:
            config = item.config
        else:
            return
        place = self._places.get((item.flow, config.idcode))  # a connection that has ended has no owners any more
        if place is None and (places := owners(item.flow, config.idcode)):
            place = places[0]
        if place is None:
            return
        endpoint = self.endpoints[place].endpoint
        host = endpoint.host if endpoint.scheme.commanded else item.flow.host  # whose data may come from elsewhere
        key = (place, host, config.idcode)
        stream = self._streams.get(key)
        if stream is None:
            if len(self._streams) >= STREAMS:
                if len(self._unlisted) < STREAMS * STREAMS:
                    self._unlisted.add(key)
                return
            stream = self._streams[key] = SurveyedStream(host, StreamInventory(item.flow, config.idcode, config))
            self.endpoints[place].streams.append(stream)
        self._unconfigured.pop((place, item.flow.host, config.idcode), None)
        if isinstance(item, Block):
            stream.add(item.batch, now_ns)
            if len(stream.senders) < SENDERS:
                stream.senders[item.flow.source] = None

    def settled(self, now_ns: int) -> bool:
        """Whether every endpoint has shown a configuration and data for a while, or has refused."""
        if self._unconfigured or now_ns - self._began_ns < LOOK_NS:
            return False
        return all(
            _looked_at(endpoint.streams, now_ns) or (not endpoint.streams and self.reasons.refused(place))
            for place, endpoint in enumerate(self.endpoints)
        )

    def result(self, source: LiveSource, began_ns: int, now_ns: int) -> Survey:
        """All that was seen."""
        for place, _, idcode in self._streams:
            self.endpoints[place].foreign.pop(idcode, None)
        for place, host, idcode in self._unconfigured:
            self.endpoints[place].unconfigured.append((host, idcode))
        for place, endpoint in enumerate(self.endpoints):
            endpoint.streams.sort(key=lambda stream: (stream.inventory.idcode, stream.host))
            for stream in endpoint.streams:
                stream.inventory.close()
            if not endpoint.streams:
                endpoint.reason = self.reasons.why(place)
        skipped = {str(reason): nbytes for reason, nbytes in source.tally.skipped.items()}
        listened_ns = now_ns - self._began_ns
        return Survey(self.endpoints, began_ns, listened_ns, skipped, source.own_drops, len(self._unlisted))


def _looked_at(streams: Sequence[SurveyedStream], now_ns: int) -> bool:
    return bool(streams) and all(
        stream.since_ns is not None and now_ns - stream.since_ns >= LOOK_NS for stream in streams
    )


def survey(
    urls: Sequence[str | Endpoint],
    *,
    duration_ns: int | None = None,
    stop: Callable[[], bool] = lambda: False,
    tell: Callable[[LinkEvent], None] | None = None,
    progress: Callable[[Sequence[SurveyedEndpoint]], None] | None = None,
    clock: Clock | None = None,
) -> Survey:
    """Listen to endpoints: for ``duration_ns``, or until all have been seen, at most :data:`PATIENCE_NS`.

    A spontaneous stream may send its configuration only once a minute; what came without one is told of. ``tell`` is
    given the news of connections, ``progress`` what is known, four times a second; ``stop`` ends it, too. Raises
    SourceError where an endpoint cannot be opened, SettingsError for a URL that is none.
    """
    endpoints = [parse_endpoint(url) if isinstance(url, str) else url for url in urls]
    surveyor: Surveyor | None = None

    def hear(event: LinkEvent) -> None:
        if surveyor is not None:
            surveyor.hear(event)
        if tell is not None:
            tell(event)

    def over() -> bool:
        enough = duration_ns is None and surveyor is not None and surveyor.settled(source.clock.monotonic_ns())
        return enough or stop()

    source = LiveSource(endpoints, duration_ns=duration_ns or PATIENCE_NS, tell=hear, stop=over, clock=clock)
    with source:
        began_ns = source.clock.realtime_ns()
        surveyor = Surveyor(endpoints, source.clock.monotonic_ns())
        for found in source.rounds():
            now_ns = source.clock.monotonic_ns()
            for item in found:
                if not isinstance(item, Loss):
                    surveyor.take(item, source.receivers.owners, now_ns)
            if progress is not None:
                progress(surveyor.endpoints)
        return surveyor.result(source, began_ns, source.clock.monotonic_ns())
