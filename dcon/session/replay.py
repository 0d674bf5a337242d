"""``dcon replay``: a recorded session through the same engine again, from its logged bytes and arrivals.

With the session's own settings every record must come out the same, to the last bit, and every frame must hold its
CHK and decode to what the log says; the first difference is reported with the tick's inputs. With changed settings
the result is what the controller would have *commanded*: the grid that answered is the recorded one, so nothing is
said of what the grid would have done.

What is compared first are the bytes of the messages: they are the same where every value is, and nothing needs to be
decoded for that. Events of the log itself are not the controller's, and are passed over.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import pmutools
from dcon.core.values import Order, Record
from dcon.engine import Engine, Tick
from dcon.session import codec
from dcon.session.defaults import former
from dcon.session.newer import Newer, newer_in
from dcon.session.parts import Paths
from dcon.session.reader import TICK_MESSAGES, LoggedTick, SessionReader, TickMessages, logged_tick
from dcon.session.rolling import LOG_SUBJECT
from dcon.settings import parse
from pmutools.c37118 import Frame, decode_config
from pmutools.c37118.checksum import chk
from pmutools.errors import SourceError, WireError
from pmutools.flow import StampSource
from pmutools.schema.pmu_log import PmuFrame

NOT_THE_GRID = "This is the command, not the grid: the recorded grid answered to the recorded command."
"""What is to be said of a replay with changed settings."""


class Driven(NamedTuple):
    """What a tick commanded and drove: fields of a :class:`~dcon.core.values.Record`, or how far they changed."""

    command_mw: float = 0.0
    probe_mw: float = 0.0
    output_v: float = 0.0

    @classmethod
    def of(cls, tick: Any) -> Driven:
        """Of a record, or of the message of a tick."""
        return cls(tick.command_mw, tick.probe_mw, tick.output_v)


Observer = Callable[[Driven, Record], None]
"""(what was recorded, the record of the tick now)."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first field of a tick's record that came out otherwise, or ``frame`` and the one that is not as logged."""

    tick_ns: int
    field: str
    recorded: Any
    replayed: Any
    before: str
    """How the tick before ended."""
    frames: tuple[PmuFrame, ...]
    orders: tuple[Order, ...]

    def __str__(self) -> str:
        inputs = [f"before: {self.before}"]
        inputs += [
            f"{frame.name}: stamp {frame.time_ns}, arrival {frame.arrival_ns}, V1 {abs(frame.v1):.3f} V at "
            f"{math.degrees(cmath.phase(frame.v1)):.4f}°, {frame.frequency_hz:.6f} Hz, STAT {frame.stat:#06x}"
            for frame in self.frames
        ]
        inputs += [
            f"order: {order.name}" + (f" {order.given:g}" if order.given is not None else "") for order in self.orders
        ]
        what = f"tick {self.tick_ns}: {self.field} {self.recorded!r} -> {self.replayed!r}"
        return "\n  ".join((what, *(inputs if self.frames or self.orders else [*inputs, "no frames"])))

    def to_json(self) -> dict[str, Any]:
        return {
            "tick_ns": self.tick_ns,
            "field": self.field,
            "recorded": _plain(self.recorded),
            "replayed": _plain(self.replayed),
            "before": self.before,
            "frames": [
                {
                    "pmu": frame.name,
                    "time_ns": frame.time_ns,
                    "arrival_ns": frame.arrival_ns,
                    "v1_re": _plain(frame.v1.real),
                    "v1_im": _plain(frame.v1.imag),
                    "frequency_hz": _plain(frame.frequency_hz),
                    "stat": frame.stat,
                }
                for frame in self.frames
            ],
            "orders": [{"name": order.name, "value": _plain(order.given)} for order in self.orders],
        }


def _plain(value: object) -> object:
    """A value that JSON has; NaN, infinities and tuples as text."""
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return value if isinstance(value, int | float | str | None) else repr(value)


