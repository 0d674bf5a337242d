"""Which reporting instants a stream filled: expected, received, lost, duplicated; stale frames and new epochs.

C37.118 has no sequence number. The slot, the reporting instant nearest to the stamp, takes its place: an instant that
no frame came for is a loss (RFC 7680, with the horizon as its waiting time Tmax), a second frame for one is a duplicate
(RFC 5560), or, where its bytes differ, a conflicting duplicate.

Memory is bounded. A ring holds the slots of the last ``horizon``; what comes for an older one is *stale*: counted, and
lost all the same. A stamp that jumps further than the horizon is believed as follows:

- forward, by what the arrivals say has passed: an outage; every slot of it is lost;
- otherwise it is a stray, kept aside. The next :data:`CONFIRM` frames decide: where they go on from it, the sender's
  clock was set, and a new *epoch* begins there, without loss; where they do not, the strays were stale frames.

A jump by less than the horizon is a clock that was set where frames keep coming (:mod:`pmutools.measure.clockstep`): a
new epoch, too.

So a device's first frames that are months old neither make a million losses nor spoil the delays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME
from pmutools.measure.clockstep import ROWS, STEPS, ClockStep, StepWatch
from pmutools.measure.columns import Flags, Frames, Ints, joined
from pmutools.measure.counts import Counts

CONFIRM = 4
"""So many frames in a row make a stamp far from the last one believed."""
HORIZON_S = 30.0
"""A frame that comes later than this after its successors is stale."""
OFF_GRID_SHARE = 0.1
"""A stamp further than this share of a period from its reporting instant is off the grid."""
_BELIEVED_NS = 86_400 * timebase.NS
"""Without arrivals, a longer gap between stamps is a clock that was set."""


@dataclass
class SlotCounts(Counts):
    """Frames by what became of them; ``expected`` slots lie between the first and the last received of each epoch."""

    frames: int = 0
    expected: int = 0
    received: int = 0
    """Unique frames."""
    duplicated: int = 0
    """Extra copies: Σ(copies - 1)."""
    conflicting: int = 0
    """Those of the extra copies whose bytes differ from the first's."""
    replicated: int = 0
    """Slots that more than one frame came for (RFC 5560, replicated packets)."""
    stale: int = 0
    """Older than the horizon, or strays that nothing followed."""
    off_grid: int = 0
    epochs: int = 0
    """Times that counting began anew: at the start, a change of rate, a clock that was set."""
    outages: int = 0
    """Silences longer than the horizon."""

    @property
    def lost(self) -> int:
        return self.expected - self.received


class Verdict(Enum):
    """What is made of frames that came together."""

    FOLLOW = auto()
    """They go on from what came before."""
    OUTAGE = auto()
    """They follow a silence that the arrivals confirm."""
    RESTART = auto()
    """They begin a new epoch."""
    STALE = auto()


