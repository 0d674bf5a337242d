"""From the gate to the wire: drop and loss, duplicates, delay, reordering, rate and slots, segmentation."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pmutools.draws import Draws
from pmutools.impair.blocks import chance
from pmutools.impair.delays import ByIndex, Delay, DelaySource, fixed
from pmutools.impair.grammar import named_parts
from pmutools.impair.link import Rate, RateLink, Slot, SlotLink
from pmutools.impair.losses import Loss, Lost
from pmutools.impair.moment import Moment, Test
from pmutools.impair.outgoing import Fate, Outgoing
from pmutools.impair.reorder import Duplicate, Leaving, Reorder, Reordering
from pmutools.impair.segment import Segment, Segmenting
from pmutools.impair.selectors import Selector, is_data
from pmutools.impair.stages import Drop, Stages


class Transmission:
    """The stages of one stream that decide whether, when, how often and in which order frames leave.

    ``draws`` gives the draws of a stage by its name.
    """

    def __init__(self, draws: Callable[[str], Draws]) -> None:
        self._draws = draws
        self._drops: list[Test] = []
        self._losses: list[tuple[Lost, Test]] = []
        self._copies: tuple[Callable[[Moment], int], Test, int] | None = None
        self._delays: list[tuple[DelaySource, Test]] = []
        self._keep_order = False
        self._last_ns = 0
        self._reordering: Reordering | None = None
        self._rate: RateLink | None = None
        self._slot: SlotLink | None = None
        self._segmenting: Segmenting | None = None
        self._after = False
        self._setters: dict[str, Callable[[Any], None]] = {
            "drop": self._set_drop,
            "loss": self._set_loss,
            "duplicate": self._set_duplicate,
            "delay": self._set_delay,
            "reorder": self._set_reorder,
            "rate": self._set_rate,
            "slot": self._set_slot,
            "segment": self._set_segment,
        }

    @property
    def holding(self) -> bool:
        """Whether a frame waits for others to overtake it."""
        return self._reordering is not None and self._reordering.holding

    def change(self, option: str, stages: Stages) -> tuple[Outgoing, ...]:
        """Put one option anew to work; gives what its old state held back."""
        flushed = self.flush() if option == "reorder" else ()
        self._setters[option](getattr(stages, option))
        self._after = any((self._reordering, self._rate, self._slot, self._segmenting))
        return flushed

    def _set_drop(self, parts: tuple[Drop, ...]) -> None:
        self._drops = [self._test(part.when, name) for name, part in named_parts("drop", parts)]

    def _set_loss(self, parts: tuple[Loss, ...]) -> None:
        self._losses = [
            (part.model.lost(self._draws(name)), self._test(part.when, name))
            for name, part in named_parts("loss", parts)
        ]

    def _set_duplicate(self, parts: tuple[Duplicate, ...]) -> None:
        self._copies = None
        for part in parts:
            self._copies = chance(self._draws("duplicate"), part.p), self._test(part.when, "duplicate"), part.count

    def _set_delay(self, parts: tuple[Delay, ...]) -> None:
        self._keep_order = any(part.order == "keep" for part in parts)
        self._delays = [
            (part.source(self._draws(name)), self._test(part.when, name)) for name, part in named_parts("delay", parts)
        ]

    def _set_reorder(self, parts: tuple[Reorder, ...]) -> None:
        self._reordering = None
        for part in parts:
            self._reordering = Reordering(part, self._draws("reorder"), self._test(part.when, "reorder"))

    def _set_rate(self, parts: tuple[Rate, ...]) -> None:
        self._rate = None
        for part in parts:
            self._rate = RateLink(part, self._test(part.when, "rate"))

    def _set_slot(self, parts: tuple[Slot, ...]) -> None:
        self._slot = None
        for part in parts:
            self._slot = SlotLink(part, self._draws("slot"), self._test(part.when, "slot"))

    def _set_segment(self, parts: tuple[Segment, ...]) -> None:
        self._segmenting = Segmenting(parts, self._draws) if parts else None

    def rehearse(self, at: Moment) -> None:
        """Draw what is drawn for a frame and those after it, so that it is there when they come."""
        for lost, _ in self._losses:
            lost(at)
        if self._copies is not None:
            self._copies[0](at)
        for source, _ in self._delays:
            source(at)

    def copies(self, at: Moment) -> int:
        """How many copies of a frame leave, 0 where it is dropped or lost; for frames that wait for nothing."""
        if any(drops(at) for drops in self._drops) or any(lost(at) and selected(at) for lost, selected in self._losses):
            return 0
        if self._copies is None:
            return 1
        happens, selected, count = self._copies
        return 1 + count if happens(at) and selected(at) else 1

    def send(self, row: Outgoing, at: Moment) -> tuple[Outgoing, ...]:
        """The rows of a frame that passed the gate, due at ``row.offset_ns``."""
        for drops in self._drops:
            if drops(at):
                return (row._replace(fate=Fate.DROPPED),)
        for lost, selected in self._losses:
            if lost(at) and selected(at):
                return (row._replace(fate=Fate.LOST),)
        extra = 0
        if self._copies is not None:
            happens, selected, count = self._copies
            extra = count if happens(at) and selected(at) else 0
        rows: tuple[Outgoing, ...] = ()
        for copy in range(1 + extra):
            then = at._replace(lane=at.lane + copy) if copy else at
            delay_ns = 0
            for source, selected in self._delays:
                if selected(then):
                    delay_ns += source(then)
            leaves_ns = row.offset_ns + max(0, delay_ns)
            if self._keep_order:
                leaves_ns = self._last_ns = max(leaves_ns, self._last_ns)
            late_ns = leaves_ns - row.offset_ns
            out = row._replace(copy=copy, offset_ns=leaves_ns, delay_ns=late_ns)
            rows += self._link(self._reordered(Leaving(out, then))) if self._after else (out,)
        return rows

    def delay_by_index(self) -> ByIndex | None:
        """The delays of data frames by their index, where nothing else happens to them and nothing else counts."""
        others = self._drops or self._losses or self._copies or self._after
        if others or self._keep_order or len(self._delays) > 1:
            return None
        if not self._delays:
            return NO_DELAY
        source, selected = self._delays[0]
        return source.indexed if selected is is_data else None

    def flush(self) -> tuple[Outgoing, ...]:
        """What reordering still holds back."""
        return self._link(self._reordering.close()) if self._reordering else ()

    def _reordered(self, leaving: Leaving) -> Iterable[Leaving]:
        return self._reordering.apply(leaving) if self._reordering else (leaving,)

    def _link(self, leaving: Iterable[Leaving]) -> tuple[Outgoing, ...]:
        rows = list[Outgoing]()
        for outgoing, at in leaving:
            row = self._rate.apply(outgoing, at) if self._rate else outgoing
            if row.fate is Fate.SENT:
                row = self._slot.apply(row, at) if self._slot else row
                row = self._segmenting.apply(row, at) if self._segmenting else row
            rows.append(row)
        return tuple(rows)

    def _test(self, selector: Selector, stage: str) -> Test:
        return selector.test(self._draws(f"{stage}.when"))


NO_DELAY = fixed(0)
