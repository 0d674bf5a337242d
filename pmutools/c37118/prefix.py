"""The 14 bytes every frame begins with (Table 2), and the checks that hold for a whole frame."""

from __future__ import annotations

import struct
from typing import NamedTuple

from pmutools.c37118.checksum import chk
from pmutools.c37118.constants import MIN_FRAME_SIZE, PREFIX_SIZE, SYNC, FrameType, LeapFlag, TimeQuality
from pmutools.errors import ChecksumError, EncodeError, LengthError, WireError

_PREFIX = struct.Struct(">HHHII")
_TYPES = tuple(FrameType)


class Prefix(NamedTuple):
    """SYNC, FRAMESIZE, IDCODE, SOC, time quality byte and FRACSEC (24 bits), as on the wire.

    Data frames carry the time of measurement, all others that of transmission.
    """

    sync: int
    framesize: int
    idcode: int
    soc: int
    time_quality: int
    fracsec: int

    @property
    def type(self) -> FrameType:
        return _TYPES[self.sync >> 4 & 7]

    @property
    def version(self) -> int:
        return self.sync & 0xF

    @property
    def msg_tq(self) -> TimeQuality | int:
        """Worst-case clock error code (Table 4); a plain int where the standard leaves it undefined."""
        code = self.time_quality & 0xF
        try:
            return TimeQuality(code)
        except ValueError:
            return code

    @property
    def leap(self) -> LeapFlag:
        return LeapFlag(self.time_quality & 0x70)


def decode_prefix(data: bytes, offset: int = 0) -> Prefix:
    """Unpack a prefix at ``offset``; raises LengthError where fewer than 14 bytes are left, checks nothing else."""
    if len(data) - offset < PREFIX_SIZE:
        raise LengthError("frame prefix", PREFIX_SIZE, len(data) - offset)
    sync, framesize, idcode, soc, word = _PREFIX.unpack_from(data, offset)
    return Prefix(sync, framesize, idcode, soc, word >> 24, word & 0xFFFFFF)


def encode_prefix(prefix: Prefix) -> bytes:
    """Pack a prefix; raises EncodeError for a value outside its field."""
    sync, framesize, idcode, soc, time_quality, fracsec = prefix
    if not (0 <= time_quality <= 0xFF and 0 <= fracsec <= 0xFFFFFF):
        raise EncodeError(f"time quality {time_quality} or FRACSEC {fracsec} does not fit its field")
    try:
        return _PREFIX.pack(sync, framesize, idcode, soc, time_quality << 24 | fracsec)
    except struct.error as error:
        raise EncodeError(f"frame prefix: {error}") from None


def verified(frame: bytes) -> Prefix:
    """The prefix of a complete frame whose SYNC, FRAMESIZE and CHK hold.

    Raises
    ------
    WireError
        Bad SYNC or an undefined frame type.
    LengthError
        FRAMESIZE below 16, or not the number of bytes given.
    ChecksumError
        CHK is wrong.
    """
    prefix = decode_prefix(frame)
    if prefix.sync >> 8 != SYNC or prefix.sync & 0x80 or prefix.sync >> 4 & 7 >= len(_TYPES):
        raise WireError(f"SYNC is {prefix.sync:#06x}")
    if prefix.framesize < MIN_FRAME_SIZE or prefix.framesize != len(frame):
        raise LengthError("FRAMESIZE", prefix.framesize, len(frame), idcode=prefix.idcode)
    if (computed := chk(frame[:-2])) != (sent := int.from_bytes(frame[-2:], "big")):
        raise ChecksumError(computed, sent, idcode=prefix.idcode)
    return prefix
