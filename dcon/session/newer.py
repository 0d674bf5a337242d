"""What a session log holds beyond what this program knows: a newer one wrote it, or others wrote to it too."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import pmutools
from dcon.session.reader import SessionReader
from pmutools.schema.messages import MESSAGES

SHOWN = 8
"""More topics or fields than these are only counted."""


class Newer(NamedTuple):
    """False where all is known."""

    version: str = ""
    """Of the program that wrote it, where that is newer."""
    topics: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    """As ``Message.field``, or ``Message.number`` where the log does not name it."""

    def __bool__(self) -> bool:
        return any(self)

    def __str__(self) -> str:
        parts = [f"written by version {self.version}"] if self.version else []
        parts += [
            f"{what} {', '.join(names[:SHOWN])}{f' and {len(names) - SHOWN} more' if len(names) > SHOWN else ''}"
            for what, names in (("topics", self.topics), ("fields", self.fields))
            if names
        ]
        return f"holds what version {pmutools.__version__} does not know ({'; '.join(parts)}); the rest is read"

    def to_json(self) -> dict[str, Any] | None:
        if not self:
            return None
        return {"version": self.version or None, "topics": list(self.topics), "fields": list(self.fields)}


def newer_in(reader: SessionReader) -> Newer:
    """Of a session, as far as it has been read."""
    version = reader.metadata.get("version", "")
    names = sorted({name for part in reader.parts for name in part.log.unknown})
    fields = [name for name in names if name.partition(".")[0] in MESSAGES]
    return Newer(
        version if _numbers(version) > _numbers(pmutools.__version__) else "",
        tuple(name for name in names if name not in fields),
        tuple(fields),
    )


def _numbers(version: str) -> tuple[int, ...]:
    """Of a version; () of a text that is none, which is older than all."""
    found = re.match(r"[0-9]+(?:\.[0-9]+)*", version)
    return tuple(map(int, found[0].split("."))) if found else ()
