"""Sending a plan on time: one loop, absolute deadlines, the ledger."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from types import TracebackType
from typing import Any

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.session import Outcome, Served, served
from pmutools.clock import Clock, utc_offset
from pmutools.errors import SettingsError
from pmutools.impair.outgoing import Fate, LedgerRow
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import Profile
from pmutools.net.endpoint import Endpoint
from pmutools.net.outlet import ServerEvent
from pmutools.net.server import Senders
from pmutools.pacing import Lateness
from pmutools.timebase import NS
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.plan import Due, Items, plan
from pmutools.tools.player.script import Script
from pmutools.tools.player.stamps import StampPolicy, Timeline, timeline

TOGETHER_NS = 50_000
"""Frames due within this time of each other leave with one system call."""
TOGETHER_FRAMES = 1024
DRAIN_NS = 2 * NS
"""How long clients may take for the last frames of a TCP stream."""
POLL_NS = NS // 10
"""How often a waiting player looks whether it is to stop."""


@dataclass(frozen=True)
class Options:
    """How to play; fields as on the command line of ``pmu play``."""

    to: Sequence[Endpoint] = ()
    listen: Sequence[Endpoint] = ()
    policy: StampPolicy = StampPolicy.SHIFT
    speed: Fraction = Fraction(1)
    interval_ns: int | None = None
    fps: int | None = None
    loops: int = 1
    """0: for ever."""
    cfg_period_ns: int = 60 * NS
    """0: announced at the start only."""
    profile: Profile = field(default_factory=Profile)
    seed: int | None = None
    duration_ns: int | None = None


@dataclass
class StreamResult:
    """What became of one stream's frames, and how late they left (ns)."""

    name: str
    idcode: int
    lateness: Lateness
    fates: Counter[str] = field(default_factory=Counter)

    def to_json(self) -> dict[str, Any]:
        late = self.lateness.summary()
        return {
            "name": self.name,
            "idcode": self.idcode,
            "fates": dict(self.fates),
            "late_us": {"p50": late.p50_ns / 1e3, "p99": late.p99_ns / 1e3, "max": late.max_ns / 1e3},
            "misses": late.misses,
        }


