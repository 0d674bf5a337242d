"""Sending a script on time: one loop, absolute deadlines, the fault pipeline between cue and wire."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.session import Outcome, served
from pmutools.clock import Clock, utc_offset
from pmutools.errors import SettingsError
from pmutools.impair.outgoing import Fate, LedgerRow, Outgoing
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import Profile
from pmutools.net.endpoint import Endpoint
from pmutools.net.outlet import ServerEvent
from pmutools.net.server import Senders
from pmutools.pacing import Lateness, LatenessSummary
from pmutools.timebase import NS
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.script import Cue, Items, Script, cues
from pmutools.tools.player.stamps import StampPolicy, Timeline, timeline

TOGETHER_NS = 50_000
"""Frames due within this time of each other leave with one system call."""
DRAIN_NS = 2 * NS
"""How long clients may take for the last frames of a TCP stream."""
OFFSET_NS = NS
"""How often UTC is compared with the monotonic clock."""


@dataclass(frozen=True)
class Options:
    """How to play; fields as on the command line of ``pmu play``."""

    to: Sequence[Endpoint] = ()
    listen: Sequence[Endpoint] = ()
    policy: StampPolicy = StampPolicy.SHIFT
    speed: Any = 1
    interval_ns: int | None = None
    fps: int | None = None
    loops: int = 1
    """0: for ever."""
    cfg_period_s: float = 60.0
    profile: Profile = field(default_factory=Profile)
    seed: int | None = None
    duration_s: float | None = None


@dataclass
class StreamResult:
    """What became of one stream's frames, and how late they left (ns)."""

    name: str
    idcode: int
    lateness: Lateness
    fates: dict[str, int] = field(default_factory=dict)
    failed: int = 0

    def to_json(self) -> dict[str, Any]:
        late: LatenessSummary = self.lateness.summary()
        return {
            "name": self.name,
            "idcode": self.idcode,
            "fates": self.fates,
            "late_us": {"p50": late.p50_ns / 1e3, "p99": late.p99_ns / 1e3, "max": late.max_ns / 1e3},
            "misses": late.misses,
        }


class _Due(NamedTuple):
    """A copy waiting for its time, on the heap by deadline and order."""

    offset_ns: int
    order: int
    stream: int
    out: Outgoing
    source_ns: int
    stamp_ns: int
    config: StreamConfig