@dataclass
class Replay:
    """What came of it. ``stopped`` says why not every tick could be replayed."""

    ticks: int = 0
    different: int = 0
    first: Difference | None = None
    changes: tuple[str, ...] = ()
    stopped: str = ""
    problems: list[str] = field(default_factory=list)
    """Configurations that could not be used, in words."""
    largest: Driven = field(default_factory=Driven)
    """Largest change of each."""
    newer: Newer = field(default_factory=Newer)
    """What the log holds that this program does not know."""

    def to_json(self) -> dict[str, Any]:
        return {
            "ticks": self.ticks,
            "different": self.different,
            "first": self.first.to_json() if self.first else None,
            "changes": list(self.changes),
            "stopped": self.stopped or None,
            "problems": self.problems,
            "newer": self.newer.to_json(),
            "largest_command_change_mw": self.largest.command_mw,
            "largest_probe_change_mw": self.largest.probe_mw,
            "largest_output_change_v": self.largest.output_v,
            "note": NOT_THE_GRID if self.changes else None,
        }


def replay(
    paths: Paths, changes: Sequence[str] = (), observe: Observer | None = None, duration_ns: int | None = None
) -> Replay:
    """Replay a session log, with ``SECTION.KEY=VALUE`` changes laid over its settings.

    ``observe`` is shown every tick. Ticks ``duration_ns`` after the first, and later ones, are left out. Raises
    SourceError for what is no session log or not its beginning, SettingsError for settings that cannot be.
    """
    reader = SessionReader(paths)
    if reader.parts[0].number > 1:
        first = reader.metadata.get("first", "")
        raise SourceError(
            f"{reader.path}: part {reader.parts[0].number} of a session; a replay starts with the first"
            f"{first and f', {first}'}"
        )
    if not reader.ini_text:
        raise SourceError(f"{reader.path}: the log holds no initialisation file (its beginning is lost), so no replay")
    name, defaults = f"{reader.path}: {_INI}", former(reader.metadata)
    settings = parse(reader.ini_text, name, tuple(changes), probe_file=reader.probe_file, defaults=defaults)
    engine = Engine(settings.params, settings.sites, verified=reader.metadata.get("verified") == "true")
    result = Replay(changes=tuple(changes))
    before = "the session begins"
    ended, end_ns = False, math.inf
    for group in reader.groups(TICK_MESSAGES):
        logged = group.one("Tick")
        if not result.ticks and duration_ns is not None:
            end_ns = group.tick_ns + duration_ns
        if group.tick_ns >= end_ns:
            ended = True
            break
        if group.after_loss:
            result.stopped = "; ".join((f"the log lost something before tick {group.tick_ns}", *reader.missing))
            break
        if logged is None or group.one("Instance") is None:
            result.stopped = f"tick {group.tick_ns} is not whole"
            break
        now = _again(engine, group, result)
        result.ticks += 1
        recorded, driven = Driven.of(logged), Driven.of(now.record)
        if recorded != driven:
            changes_now = (abs(one - other) for one, other in zip(recorded, driven, strict=True))
            result.largest = Driven(*map(max, result.largest, changes_now))
        if not _same_bytes(group, now, reader.instances, frames=not changes):
            try:
                tick = logged_tick(group)
            except ValueError as error:
                result.stopped = str(error)
                break
            found = (None if changes else _changed_frame(tick, now.frames)) or _changed_record(tick.record, now.record)
            if found is not None:
                result.different += 1
                result.first = result.first or Difference(group.tick_ns, *found, before, tick.frames, tick.orders)
        if observe is not None:
            observe(recorded, now.record)
        before = (
            f"{logged.state} {logged.mode}, {logged.active_instance or 'no instance'} active, "
            f"{logged.gain_mw_per_mhz:g} MW/mHz, command {logged.command_mw!r} MW"
        )
    result.newer = newer_in(reader)
    version = reader.metadata.get("version", "")
    if result.different and not changes and version != pmutools.__version__:
        result.problems.append(f"recorded by version {version or 'unknown'}, replayed by {pmutools.__version__}")
    if not result.stopped and not ended:
        result.stopped = "; ".join((*reader.missing, *reader.damage.lines()))
    if not result.ticks and not result.stopped:
        raise SourceError(f"{reader.path}: holds no tick")
    return result


