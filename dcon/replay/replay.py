"""``dcon replay``: a recorded session through the same engine again, from its logged bytes and arrivals.

With the session's own settings every record must come out the same, to the last bit, and every frame must hold its
CHK and decode to what the log says; the first difference is reported with the tick's inputs. With changed settings
the result is what the controller would have *commanded*: the grid that answered is the recorded one, so nothing is
said of what the grid would have done.

What the controller knew behind a gap is not in the log but at the next checkpoint, and there the replay goes on. With
changed settings it does not: the controller of that checkpoint had the recorded ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import pmutools
from dcon.core.values import Record
from dcon.engine import Engine, Tick
from dcon.replay.difference import Difference, changed, changed_frame, changed_memory, same_bytes
from dcon.session import codec
from dcon.session.checkpoint import decode_checkpoint
from dcon.session.defaults import former
from dcon.session.newer import Newer, newer_in
from dcon.session.parts import Paths
from dcon.session.reader import TICK_MESSAGES, SessionReader, TickMessages, logged_tick
from dcon.settings import parse
from pmutools.c37118 import Frame, StreamConfig, decode_config
from pmutools.errors import SourceError, WireError
from pmutools.flow import StampSource

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


@dataclass
class Gap:
    """A place where what the controller knew is not in the log: the ticks there are not judged."""

    tick_ns: int
    """The first tick behind it."""
    why: str
    ticks: int = 0
    """From there on, that could not be replayed."""
    passed: bool = False
    """A checkpoint came, and the replay went on with it."""
    begins: bool = False
    """It is before all that was named, and nobody lost it."""

    def __str__(self) -> str:
        lost = f"the log lost something before tick {self.tick_ns} ({self.why})"
        return f"{lost}; {self.ticks} ticks from there on are not replayed" if self.ticks else lost


@dataclass
class Replay:
    """What came of it. ``stopped`` says why not every tick could be replayed."""

    ticks: int = 0
    """That were replayed."""
    different: int = 0
    first: Difference | None = None
    changes: tuple[str, ...] = ()
    gaps: list[Gap] = field(default_factory=list)
    stopped: str = ""
    problems: list[str] = field(default_factory=list)
    """Configurations that could not be used, in words."""
    largest: Driven = field(default_factory=Driven)
    """Largest change of each."""
    newer: Newer = field(default_factory=Newer)
    """What the log holds that this program does not know."""

    @property
    def to_the_end(self) -> bool:
        """The last ticks of the log were replayed, whatever was not before them."""
        return all(gap.passed for gap in self.gaps)

    def to_json(self) -> dict[str, Any]:
        return {
            "ticks": self.ticks,
            "not_replayed": sum(gap.ticks for gap in self.gaps),
            "different": self.different,
            "first": self.first.to_json() if self.first else None,
            "changes": list(self.changes),
            "gaps": [{"tick_ns": gap.tick_ns, "why": gap.why, "not_replayed": gap.ticks} for gap in self.gaps],
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

    ``observe`` is shown every tick that is replayed. Ticks ``duration_ns`` after the log's first, and later ones, are
    left out. Raises SourceError for what is no session log, or one that is not its beginning and has no checkpoint,
    SettingsError for settings that cannot be.
    """
    reader = SessionReader(paths)
    if not reader.ini_text:
        raise SourceError(f"{reader.path}: the log holds no initialisation file (its beginning is lost), so no replay")
    name, defaults = f"{reader.path}: {_INI}", former(reader.metadata)
    settings = parse(reader.ini_text, name, tuple(changes), probe_file=reader.probe_file, defaults=defaults)
    engine = Engine(settings.params, settings.sites, verified=reader.metadata.get("verified") == "true")
    part = reader.parts[0].number
    begins = "" if part == 1 else f"what is read begins with part {part}"
    course = _Course(engine, reader.instances, tuple(changes), observe, begins)
    result, first_ns, at_end = course.result, None, True
    for group in reader.groups(_MESSAGES):
        first_ns = group.tick_ns if first_ns is None else first_ns
        if duration_ns is not None and group.tick_ns >= first_ns + duration_ns:
            at_end = False
            break
        course.take(group)
    if begins and not result.ticks:
        first = reader.metadata.get("first", "")
        named = f", {first}" if first else ""
        raise SourceError(f"{reader.path}: part {part} of a session; a replay starts with the first{named}")
    result.newer = newer_in(reader)
    version = reader.metadata.get("version", "")
    if result.different and not changes and version != pmutools.__version__:
        result.problems.append(f"recorded by version {version or 'unknown'}, replayed by {pmutools.__version__}")
    result.stopped = "; ".join(_lacking(result.gaps, reader, at_end=at_end))
    if not result.ticks and not result.stopped:
        raise SourceError(f"{reader.path}: holds no tick")
    return result


_INI = "initialisation file"
_MESSAGES = TICK_MESSAGES | {"Checkpoint"}
_STAMP_SOURCES = {str(source): source for source in StampSource}


