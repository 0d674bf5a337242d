"""Random draws that are a function of (seed, stream, stage, frame index, variate) and of nothing else.

So a stream or a stage that is added, a parameter that changes, a seek or a loop leaves every other draw as it was, and
a library upgrade changes none: the generator is Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as
1, 2, 3", SC 2011), written out here twice, for arrays and for one frame, bit for bit the same.
"""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85
_MASK = 0xFFFF_FFFF
_ROUNDS = 10

Words = TypeVar("Words", int, npt.NDArray[Any])


def philox(c0: Words, c1: Words, c2: Words, c3: Words, k0: int, k1: int) -> tuple[Words, Words, Words, Words]:
    """Philox4x32-10: four 32-bit words of a 128-bit counter under a 64-bit key; ints, or uint64 arrays of equal shape.

    The products stay below 2**64, so both kinds of words give the same bits.
    """
    for _ in range(_ROUNDS):
        p0, p1 = c0 * _M0, c2 * _M1
        c0, c1, c2, c3 = (p1 >> 32) ^ c1 ^ k0, p1 & _MASK, (p0 >> 32) ^ c3 ^ k1, p0 & _MASK
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return c0, c1, c2, c3


_SCALE = 2.0**-52
"""A draw is (52 bits + 1/2) * 2**-52: exact in float64, symmetric about 1/2, never 0 or 1."""


class Draws:
    """The uniform draws of one stage of one stream, each in the open interval (0, 1).

    ``lane`` keeps apart what shares a frame index: the copies of a frame, and frames that are not data.
    """

    __slots__ = ("_k0", "_k1", "phase")

    def __init__(self, seed: int, stream: str, stage: str) -> None:
        digest = hashlib.sha256(f"{seed}\0{stream}\0{stage}".encode()).digest()
        self._k0 = int.from_bytes(digest[0:4], "little")
        self._k1 = int.from_bytes(digest[4:8], "little")
        self.phase = int.from_bytes(digest[8:12], "little")
        """A number of this stage alone, by which work that comes in blocks is spread over the streams."""

    def uniform(self, index: int, variate: int = 0, lane: int = 0) -> float:
        """One draw."""
        words = philox(index & _MASK, index >> 32 & _MASK, variate >> 1, lane, self._k0, self._k1)
        high, low = words[2:] if variate & 1 else words[:2]
        return ((high << 20 | low >> 12) + 0.5) * _SCALE

    def uniforms(self, first: int, count: int, variate: int = 0, lane: int = 0) -> npt.NDArray[np.float64]:
        """The draws of frames ``first`` to ``first + count - 1``, shape (count,)."""
        index = np.arange(first, first + count, dtype=np.int64).view(np.uint64)
        block, lanes = np.full(count, variate >> 1, np.uint64), np.full(count, lane, np.uint64)
        words = philox(index & _MASK, index >> 32, block, lanes, self._k0, self._k1)
        high, low = words[2:] if variate & 1 else words[:2]
        return ((high << 20 | low >> 12).astype(np.float64) + 0.5) * _SCALE


_BLOCK = 256


def normal(seed: int, stream: str, stage: str, index: int) -> float:
    """A standard normal draw, by Box and Muller; those of neighbouring frames are computed together, so it is cheap."""
    return _normals(seed, stream, stage, index // _BLOCK)[index % _BLOCK]


@lru_cache(maxsize=1024)
def _normals(seed: int, stream: str, stage: str, block: int) -> tuple[float, ...]:
    draws = Draws(seed, stream, stage)
    pairs = zip(*(draws.uniforms(block * _BLOCK, _BLOCK, variate).tolist() for variate in (0, 1)), strict=True)
    # the scalar functions: numpy's depend on what the processor can
    return tuple(math.sqrt(-2 * math.log(u)) * math.cos(2 * math.pi * v) for u, v in pairs)
