"""CHK: CRC-CCITT with polynomial 0x1021, initial value 0xFFFF, no reflection, no final XOR (annex B).

Its check value over ``b"123456789"`` is 0x29B1. Over a whole frame, CHK included, the register ends at 0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
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


def chk_array(frames: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint16]:
    """CHK of each row of ``frames`` (N, B), over all B bytes; a row that ends in its own CHK gives 0."""
    import numpy as np

    count, size = frames.shape
    rows = struct.iter_unpack(f"{size}s", np.ascontiguousarray(frames).data)  # N bytes objects at little cost
    return np.fromiter(starmap(chk, rows), np.uint16, count)


def seal_array(frames: npt.NDArray[np.uint8]) -> None:
    """Make the CHK of each frame (N, FRAMESIZE) anew, in place."""
    frames[:, -2:] = chk_array(frames[:, :-2]).astype(">u2")[:, None].view("u1")
