"""What the datagrams between processes have in common: big-endian, a magic first, a CRC-32 of all before it last.

The watchdog has its own code for the same; the tests hold the two together.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Final

WRAP: Final = 1 << 32
"""Sequences and counters wrap here."""


class Sealed:
    """One kind of datagram."""

    def __init__(self, magic: bytes, layout: str) -> None:
        """``layout`` as in :mod:`struct`, of what comes between magic and CRC."""
        self.magic, self._layout = magic, struct.Struct(f">4s{layout}")
        self.size = self._layout.size + 4

    def pack(self, *values: object) -> bytes:
        body = self._layout.pack(self.magic, *values)
        return body + zlib.crc32(body).to_bytes(4, "big")

    def unpack(self, datagram: bytes) -> tuple[Any, ...] | None:
        """The values; None for another datagram, or one that is damaged."""
        body, crc = datagram[:-4], datagram[-4:]
        if len(datagram) != self.size or not datagram.startswith(self.magic):
            return None
        return self._layout.unpack(body)[1:] if zlib.crc32(body).to_bytes(4, "big") == crc else None


def follows(sequence: int, last: int) -> bool:
    """Whether a sequence is newer than ``last``."""
    return 0 < (sequence - last) % WRAP < WRAP // 2
