"""Where a replay differs from its log: messages byte by byte, then value by value, and the first that differs told.

What is compared first are the bytes of the messages: they are the same where every value is, and nothing needs to be
decoded for that. Events of the log itself are not the controller's, and are passed over.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dcon.core.values import Order, Record
from dcon.engine import Memory, Tick
from dcon.session import codec
from dcon.session.checkpoint import LAYOUT, decode_checkpoint, text_of
from dcon.session.reader import LoggedTick, TickMessages
from dcon.session.rolling import LOG_SUBJECT
from pmutools.c37118.checksum import chk
from pmutools.schema.pmu_log import PmuFrame

Found = tuple[str, object, object]
"""A field, and its two values."""


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
        recorded, replayed = (_shortened(repr(value)) for value in (self.recorded, self.replayed))
        what = f"tick {self.tick_ns}: {self.field} {recorded} -> {replayed}"
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


def _shortened(text: str, most: int = 200) -> str:
    """A checkpoint may be thousands of characters; ``--json`` has all of them."""
    return text if len(text) <= most else f"{text[:most]}..."


def _plain(value: object) -> object:
    """A value that JSON has; NaN, infinities and tuples as text."""
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return value if isinstance(value, int | float | str | None) else repr(value)


def same_bytes(group: TickMessages, now: Tick, instances: Sequence[str], *, frames: bool) -> bool:
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
    """Equal to the last bit, NaN and -0.0 too, through tuples and mappings."""
    one, other = _as_pairs(one), _as_pairs(other)
    if isinstance(one, complex) and isinstance(other, complex):
        one, other = (one.real, one.imag), (other.real, other.imag)
    if isinstance(one, float) and isinstance(other, float):
        if one == other:
            return one != 0 or math.copysign(1, one) == math.copysign(1, other)
        return math.isnan(one) and math.isnan(other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(identical, one, other))
    return one == other


def _as_pairs(value: object) -> object:
    return tuple(value.items()) if isinstance(value, Mapping) else value


def changed(recorded: object, replayed: object, name: str = "") -> Found | None:
    """The first value that differs, with its place: ``instances.3.command_mw``."""
    if isinstance(recorded, Record):
        events = tuple(event for event in recorded.events if event.subject != LOG_SUBJECT)
        recorded = recorded._replace(events=events)
    if identical(recorded, replayed):
        return None
    recorded, replayed = _as_pairs(recorded), _as_pairs(replayed)
    if isinstance(recorded, tuple) and isinstance(replayed, tuple) and len(recorded) == len(replayed):
        places = getattr(recorded, "_fields", range(len(recorded)))
        for place, one, other in zip(places, recorded, replayed, strict=True):
            if found := changed(one, other, f"{name}.{place}" if name else str(place)):
                return found
    return name, recorded, replayed


def changed_memory(group: TickMessages, memory: Memory) -> Found | None:
    """What the tick's checkpoint has otherwise than ``memory``, where there is one that this program can read."""
    logged = group.one("Checkpoint")
    if logged is None or logged.layout != LAYOUT or logged.memory == text_of(memory):
        return None
    known = decode_checkpoint(logged)
    return ("checkpoint", logged.memory, "makes no sense") if known is None else changed(known, memory, "checkpoint")


def changed_frame(tick: LoggedTick, frames: Sequence[PmuFrame]) -> Found | None:
    """The first frame that is not what was received: its bytes, or what the log says they mean, were changed."""
    if len(frames) != len(tick.frames):
        return "frame", f"{len(tick.frames)} frames", f"{len(frames)} of them readable"
    for logged, read in zip(tick.frames, frames, strict=True):
        if chk(logged.wire):
            return "frame", f"{logged.name} {logged.wire.hex()}", "CHK does not hold"
        if not identical(logged._replace(tick_ns=0), read):
            return "frame", f"{logged.name} {logged.time_ns}", "decodes otherwise"
    return None
