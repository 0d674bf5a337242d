"""A session's log taken apart, tick by tick, to be logged again: whole, or with ticks that get lost on the way."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import NamedTuple

from dcon.link.bundle import Entry
from dcon.session.head import Head
from dcon.session.reader import TICK_MESSAGES, SessionReader, TickMessages
from dcon.session.rolling import RollingWriter

KINDS = ("PmuFrame", "Checkpoint", "Setting", "Surroundings", "Tick", "Instance", "Event", "Flag", "Timing", "Pdci")
"""In the order in which they are logged."""
assert TICK_MESSAGES | {"Checkpoint"} == frozenset(KINDS)


class Given(NamedTuple):
    """What was logged of one tick."""

    tick_ns: int
    entries: list[Entry]
    configs: list[tuple[str, bytes]]
    """That came before it."""

    @property
    def has_checkpoint(self) -> bool:
        return any(entry.message == "Checkpoint" for entry in self.entries)


def given_in(path: Path) -> tuple[Head, list[Given]]:
    """A session's head, and its ticks."""
    reader = SessionReader(path)
    metadata = {key: value for key, value in reader.metadata.items() if key not in ("pmus", "instances", "flags")}
    head = Head(reader.ini_text, reader.pmus, reader.instances, reader.flags, metadata)
    return head, [Given(group.tick_ns, _entries(group), group.configs) for group in reader.groups(KINDS)]


def _entries(group: TickMessages) -> list[Entry]:
    names = [name for name, _ in group.frames]
    return [
        Entry(kind, names[at] if kind == "PmuFrame" else "", data, group.tick_ns, group.tick_ns)
        for kind in KINDS
        for at, data in enumerate(group.data.get(kind, ()))
    ]


def without(kind: str) -> Callable[[Given], Given]:
    """Leaves messages of a kind out."""
    return lambda tick: tick._replace(entries=[entry for entry in tick.entries if entry.message != kind])


def relogged(
    path: Path,
    head: Head,
    ticks: Iterable[Given],
    lost: Collection[int] = (),
    edit: Callable[[Given], Given] = lambda tick: tick,
    **limits: float,
) -> RollingWriter:
    """Log ``ticks`` anew, but for those whose numbers are ``lost``: with what they brought, on their way to the log."""
    with RollingWriter(path, head, patient=True, **limits) as log:
        for number, tick in enumerate(ticks):
            for name, frame in tick.configs:
                log.config(name, frame, tick.tick_ns)
            if number in lost:
                log.lost(1, "the server was away", tick.tick_ns)
            else:
                log.write(edit(tick).entries, tick.tick_ns)
    return log