class Player:
    """One run of a script. Sockets are open once this is made; :attr:`results` are up to date at any time.

    ``stop`` is asked at least every 0.1 s whether to end early, ``tell`` is given the news of clients. ``senders`` is
    for tests. Raises SourceError where an endpoint cannot be opened, SettingsError for one that cannot be.
    """

    def __init__(
        self,
        script: Script,
        items: Items,
        options: Options,
        clock: Clock,
        *,
        stop: Callable[[], bool] = lambda: False,
        tell: Callable[[ServerEvent], None] = lambda event: None,
        senders: Senders | None = None,
    ) -> None:
        self.script, self.items, self.options, self.clock = script, items, options, clock
        self._stop, self._tell = stop, tell
        self._idle = timeline(script, options.policy, 0, fps=options.fps)
        self._announced = [self._idle.config(stream.config) for stream in script.streams]
        self._sent = [stream.config for stream in script.streams]
        self.results = [
            StreamResult(stream.name, stream.config.idcode, Lateness(_half_period(config)))
            for stream, config in zip(script.streams, self._announced, strict=True)
        ]
        self.pipelines = [
            Pipeline(options.profile, stream.name, options.seed, config=config, aliases=stream.names[1:])
            for stream, config in zip(script.streams, self._announced, strict=True)
        ]
        self.senders = senders or Senders(clock, cfg_period_ns=options.cfg_period_ns or None)
        try:
            self.handles = [self.senders.add(_offer(config)) for config in self._announced]
            for endpoint in options.to:
                self.senders.send_to(endpoint, self._picked(endpoint))
            for endpoint in options.listen:
                self.senders.listen(endpoint, self._told_apart(endpoint, self._picked(endpoint)))
        except BaseException:
            self.senders.close()
            raise

    def _picked(self, endpoint: Endpoint) -> list[int]:
        """Handles of the streams that an endpoint's ``idcode`` picks; all without one."""
        streams = self.script.streams
        chosen = [h for h, s in zip(self.handles, streams, strict=True) if endpoint.idcode in (None, s.config.idcode)]
        if not chosen:
            there = ", ".join(str(stream.config.idcode) for stream in streams)
            raise SettingsError(f"{endpoint}: no stream of IDCODE {endpoint.idcode}; there are {there}")
        return chosen

    def _told_apart(self, endpoint: Endpoint, handles: list[int]) -> list[int]:
        """``handles``, if commands can tell their streams apart."""
        names: dict[int, str] = {}
        for handle in handles:
            stream = self.script.streams[handle]
            if (other := names.setdefault(stream.config.idcode, stream.name)) != stream.name:
                both = f"{other} and {stream.name} both have IDCODE {stream.config.idcode}"
                raise SettingsError(f"--listen {endpoint}: {both}; choose one with --select or --exclude")
        return handles

    def play(self, ledger: LedgerWriter | None = None, progress: Callable[[int], None] = lambda sent: None) -> None:
        """Play to the end, or for ``duration_ns``. With ``listen`` only, begins at the first start command.

        ``progress`` is given the number of frames sent, about once a second.
        """
        options, clock = self.options, self.clock
        told_ns = clock.monotonic_ns()
        end_ns = None if options.duration_ns is None else clock.monotonic_ns() + options.duration_ns
        if options.listen and not options.to and not self._wait_for_start(end_ns):
            return
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
        dues = plan(self.script, self.items, line, self.pipelines, options.loops)
        due = next(dues, None)
        while due is not None:
            due_ns = anchor_ns + due.offset_ns
            if end_ns is not None and due_ns >= end_ns:
                break
            if not self._serve_until(due_ns):
                return
            horizon_ns = clock.monotonic_ns() - anchor_ns + TOGETHER_NS
            batch: list[Due] = []
            while due is not None and due.offset_ns <= horizon_ns and len(batch) < TOGETHER_FRAMES:
                batch.append(due)
                due = next(dues, None)
            self._send(batch, anchor_ns, line, ledger)
            if clock.monotonic_ns() - told_ns >= NS:
                told_ns = clock.monotonic_ns()
                progress(sum(result.fates[Fate.SENT] for result in self.results))
        if end_ns is None:
            self._drain()
        else:  # the end was asked for in time, not in frames
            self._serve_until(end_ns)

    def close(self) -> None:
        self.senders.close()

    def __enter__(self) -> Player:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _send(self, batch: list[Due], anchor_ns: int, line: Timeline, ledger: LedgerWriter | None) -> None:
        frames: list[tuple[int, bytes]] = []
        marks: list[int | None] = []
        for due in batch:
            marks.append(None)
            if due.out.fate is Fate.SENT:
                handle = self.handles[due.stream]
                frames += [(handle, announcement) for announcement in self._reconfigured(due)]
                marks[-1] = len(frames)
                frames.append((handle, due.out.data))
        refusals = Counter(self.senders.publish(frames)) if frames else Counter[int]()
        left_ns = self.clock.monotonic_ns() - anchor_ns
        for due, mark in zip(batch, marks, strict=True):
            result, fate = self.results[due.stream], due.out.fate
            if mark is not None:
                audience = self.senders.audience(self.handles[due.stream])
                if refusals[mark] and refusals[mark] >= audience:
                    fate = Fate.FAILED
                elif not audience:
                    fate = Fate.SKIPPED
                else:
                    result.lateness.add(left_ns - due.offset_ns)
            result.fates[str(fate)] += 1
            if ledger is not None:
                ledger.add(self._row(due, fate, line.start_utc_ns, left_ns))

    def _row(self, due: Due, fate: Fate, start_utc_ns: int, left_ns: int) -> LedgerRow:
        return LedgerRow(
            self.results[due.stream].name,
            due.out.index,
            due.out.copy,
            due.source_ns,
            due.stamp_ns,
            due.offset_ns,
            start_utc_ns + due.offset_ns,
            start_utc_ns + left_ns if fate is Fate.SENT else None,
            None,
            str(fate),
            due.out.faults,
            len(due.out.data),
        )

    def _reconfigured(self, due: Due) -> list[bytes]:
        """Where the recording's configuration changes: offers the new one, and gives the frames that announce it.

        Everyone who gets the data gets these before them, asked for or not.
        """
        if due.config is self._sent[due.stream]:
            return []
        self._sent[due.stream] = due.config
        config = self._idle.config(due.config)
        if config == self._announced[due.stream]:
            return []
        self._announced[due.stream] = config
        offer = _offer(config)
        self.senders.replace(self.handles[due.stream], offer)
        return offer.announcements(self.clock.realtime_ns())

    def _wait_for_start(self, end_ns: int | None) -> bool:
        while not self._stop() and (end_ns is None or self.clock.monotonic_ns() < end_ns):
            for event in self.senders.poll(POLL_NS):
                self._tell(event)
                if event.kind is Outcome.STARTED:
                    return True
        return False

    def _serve_until(self, deadline_ns: int) -> bool:
        """Answer clients until ``deadline_ns``; false if told to stop before."""
        while not self._stop():
            for event in self.senders.serve_until(min(deadline_ns, self.clock.monotonic_ns() + POLL_NS)):
                self._tell(event)
            if self.clock.monotonic_ns() >= deadline_ns:
                return True
        return False

    def _drain(self) -> None:
        """Let TCP clients take what waits for them, and read what they last said: unread, it would reset them."""
        end_ns, timeout_ns = self.clock.monotonic_ns() + DRAIN_NS, 0
        while True:
            for event in self.senders.poll(timeout_ns):
                self._tell(event)
            if not self.senders.queued_bytes or self.clock.monotonic_ns() >= end_ns or self._stop():
                return
            timeout_ns = POLL_NS


def _offer(config: StreamConfig) -> Served:
    return served(config, f"pmutools player, stream {config.idcode}")


def _half_period(config: StreamConfig) -> int:
    return round(NS / config.rate / 2) if config.rate else NS // 2
