"""The flag register: of every check that was ever up, for whom, since when, how often, and who knows of it.

Pure: a change gives another register. It has one entry a check and subject, so it is bounded by the tables.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Final

from dcon.core.values import Flag

Register = Mapping[tuple[str, str], Flag]
NO_FLAGS: Final[Register] = MappingProxyType({})


def with_changes(register: Register, changes: Collection[Flag]) -> Register:
    """``register`` with some entries replaced or added."""
    return {**register, **{(flag.name, flag.subject): flag for flag in changes}} if changes else register


def risen(
    register: Register, name: str, subject: str, now_ns: int, value: float = math.nan, limit: float = math.nan
) -> Flag:
    """The entry of a check that rose in this tick: nobody has acknowledged that yet."""
    last = register.get((name, subject))
    if last is None:
        return Flag(name, subject, True, now_ns, now_ns, 1, value, limit, False)
    return last._replace(up=True, last_ns=now_ns, times=last.times + 1, value=value, limit=limit, acknowledged="")


def fallen(flag: Flag, now_ns: int) -> Flag:
    """The entry of a check that is down from this tick on; what was acknowledged needs no latch any more."""
    return flag._replace(up=False, last_ns=now_ns, latched=flag.latched and not flag.acknowledged)


def acknowledged(flag: Flag, who: str) -> Flag:
    """The entry once ``who`` has seen it. A flag that is still up stays latched until it falls."""
    return flag._replace(acknowledged=who, latched=flag.latched and flag.up)


def latched(register: Register) -> list[str]:
    """Names of checks that keep the controller from being armed until they are acknowledged."""
    return sorted({flag.name for flag in register.values() if flag.latched and not flag.acknowledged})


def still_up(register: Register) -> list[str]:
    """Names of checks that do so although they are acknowledged: they have not fallen yet."""
    return sorted({flag.name for flag in register.values() if flag.latched and flag.acknowledged})


def open_flags(register: Register, text: str) -> list[Flag]:
    """Entries that nobody has acknowledged and that ``text`` means: ``NAME``, ``NAME SUBJECT``, or "" for all."""
    wanted = text.split()
    return [
        flag
        for flag in register.values()
        if not flag.acknowledged and wanted == [flag.name, flag.subject][: len(wanted)]
    ]
