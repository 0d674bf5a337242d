"""The generator: known answers, keys, and that a block is its frames one by one."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.impair.blocks import ANCHOR, BLOCK, Blocks, Chance, Lanes, chance
from pmutools.impair.draws import Draws, philox
from pmutools.impair.losses import FourState, GilbertElliott, LossModel
from pmutools.impair.moment import Moment

# Philox4x32-10 of the generator's own published known-answer file: counter, key, output.
KNOWN_ANSWERS = """
00000000 00000000 00000000 00000000  00000000 00000000  6627e8d5 e169c58d bc57ac4c 9b00dbd8
ffffffff ffffffff ffffffff ffffffff  ffffffff ffffffff  408f276d 41c83b0e a20bc7c6 6d5451fd
243f6a88 85a308d3 13198a2e 03707344  a4093822 299f31d0  d16cfe09 94fdcceb 5001e420 24126ea1
"""


@pytest.mark.parametrize("line", KNOWN_ANSWERS.strip().splitlines())
def test_known_answers(line: str) -> None:
    *words, k0, k1, w0, w1, w2, w3 = (int(word, 16) for word in line.split())
    expected = (w0, w1, w2, w3)
    c0, c1, c2, c3 = words
    assert philox(c0, c1, c2, c3, k0, k1) == expected
    a0, a1, a2, a3 = (np.full(3, word, np.uint64) for word in words)
    for column, word in zip(philox(a0, a1, a2, a3, k0, k1), expected, strict=True):
        assert column.tolist() == [word] * 3


def test_a_draw_is_pinned_by_its_key() -> None:
    """The path from (seed, stream, stage, index, variate, lane) to a number, spelled out once more."""
    digest = hashlib.sha256(b"7\0N1\0loss").digest()
    k0, k1 = int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:8], "little")
    words = philox(1000, 0, 1, 2, k0, k1)
    expected = ((words[2] << 20 | words[3] >> 12) + 0.5) * 2.0**-52
    assert Draws(7, "N1", "loss").uniform(1000, 3, 2) == expected
    assert expected == 0.34731376229213506


@given(
    st.integers(0, 2**64 - 1),
    st.text(max_size=5),
    st.one_of(st.integers(-1000, 1000), st.integers(2**32 - 50, 2**32 + 50), st.integers(0, 2**62)),
    st.integers(0, 9),
    st.integers(0, 70_000),
)
def test_blocks_are_single_draws(seed: int, stream: str, first: int, variate: int, lane: int) -> None:
    draws = Draws(seed, stream, "delay")
    assert draws.uniforms(first, 40, variate, lane).tolist() == [
        draws.uniform(index, variate, lane) for index in range(first, first + 40)
    ]


def test_every_part_of_the_key_counts() -> None:
    keys = [(1, "N1", "loss"), (2, "N1", "loss"), (1, "N2", "loss"), (1, "N1", "delay"), (1, "N", "1loss")]
    draws = [Draws(*key).uniform(0) for key in keys]
    one = Draws(*keys[0])
    draws += [one.uniform(1), one.uniform(0, 1), one.uniform(0, 2), one.uniform(0, 0, 1), one.uniform(2**32)]
    assert len(set(draws)) == len(draws)


def test_uniform_and_independent() -> None:
    """Mean, variance and lag correlations of 100,000 draws within 5 standard errors; 64 bins by chi-square."""
    n = 100_000
    first, second = (Draws(1, "N1", "delay").uniforms(0, n, variate) for variate in (0, 1))
    assert first.min() > 0 and first.max() < 1
    for u in (first, second):
        assert abs(u.mean() - 0.5) < 5 * math.sqrt(1 / 12 / n)
        assert abs(u.var() - 1 / 12) < 5 * math.sqrt(1 / 180 / n)
        chi2 = (np.histogram(u, 64, (0, 1))[0] - n / 64) ** 2 / (n / 64)
        assert abs(chi2.sum() - 63) < 5 * math.sqrt(2 * 63)
    for x, y in ((first, second), (first[1:], first[:-1]), (first[2:], first[:-2])):
        assert abs(np.corrcoef(x, y)[0, 1]) < 5 / math.sqrt(len(x))


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
