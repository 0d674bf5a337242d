"""Sheets to sockets: each copy at its time, and in its place what is not a copy: changed configurations, hang-ups."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence

import numpy as np

from pmutools.c37118.session import Served
from pmutools.clock import Clock
from pmutools.net.cargo import Frames
from pmutools.net.server import Senders
from pmutools.tools.player.cast import Cast
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.reel import I64
from pmutools.tools.player.results import Results
from pmutools.tools.player.route import Gate
from pmutools.tools.player.sheet import FAILED, SENT, SKIPPED, Sheet, changes

TOGETHER_FRAMES = 1024
"""Frames that leave with one system call at most."""

Serve = Callable[[int], bool]
"""Answers clients until a monotonic time; false if told to stop before."""


class Delivery:
    """Sends what a plan gives; ``offers`` makes what is answered and announced for a part and an edition."""

    def __init__(
        self,
        senders: Senders,
        handles: Sequence[int],
        cast: Cast,
        clock: Clock,
        results: Results,
        offers: Callable[[int, int], Served],
        ledger: LedgerWriter | None,
    ) -> None:
        self._senders, self._cast, self._clock = senders, cast, clock
        self._handles = np.array(handles, np.int64)
        self._results, self._offers, self._ledger = results, offers, ledger
        self._editions = cast.editions.copy()

    def send(self, sheet: Sheet, anchor_ns: int, serve: Serve) -> bool:
        """Send a sheet whose offset 0 is at ``anchor_ns``; false if told to stop, with the rest left out."""
        count = len(sheet)
        if not count:
            return True
        base = self._ledger.rows if self._ledger is not None else 0
        frames = Frames(
            self._handles[sheet.part],
            sheet.at,
            sheet.nbytes,
            sheet.wire,
            sheet.fate == SENT,
            np.arange(base, base + count),
            [extra.write if extra is not None else None for extra in sheet.extra] if sheet.special else None,
        )
        cargo = self._senders.load(frames)
        offsets, stops = sheet.offset_ns.tolist(), [*self._stops(sheet), count]
        ends, times = [0], list[int]()
        counts, refused = cargo.counts, list[int]()
        done, going, monotonic_ns = 0, serve(self._clock.monotonic_ns()), self._clock.monotonic_ns
        while done < count and going:
            due = bisect_right(offsets, monotonic_ns() - anchor_ns, done)
            if due == done:
                going = serve(anchor_ns + offsets[done])
                continue
            if done == stops[0]:
                self._reconfigure(sheet, stops.pop(0))
            if self._senders.stale(cargo):
                cargo = self._senders.load(frames)
                counts = np.concatenate([counts[:done], cargo.counts[done:]])
            due = min(due, stops[0], done + TOGETHER_FRAMES)
            refused += self._senders.send(cargo, done, due)
            times.append(monotonic_ns() - anchor_ns)
            ends.append(due)
            done = due
        if done < count:
            sheet, counts = sheet.take(slice(0, done)), counts[:done]
        self._account(sheet, np.repeat(np.array(times, np.int64), np.diff(ends)), counts, refused)
        return going

    def _account(self, sheet: Sheet, left_ns: I64, counts: I64, refused: list[int]) -> None:
        """What became of copies that left at ``left_ns``, for ``counts`` destinations; ``refused`` by a destination."""
        fate = sheet.fate
        if refused or not counts.all():
            refusals = np.bincount(refused, minlength=len(sheet))
            fate = fate.copy()
            fate[(fate == SENT) & (refusals >= counts) & (refusals > 0)] = FAILED
            fate[(fate == SENT) & (counts == 0)] = SKIPPED
        self._results.add(sheet.part, fate, left_ns - sheet.offset_ns)
        if self._ledger is not None:
            self._ledger.add(sheet, fate, left_ns)
            self._ledger.stamp(*self._senders.departures())

    def _stops(self, sheet: Sheet) -> list[int]:
        """The rows before which a configuration is changed: what is not sent changes none."""
        sent = np.flatnonzero(sheet.fate == SENT)
        stops: list[int] = sent[changes(self._editions, sheet.part[sent], sheet.edition[sent])].tolist()
        return stops

    def _reconfigure(self, sheet: Sheet, row: int) -> None:
        """Offer another configuration; everyone who gets the data gets it before them, asked for or not."""
        part, edition, extra = int(sheet.part[row]), int(sheet.edition[row]), sheet.extra[row]
        before, self._editions[part] = int(self._editions[part]), edition
        if self._cast.config(part, before) == self._cast.config(part, edition):
            return
        handle, offer = int(self._handles[part]), self._offers(part, edition)
        self._senders.replace(handle, offer)
        if extra is None or extra.notice:
            self._senders.inform(handle)

    def turn(self, gate: Gate) -> None:
        """Hang up on a stream's TCP clients, or let them come back."""
        handle = int(self._handles[gate.part])
        if gate.hangup is None:
            self._senders.take_up(handle)
        else:
            self._senders.hang_up(handle, gate.hangup)