class Player:
    """One run of a script. Sockets are open once this is made."""

    def __init__(self, script: Script, items: Items, options: Options, clock: Clock) -> None:
        """Raises SourceError where an endpoint cannot be opened, SettingsError for one that cannot be."""
        self.script, self.items, self.options, self.clock = script, items, options, clock
        period = None if options.cfg_period_s == 0 else round(options.cfg_period_s * NS)
        self.senders = Senders(clock, cfg_period_ns=period)
        self._order = count()
        self.results = [
            StreamResult(stream.name, stream.config.idcode, Lateness(_half_period(stream.config)))
            for stream in script.streams
        ]
        self.pipelines = [
            Pipeline(options.profile, stream.name, options.seed, config=stream.config, aliases=stream.names[1:])
            for stream in script.streams
        ]
        try:
            self._open()
        except BaseException:
            self.senders.close()
            raise

    def _open(self) -> None:
        self._announced = [self._retimed(stream.config) for stream in self.script.streams]
        self.handles = [self.senders.add(served(config, _header(config))) for config in self._announced]
        for endpoint in self.options.to:
            self.senders.send_to(endpoint, self._picked(endpoint))
        for endpoint in self.options.listen:
            self.senders.listen(endpoint, self._picked(endpoint))

    def _retimed(self, config: StreamConfig) -> StreamConfig:
        return timeline(self.script, self.options.policy, 0, fps=self.options.fps).config(config)

    def _picked(self, endpoint: Endpoint) -> list[int]:
        """Handles of the streams that an endpoint's ``idcode`` picks; all without one."""
        streams = self.script.streams
        chosen = [h for h, s in zip(self.handles, streams, strict=True) if endpoint.idcode in (None, s.config.idcode)]
        if not chosen:
            there = ", ".join(str(stream.config.idcode) for stream in streams)
            raise SettingsError(f"{endpoint}: no stream of IDCODE {endpoint.idcode}; there are {there}")
        return chosen

    def play(
        self, ledger: LedgerWriter | None = None, tell: Callable[[ServerEvent], None] = lambda event: None
    ) -> list[StreamResult]:
        """Play to the end, or for ``duration_s``. With ``listen`` only, begins at the first start command."""
        options, clock = self.options, self.clock
        started_ns = clock.monotonic_ns()
        end_ns = None if options.duration_s is None else started_ns + round(options.duration_s * NS)
        if options.listen and not options.to and not self._wait_for_start(end_ns, tell):
            return self.results
        offset = utc_offset(clock)
        line = timeline(
            self.script,
            options.policy,
            clock.realtime_ns(),
            speed=options.speed,
            interval_ns=options.interval_ns,
            fps=options.fps,
        )
        anchor_ns = offset.monotonic_ns(line.start_utc_ns)
        self.senders.announce()
        waiting: list[_Due] = []
        upcoming = self._staged(line)
        following = next(upcoming, None)
        while following is not None or waiting:
            while following is not None and (not waiting or waiting[0].offset_ns >= following[0]):
                for due in self._through(following, line):
                    heapq.heappush(waiting, due)
                following = next(upcoming, None)
            if following is None:
                self._close_pipelines(waiting)
            if not waiting:
                continue
            due_ns = anchor_ns + waiting[0].offset_ns
            if end_ns is not None and due_ns > end_ns:
                break
            if self._serve_until(due_ns, tell):
                continue
            horizon = clock.monotonic_ns() - anchor_ns + TOGETHER_NS
            batch = []
            while waiting and waiting[0].offset_ns <= horizon:
                batch.append(heapq.heappop(waiting))
            self._send(batch, anchor_ns, line, ledger)
        if end_ns is not None:  # the end was asked for in time, not in frames
            while clock.monotonic_ns() < end_ns:
                self._serve_until(end_ns, tell)
        self._drain(tell)
        return self.results

    def close(self) -> None:
        self.senders.close()

    def _staged(self, line: Timeline) -> Iterator[tuple[int, int, Cue, int]]:
        """(offset, stream time, cue, loop) in order, over all loops."""
        loop = 0
        while self.options.loops == 0 or loop < self.options.loops:
            for cue in cues(self.script, self.items()):
                stream_ns = line.stream_ns(cue, loop)
                yield line.offset_ns(stream_ns), stream_ns, cue, loop
            loop += 1

    def _through(self, staged: tuple[int, int, Cue, int], line: Timeline) -> Iterator[_Due]:
        offset_ns, stream_ns, cue, loop = staged
        data, stamp_ns = line.stamped(cue, loop, offset_ns)
        index = cue.number + loop * self.script.streams[cue.stream].frames
        for out in self.pipelines[cue.stream].apply(index, data, offset_ns, stream_ns):
            yield self._due(out, cue.stream, cue.stamp_ns, stamp_ns, cue.config)

    def _due(self, out: Outgoing, stream: int, source_ns: int, stamp_ns: int, config: StreamConfig) -> _Due:
        return _Due(out.offset_ns, next(self._order), stream, out, source_ns, stamp_ns, config)

    def _close_pipelines(self, waiting: list[_Due]) -> None:
        for number, pipeline in enumerate(self.pipelines):
            for out in pipeline.close():
                heapq.heappush(waiting, self._due(out, number, 0, 0, self.script.streams[number].config))

    def _send(self, batch: list[_Due], anchor_ns: int, line: Timeline, ledger: LedgerWriter | None) -> None:
        frames = []
        for due in batch:
            if due.out.fate is Fate.SENT:
                self._reconfigure(due)
                frames.append((self.handles[due.stream], due.out.data))
        failed = set(self.senders.publish(frames)) if frames else set()
        sent_ns = self.clock.monotonic_ns()
        place = 0
        for due in batch:
            result, fate = self.results[due.stream], due.out.fate
            left: int | None = None
            if fate is Fate.SENT:
                if place in failed:
                    fate = Fate.FAILED
                elif not self.senders.audience(self.handles[due.stream]):
                    fate = Fate.SKIPPED
                else:
                    left = sent_ns
                    result.lateness.add(sent_ns - anchor_ns - due.offset_ns)
                place += 1
            result.fates[str(fate)] = result.fates.get(str(fate), 0) + 1
            if ledger is not None:
                ledger.add(self._row(due, fate, left, anchor_ns, line))

    def _row(self, due: _Due, fate: Fate, left: int | None, anchor_ns: int, line: Timeline) -> LedgerRow:
        return LedgerRow(
            self.results[due.stream].name,
            due.out.index,
            due.out.copy,
            due.source_ns,
            due.stamp_ns,
            due.offset_ns,
            line.start_utc_ns + due.offset_ns,
            None if left is None else line.start_utc_ns + left - anchor_ns,
            None,
            str(fate),
            due.out.faults,
            len(due.out.data),
        )

    def _reconfigure(self, due: _Due) -> None:
        """The recording's configuration changes here: offer and announce the new one first."""
        config = self._retimed(due.config)
        if self._announced[due.stream] != config:
            self._announced[due.stream] = config
            self.pipelines[due.stream].configure(config)
            self.senders.replace(self.handles[due.stream], served(config, _header(config)))
            self.senders.announce([self.handles[due.stream]])

    def _wait_for_start(self, end_ns: int | None, tell: Callable[[ServerEvent], None]) -> bool:
        while end_ns is None or self.clock.monotonic_ns() < end_ns:
            for event in self.senders.poll(100_000_000):
                tell(event)
                if event.kind is Outcome.STARTED:
                    return True
        return False

    def _serve_until(self, deadline_ns: int, tell: Callable[[ServerEvent], None]) -> bool:
        """Answer clients until ``deadline_ns``; true if news made it come back before."""
        events = self.senders.serve_until(deadline_ns)
        for event in events:
            tell(event)
        return bool(events)

    def _drain(self, tell: Callable[[ServerEvent], None]) -> None:
        if not self.options.listen:
            return
        end_ns = self.clock.monotonic_ns() + DRAIN_NS
        while self.clock.monotonic_ns() < end_ns and any(map(self.senders.audience, self.handles)):
            for event in self.senders.poll(50_000_000):
                tell(event)


def _half_period(config: StreamConfig) -> int:
    return round(NS / config.rate / 2) if config.rate else NS // 2


def _header(config: StreamConfig) -> str:
    return f"pmutools player, stream {config.idcode}"
