"""The parts of a session that was rotated: how they are named, how they know each other, which belong together.

Part k of ``session.mcap`` is ``session.part2.mcap``, ``session.part3.mcap``, ... beside it. Each is whole in itself:
initialisation file, configurations and names are in every one. What makes them one session is the ``session`` key of
their metadata; names alone do not, for an earlier session may have left its own parts behind.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from pmutools.errors import SourceError
from pmutools.schema.log_reader import LogMessage, LogMetadata, LogReader

SESSION = "session"
"""Name of the metadata record that makes an MCAP file a session log; and its key that all parts of one share."""


Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A session: one file, or its parts."""


class Part(NamedTuple):
    """One file of a session."""

    log: LogReader
    session: str
    """"" where the log does not say: then there is only this file."""
    number: int
    unlogged: int
    """Ticks that were not logged just before this part."""


def part_path(first: str | os.PathLike[str], number: int) -> Path:
    """Where part ``number`` of the session that begins in ``first`` is."""
    path = Path(first)
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


def free_path(path: str | os.PathLike[str]) -> Path:
    """``path``, or ``NAME-2``, ``NAME-3``, ...: the first that no session has, nor a part of one.

    Raises SourceError where the folder cannot be looked into.
    """
    first = Path(path)
    if first.exists() and not first.is_file():
        return first  # a device, or a folder: whoever writes there is told
    try:
        there = {entry.name for entry in os.scandir(first.parent)}
    except OSError as error:
        raise SourceError(f"{first.parent}: {error.strerror}") from None
    part = re.compile(rf"(.+)\.part\d+{re.escape(first.suffix)}")
    there |= {f"{match[1]}{first.suffix}" for name in there if (match := part.fullmatch(name))}
    number, free = 1, first
    while free.name in there:
        number += 1
        free = first.with_name(f"{first.stem}-{number}{first.suffix}")
    return free


def part_of(path: str | os.PathLike[str]) -> Part:
    """Raises SourceError for a file that cannot be read; one that says nothing of parts is a first and only part."""
    log = LogReader(path)
    values: dict[str, str] = {}
    for record in log.records(()):
        if isinstance(record, LogMetadata) and record.name == SESSION:
            values.update(record.values)
            break
        if isinstance(record, LogMessage):
            break
    return Part(
        log,
        values.get(SESSION, ""),
        _count(values.get("part"), 1),
        _count(values.get("unlogged_ticks"), 0),
    )


def parts_of(paths: Paths) -> list[Part]:
    """The parts to be read, in order.

    A first part brings those of its session that are beside it, with gaps where some are not; a later one stands
    alone; several are taken as named, whatever their order. Raises SourceError for files that are not parts of one
    session, or one named twice.
    """
    named = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    parts = sorted(map(part_of, named), key=lambda part: part.number)
    if len(parts) > 1:
        first = parts[0]
        for before, part in pairwise(parts):
            if not part.session or part.session != first.session:
                raise SourceError(f"{part.log.path}: not of the same session as {first.log.path}; read one at a time")
            if part.number == before.number:
                raise named_twice(before, part)
        return parts
    (only,) = parts
    if only.number == 1 and only.session:
        parts += _followers(only)
    return parts


def named_twice(one: Part, other: Part) -> SourceError:
    """What is to be raised for two files that are the same part of a session."""
    return SourceError(f"{other.log.path}: part {other.number} of the session twice, also {one.log.path}")


def missing(parts: Sequence[Part]) -> list[str]:
    """What is not there before and between parts of a session, in words; damage within one is told by its reader."""
    return [line for before, part in zip((None, *parts), parts, strict=False) for line in _absent(before, part)]


def lost(before: Part | None, part: Part) -> str:
    """What is missing between two parts, the first of which has been read to its end; "" is nothing.

    ``before`` is None for the first that is read.
    """
    return "; ".join([*_absent(before, part), *([] if before is None else before.log.damage.lines())])


def _absent(before: Part | None, part: Part) -> list[str]:
    lines: list[str] = []
    absent = [] if before is None else [str(number) for number in range(before.number + 1, part.number)]
    if absent:
        which = f"part {absent[0]} is" if len(absent) == 1 else f"parts {absent[0]} to {absent[-1]} are"
        lines.append(f"{which} missing, part {part.number} is there")
    if part.unlogged and part.number == 1:
        lines.append(f"the first {part.unlogged} ticks were not logged")
    elif part.unlogged:
        lines.append(f"{part.unlogged} ticks before part {part.number} were not logged")
    return lines


def later_paths(first: str | os.PathLike[str]) -> dict[int, Path]:
    """The files beside ``first`` that are named as its further parts, by their numbers, ascending."""
    path = Path(first)
    named = re.compile(rf"{re.escape(path.stem)}\.part([1-9]\d{{0,8}}){re.escape(path.suffix)}")
    try:
        found = {int(match[1]): place for place in path.parent.iterdir() if (match := named.fullmatch(place.name))}
    except OSError:
        return {}
    return {number: found[number] for number in sorted(found) if number > 1 and found[number].is_file()}


def _followers(first: Part) -> list[Part]:
    found: list[Part] = []
    for number, path in later_paths(first.log.path).items():
        try:
            part = part_of(path)
        except SourceError:
            continue
        if (part.session, part.number) == (first.session, number):
            found.append(part)
    return found


def _count(text: str | None, default: int) -> int:
    try:
        return default if text is None else int(text)
    except ValueError:
        return default
