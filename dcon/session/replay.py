"""``dcon replay``: a recorded session through the same engine again, from its logged bytes and arrivals.

With the session's own settings every record must come out the same, to the last bit, and every frame must hold its
CHK and decode to what the log says; the first difference is reported with the tick's inputs. With changed settings
the result is what the controller would have *commanded*: the grid that answered is the recorded one, so nothing is
said of what the grid would have done.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from dcon.core.values import Record
from dcon.engine import Engine
from dcon.session.log import LoggedTick, SessionReader
from dcon.settings import parse
from pmutools.c37118 import Frame, decode_config
from pmutools.c37118.checksum import chk
from pmutools.errors import SourceError, WireError
from pmutools.schema.pmu_log import PmuFrame

Observer = Callable[[LoggedTick, Record], None]


@dataclass(frozen=True, slots=True)
class Difference:
    """The first field of a tick's record that came out otherwise, or ``frame`` and the one that is not as logged."""

    tick_ns: int
    field: str
    recorded: Any
    replayed: Any
    frames: tuple[str, ...]
    """The tick's inputs: PMU, stamp and arrival of each frame, and the orders."""

    def __str__(self) -> str:
        inputs = "; ".join(self.frames) or "no frames"
        return f"tick {self.tick_ns}: {self.field} {self.recorded!r} -> {self.replayed!r} (inputs: {inputs})"


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
    largest_mw: float = 0.0
    """Largest change of ``command_mw``."""

    def to_json(self) -> dict[str, Any]:
        return {
            "ticks": self.ticks,
            "different": self.different,
            "first": str(self.first) if self.first else None,
            "changes": list(self.changes),
            "stopped": self.stopped or None,
            "problems": self.problems,
            "largest_command_change_mw": self.largest_mw,
        }


def replay(path: str, changes: Sequence[str] = (), observe: Observer | None = None) -> Replay:
    """Replay the session log at ``path``, with ``SECTION.KEY=VALUE`` changes laid over its settings.

    ``observe`` is shown every tick as recorded, with the record it gives now. Raises SourceError for a file that is no
    session log, SettingsError for settings that cannot be.
    """
    reader = SessionReader(path)
    if not reader.ini_text:
        raise SourceError(f"{path}: the log holds no initialisation file (its beginning is lost), so no replay")
    settings = parse(reader.ini_text, f"{path}: {_INI}", tuple(changes), probe_file=reader.probe_file)
    engine = Engine(settings.params, settings.sites, verified=reader.metadata.get("verified") == "true")
    result = Replay(changes=tuple(changes))
    for tick in reader.ticks():
        if tick.after_loss:
            result.stopped = f"the log lost something before tick {tick.record.tick_ns}"
            break
        _configure(engine, tick, result)
        frames: dict[str, list[Frame]] = {}
        for frame in tick.frames:
            arrived = Frame(frame.wire, frame.arrival_ns, frame.stamp_source, 0)
            frames.setdefault(frame.name, []).append(arrived)
        now = engine.tick(frames, tick.orders, tick.record.tick_ns, tick.surroundings)
        result.ticks += 1
        result.largest_mw = max(result.largest_mw, abs(now.record.command_mw - tick.record.command_mw))
        found = (None if changes else _changed_frame(tick, now.frames)) or _changed_record(tick.record, now.record)
        if found is not None:
            result.different += 1
            result.first = result.first or _difference(tick, *found)
        if observe is not None:
            observe(tick, now.record)
    if not result.stopped and (reader.damage or reader.incomplete_ticks):
        result.stopped = "; ".join(reader.damage.lines()) or "the last tick is not whole"
    if not result.ticks and not result.stopped:
        raise SourceError(f"{path}: holds no tick")
    return result


_INI = "initialisation file"


def _configure(engine: Engine, tick: LoggedTick, result: Replay) -> None:
    for name, frame in tick.configs:
        try:
            config = decode_config(frame)[1]
        except WireError as error:
            result.problems.append(f"{name}: {error}")
            continue
        if (problem := engine.reconfigure(name, config)) is not None:
            result.problems.append(problem)


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


def _difference(tick: LoggedTick, name: str, recorded: object, replayed: object) -> Difference:
    inputs = [f"{frame.name} stamp {frame.time_ns} arrival {frame.arrival_ns}" for frame in tick.frames]
    inputs += [f"order {order.name} {order.value:g}" for order in tick.orders]
    return Difference(tick.record.tick_ns, name, recorded, replayed, tuple(inputs))


def _changed_record(recorded: object, replayed: object, name: str = "") -> tuple[str, object, object] | None:
    """The first value that differs, with its place: ``instances.3.command_mw``."""
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
