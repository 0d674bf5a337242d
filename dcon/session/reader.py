"""Reading a session log: every tick with the frames and orders it was given, and what it decided.

Which frames a tick consumed is part of the log (``tick_ns`` in each), so a replay groups by tick, never by arrival.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from dcon.core.values import NOTHING, Inputs, Order, Pdci, Record, Sample, Surroundings
from dcon.session import codec
from dcon.session.codec import Timing
from dcon.session.head import INI_NAME, PROBE_NAME
from dcon.session.parts import SESSION, Part, Paths, lost, missing, parts_of
from pmutools.errors import SourceError
from pmutools.schema.log_reader import Damage, LogAttachment, LogMessage, LogReader
from pmutools.schema.messages import MESSAGES
from pmutools.schema.pmu_log import PmuFrame, config_name, from_message, name_of


class LoggedTick(NamedTuple):
    """One tick of a session: its inputs and what came of them."""

    record: Record
    frames: tuple[PmuFrame, ...]
    orders: tuple[Order, ...]
    timing: Timing | None
    pdci: Pdci | None
    after_loss: bool
    """Something of the log is missing just before this tick: a replay cannot know the controller's state."""
    configs: tuple[tuple[str, bytes], ...] = ()
    """Configuration frames that came since the last tick (or before the first), with the PMU's name."""
    surroundings: Surroundings = NOTHING

    def inputs(self, pmus: Sequence[str]) -> Inputs:
        """What ``step`` was given; ``pmus`` are the names in the order of its parameters."""
        samples: dict[str, list[Sample]] = {name: [] for name in pmus}
        for frame in self.frames:
            if frame.name in samples:
                samples[frame.name].append(codec.sample_of(frame))
        return Inputs(tuple(map(tuple, samples.values())), self.orders, self.surroundings)


@dataclass(slots=True)
class TickMessages:
    """The decoded protobuf messages of one tick, by name; frames as (PMU, message)."""

    tick_ns: int
    lost: str
    """What of the log is missing just before this tick, in words; "" is nothing."""
    frames: list[tuple[str, Any]] = field(default_factory=list)
    messages: dict[str, list[Any]] = field(default_factory=dict)
    configs: list[tuple[str, bytes]] = field(default_factory=list)
    data: dict[str, list[bytes]] = field(default_factory=dict)
    """All of them as they are in the file, in the same order."""

    def one(self, message: str) -> Any | None:
        """The tick's only message of that name; None where it has none."""
        return self.messages.get(message, (None,))[0]


