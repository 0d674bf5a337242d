"""The content stage: frames whose bytes are wrong. ``corrupt = 1% stat(not_synchronised) station=N1 when=5..8``.

A fault of the wire (flipped bits, wrong CHK, FRAMESIZE or SYNC, cut short) leaves CHK as it was, so a receiver must
find it; a fault of the source (IDCODE, STAT, time, values) gets the CHK that fits. ``chk=keep|fix`` says otherwise.
Bytes change above UDP and TCP, whose own checksums stay right: the receiver's CHK is what is tested.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from pmutools.c37118.checksum import sealed
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import CHK_SIZE, MIN_FRAME_SIZE, FrameType
from pmutools.draws import Draws
from pmutools.impair.blocks import chance
from pmutools.impair.grammar import Chanced, with_probability
from pmutools.impair.moment import Moment, Test
from pmutools.impair.scope import FIELDS, STATION_FIELDS, WHOLE, Scope, Span, byte_span
from pmutools.impair.selectors import DATA, Selector, selector
from pmutools.impair.source_faults import (
    FalseValues,
    LeapError,
    MovedStamp,
    Quality,
    RepeatedStamp,
    StatBits,
    WrongIdcode,
)
from pmutools.impair.wire_faults import Bits, Change, Truncate, WrongChk, WrongSize, WrongSync
from pmutools.parsers import choice, one_of, parsed_by


class Kind(Protocol):
    """A kind of content fault. ``refit``: CHK is made to fit afterwards."""

    @property
    def refit(self) -> bool: ...

    def change(self, draws: Draws, scope: Scope) -> Change:
        """The fault on one stream; draw 0 is the stage's, a fault's own begin at 1. Raises ValueError."""


KINDS: dict[str, type[Kind]] = {
    "bits": Bits,
    "chk": WrongChk,
    "sync": WrongSync,
    "framesize": WrongSize,
    "truncate": Truncate,
    "idcode": WrongIdcode,
    "stat": StatBits,
    "quality": Quality,
    "stamp": MovedStamp,
    "leap": LeapError,
    "repeat": RepeatedStamp,
    "value": FalseValues,
}
_ONE_BIT: Kind = Bits()
_fault = with_probability(one_of(KINDS, "content fault"), "bits(3)", alone=_ONE_BIT)


@dataclass(frozen=True, slots=True)
class Corrupt:
    fault: Chanced[Kind] = field(metadata=parsed_by(_fault))
    field_: str = field(default="", metadata=parsed_by(choice(*FIELDS)))
    station: str = field(default="", metadata=parsed_by(str))
    bytes_: Span = field(default=WHOLE, metadata=parsed_by(byte_span))
    chk_: str = field(default="", metadata=parsed_by(choice("keep", "fix")))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))

    def __post_init__(self) -> None:
        if self.field_ and self.bytes_ != WHOLE:
            raise ValueError("field= and bytes= both say where; give one")

    @property
    def refit(self) -> bool:
        return self.fault.kind.refit if not self.chk_ else self.chk_ == "fix"


class Corruption:
    """One content fault at work on one stream."""

    def __init__(self, part: Corrupt, draws: Draws, selected: Test, config: StreamConfig | None) -> None:
        kind = part.fault.kind
        by_layout = part.field_ in STATION_FIELDS or isinstance(kind, StatBits | FalseValues)
        self._size = config.frame_size if config is not None and by_layout else 0
        self._change = kind.change(draws, Scope(config, part.field_, part.station, part.bytes_))
        self._refit = part.refit
        self.happens = chance(draws, part.fault.p)
        self._selected = selected
        self._last = b""

    def apply(self, frame: bytes, at: Moment) -> tuple[bytes, str]:
        """The frame, changed or not, and what was done ("" for nothing).

        Left alone besides: frames cut short before, and for a fault placed by the configuration, frames that are not
        data or not of its size.
        """
        fits = (at.type is FrameType.DATA and len(frame) == self._size) if self._size else len(frame) >= MIN_FRAME_SIZE
        if not (fits and self.happens(at) and self._selected(at)):
            if fits and at.type is FrameType.DATA:
                self._last = frame
            return frame, ""
        changed = bytearray(frame)
        done = self._change(changed, at, self._last)
        if done and self._refit:
            changed[:] = sealed(bytes(changed[:-CHK_SIZE]))
        return bytes(changed), f"corrupt:{done}" if done else ""
