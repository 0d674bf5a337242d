"""Columns made block by block: what is gathered, looked up and put together, whatever it is of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcon.columns.tables import UNKNOWN, Array, Codes, Ints
from pmutools.schema.columns import Texts


class Blocks:
    """Columns under way: a list of blocks each."""

    def __init__(self) -> None:
        self.blocks: dict[str, list[Array]] = {}

    def add(self, **columns: Array) -> None:
        for name, column in columns.items():
            self.blocks.setdefault(name, []).append(column)

    def whole(self, width: int = 0) -> dict[str, Array]:
        """Each column in one piece; those of two dimensions at least ``width`` wide."""
        made: dict[str, Array] = {}
        for name in list(self.blocks):
            blocks = self.blocks.pop(name)  # and let go of them
            if blocks[0].ndim == 2:
                widest = max(width, *(block.shape[1] for block in blocks))
                blocks = [_padded(block, widest) for block in blocks]
            made[name] = np.concatenate(blocks)
        return made


def codes_of(texts: Texts, known: Sequence[str]) -> Codes:
    """Texts as places in ``known``, whatever their shape."""
    table = [known.index(text) if text in known else UNKNOWN for text in texts.values]
    return np.array([*table, UNKNOWN], np.uint8)[texts.codes]  # the last stands for -1, too


def places(there_ns: Ints, wanted_ns: Ints) -> Ints:
    """For each of ``wanted_ns`` its place in ``there_ns``; -1 for none."""
    if np.array_equal(there_ns, wanted_ns):
        return np.arange(len(wanted_ns))
    place = {ns: number for number, ns in enumerate(there_ns.tolist())}
    return np.array([place.get(ns, -1) for ns in wanted_ns.tolist()], np.int64)


def looked_up(column: Array, at: Ints, unknown: float = np.nan) -> Array:
    """Rows ``at`` of ``column``; ``unknown`` for -1."""
    return np.append(column, np.full((1, *column.shape[1:]), unknown, column.dtype), axis=0)[at]


def named(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """A log whose head is damaged may name fewer than its ticks hold: number the rest."""
    return names + tuple(map(str, range(len(names), count)))


def _padded(block: Array, width: int) -> Array:
    """``block`` (n, m) made ``width`` wide."""
    if block.shape[1] == width:
        return block
    fill = np.nan if block.dtype == np.float64 else UNKNOWN
    return np.concatenate((block, np.full((len(block), width - block.shape[1]), fill, block.dtype)), axis=1)
