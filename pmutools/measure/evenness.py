"""How the delays of successive frames depend on each other, by period and drift; and how many frames come a second.

=================== ==============================================================================================
periodic share      of the variance of D within 256 frames, the largest part in three neighbouring bins of a
                    Hann-windowed periodogram averaged over the run; of white noise some 5 %
Allan deviation     of arrivals against the reporting instants, over τ = 2^j/Fs: falls as 1/τ where delays are noise,
                    levels out or rises where a clock wanders
=================== ==============================================================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.measure.columns import Ints
from pmutools.measure.counts import Counts
from pmutools.timebase import NS

SEGMENT = 256
LEVELS = 16
GATHER = 512
BRIDGED = 4
"""Gaps of fewer slots are bridged by a straight line for the periodogram."""
SPANS_S = (1, 10, 60)
_HANN = np.hanning(SEGMENT)
Floats = npt.NDArray[np.float64]


class Sums:
    """Numbers that add up place by place."""

    __slots__ = ("values",)

    def __init__(self, size: int) -> None:
        self.values: Floats = np.zeros(size)

    def merge(self, other: Sums) -> None:
        self.values = self.values + other.values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sums) and bool(np.allclose(self.values, other.values, rtol=1e-6))

    __hash__ = None  # type: ignore[assignment]  # it changes


@dataclass
class EvennessCounts(Counts):
    """Sums over pairs, triples and segments of frames that follow each other."""

    segments: int = 0
    power: Sums = field(default_factory=lambda: Sums(SEGMENT // 2 + 1))
    """Of the periodograms of delays, ns²."""
    triples: Sums = field(default_factory=lambda: Sums(LEVELS))
    squares: Sums = field(default_factory=lambda: Sums(LEVELS))
    """Squared second differences of delays that are 2^j slots apart, ns²."""

    def peak(self, period_ns: float) -> tuple[float, float] | None:
        """Frequency in Hz and share of the strongest period; None of too few frames."""
        power = self.power.values[2:]
        total = float(power.sum())
        if self.segments < 4 or not total or not period_ns:
            return None
        threes = power[:-2] + power[1:-1] + power[2:]
        at = int(np.argmax(threes))
        around = np.arange(at, at + 3)
        middle = float(around @ power[around] / threes[at]) + 2
        return middle * NS / (SEGMENT * period_ns), float(threes[at]) / total

    def allan(self, period_ns: float) -> list[list[float]]:
        """``[[τ in s, deviation]]`` of all τ with ten triples or more."""
        found = []
        for level, (count, square) in enumerate(zip(self.triples.values, self.squares.values, strict=True)):
            tau_ns = period_ns * 2**level
            if count >= 10 and tau_ns:
                found.append([tau_ns / NS, math.sqrt(square / (2 * count)) / tau_ns])
        return found


class EvennessMeter:
    """Takes delays of unique frames in order of arrival; those that come after a later slot are passed over.

    They are gathered, and counted many at once: :meth:`flush` counts what is left.
    """

    def __init__(self) -> None:
        self.counts = EvennessCounts()
        self._waiting: list[tuple[Ints, Ints]] = []
        self._count = 0
        self.restart()

    def restart(self) -> None:
        """What comes next has nothing to do with what came before."""
        self.flush()
        self._slot: int | None = None
        self._delay_ns = self._base_ns = 0
        self._segment: Floats = np.zeros(0)
        self._recent: list[list[tuple[int, int]]] = [[] for _ in range(LEVELS)]
        """(slot, delay) of the last two frames of each level."""

    def add(self, slot: Ints, delay_ns: Ints) -> None:
        """Frames (N,)."""
        self._waiting.append((slot, delay_ns))
        self._count += len(slot)
        if self._count >= GATHER:
            self.flush()

    def flush(self) -> None:
        """Count what was gathered."""
        if not self._count:
            return
        slot, delay_ns = (np.concatenate(columns) for columns in zip(*self._waiting, strict=True))
        self._waiting, self._count = [], 0
        if self._slot is None:
            self._slot, self._delay_ns = int(slot[0]) - 1, int(delay_ns[0])
            self._base_ns = self._delay_ns  # so that floats are exact
        highest = np.maximum.accumulate(np.concatenate(([self._slot], slot)))
        ahead = slot > highest[:-1]
        if not ahead.all():
            slot, delay_ns = slot[ahead], delay_ns[ahead]
            if not len(slot):
                return
        self._spectrum(slot, delay_ns)
        self._triples(slot, delay_ns)
        self._slot, self._delay_ns = int(slot[-1]), int(delay_ns[-1])

    def _spectrum(self, slot: Ints, delay_ns: Ints) -> None:
        assert self._slot is not None
        slots = np.concatenate(([self._slot], slot)) - self._slot
        delays = np.concatenate(([self._delay_ns], delay_ns)) - self._base_ns
        gaps = np.flatnonzero(np.diff(slots) > BRIDGED)
        starts, ends = np.concatenate(([0], gaps + 1)), np.concatenate((gaps, [len(slots) - 1]))
        for number, (first, last) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            begin = slots[first] + (number == 0)  # the very first was in what came before
            if number:
                self._segment = self._segment[:0]
            grid = np.arange(begin, slots[last] + 1)
            line = np.interp(grid, slots[first : last + 1], delays[first : last + 1])
            self._segment = np.concatenate((self._segment, line))
            whole = len(self._segment) // SEGMENT
            if whole:
                blocks = self._segment[: whole * SEGMENT].reshape(whole, SEGMENT)
                blocks = (blocks - blocks.mean(1, keepdims=True)) * _HANN
                found = np.fft.rfft(blocks, axis=1)
                self.counts.power.values += (found.real**2 + found.imag**2).sum(0)
                self.counts.segments += whole
                self._segment = self._segment[whole * SEGMENT :]

    def _triples(self, slot: Ints, delay_ns: Ints) -> None:
        counts = self.counts
        for level in range(LEVELS):
            if level:
                even = slot >> (level - 1) & 1 == 0
                slot, delay_ns = slot[even], delay_ns[even]
            if not len(slot):
                return
            before = self._recent[level]
            if before:
                slots = np.concatenate(([at for at, _ in before], slot))
                delays = np.concatenate(([delay for _, delay in before], delay_ns))
            else:
                slots, delays = slot, delay_ns
            self._recent[level] = list(zip(slots[-2:].tolist(), delays[-2:].tolist(), strict=True))
            if len(slots) < 3:
                continue
            apart = np.diff(slots) == 1 << level
            bends = np.diff(delays, 2)
            three = apart[:-1] & apart[1:]
            if not three.all():
                bends = bends[three]
            counts.triples.values[level] += len(bends)
            squares = bends.astype(np.float64)
            counts.squares.values[level] += float(squares @ squares)


@dataclass
class RateCounts(Counts):
    """Arrivals in each second, ten seconds and minute of UTC that was measured from end to end."""

    fewest: dict[int, int] = field(default_factory=dict, metadata={"merge": lambda a, b: _extreme(min, a, b)})
    most: dict[int, int] = field(default_factory=dict, metadata={"merge": lambda a, b: _extreme(max, a, b)})
    """By the length of the span in s."""

    def to_json(self) -> dict[str, dict[str, float]]:
        """The least and the highest rate over each span, frames/s."""
        return {str(s): {"min": self.fewest[s] / s, "max": self.most[s] / s} for s in sorted(self.most)}


def _extreme(choose: Any, mine: dict[int, int], other: dict[int, int]) -> dict[int, int]:
    return {s: choose(d[s] for d in (mine, other) if s in d) for s in {*mine, *other}}


class RateMeter:
    """Takes arrivals of unique frames, about in order."""

    def __init__(self) -> None:
        self.counts = RateCounts()
        self.restart()

    def restart(self) -> None:
        """The spans that are open are not whole."""
        self._open: dict[int, tuple[int, int, bool]] = {}
        """(number of the span since 1970, arrivals, whether its beginning was seen) by length."""

    def add(self, arrival_ns: Ints) -> None:
        """Arrivals (N,) that are known."""
        seconds = arrival_ns // NS
        numbers, frames = np.unique(seconds, return_counts=True)
        for second, count in zip(numbers.tolist(), frames.tolist(), strict=True):
            for span in SPANS_S:
                self._add(span, second // span, count)

    def _add(self, span: int, number: int, count: int) -> None:
        current = self._open.get(span)
        if current is None:
            self._open[span] = (number, count, False)
            return
        at, frames, whole = current
        if number <= at:
            self._open[span] = (at, frames + count, whole)
            return
        if whole:
            self._take(span, frames)
        if number > at + 1:
            self._take(span, 0)
        self._open[span] = (number, count, True)

    def _take(self, span: int, frames: int) -> None:
        fewest, most = self.counts.fewest, self.counts.most
        fewest[span] = min(frames, fewest.get(span, frames))
        most[span] = max(frames, most.get(span, frames))