class Intake:
    """Splits frames where stamps jump further than ``reach`` slots, and says what to make of each part."""

    def __init__(self, reach: int, period_ns: float, steps: list[ClockStep]) -> None:
        self._reach, self._period_ns = reach, period_ns
        self._head: int | None = None
        self._head_arrival_ns = NO_TIME
        self._aside: list[Frames] = []
        self._watch = StepWatch(period_ns)
        self.steps = steps
        """The times that the sender's clock was set; the first :data:`~pmutools.measure.clockstep.STEPS`."""

    def feed(self, frames: Frames) -> Iterator[tuple[Verdict, Frames]]:
        """Parts of what came so far, in order; a few frames are kept for later."""
        for change_ns, part in self._watch.feed(frames):
            yield from self._stepped(change_ns, part) if change_ns else self._split(part)

    def _stepped(self, change_ns: int, part: Frames) -> Iterator[tuple[Verdict, Frames]]:
        """A part with which the sender's clock was set."""
        if self._aside:
            yield Verdict.STALE, joined(self._aside)
            self._aside = []
        self._note(change_ns, int(part.arrival_ns[0]))
        yield from self._accept(Verdict.RESTART, part[:ROWS])
        yield from self._split(part[ROWS:])

    def _note(self, change_ns: int, at_ns: int) -> None:
        if len(self.steps) < STEPS:
            self.steps.append(ClockStep(change_ns, at_ns))

    def _split(self, frames: Frames) -> Iterator[tuple[Verdict, Frames]]:
        steps = np.abs(np.diff(frames.slot)) > self._reach
        if not steps.any():
            yield from self._part(frames)
            return
        cuts = [0, *(np.flatnonzero(steps) + 1).tolist(), len(frames)]
        for first, end in pairwise(cuts):
            yield from self._part(frames[first:end])

    def flush(self) -> Iterator[tuple[Verdict, Frames]]:
        """What was kept, at the end of the stream."""
        for _, part in self._watch.flush():
            yield from self._split(part)
        if self._aside:
            aside = joined(self._aside)
            yield from self._accept(Verdict.RESTART, aside) if self._head is None else ((Verdict.STALE, aside),)
            self._aside = []

    @property
    def waiting(self) -> int:
        """How many frames are kept aside."""
        return sum(map(len, self._aside))

    def _part(self, part: Frames) -> Iterator[tuple[Verdict, Frames]]:
        if not len(part):
            return
        if len(part) > 1 and bool((np.maximum.accumulate(part.slot) - part.slot > self._reach).any()):
            for row in range(len(part)):  # it goes back step by step: judge each frame for itself
                yield from self._part(part[row : row + 1])
            return
        first = int(part.slot[0])
        if self._head is not None and abs(first - self._head) <= self._reach:
            verdict = Verdict.FOLLOW
        elif self._head is not None and self._is_outage(first, int(part.arrival_ns[0])):
            verdict = Verdict.OUTAGE
        else:
            if self._aside and abs(first - int(self._aside[-1].slot[-1])) > self._reach:
                yield Verdict.STALE, joined(self._aside)
                self._aside = []
            self._aside.append(part)
            if self.waiting < CONFIRM:
                return
            part, self._aside, verdict = joined(self._aside), [], Verdict.RESTART
            if self._head is not None and NO_TIME not in (arrival_ns := int(part.arrival_ns[0]), self._head_arrival_ns):
                stamped_ns = round((int(part.slot[0]) - self._head) * self._period_ns)
                self._note(stamped_ns - (arrival_ns - self._head_arrival_ns), arrival_ns)
        if self._aside:
            yield Verdict.STALE, joined(self._aside)
            self._aside = []
        yield from self._accept(verdict, part)

    def _accept(self, verdict: Verdict, part: Frames) -> Iterator[tuple[Verdict, Frames]]:
        at = int(np.argmax(part.slot))
        if verdict is Verdict.RESTART or self._head is None or int(part.slot[at]) > self._head:
            self._head, self._head_arrival_ns = int(part.slot[at]), int(part.arrival_ns[at])
        yield verdict, part

    def _is_outage(self, first: int, arrival_ns: int) -> bool:
        assert self._head is not None
        stamped_ns = (first - self._head) * self._period_ns
        if stamped_ns <= 0:
            return False
        if arrival_ns == NO_TIME or self._head_arrival_ns == NO_TIME:
            return stamped_ns <= _BELIEVED_NS
        return abs(stamped_ns - (arrival_ns - self._head_arrival_ns)) <= self._reach * self._period_ns


class Placed(NamedTuple):
    """What the ring made of frames (N,)."""

    first: Flags
    """(N,) the first of its slot to come, in time: one of ``received``."""
    again: Flags | None
    """(N,) further frames of a slot, in time; None where there are none. Neither first nor again: stale."""
    conflicting: Flags | None
    """(N,) those of them whose bytes differ from the first's."""
    before: Ints
    """(N,) the highest slot that had come before each frame."""
    ipdv_ns: Ints
    """(M,) delay of a slot less the delay of the slot before it, of all pairs that are now complete (RFC 3393)."""


class Settled(NamedTuple):
    """Slots (K,) from ``first`` on that nothing can change any more: true where a frame came."""

    first: int
    received: Flags

    @property
    def lost(self) -> Ints:
        """The slots that nothing came for."""
        return np.flatnonzero(~self.received) + self.first


