"""The slots of one stream: what came, was lost, repeated, out of order; frames in order of arrival go in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from pmutools import timebase
from pmutools.measure.clockstep import ClockStep
from pmutools.measure.columns import Flags, Frames, Ints
from pmutools.measure.sequence import LossMeter, OrderMeter
from pmutools.measure.slots import OFF_GRID_SHARE, Intake, Placed, Ring, SlotCounts, Verdict

_LONGEST_REACH = 1 << 15


class Part(NamedTuple):
    """Frames that came together, and what was made of them."""

    verdict: Verdict
    """RESTART: an epoch begins with this part."""
    frames: Frames
    placed: Placed | None
    """None where they are stale."""
    lost: Ints
    """Slots found to be lost meanwhile; those of an outage are not listed."""


class SlotMeter:
    """Counts slots, order and losses, in constant memory: some 100 KiB at 60 frames/s and a horizon of 30 s.

    ``counts``, ``order.counts`` and ``losses.counts`` may be exchanged: counting goes on in the new ones.
    """

    def __init__(self, rate: Fraction, horizon_ns: int) -> None:
        self.counts = SlotCounts()
        self.losses = LossMeter()
        self._horizon_ns = horizon_ns
        self.steps: list[ClockStep] = []
        """The times that the sender's clock was set."""
        self._regrid(rate)
        self.order = OrderMeter(self.reach)

    def _regrid(self, rate: Fraction) -> None:
        self.period_ns = timebase.NS / float(rate) if rate else timebase.NS
        self.reach = min(max(int(self._horizon_ns / self.period_ns), 16), _LONGEST_REACH)
        """The horizon, in slots."""
        self._intake, self._ring = Intake(self.reach, self.period_ns, self.steps), Ring(self.reach)

    def restart(self, rate: Fraction) -> None:
        """What comes next is counted at another rate; :meth:`flush` and :meth:`close` before."""
        self.losses.restart()
        self._regrid(rate)
        counts, self.order = self.order.counts, OrderMeter(self.reach)
        self.order.counts = counts

    def feed(self, frames: Frames) -> Iterator[Part]:
        """Count frames that came after all before them; a few may be kept for later."""
        self.counts.frames += len(frames)
        off_grid = np.abs(frames.off_grid_ns) > OFF_GRID_SHARE * self.period_ns
        self.counts.off_grid += int(np.count_nonzero(off_grid))
        return self._parts(self._intake.feed(frames))

    def flush(self) -> Iterator[Part]:
        """Count what was kept, at the end."""
        return self._parts(self._intake.flush())

    def close(self) -> Ints:
        """Settle all that is still open; the slots found to be lost."""
        rest = self._ring.rest()
        self.losses.add(rest.received)
        self.losses.close()
        return rest.lost

    def _parts(self, judged: Iterable[tuple[Verdict, Frames]]) -> Iterator[Part]:
        nothing = np.zeros(0, np.int64)
        for verdict, frames in judged:
            if verdict is Verdict.STALE:
                self.counts.stale += len(frames)
                yield Part(verdict, frames, None, nothing)
                continue
            losses, pieces = [self._begin(verdict, int(frames.slot[0]))], []
            for _, placed, settled in self._ring.place(frames, self.counts):
                self.losses.add(settled.received)
                losses.append(settled.lost)
                pieces.append(placed)
            placed = _merged(pieces)
            first, before = placed.first, placed.before
            if first.all():
                self.order.add(frames.slot, before, frames.arrival_ns)
            else:
                self.order.add(frames.slot[first], before[first], frames.arrival_ns[first])
            yield Part(verdict, frames, placed, np.concatenate(losses))

    def _begin(self, verdict: Verdict, slot: int) -> Ints:
        """Make the ring ready for frames from ``slot`` on; the slots found to be lost."""
        if verdict is Verdict.RESTART:
            rest = self._ring.rest()
            self.losses.add(rest.received)
            self.losses.restart()
            self._ring.restart(slot)
            self.order.restart()
            self.counts.epochs += 1
            return rest.lost
        if verdict is Verdict.OUTAGE:
            self.counts.outages += 1
            rest, gone = self._ring.skip(slot, self.counts)
            self.losses.add(rest.received)
            self.losses.add_lost(gone)
            return rest.lost
        return np.zeros(0, np.int64)


def _merged(pieces: Sequence[Placed]) -> Placed:
    """Of frames that follow each other."""
    if len(pieces) == 1:
        return pieces[0]
    return Placed(
        np.concatenate([piece.first for piece in pieces]),
        _flags([(piece.again, piece.first) for piece in pieces]),
        _flags([(piece.conflicting, piece.first) for piece in pieces]),
        np.concatenate([piece.before for piece in pieces]),
        np.concatenate([piece.ipdv_ns for piece in pieces]),
    )


def _flags(pieces: Sequence[tuple[Flags | None, Flags]]) -> Flags | None:
    """Flags one after the other, none where there are none; each with flags of the same length."""
    if all(flags is None for flags, _ in pieces):
        return None
    return np.concatenate([np.zeros_like(like) if flags is None else flags for flags, like in pieces])
