"""The generator: known answers, keys, and that many draws at once are single draws."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.draws import Draws, normal, philox

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


def test_normal_draws() -> None:
    """Moments of 20,000 within 5 standard errors; each is a function of its key, in whatever order it is asked for."""
    n = 20_000
    z = np.array([normal(1, "N1", "angle", index) for index in range(n)])
    assert abs(z.mean()) < 5 / math.sqrt(n) and abs(z.var() - 1) < 5 * math.sqrt(2 / n)
    assert abs((z**3).mean()) < 5 * math.sqrt(15 / n) and abs((z**4).mean() - 3) < 5 * math.sqrt(96 / n)
    assert abs(np.corrcoef(z[1:], z[:-1])[0, 1]) < 5 / math.sqrt(n)
    for index in (9_999, 0, 256, 255):
        assert normal(1, "N1", "angle", index) == z[index]
        others = {normal(2, "N1", "angle", index), normal(1, "N2", "angle", index), normal(1, "N1", "magnitude", index)}
        assert len(others | {z[index]}) == 4
    draws = Draws(1, "N1", "angle")
    u, v = draws.uniform(300), draws.uniform(300, 1)
    assert z[300] == math.sqrt(-2 * math.log(u)) * math.cos(2 * math.pi * v)
    assert math.isfinite(normal(1, "N1", "angle", -1))
