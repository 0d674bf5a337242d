"""Content faults of the wire: the frame arrives damaged, and its CHK or FRAMESIZE tells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from pmutools.c37118.checksum import chk
from pmutools.c37118.constants import CHK_SIZE
from pmutools.draws import Draws
from pmutools.impair.moment import Moment
from pmutools.impair.scope import Scope
from pmutools.parsers import integer, parsed_by

Change = Callable[[bytearray, Moment, bytes], str]
"""Changes a frame in place, given the last frame that the fault left alone (empty: none yet); returns what it did."""

WORD = parsed_by(integer(0, 0xFFFF))
MAX_BITS = 64


@dataclass(frozen=True, slots=True)
class Bits:
    """``n`` different bits flipped, anywhere in the frame or in ``field=`` or ``bytes=``."""

    refit: ClassVar[bool] = False
    n: int = field(default=1, metadata=parsed_by(integer(1, MAX_BITS)))

    def change(self, draws: Draws, scope: Scope) -> Change:
        wanted, spans = self.n, scope.spans()

        def flip(frame: bytearray, at: Moment, last: bytes) -> str:
            places = [8 * byte + bit for span in spans for byte in span.of(len(frame)) for bit in range(8)]
            count = min(wanted, len(places))
            for k in range(count):
                pick = k + int(draws.uniform(at.index, 1 + k, at.lane) * (len(places) - k))
                places[k], places[pick] = places[pick], places[k]
                frame[places[k] >> 3] ^= 0x80 >> (places[k] & 7)
            return f"{count}bit"

        return flip


@dataclass(frozen=True, slots=True)
class WrongChk:
    """CHK replaced by ``value``, or by a drawn one that is wrong."""

    refit: ClassVar[bool] = False
    value: int | None = field(default=None, metadata=WORD)

    def change(self, draws: Draws, scope: Scope) -> Change:
        value = self.value

        def spoil(frame: bytearray, at: Moment, last: bytes) -> str:
            sent = int.from_bytes(frame[-CHK_SIZE:], "big")
            wrong = sent ^ (1 + int(draws.uniform(at.index, 1, at.lane) * 0xFFFF)) if value is None else value
            frame[-CHK_SIZE:] = wrong.to_bytes(2, "big")
            return "chk"

        return spoil


@dataclass(frozen=True, slots=True)
class WrongSync:
    """The SYNC word replaced."""

    refit: ClassVar[bool] = False
    value: int = field(default=0xAB01, metadata=WORD)

    def change(self, draws: Draws, scope: Scope) -> Change:
        return replaced_word(0, self.value, "sync")


@dataclass(frozen=True, slots=True)
class WrongSize:
    """FRAMESIZE replaced; the frame stays as long as it was."""

    refit: ClassVar[bool] = False
    value: int = field(default=0xFFFF, metadata=WORD)

    def change(self, draws: Draws, scope: Scope) -> Change:
        return replaced_word(2, self.value, "framesize")


@dataclass(frozen=True, slots=True)
class Truncate:
    """Only the first ``size`` bytes, or a drawn number of them, at least 1; later faults leave the frame alone."""

    refit: ClassVar[bool] = False
    size: int | None = field(default=None, metadata=parsed_by(integer(1, 0xFFFF)))

    def change(self, draws: Draws, scope: Scope) -> Change:
        size = self.size

        def cut(frame: bytearray, at: Moment, last: bytes) -> str:
            drawn = 1 + int(draws.uniform(at.index, 1, at.lane) * (len(frame) - 1))
            del frame[drawn if size is None else size :]
            return f"truncate={len(frame)}"

        return cut


def replaced_word(offset: int, value: int, name: str) -> Change:
    """A 16-bit word of the prefix replaced."""
    word = value.to_bytes(2, "big")

    def write(frame: bytearray, at: Moment, last: bytes) -> str:
        frame[offset : offset + 2] = word
        return f"{name}={value:#06x}"

    return write


def refitted(frame: bytes, body: bytes) -> bytes:
    """``body`` with a CHK that is right if that of ``frame`` is, and wrong if not."""
    wrong = chk(frame[:-CHK_SIZE]) ^ int.from_bytes(frame[-CHK_SIZE:], "big")
    return body + (chk(body) ^ wrong).to_bytes(CHK_SIZE, "big")
