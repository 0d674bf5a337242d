"""Blocks of frames: a block is its frames one by one, in whatever order they are looked at."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.draws import Draws
from pmutools.impair.blocks import ANCHOR, BLOCK, Blocks, Chance, Lanes, chance
from pmutools.impair.losses import FourState, GilbertElliott, LossModel
from pmutools.impair.moment import Moment


class Counting:
    """A chain whose value is the frames since it began: a block run twice, left out or out of order shows."""

    memory = True

    def begin(self, index: int) -> None:
        self.begun = self.next = index

    def run(self, first: int, count: int) -> Sequence[int]:
        assert first == self.next
        self.next = first + count
        return [index - self.begun for index in range(first, first + count)]


@given(st.integers(0, 2**32), st.lists(st.integers(0, 3 * ANCHOR) | st.integers(0, 3 * BLOCK), max_size=12))
def test_memory_begins_at_anchors(phase: int, indices: list[int]) -> None:
    blocks = Blocks(Counting(), phase)
    for index in indices:
        assert blocks[index] == (index + phase % BLOCK) % ANCHOR


CHAINS: list[Callable[[Draws], Callable[[Moment], int]]] = [
    lambda draws: chance(draws, 0.3),
    GilbertElliott(0.05, 0.2, 0.9, 0.01).lost,
    FourState(0.05, 0.2, 0.1, 0.4, 0.02).lost,
]


@pytest.mark.parametrize("chain", CHAINS, ids=["bernoulli", "gilbert-elliott", "four-state"])
@given(indices=st.lists(st.integers(0, 3 * ANCHOR) | st.integers(0, 2 * BLOCK), max_size=8))
def test_the_order_of_looking_does_not_matter(
    chain: Callable[[Draws], Callable[[Moment], int]], indices: list[int]
) -> None:
    draws = Draws(3, "S1", "loss")
    straight = _straight(chain)
    jumping = chain(draws)
    for index in indices:
        assert jumping(Moment(index, 0)) == straight[index]


_STRAIGHT: dict[int, list[int]] = {}


def _straight(chain: Callable[[Draws], Callable[[Moment], int]]) -> list[int]:
    """Frames 0, 1, 2... in order, computed once."""
    if id(chain) not in _STRAIGHT:
        value = chain(Draws(3, "S1", "loss"))
        _STRAIGHT[id(chain)] = [value(Moment(index, 0)) for index in range(3 * ANCHOR + 1)]
    return _STRAIGHT[id(chain)]


def test_block_borders_are_spread_over_the_streams() -> None:
    """So that streams that run in step do not all compute a block in the same tick."""
    starts = list[int]()

    class Watched(Chance):
        def run(self, first: int, count: int) -> bytes:
            starts.append(first)
            return super().run(first, count)

    for number in range(200):
        draws = Draws(0, f"PMU {number}", "loss")
        assert Blocks(Watched(draws, 0.5, 0, 0), draws.phase)[5 * BLOCK] in (0, 1)
    assert len(set(starts)) > 150
    assert all(4 * BLOCK < start <= 5 * BLOCK for start in starts)


def test_lanes_are_apart() -> None:
    lanes = Lanes(lambda lane: Chance(draws, 0.5, 0, lane), draws := Draws(0, "N1", "loss"))
    data = [lanes(Moment(index, 0)) for index in range(100)]
    copies = [lanes(Moment(index, 0, lane=1)) for index in range(100)]
    assert data != copies
    assert data == [lanes.data[index] for index in range(100)]


def _first_lost(model: LossModel, stream: str) -> int:
    draws = Draws(0, stream, "loss")
    draws.phase = 0  # so that frame 0 is the first of a block, and the chain begins with it
    return model.lost(draws)(Moment(0, 0))


@pytest.mark.parametrize("model", [GilbertElliott(0.01, 0.1), FourState(0.01, 0.1, 0.2, 0.3, 0.05)])
def test_a_chain_begins_in_its_stationary_state(model: LossModel) -> None:
    """Over 2,000 streams the first frame is lost as often as any other: no run-in."""
    n = 2000
    if isinstance(model, GilbertElliott):
        expected = 0.01 / 0.11
    else:
        assert isinstance(model, FourState)
        expected = sum(model.stationary()[2:])
    first = np.mean([_first_lost(model, f"PMU {number}") for number in range(n)])
    assert abs(first - expected) < 5 * math.sqrt(expected * (1 - expected) / n)
