"""Rows of what was received, sorted: which are whole data frames of one stream, and so can be taken together."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pmutools.c37118.checksum import chk_array
from pmutools.c37118.constants import MIN_FRAME_SIZE
from pmutools.linux_receive import ROWS, Rows

HEAD_BYTES = 6
"""SYNC, FRAMESIZE, IDCODE: what the frames of a group have in common, beside source and sender."""
_ROW_BITS = ROWS.bit_length() - 1
_SIZE_SHIFT = 52
_HASH_BITS = _SIZE_SHIFT - _ROW_BITS
_MULTIPLIER = 0x9E3779B97F4A7C15  # odd, and without a pattern
_FACTORS = np.array([pow(_MULTIPLIER, power, 1 << 64) for power in range(1, 7)], np.uint64)


class Groups(NamedTuple):
    """G groups of M rows that look like data frames of one stream; groups of one FRAMESIZE side by side."""

    order: NDArray[np.intp]
    """(M,) the rows, group by group, in each as they came."""
    starts: NDArray[np.intp]
    """(G + 1,) where in ``order`` each group begins, and where the last ends."""
    heads: NDArray[np.uint64]
    """(G,) the first six bytes, the first of them lowest."""
    mixed: NDArray[np.bool_]
    """(G,) whether rows of several streams got into it, by an unlikely chance."""

    @property
    def sizes(self) -> NDArray[np.uint64]:
        """(G,) FRAMESIZE."""
        return _framesize(self.heads)


def _framesize(heads: NDArray[np.uint64]) -> NDArray[np.uint64]:
    high, low = heads >> np.uint64(8) & np.uint64(0xFF00), heads >> np.uint64(24) & np.uint64(0xFF)
    return high | low


def group(rows: Rows) -> Groups:
    """The groups of ``rows``; a row that is no whole data frame, or too long for its row, is in none."""
    heads = np.ascontiguousarray(rows.octets[:, :8]).view(np.uint64)[:, 0] & np.uint64((1 << 8 * HEAD_BYTES) - 1)
    sizes = _framesize(heads)
    whole = (sizes == rows.sizes) & (sizes >= MIN_FRAME_SIZE) & (sizes <= rows.octets.shape[1])
    whole &= heads & 0xF0FF == 0x00AA  # SYNC of data, of any version
    chosen = np.flatnonzero(whole)
    words = np.ascontiguousarray(rows.senders).view(np.uint64)
    kinds = np.column_stack((heads, rows.sources.astype(np.uint64), words))[chosen]  # (M, 6)
    mixture = (kinds * _FACTORS).sum(axis=1, dtype=np.uint64)
    mixture = (mixture ^ mixture >> 32) * _FACTORS[0]
    keys = sizes[chosen] << _SIZE_SHIFT | mixture >> (64 - _HASH_BITS) << _ROW_BITS | chosen.astype(np.uint64)
    by_key = np.argsort(keys)
    keys, kinds, order = keys[by_key], kinds[by_key], chosen[by_key]
    new = np.ones(len(keys) + 1, np.bool_)  # the last stands for the end
    new[1:-1] = keys[1:] >> _ROW_BITS != keys[:-1] >> _ROW_BITS
    starts = np.flatnonzero(new)
    firsts = starts[:-1]
    differ = (kinds[1:] != kinds[:-1]).any(axis=1) & ~new[1:-1]
    mixed = np.zeros(len(firsts), np.bool_)
    if differ.any():
        mixed[np.searchsorted(firsts, np.flatnonzero(differ), side="right") - 1] = True
    return Groups(order, starts, kinds[firsts, 0], mixed)


def octets_by_size(rows: Rows, groups: Groups) -> list[tuple[int, int, NDArray[np.uint8]]]:
    """For each FRAMESIZE (first group, last group exclusive, octets (K, FRAMESIZE) of their rows in order)."""
    sizes = groups.sizes
    edges = [0, *(np.flatnonzero(sizes[1:] != sizes[:-1]) + 1).tolist(), len(sizes)]
    found = []
    for first, last in pairwise(edges):
        if first == last:
            continue
        of_size = groups.order[groups.starts[first] : groups.starts[last]]
        found.append((first, last, rows.octets[of_size, : int(sizes[first])]))
    return found


def bad_chks(octets: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(K,) frames whose CHK does not hold."""
    bad: NDArray[np.bool_] = chk_array(octets) != 0
    return bad


def announcing(octets: NDArray[np.uint8], stats: Sequence[int]) -> NDArray[np.bool_]:
    """(K,) frames with STAT bit 10 set in any station; ``stats`` are the offsets of STAT. 0xFFFF says nothing."""
    at = np.array(stats)
    high, low = octets[:, at], octets[:, at + 1]
    found: NDArray[np.bool_] = ((high & 4 != 0) & ((high & low) != 0xFF)).any(axis=1)
    return found
