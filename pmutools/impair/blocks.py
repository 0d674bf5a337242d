"""What a random model does to frame i, computed a block of frames at a time and found again at any i.

Models with memory (a Markov chain, correlated delays) draw a fresh stationary state every :data:`ANCHOR` frames. So
the value at i follows from the draws of at most that many frames: a seek, a gate or a second look changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from pmutools.draws import Draws
from pmutools.impair.moment import Moment

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

BLOCK = 512
ANCHOR = 32 * BLOCK


class Chain(Protocol[T_co]):
    """The values of consecutive frames. ``memory`` says whether they depend on those before."""

    memory: bool

    def begin(self, index: int) -> None:
        """Take a state drawn from the stationary distribution, as if before frame ``index``."""

    def run(self, first: int, count: int) -> Sequence[T_co]:
        """The values of frames ``first`` to ``first + count - 1``, going on from the state left before."""


class Blocks(Generic[T_co]):
    """A chain's values by frame index; one block is kept.

    ``phase`` shifts the block borders, so that thousands of streams at one index do not all refill in one tick.
    """

    __slots__ = ("_chain", "_first", "_phase", "_values")

    def __init__(self, chain: Chain[T_co], phase: int = 0) -> None:
        self._chain = chain
        self._phase = phase % BLOCK
        self._first = 0
        self._values: Sequence[T_co] = ()

    def around(self, index: int) -> tuple[Sequence[T_co], int]:
        """The values of the block that ``index`` lies in, and the index of the first."""
        self[index]
        return self._values, self._first

    def __getitem__(self, index: int) -> T_co:
        at = index - self._first
        if 0 <= at < len(self._values):
            return self._values[at]
        first = index - (index + self._phase) % BLOCK
        if self._chain.memory:
            anchor = index - (index + self._phase) % ANCHOR
            following = self._first + len(self._values)
            if not (self._values and anchor < following <= first):
                following = anchor
                self._chain.begin(anchor)
            for start in range(following, first, BLOCK):
                self._chain.run(start, BLOCK)
        self._first, self._values = first, self._chain.run(first, BLOCK)
        return self._values[index - first]


def by_index(blocks: Blocks[int], index: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The values at all of ``index`` (N,), in any order; fastest where neighbours are near each other."""
    found = np.empty(index.size, np.int64)
    at = 0
    while at < index.size:
        values, first = blocks.around(int(index[at]))
        near = index[at : at + BLOCK]
        inside = (near >= first) & (near < first + len(values))
        until = at + (int(np.argmin(inside)) if not inside.all() else inside.size)
        found[at:until] = np.asarray(values, np.int64)[index[at:until] - first]
        at = until
    return found


class Lanes(Generic[T]):
    """A chain's values for any frame: ``chain`` makes the chain of one lane, when first asked for."""

    __slots__ = ("_chain", "_lanes", "_phase", "data")

    def __init__(self, chain: Callable[[int], Chain[T]], draws: Draws) -> None:
        self._chain = chain
        self._phase = draws.phase
        self.data = Blocks(chain(0), draws.phase)
        self._lanes: dict[int, Blocks[T]] = {}

    def __call__(self, at: Moment) -> T:
        if not at.lane:
            return self.data[at.index]
        if at.lane not in self._lanes:
            self._lanes[at.lane] = Blocks(self._chain(at.lane), self._phase)
        return self._lanes[at.lane][at.index]


class Chance:
    """1 with probability ``p`` for each frame on its own, else 0."""

    memory = False

    def __init__(self, draws: Draws, p: float, variate: int, lane: int) -> None:
        self._draws, self._p, self._variate, self._lane = draws, p, variate, lane

    def begin(self, index: int) -> None:
        """Nothing to take up."""

    def run(self, first: int, count: int) -> bytes:
        return (self._draws.uniforms(first, count, self._variate, self._lane) < self._p).tobytes()


def chance(draws: Draws, p: float, variate: int = 0) -> Callable[[Moment], int]:
    """Whether draw ``variate`` of a frame is below ``p``: 1 or 0."""
    return Lanes(lambda lane: Chance(draws, p, variate, lane), draws)