def _lacking(gaps: Sequence[Gap], reader: SessionReader, *, at_end: bool) -> list[str]:
    """Why not all was replayed: gaps, and ``at_end`` what else is not there."""
    told = [gap.why for gap in gaps]
    others = [*reader.missing, *reader.damage.lines()] if at_end else []
    return [*map(str, gaps), *(line for line in others if not any(line in why for why in told))]


class _Course:
    """A replay under way: takes the log tick by tick."""

    def __init__(
        self,
        engine: Engine,
        instances: Sequence[str],
        changes: tuple[str, ...],
        observe: Observer | None,
        begins: str = "",
    ) -> None:
        """``begins`` says why ``engine`` is not that of the first tick; "" where it is."""
        self.result = Replay(changes=changes)
        self._engine = engine
        self._instances = instances
        self._observe = observe
        self._before = "the session begins"
        self._configs: dict[str, bytes] = {}
        """Newest of each PMU."""
        self._begins = begins
        self._gap: Gap | None = None
        """Where the engine's memory was lost; None while it is that of the controller."""

    def take(self, group: TickMessages) -> None:
        """Replay one tick, or count it."""
        self._configs.update(group.configs)
        begins, self._begins = self._begins, ""
        if lost := group.lost or begins:
            self._lose(group, lost, begins=not group.lost)
        if self._gap is not None and not self._resumes(group, self._gap):
            self._gap.ticks += group.one("Tick") is not None
            return
        if group.one("Tick") is None or group.one("Instance") is None:
            self._lose(group, f"tick {group.tick_ns} is not whole")
            return
        try:
            self._replay(group)
        except ValueError as error:
            self._lose(group, str(error))

    def _lose(self, group: TickMessages, why: str, *, begins: bool = False) -> None:
        if self._gap is None:
            self._gap = Gap(group.tick_ns, why, begins=begins)
            self.result.gaps.append(self._gap)

    def _resumes(self, group: TickMessages, gap: Gap) -> bool:
        """Whether the controller's memory is known again."""
        memory = None if self.result.changes else decode_checkpoint(group.one("Checkpoint"))
        if memory is None:
            return False
        configs = {name: config for name, frame in self._configs.items() if (config := self._decoded(name, frame))}
        try:
            self._engine.resume(memory, configs)
        except ValueError:
            return False
        gap.passed, self._gap = True, None
        if gap.begins and not gap.ticks:
            self.result.gaps.remove(gap)  # nothing of what was named is missing
        self._before = "a checkpoint"
        return True

    def _replay(self, group: TickMessages) -> None:
        """Raises ValueError for a tick that this program does not understand."""
        result, logged = self.result, group.one("Tick")
        assert logged is not None
        now = self._again(group)
        difference = self._difference(group, now)
        if difference is not None:
            result.different += 1
            result.first = result.first or difference
        result.ticks += 1
        recorded, driven = Driven.of(logged), Driven.of(now.record)
        if recorded != driven:
            changes_now = (abs(one - other) for one, other in zip(recorded, driven, strict=True))
            result.largest = Driven(*map(max, result.largest, changes_now))
        if self._observe is not None:
            self._observe(recorded, now.record)
        self._before = (
            f"{logged.state} {logged.mode}, {logged.active_instance or 'no instance'} active, "
            f"{logged.gain_mw_per_mhz:g} MW/mHz, command {logged.command_mw!r} MW"
        )

    def _again(self, group: TickMessages) -> Tick:
        """The tick, from what the log says it was given."""
        for name, frame in group.configs:
            if (config := self._decoded(name, frame)) is not None:
                problem = self._engine.reconfigure(name, config)
                self.result.problems += [] if problem is None else [problem]
        frames: dict[str, list[Frame]] = {}
        for name, message in group.frames:
            source = _STAMP_SOURCES.get(message.stamp_source, StampSource.CAPTURE)
            frames.setdefault(name, []).append(Frame(message.wire, message.arrival_ns or None, source, 0))
        orders = tuple(map(codec.decode_order, group.messages.get("Setting", ())))
        return self._engine.tick(frames, orders, group.tick_ns, codec.decode_surroundings(group.one("Surroundings")))

    def _decoded(self, name: str, frame: bytes) -> StreamConfig | None:
        try:
            return decode_config(frame)[1]
        except WireError as error:
            if (problem := f"{name}: {error}") not in self.result.problems:
                self.result.problems.append(problem)
            return None

    def _difference(self, group: TickMessages, now: Tick) -> Difference | None:
        """Of a tick from its record in the log; with changed settings of no more than what was decided."""
        is_same = not self.result.changes
        found = changed_memory(group, now.memory) if is_same else None
        if found is None and same_bytes(group, now, self._instances, frames=is_same):
            return None
        tick = logged_tick(group)
        found = found or (changed_frame(tick, now.frames) if is_same else None) or changed(tick.record, now.record)
        return None if found is None else Difference(group.tick_ns, *found, self._before, tick.frames, tick.orders)
