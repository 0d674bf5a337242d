"""CHK: CRC-CCITT with polynomial 0x1021, initial value 0xFFFF, no reflection, no final XOR (annex B).

Its check value over ``b"123456789"`` is 0x29B1. Over a whole frame, CHK included, the register ends at 0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from itertools import starmap
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def _plain_chk(data: bytes) -> int:
    import binascii

    return binascii.crc_hqx(data, 0xFFFF)


chk: Callable[[bytes], int]
"""CHK of a bytes-like object, as an int."""
try:
    from fastcrc.crc16 import ibm_3740 as chk
except ImportError:  # no wheel for this platform: the standard library is two to nine times slower
    chk = _plain_chk


def sealed(body: bytes) -> bytes:
    """The frame of ``body``: with its CHK behind it."""
    return body + chk(body).to_bytes(2, "big")


_MANY = 512
"""So many rows are worth a walk through them column by column."""
_SHORT = 96
"""Up to so many bytes the walk is faster than a call a row of a compiled function."""


def chk_array(frames: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint16]:
    """CHK of each row of ``frames`` (N, B), over all B bytes; a row that ends in its own CHK gives 0."""
    import numpy as np

    count, size = frames.shape
    if count >= _MANY and (size <= _SHORT or chk is _plain_chk):
        return _chk_by_columns(frames)
    rows = struct.iter_unpack(f"{size}s", np.ascontiguousarray(frames).data)  # N bytes objects at little cost
    return np.fromiter(starmap(chk, rows), np.uint16, count)


def _chk_by_columns(frames: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint16]:
    """Two bytes of all rows at a time."""
    import numpy as np

    count, size = frames.shape
    even, table = size // 2 * 2, _two_bytes()
    register = np.full(count, 0xFFFF, np.uint16)
    for word in np.ascontiguousarray(frames[:, :even]).view(">u2").T.astype(np.uint16):
        register = table.take(register ^ word)
    if size > even:
        eight = np.uint16(8)
        register = (register << eight) ^ table.take((register >> eight) ^ frames[:, -1])
    return register


@lru_cache(maxsize=1)
def _two_bytes() -> npt.NDArray[np.uint16]:
    """(65536,) what the register becomes in two bytes, by what it and they are, exclusive-or."""
    import numpy as np

    register = np.arange(1 << 16)
    for _ in range(16):
        register = register << 1 ^ (register >> 15 & 1) * 0x1021
    return register.astype(np.uint16)


def seal_array(frames: npt.NDArray[np.uint8]) -> None:
    """Make the CHK of each frame (N, FRAMESIZE) anew, in place."""
    frames[:, -2:] = chk_array(frames[:, :-2]).astype(">u2")[:, None].view("u1")