class SessionReader:
    """A session log. What precedes the first tick is read at once.

    ``metadata`` (text by key), ``pmus``, ``instances``, ``flags`` (names), ``ini_text``, ``probe_file`` (None where
    there is none), ``configs`` (first frame of each PMU): those of the first part. ``incomplete_ticks`` and ``damage``
    are those of the last iteration, once it is exhausted. Which parts are read for ``paths``:
    :func:`~dcon.session.parts.parts_of`.
    Raises SourceError for a file that cannot be read, is no session log, or not of the same session.
    """

    def __init__(self, paths: Paths) -> None:
        self.parts = parts_of(paths)
        self.metadata: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.incomplete_ticks = 0
        first_tick = self._read_head()
        if first_tick is None and not self.metadata:
            raise SourceError(f"{self.path}: not a session log (no {SESSION!r} metadata, no tick)")
        # chunks have a CRC, metadata records have none: the tick channel's word goes first
        names = self.metadata if first_tick is None else {**self.metadata, **first_tick.channel.metadata}
        self.pmus = _names(names, "pmus")
        self.instances = _names(names, "instances")
        self.flags = _names(names, "flags")
        self.probe_file = self.attachments.get(PROBE_NAME)
        self.ini_text = self.attachments.get(INI_NAME, b"").decode(errors="replace")
        self.configs = {name: data for key, data in self.attachments.items() if (name := config_name(key)) is not None}

    @property
    def path(self) -> Path:
        """Of the first part."""
        return self.parts[0].log.path

    @property
    def damage(self) -> Damage:
        """Of all parts together."""
        return sum((part.log.damage for part in self.parts), start=Damage())

    @property
    def missing(self) -> list[str]:
        """What is not there before and between the parts, in words."""
        return missing(self.parts)

    def ticks(self) -> Iterator[LoggedTick]:
        """Every whole tick with its inputs, in file order."""
        loss = False
        for group in self.groups(TICK_MESSAGES):
            loss |= bool(group.lost)
            try:
                tick = logged_tick(group, loss)
            except ValueError:
                self.incomplete_ticks += 1
                loss = True
                continue
            yield tick
            loss = False

    def groups(self, messages: Collection[str]) -> Iterator[TickMessages]:
        """The wanted messages (names of the table) of each tick, decoded; memory is bounded by a tick and a chunk."""
        self.incomplete_ticks = 0
        self.reset_damage()
        before: Part | None = None
        losses: list[str] = []
        for part in self.parts:
            losses.append(lost(before, part))
            for group in self._groups(part.log, messages):
                group.lost = "; ".join(filter(None, (*losses, group.lost)))
                losses.clear()
                yield group
            before = part

    def reset_damage(self) -> None:
        """Before an iteration."""
        for part in self.parts:
            part.log.damage = Damage()

    def _groups(self, log: LogReader, messages: Collection[str]) -> Iterator[TickMessages]:
        group: TickMessages | None = None
        losses = 0
        configs: list[tuple[str, bytes]] = []
        for entry in log.records(messages):
            if isinstance(entry, LogAttachment) and (name := config_name(entry.name)) is not None:
                configs.append((name, entry.data))
            if not isinstance(entry, LogMessage) or (message := log.decode(entry)) is None:
                continue
            if entry.channel.message == "PmuFrame" and not message.tick_ns:
                continue  # no tick consumed it
            kind = str(entry.channel.message)
            tick_ns = getattr(message, _TIMES[kind])
            if group is None or tick_ns != group.tick_ns:
                if group is not None:
                    yield group
                group = TickMessages(tick_ns, DAMAGED if log.damage.losses > losses else "", configs=configs)
                configs = []
                losses = log.damage.losses
            if kind == "PmuFrame":
                group.frames.append((name_of(entry.channel.topic), message))
            else:
                group.messages.setdefault(kind, []).append(message)
            group.data.setdefault(kind, []).append(entry.data)
        if group is not None:
            yield group

    def _read_head(self) -> LogMessage | None:
        """Take in what comes before the first tick, and return that."""
        for entry in self.parts[0].log.records({"Tick"}):
            if isinstance(entry, LogMessage):
                return entry
            if isinstance(entry, LogAttachment):
                self.attachments.setdefault(entry.name, entry.data)
            elif entry.name == SESSION:
                self.metadata.update(entry.values)
        return None


DAMAGED = "what is there cannot be read"
"""Lost within a part."""
_TIMES = {name: "tick_ns" if name == "PmuFrame" else message.fields[0].name for name, message in MESSAGES.items()}
"""Field of each message that names its tick; of one that belongs to none, its time."""
TICK_MESSAGES = frozenset(
    ("PmuFrame", "Setting", "Surroundings", "Tick", "Instance", "Event", "Flag", "Timing", "Pdci")
)
"""What a :class:`LoggedTick` is made of."""


def _names(metadata: Mapping[str, str], key: str) -> tuple[str, ...]:
    try:
        return tuple(map(str, json.loads(metadata.get(key, "[]"))))
    except (ValueError, TypeError):
        return ()


def logged_tick(group: TickMessages, after_loss: bool = False) -> LoggedTick:
    """Raises ValueError where the tick is not whole."""
    tick, instance = group.one("Tick"), group.one("Instance")
    if tick is None or instance is None:
        raise ValueError(f"tick {group.tick_ns} is not whole")
    timing, pdci = group.one("Timing"), group.one("Pdci")
    return LoggedTick(
        codec.decode_record(tick, instance, group.messages.get("Event", ()), group.messages.get("Flag", ())),
        tuple(from_message(name, message) for name, message in group.frames),
        tuple(map(codec.decode_order, group.messages.get("Setting", ()))),
        None if timing is None else Timing(timing.compute_us, timing.late_us),
        None if pdci is None else codec.decode_pdci(pdci),
        after_loss,
        tuple(group.configs),
        codec.decode_surroundings(group.one("Surroundings")),
    )
