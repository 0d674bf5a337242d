"""What the server says to the watchdog: beats and operators' words, big-endian, CRC-32 of all before it at the end."""

from __future__ import annotations

import struct
import zlib

_BEAT = struct.Struct(">4s8sIqB3x")
_WORD = struct.Struct(">4sB3x32s")
RUNNING, ENDING = 1, 2
WORDS = {"estop": 1, "release": 2, "reset": 3}
"""Orders that are the watchdog's too."""


def beat(counter: int, monotonic_ns: int, state: int) -> bytes:
    """The server's sign of life: ``DCB1``."""
    return _sealed(_BEAT.pack(b"DCB1", b"server", counter & 0xFFFFFFFF, monotonic_ns, state))


def word(order: str, who: str) -> bytes:
    """An operator's word: ``DCO1``."""
    name = who.encode()[:32].decode(errors="ignore").encode()
    return _sealed(_WORD.pack(b"DCO1", WORDS[order], name))


def _sealed(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(4, "big")
