"""Recordings made of thin air and a player in virtual time: what it would send, when, exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from support.live import data_frame

from pmutools.c37118 import (
    Format,
    Frame,
    FrameType,
    Message,
    PhasorChannel,
    Station,
    StreamConfig,
    decode_config,
    decode_prefix,
    encode_config,
)
from pmutools.c37118.session import Outcome, Served
from pmutools.clock import VirtualClock
from pmutools.flow import Flow, Hangup, StampSource
from pmutools.formats.source import gather
from pmutools.impair.profile import Profile, parse_action, profile_of_options
from pmutools.net.cargo import Frames
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.net.outlet import ServerEvent
from pmutools.timebase import NS, from_ns, slot_time_ns, to_ns
from pmutools.tools.player.cast import Cast, as_recorded
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.play import Options, Player
from pmutools.tools.player.reel import I64, Reel, at_interval, at_rate, record, without_gaps
from pmutools.tools.player.stamps import StampPolicy
from pmutools.tools.window import Window

START_NS = 1_473_354_311 * NS
"""A whole second, 2016."""
MS = 1_000_000
NOWHERE = parse_endpoint("udp://192.0.2.99:4713")


def stream(
    idcode: int = 7, *, name: str | None = None, rate: int = 50, time_base: int = 1_000_000, cfgcnt: int = 0
) -> StreamConfig:
    """A one-station stream with one integer phasor."""
    station = Station(name or f"PMU {idcode}", idcode, Format(0), (PhasorChannel("V1", 100),), cfgcnt=cfgcnt)
    return StreamConfig(idcode, (station,), rate, time_base=time_base)


def recording(
    config: StreamConfig,
    frames: int,
    *,
    first_ns: int = START_NS,
    first_slot: int = 0,
    latency_ns: Callable[[int], int] | int | None = None,
    slots: Sequence[int] | None = None,
    flow: Flow | None = None,
    announced: bool = True,
) -> list[Message]:
    """A stream's CFG-2 and data frames; frame k (its deviation is k mHz) is stamped ``first_ns + slot / rate``.

    ``latency_ns`` says how long after its stamp a frame arrived (None: nobody knows), ``slots`` which slot each has.
    """
    flow = flow or Flow("udp", f"192.0.2.{config.idcode % 250}:4713", "192.0.2.1:4713")
    messages = []
    if announced:
        opening = encode_config(config, soc=first_ns // NS, fracsec=0)
        arrival = None if latency_ns is None else first_ns
        messages.append(Message(Frame(opening, arrival, StampSource.CAPTURE, 0), flow, config))
    base_slot = first_ns * config.rate.numerator // (config.rate.denominator * NS)
    for k in range(frames):
        slot = first_slot + (slots[k] if slots is not None else k)
        stamp_ns = slot_time_ns(base_slot + slot, config.rate)
        data = data_frame(config, stamp_ns, value=k)
        arrival = None
        if latency_ns is not None:
            arrival = stamp_ns + (latency_ns(k) if callable(latency_ns) else latency_ns)
        messages.append(Message(Frame(data, arrival, StampSource.CAPTURE, 0), flow, config))
    return messages


def interleaved(*recordings: list[Message]) -> list[Message]:
    """Recordings merged on their stamps, configurations first."""

    def key(message: Message) -> tuple[bool, int]:
        data = message.frame.type is FrameType.DATA
        return data, stamp_ns(message.frame.data, message.config) if data else 0

    return sorted((message for messages in recordings for message in messages), key=key)


def stamp_ns(frame: bytes, config: StreamConfig | None) -> int:
    prefix = decode_prefix(frame)
    assert config is not None
    return to_ns(prefix.soc, prefix.fracsec, config.time_base)


def number(frame: bytes) -> int:
    """Which frame of a :func:`recording` this is."""
    return int.from_bytes(frame[-6:-4], "big", signed=True)


class Sent(NamedTuple):
    """A frame that left: on the virtual clock, from the start of play; its stream; its bytes."""

    at_ns: int
    stream: int
    frame: bytes

    @property
    def type(self) -> FrameType:
        return decode_prefix(self.frame).type


class Loaded(NamedTuple):
    """What the stage was given to send, and for how many."""

    frames: Frames
    counts: I64


@dataclass
class Stage:
    """Stands for :class:`~pmutools.net.server.Senders`: takes down what is published, and when.

    ``plays`` maps times (ns from the making) to events that clients cause then; ``listeners`` are how many get a
    stream's frames, ``refuses`` says for which frames (counted over all) how many of them fail.
    """

    clock: VirtualClock
    plays: dict[int, ServerEvent] = field(default_factory=dict)
    listeners: int = 1
    refuses: dict[int, int] = field(default_factory=dict)
    sent: list[Sent] = field(default_factory=list)
    offered: list[Served] = field(default_factory=list)
    announced: list[tuple[int, int]] = field(default_factory=list)
    gates: list[tuple[int, int, Hangup | None]] = field(default_factory=list)
    orders: dict[int, Callable[[], object]] = field(default_factory=dict)
    """What is done at which time (ns from the making), amid the waiting, as a control client does it."""
    closed: bool = False
    queued_bytes: int = 0
    cost_ns: int = 0
    """How long publishing takes."""

    def __post_init__(self) -> None:
        self.zero_ns = self.clock.monotonic_ns()
        self._count = 0

    def add(self, offer: Served) -> int:
        self.offered.append(offer)
        return len(self.offered) - 1

    def replace(self, handle: int, offer: Served) -> None:
        self.offered[handle] = offer

    def send_to(self, endpoint: Endpoint, streams: Sequence[int]) -> int:
        return 0

    def listen(self, endpoint: Endpoint, streams: Sequence[int]) -> int:
        return 0

    def audience(self, handle: int) -> int:
        return self.listeners

    def announce(self, streams: Iterable[int] | None = None) -> None:
        self.announced += [(self.now_ns, handle) for handle in streams or range(len(self.offered))]

    def publish(self, frames: Iterable[tuple[int, bytes]]) -> list[int]:
        failed = []
        for mark, (handle, frame) in enumerate(frames):
            self.sent.append(Sent(self.now_ns, handle, frame))
            failed += [mark] * self.refuses.get(self._count, 0)
            self._count += 1
        self.clock.advance(self.cost_ns)
        return failed

    def load(self, frames: Frames) -> Loaded:
        return Loaded(frames, np.where(frames.wanted, self.listeners, 0))

    def stale(self, cargo: Loaded) -> bool:
        return False

    def send(self, cargo: Loaded, first: int, last: int) -> list[int]:
        """All at once, as one system call does."""
        rows = [row for row in range(first, last) if cargo.frames.wanted[row]]
        frames = cargo.frames
        return [rows[k] for k in self.publish((int(frames.stream[row]), frames.frame(row)) for row in rows)]

    def departures(self) -> tuple[I64, I64]:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)

    def hang_up(self, handle: int, how: Hangup) -> int:
        self.gates.append((self.now_ns, handle, how))
        return 1

    def take_up(self, handle: int) -> None:
        self.gates.append((self.now_ns, handle, None))

    def poll(self, timeout_ns: int | None) -> list[ServerEvent]:
        return self.serve_until(self.clock.monotonic_ns() + (timeout_ns or 0))

    def serve_until(self, deadline_ns: int) -> list[ServerEvent]:
        due = sorted(at for at in (*self.plays, *self.orders) if self.zero_ns + at <= deadline_ns)
        self.clock.sleep_until(self.zero_ns + due[0] if due else deadline_ns)
        if due and due[0] in self.orders:
            self.orders.pop(due[0])()
            return []
        return [self.plays.pop(due[0])] if due else []

    def inform(self, handle: int) -> None:
        now_ns = self.clock.realtime_ns()
        self.sent += [Sent(self.now_ns, handle, frame) for frame in self.offered[handle].announcements(now_ns)]

    def interrupt(self) -> None:
        """It returns from waiting after each order anyway."""

    def close(self) -> None:
        self.closed = True

    @property
    def now_ns(self) -> int:
        return self.clock.monotonic_ns() - self.zero_ns


def started(idcode: int = 7) -> ServerEvent:
    """News that a client has sent the start command."""
    return ServerEvent(Outcome.STARTED, 0, "192.0.2.50:4712", idcode)


@dataclass
class Played:
    """A run in virtual time that is over."""

    cast: Cast
    stage: Stage
    player: Player
    began_ns: int
    """UTC when it began."""
    warnings: list[str] = field(default_factory=list)

    @property
    def reel(self) -> Reel:
        return self.cast.reel

    @property
    def data(self) -> list[Sent]:
        return [sent for sent in self.stage.sent if sent.type is FrameType.DATA]

    def times(self, stream: int = 0) -> list[int]:
        """When the data frames of a stream left: ns from the beginning."""
        return [sent.at_ns for sent in self.data if sent.stream == stream]

    def stamps(self, stream: int = 0) -> list[int]:
        """Stamps of the data frames sent, POSIX UTC ns."""
        config = self.reel.tracks[self.cast.parts[stream].track].config
        return [stamp_ns(sent.frame, config) for sent in self.data if sent.stream == stream]

    def numbers(self, stream: int = 0) -> list[int]:
        return [number(sent.frame) for sent in self.data if sent.stream == stream]

    @property
    def fates(self) -> dict[str, int]:
        """Over all streams."""
        return self.player.results.fates()


def faults(*pairs: str) -> Profile:
    """``faults("loss=5%", "drop=3")``, as on the command line."""
    return profile_of_options((name, value) for name, _, value in (pair.partition("=") for pair in pairs))


def reel_of(messages: list[Message], *choices: Any, **named: Any) -> Reel:
    """The reel of a recording; arguments as of :func:`record`."""
    return record(gather(messages), *choices, **named)


def play(
    messages: list[Message],
    *,
    clock: VirtualClock | None = None,
    stage: Stage | None = None,
    window: Window | None = None,
    timing: str | None = None,
    select: Sequence[str] = (),
    exclude: Sequence[str] = (),
    interval_ns: int | None = None,
    fps: int | None = None,
    cast: Callable[[Reel], Cast] = as_recorded,
    ledger: Path | None = None,
    stop: Callable[[], bool] = lambda: False,
    orders: Mapping[int, str | Callable[[Player], object]] | None = None,
    skip_gaps_ns: int | None = None,
    reel: Reel | None = None,
    **options: Any,
) -> Played:
    """Play ``messages`` to the end; ``options`` are those of :class:`Options`, ``policy`` and ``speed`` as text.

    ``orders`` are given to the player at these times, ns from the beginning; those of one time on lines of their own;
    or something is done with it. ``reel`` instead of ``messages`` is what there is already.
    """
    clock = clock or VirtualClock()
    stage = stage or Stage(clock)
    reel = reel or reel_of(messages, timing, window, select, exclude)
    if skip_gaps_ns is not None:
        reel, _ = without_gaps(reel, skip_gaps_ns)
    if interval_ns is not None:
        reel = at_interval(reel, interval_ns)
    if fps is not None:
        reel = at_rate(reel, fps)
    chosen = Options(**({"to": [NOWHERE]} | options))
    chosen = replace(chosen, policy=StampPolicy(chosen.policy), speed=Fraction(chosen.speed))
    began_ns, warnings = clock.realtime_ns(), list[str]()
    with Player(cast(reel), chosen, clock, stop=stop, warn=warnings.append, senders=stage) as player:  # type: ignore[arg-type]

        def obey(order: str | Callable[[Player], object]) -> None:
            if callable(order):
                order(player)
                return
            for line in order.splitlines():
                player.act(parse_action(line))

        stage.orders |= {at_ns: partial(obey, order) for at_ns, order in (orders or {}).items()}
        if ledger is None:
            player.play()
        else:
            with LedgerWriter(ledger) as rows:
                player.play(rows)
    return Played(player.cast, stage, player, began_ns, warnings)


def config_of(sent: Sent) -> StreamConfig:
    """A configuration frame that was sent."""
    return decode_config(sent.frame)[1]


def at(ns: int, config: StreamConfig) -> tuple[int, int]:
    """(SOC, FRACSEC) of a time in a stream."""
    return from_ns(ns, config.time_base)