class Ring:
    """The slots of the last ``reach``, in a ring of fixed size; counts into ``counts``, which may be changed."""

    def __init__(self, reach: int) -> None:
        self._reach = reach
        self._size = 1 << (2 * reach + 2).bit_length()
        self._mask = self._size - 1
        self._copies = np.zeros(self._size, np.uint8)
        """0: nothing came, 1: one frame, 2: more."""
        self._marks = np.zeros(self._size, np.uint32)
        self._delays = np.full(self._size, NO_TIME)
        self._head: int | None = None
        self._low = self._settled = 0

    def restart(self, first: int) -> None:
        """Begin an epoch whose first frame is for slot ``first``."""
        self._copies[:] = 0
        self._head, self._low, self._settled = first - 1, first, first - 1 - self._reach

    def place(self, frames: Frames, counts: SlotCounts) -> Iterator[tuple[slice, Placed, Settled]]:
        """Take in frames near the head. Yields for pieces of them: which rows, what they are, and slots now settled.

        The settled ones follow those settled before.
        """
        rows = 0
        while rows < len(frames):
            assert self._head is not None
            beyond = frames.slot[rows:] >= self._head + self._size - self._reach
            count = int(np.argmax(beyond)) if beyond.any() else len(beyond)
            assert count, "a jump that Intake should have seen"
            piece = slice(rows, rows + count)
            placed = self._place(frames[piece], counts)
            yield piece, placed, self.settle(self._head - self._reach)
            rows += count

    def _place(self, frames: Frames, counts: SlotCounts) -> Placed:
        assert self._head is not None
        slots, head = frames.slot, self._head
        highest = np.maximum.accumulate(slots)
        before = np.empty_like(slots)
        before[0] = head
        np.maximum(highest[:-1], head, out=before[1:])
        newest = max(head, int(highest[-1]))
        self._clear(head + 1, newest)
        self._head = newest
        at = slots & self._mask
        below, above = (slots - 1) & self._mask, (slots + 1) & self._mask
        if bool((slots > before).all()):
            first = np.ones(len(slots), np.bool_)
            upper = again = conflicting = None
            self._copies[at], self._marks[at] = 1, frames.mark
        else:
            first, upper, again, conflicting = self._sort_out(frames, before, at, above, newest, counts)
        self._delays[at[first]] = frames.delay_ns[first]
        paired = first & (self._copies[below] > 0)
        ipdv = _differences(frames.delay_ns[paired], self._delays[below[paired]])
        if upper is not None and upper.any():
            ipdv = np.concatenate((ipdv, _differences(self._delays[above[upper]], frames.delay_ns[upper])))
        low = min(self._low, int(slots[first].min())) if first.any() else self._low
        counts.expected += newest - head + self._low - low
        counts.received += int(np.count_nonzero(first))
        self._low = low
        return Placed(first, again, conflicting, before, ipdv)

    def _sort_out(
        self, frames: Frames, before: Ints, at: Ints, above: Ints, newest: int, counts: SlotCounts
    ) -> tuple[Flags, Flags, Flags | None, Flags | None]:
        """Of frames that are not all newer than all before: the first of their slots, those of them whose next slot
        had come, and as of :class:`Placed`.
        """
        slots = frames.slot
        timely = slots > before - self._reach
        counts.stale += int(np.count_nonzero(~timely))
        rows = np.flatnonzero(timely)
        found, where = np.unique(slots[rows], return_index=True)
        first = np.zeros(len(slots), np.bool_)
        first[rows[where[self._copies[found & self._mask] == 0]]] = True
        upper = first & (self._copies[above] > 0) & (slots < newest)
        new = at[first]
        self._copies[new], self._marks[new] = 1, frames.mark[first]
        again = timely & ~first
        if not again.any():
            return first, upper, None, None
        conflicting = again & (self._marks[at] != frames.mark)
        counts.duplicated += int(np.count_nonzero(again))
        counts.conflicting += int(np.count_nonzero(conflicting))
        repeated = np.unique(at[again])
        counts.replicated += int(np.count_nonzero(self._copies[repeated] == 1))
        self._copies[repeated] = 2
        return first, upper, again, conflicting

    def settle(self, upto: int) -> Settled:
        """The slots up to ``upto`` that nothing can change any more and that were not told of before."""
        first, end = max(self._settled + 1, self._low), upto + 1
        self._settled = max(self._settled, upto)
        if end <= first:
            return Settled(first, np.zeros(0, np.bool_))
        start, stop = first & self._mask, end & self._mask
        if start < stop:
            return Settled(first, self._copies[start:stop] > 0)
        return Settled(first, np.concatenate((self._copies[start:], self._copies[:stop])) > 0)

    def skip(self, first: int, counts: SlotCounts) -> tuple[Settled, int]:
        """Go on from slot ``first`` after an outage: slots now settled, and how many after them are lost."""
        assert self._head is not None
        settled, head = self.settle(self._head), self._head
        counts.expected += first - 1 - head
        self._copies[:] = 0
        self._head, self._settled = first - 1, first - 1 - self._reach
        return settled, max(0, self._settled - head)

    def rest(self) -> Settled:
        """The slots that are not settled yet, up to the newest; the ring stays as it is."""
        if self._head is None:
            return Settled(0, np.zeros(0, np.bool_))
        settled = self._settled
        rest = self.settle(self._head)
        self._settled = settled
        return rest

    def _clear(self, first: int, last: int) -> None:
        start, stop = first & self._mask, (last + 1) & self._mask
        if last < first:
            return
        if start < stop:
            self._copies[start:stop] = 0
        else:
            self._copies[start:] = 0
            self._copies[:stop] = 0


def _differences(later_ns: Ints, earlier_ns: Ints) -> Ints:
    known = (later_ns != NO_TIME) & (earlier_ns != NO_TIME)
    differences: Ints = (later_ns[known] - earlier_ns[known]) if not known.all() else later_ns - earlier_ns
    return differences