_INI = "initialisation file"
_STAMP_SOURCES = {str(source): source for source in StampSource}


def _again(engine: Engine, group: TickMessages, result: Replay) -> Tick:
    """The tick, from what the log says it was given."""
    for name, config_frame in group.configs:
        try:
            config = decode_config(config_frame)[1]
        except WireError as error:
            result.problems.append(f"{name}: {error}")
            continue
        if (problem := engine.reconfigure(name, config)) is not None:
            result.problems.append(problem)
    frames: dict[str, list[Frame]] = {}
    for name, message in group.frames:
        source = _STAMP_SOURCES.get(message.stamp_source, StampSource.CAPTURE)
        frames.setdefault(name, []).append(Frame(message.wire, message.arrival_ns or None, source, 0))
    orders = tuple(map(codec.decode_order, group.messages.get("Setting", ())))
    return engine.tick(frames, orders, group.tick_ns, codec.decode_surroundings(group.one("Surroundings")))


def _same_bytes(group: TickMessages, now: Tick, instances: Sequence[str], *, frames: bool) -> bool:
    """Whether the tick's messages come out the same byte for byte, and, with ``frames``, every frame holds its CHK."""
    record, data = now.record, group.data
    if codec.encode_tick(record, instances) != data["Tick"][0] or codec.encode_instances(record) != data["Instance"][0]:
        return False
    logged = [
        wire
        for event, wire in zip(group.messages.get("Event", ()), data.get("Event", ()), strict=True)
        if event.subject != LOG_SUBJECT
    ]
    if [codec.encode_event(record.tick_ns, event) for event in record.events] != logged:
        return False
    if [codec.encode_flag(record.tick_ns, flag) for flag in record.flag_changes] != data.get("Flag", []):
        return False
    if not frames:
        return True
    found = [reading.encode(record.tick_ns) for reading in now.readings]
    return found == data.get("PmuFrame", []) and not any(chk(message.wire) for _, message in group.frames)


def identical(one: object, other: object) -> bool:
    """Equal to the last bit, NaN and -0.0 too, through tuples."""
    if isinstance(one, complex) and isinstance(other, complex):
        one, other = (one.real, one.imag), (other.real, other.imag)
    if isinstance(one, float) and isinstance(other, float):
        if one == other:
            return one != 0 or math.copysign(1, one) == math.copysign(1, other)
        return math.isnan(one) and math.isnan(other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(identical, one, other))
    return one == other


def _changed_record(recorded: object, replayed: object, name: str = "") -> tuple[str, object, object] | None:
    """The first value that differs, with its place: ``instances.3.command_mw``."""
    if isinstance(recorded, Record):
        events = tuple(event for event in recorded.events if event.subject != LOG_SUBJECT)
        recorded = recorded._replace(events=events)
    if identical(recorded, replayed):
        return None
    if isinstance(recorded, tuple) and isinstance(replayed, tuple) and len(recorded) == len(replayed):
        places = getattr(recorded, "_fields", range(len(recorded)))
        for place, one, other in zip(places, recorded, replayed, strict=True):
            if found := _changed_record(one, other, f"{name}.{place}" if name else str(place)):
                return found
    return name, recorded, replayed


def _changed_frame(tick: LoggedTick, frames: Sequence[PmuFrame]) -> tuple[str, object, object] | None:
    """The first frame that is not what was received: its bytes, or what the log says they mean, were changed."""
    if len(frames) != len(tick.frames):
        return "frame", f"{len(tick.frames)} frames", f"{len(frames)} of them readable"
    for logged, read in zip(tick.frames, frames, strict=True):
        if chk(logged.wire):
            return "frame", f"{logged.name} {logged.wire.hex()}", "CHK does not hold"
        if not identical(logged._replace(tick_ns=0), read):
            return "frame", f"{logged.name} {logged.time_ns}", "decodes otherwise"
    return None
