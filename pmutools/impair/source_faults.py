"""Content faults of the source: frames that arrive whole and say something false."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from pmutools.c37118.constants import LeapFlag, Stat
from pmutools.draws import Draws
from pmutools.impair.filler import filler
from pmutools.impair.moment import Moment
from pmutools.impair.scope import VALUE_FIELDS, Scope
from pmutools.impair.wire_faults import WORD, Change, replaced_word
from pmutools.parsers import Parser, choice, integer, number, parsed_by, suggestion
from pmutools.timebase import from_ns, to_ns

_WORD = struct.Struct(">H")
_STAMP = struct.Struct(">II")
_STAMP_AT, _STAMP_END, _QUALITY_AT = 6, 14, 10

STAT_BITS = {
    **{flag.name.lower(): int(flag) for flag in Stat if flag.name},
    "pmu_error": 0x4000,
    "test": 0x8000,
    "do_not_use": 0xC000,
    "pmu_tq_unknown": 0x01C0,
    "unlocked_10s": 0x0010,
    "unlocked_100s": 0x0020,
    "unlocked_1000s": 0x0030,
}
"""Names of STAT bits: those of :class:`~pmutools.c37118.constants.Stat`, the data error codes, PMU_TQ 7, and how long
the time has been unlocked (at least)."""
LEAP_BITS = {flag.name.lower(): int(flag) for flag in LeapFlag if flag.name}
_LEAP_MASK = 0x70


def _mask(known: Mapping[str, int], most: int, what: str) -> Parser[int]:
    """A parser of ``name|0x30``: names of ``known`` and masks up to ``most``."""

    def parse(text: str) -> int:
        mask = 0
        for part in text.split("|"):
            word = part.strip().lower()
            if word in known:
                mask |= known[word]
            elif word[:1].isdigit():
                mask |= integer(0, most)(word)
            else:
                raise ValueError(f"{word!r} is no {what} flag or mask; {suggestion(word, known)}")
        return mask

    return parse


stat_mask = _mask(STAT_BITS, 0xFFFF, "STAT")


@dataclass(frozen=True, slots=True)
class StatBits:
    """STAT bits of ``station=`` cleared, then set."""

    refit: ClassVar[bool] = True
    set: int = field(default=0, metadata=parsed_by(stat_mask))
    clear: int = field(default=0, metadata=parsed_by(stat_mask))

    def change(self, draws: Draws, scope: Scope) -> Change:
        offsets = [item.offset for item in scope.station_fields("stat")]

        def rewrite(frame: bytearray, at: Moment, last: bytes) -> str:
            for offset in offsets:
                (stat,) = _WORD.unpack_from(frame, offset)
                _WORD.pack_into(frame, offset, stat & ~self.clear | self.set)
            return f"stat+{self.set:#06x}-{self.clear:#06x}"

        return rewrite


@dataclass(frozen=True, slots=True)
class WrongIdcode:
    """IDCODE replaced."""

    refit: ClassVar[bool] = True
    value: int = field(metadata=WORD)

    def change(self, draws: Draws, scope: Scope) -> Change:
        return replaced_word(4, self.value, "idcode")


@dataclass(frozen=True, slots=True)
class Quality:
    """The time quality byte replaced: leap flags above, MSG_TQ below (0x0F: clock failed)."""

    refit: ClassVar[bool] = True
    value: int = field(metadata=parsed_by(integer(0, 0xFF)))

    def change(self, draws: Draws, scope: Scope) -> Change:
        value = self.value

        def rewrite(frame: bytearray, at: Moment, last: bytes) -> str:
            frame[_QUALITY_AT] = value
            return f"quality={value:#04x}"

        return rewrite


@dataclass(frozen=True, slots=True)
class MovedStamp:
    """The stamp moved by ``offset`` ms plus ``drift`` ppm of stream time (for leap seconds: ``leap``)."""

    refit: ClassVar[bool] = True
    offset: float = field(default=0.0, metadata=parsed_by(number()))
    drift: float = field(default=0.0, metadata=parsed_by(number()))

    def change(self, draws: Draws, scope: Scope) -> Change:
        if scope.config is None:
            raise ValueError("a stamp can only be moved in a stream whose configuration (TIME_BASE) is known")
        time_base, offset_ns, drift = scope.config.time_base, round(self.offset * 1e6), self.drift * 1e-6

        def move(frame: bytearray, at: Moment, last: bytes) -> str:
            soc, word = _STAMP.unpack_from(frame, _STAMP_AT)
            by_ns = offset_ns + round(drift * at.time_ns)
            moved_ns = max(0, to_ns(soc, word & 0xFFFFFF, time_base) + by_ns)
            soc, fracsec = from_ns(moved_ns, time_base)
            _STAMP.pack_into(frame, _STAMP_AT, soc & 0xFFFF_FFFF, word & 0xFF00_0000 | fracsec)
            return f"stamp{by_ns / 1e6:+.3f}ms"

        return move


@dataclass(frozen=True, slots=True)
class LeapError:
    """SOC moved by whole ``seconds`` (1: an inserted leap second was missed), leap ``flags`` of the quality byte set.

    The flags (``pending``, ``occurred``, ``direction_delete``, joined by ``|``) replace those sent; without ``flags``
    these stay. So ``leap(1)`` is a clock that missed the second, ``leap(flags=pending)`` a false announcement.
    """

    refit: ClassVar[bool] = True
    seconds: int = field(default=0, metadata=parsed_by(integer(-3600, 3600)))
    flags: int | None = field(default=None, metadata=parsed_by(_mask(LEAP_BITS, _LEAP_MASK, "leap")))

    def __post_init__(self) -> None:
        if not self.seconds and self.flags is None:
            raise ValueError("leap: nothing is wrong; give seconds or flags, as in leap(1) or leap(flags=pending)")

    def change(self, draws: Draws, scope: Scope) -> Change:
        seconds, flags = self.seconds, self.flags
        shown = "" if flags is None else f"/{flags:#04x}"

        def move(frame: bytearray, at: Moment, last: bytes) -> str:
            soc, word = _STAMP.unpack_from(frame, _STAMP_AT)
            _STAMP.pack_into(frame, _STAMP_AT, max(0, soc + seconds) & 0xFFFF_FFFF, word)
            if flags is not None:
                frame[_QUALITY_AT] = frame[_QUALITY_AT] & ~_LEAP_MASK | flags & _LEAP_MASK
            return f"leap{seconds:+d}s{shown}"

        return move


@dataclass(frozen=True, slots=True)
class RepeatedStamp:
    """The stamp of the last frame that had its own."""

    refit: ClassVar[bool] = True

    def change(self, draws: Draws, scope: Scope) -> Change:
        def rewrite(frame: bytearray, at: Moment, last: bytes) -> str:
            if not last:
                return ""
            frame[_STAMP_AT:_STAMP_END] = last[_STAMP_AT:_STAMP_END]
            return "repeat"

        return rewrite


@dataclass(frozen=True, slots=True)
class FalseValues:
    """Measured values (all, or ``field=`` and ``station=``) replaced.

    ``nan``: NaN, or 0x8000 where the FORMAT is integer, the filler of a concentrator; ``zero``; ``frozen``: as in
    the last frame that had its own.
    """

    refit: ClassVar[bool] = True
    what: str = field(metadata=parsed_by(choice("nan", "zero", "frozen")))

    def change(self, draws: Draws, scope: Scope) -> Change:
        names = VALUE_FIELDS if scope.field in ("", "values") else (scope.field,)
        if not set(names) <= set(VALUE_FIELDS):
            raise ValueError(f"value: field={scope.field} is not measured; {suggestion(scope.field, VALUE_FIELDS)}")
        items = scope.station_fields(*names)
        what, mark = self.what, f"{self.what}({scope.field or 'values'})"

        def replace(frame: bytearray, at: Moment, last: bytes) -> str:
            if what == "frozen" and not last:
                return ""
            for item in items:
                start, end = item.offset, item.offset + item.size
                if what == "frozen":
                    frame[start:end] = last[start:end]
                elif what == "zero":
                    frame[start:end] = bytes(item.size)
                elif item.name != "digitals":
                    frame[start:end] = filler(item)
            return mark

        return replace
