"""Takes what comes, and the time; tells how all streams are."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import STAT_DATA_ERROR_MASK
from pmutools.c37118.demux import Loss, Message
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.measure.columns import are_synchronised
from pmutools.measure.stream import WAIT_NS
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS
from pmutools.tools.news import told
from pmutools.tools.watch.live import HIDDEN, Frames, Live, Round
from pmutools.tools.watch.recent import RECENT_NS, Recent, shares
from pmutools.tools.watch.slots import SlotTable
from pmutools.tools.watch.snapshot import STATES, Snapshot, StreamState
from pmutools.tools.watch.table import Flags, Segments

STREAMS = 1 << 14
"""Streams kept, some 8 KB each; frames of more are counted as ``untold``."""
FOREIGN = 64
"""Senders that nobody asked for, of those."""
_DATA_ERROR = np.uint16(STAT_DATA_ERROR_MASK)
_STATE_OF = {
    LinkKind.LOST: StreamState.LOST,
    LinkKind.FAILED: StreamState.FAILED,
    LinkKind.UNANSWERED: StreamState.UNANSWERED,
    LinkKind.NOTHING: StreamState.NOTHING,
    LinkKind.NO_CONFIG: StreamState.NO_CONFIG,
    LinkKind.FOREIGN: StreamState.FOREIGN,
    LinkKind.CONFIGURED: StreamState.WAITING,
}
_SETTLED = frozenset((LinkKind.CONNECTED, LinkKind.CONFIGURED, LinkKind.STREAMING))
"""News after which an endpoint needs no row of its own."""

Key = tuple[str, str, str, int | None]


class Watch:
    """See the package. Times ``now_ns`` are monotonic, the same clock throughout.

    ``name`` gives a stream's name, where it has one other than by its configuration. ``wait_ns`` is the
    concentrator's: what comes later is late.
    """

    def __init__(
        self,
        *,
        name: Callable[[Flow, StreamConfig], str | None] = lambda flow, config: None,
        wait_ns: int = WAIT_NS,
        streams: int = STREAMS,
    ) -> None:
        self.wait_ns = wait_ns
        self.frames = self.untold = self.own_drops = 0
        self.skipped: Counter[str] = Counter()
        """Bytes that are in no frame, by reason."""
        self._name, self._streams, self._foreign = name, streams, 0
        self._rows: dict[Key, int] = {}
        self._known: dict[tuple[Flow, int], int] = {}
        """The same by the flow itself: the short way."""
        self._configs: list[StreamConfig | None] = []
        self._names: list[str] = []
        self._keys: list[Key] = []
        self._news: list[str] = []
        self._endpoints: dict[int, int] = {}
        """Rows of endpoints without a stream, by owner."""
        self._owned: defaultdict[int, set[int]] = defaultdict(set)
        """Rows of streams, by owner."""
        self._live, self._slots, self._recent = Live(), SlotTable(), Recent()
        self._started_ns: int | None = None

    def __len__(self) -> int:
        """Rows that there are."""
        return len(self._names)

    def add(self, items: Iterable[Block | Message | Loss], now_ns: int) -> None:
        """A round of :meth:`pmutools.tools.live.LiveSource.rounds`, and the time at its end."""
        if self._started_ns is None:
            self._started_ns = now_ns
        before_ns = int(self._recent.ended_ns[self._recent.at]) or now_ns
        new = self._recent.pass_time(now_ns)
        gathered = Round()
        for item in items:
            if isinstance(item, Block):
                if (row := self._row_of(item.flow, item.batch.config)) is None:
                    self.untold += len(item.batch)
                elif len(item.batch):
                    gathered.add(row, item.batch)
            elif isinstance(item, Loss):
                self.skipped[str(item.skipped.reason)] += item.skipped.nbytes
        if gathered.rows:
            self._count(*gathered.gathered(), before_ns, now_ns)
        if new:
            self._recent.refresh(len(self))

    def hear(self, event: LinkEvent, now_ns: int) -> None:
        """Take note of news of a connection or a stream."""
        if event.kind is LinkKind.OWN_DROPS:
            self.own_drops += event.datagrams
            return
        state = _STATE_OF.get(event.kind)
        rows = self._rows_of(event)
        if not rows and state is not None and (row := self._new_row_of(event)) is not None:
            rows = [row]
        for row in rows:
            if state is not None and not (state is StreamState.WAITING and self._live.last_ns[row] != NO_TIME):
                self._live.state[row] = STATES.index(state)
            if event.kind is not LinkKind.STREAMING:  # that is its state
                self._news[row] = told(event)
                self._live.news_ns[row] = now_ns
        if event.kind in _SETTLED:
            for owner in event.owners:
                self._owned[owner].update(rows)
                if (row := self._endpoints.get(owner, -1)) >= 0 and row not in rows:
                    self._live.state[row] = HIDDEN

    def look(self, now_ns: int) -> Snapshot:
        """How all of them are now."""
        live, slots, recent = self._live, self._slots, self._recent
        shown = np.flatnonzero(live.state[: len(self)] != HIDDEN)
        if recent.begun_ns is None:
            recent.pass_time(now_ns)
        places = recent.within(RECENT_NS)
        sums = {name: getattr(recent, name)[shown][:, places].sum(1, dtype=np.int64) for name in Recent.COUNTS}
        loss = np.clip(1 - shares(sums["unique"], sums["expected"]), 0, 1)
        order = recent.order()
        p50, p99, most, all_p50, all_p99 = recent.percentiles_ms[shown].T
        if (np.isnan(all_p50) & (recent.delays[shown] > 0)).any():  # their turn has not come yet
            recent.refresh_all(len(self))
            p50, p99, most, all_p50, all_p99 = recent.percentiles_ms[shown].T
        rate = self._rate(shown, NS, now_ns)
        lost = slots.expected[shown] - slots.received[shown]
        columns = {
            "name": [self._names[row] for row in shown.tolist()],
            "idcode": np.array([-1 if self._keys[row][3] is None else self._keys[row][3] for row in shown.tolist()]),
            "transport": [self._keys[row][0] for row in shown.tolist()],
            "where": [self._keys[row][1] for row in shown.tolist()],
            "state": live.states(shown, now_ns),
            "silent_s": live.since_s(live.last_ns[shown], now_ns),
            "configured_hz": live.rate[shown],
            "rate_hz": rate,
            "recent_hz": self._rate(shown, RECENT_NS, now_ns),
            "frames": live.frames[shown],
            "lost": lost,
            "duplicated": slots.duplicated[shown],
            "late": live.late[shown],
            "stale": slots.stale[shown],
            "recent_loss": loss,
            "recent_complete": np.clip(shares(sums["unique"] - sums["late"], sums["expected"]), 0, 1),
            "recent_good": shares(sums["good"], sums["frames"]),
            "p50_ms": p50,
            "p99_ms": p99,
            "max_ms": most,
            "all_p50_ms": all_p50,
            "all_p99_ms": all_p99,
            "all_max_ms": recent.max_ms[shown],
            "jitter_ms": np.where(recent.delays[shown] > 1, recent.jitter_ms[shown], np.nan),
            "frequency_hz": live.frequency_hz[shown],
            "stat": live.stat[shown],
            "time_quality": live.time_quality[shown],
            "stations": np.array([len(config.stations) if (config := self._configs[row]) else 0 for row in shown]),
            "news": [self._news[row] for row in shown.tolist()],
            "news_s": live.since_s(live.news_ns[shown], now_ns),
            "frequencies_hz": recent.frequency_hz[shown][:, order],
            "delays_ms": recent.most_ms[shown][:, order],
        }
        return Snapshot(
            columns,
            running_s=(now_ns - self._started_ns) / NS if self._started_ns is not None else 0.0,
            frames=self.frames,
            rate_hz=float(np.nansum(rate)),
            lost=int(lost.sum()),
            duplicated=int(slots.duplicated[shown].sum()),
            own_drops=self.own_drops,
            skipped=dict(self.skipped),
            untold=self.untold,
        )

    # --- rows

    def _row_of(self, flow: Flow, config: StreamConfig) -> int | None:
        row = self._known.get((flow, config.idcode))
        if row is None:
            key = _key(flow, config.idcode)
            row = self._rows.get(key)
            if row is None and (row := self._new_row(key)) is None:
                return None
            if len(self._known) >= 2 * self._streams:  # of connections that are long gone
                self._known.clear()
            self._known[flow, config.idcode] = row
        if self._configs[row] is not config:
            self._configure(row, flow, config)
        return row

    def _new_row(self, key: Key, name: str = "") -> int | None:
        row = len(self)
        if row >= self._streams:
            return None
        for table in (self._live, self._slots, self._recent):
            table.grow(row + 1)
        self._rows[key] = row
        self._keys.append(key)
        self._names.append(name or f"IDCODE {key[3]}")
        self._news.append("")
        self._configs.append(None)
        return row

    def _configure(self, row: int, flow: Flow, config: StreamConfig) -> None:
        before, self._configs[row] = self._configs[row], config
        if before == config:
            return
        self._names[row] = self._name(flow, config) or config.name
        if before is None or before.rate != config.rate:
            self._slots.restart(row, self._live.set_rate(row, config.rate))

    def _rows_of(self, event: LinkEvent) -> list[int]:
        """The rows that news are about."""
        if event.flow is None:
            if streams := set().union(*(self._owned.get(owner, ()) for owner in event.owners)):
                return sorted(streams)
            row = self._rows.get(_place(event))
            return [] if row is None else [row]
        if event.idcode is not None:
            row = self._rows.get(_key(event.flow, event.idcode))
            return [] if row is None else [row]
        wanted = _key(event.flow, None)[:3]
        return [row for key, row in self._rows.items() if key[:3] == wanted]

    def _new_row_of(self, event: LinkEvent) -> int | None:
        if event.kind is LinkKind.CONFIGURED and event.flow is None:
            return None
        if event.kind is LinkKind.FOREIGN:
            self._foreign += 1
            if self._foreign > FOREIGN:
                return None
        if event.flow is not None and event.idcode is not None:
            return self._new_row(_key(event.flow, event.idcode))
        key = _place(event)
        if (row := self._rows.get(key)) is None and (row := self._new_row(key, event.where)) is not None:
            self._endpoints.update(dict.fromkeys(event.owners, row))
        return row

    # --- counting

    def _count(self, segments: Segments, frames: Frames, before_ns: int, now_ns: int) -> None:
        slots, recent, rows = self._slots, self._recent, segments.rows
        self.frames += len(frames.time_ns)
        self._live.note(segments, frames, before_ns, now_ns)
        known = frames.arrival_ns != NO_TIME
        expected, duplicated = slots.expected[rows], slots.duplicated[rows]
        slot = self._live.slots(segments, frames.time_ns, slots.head)
        first = slots.add(segments, slot, np.where(known, frames.arrival_ns, frames.time_ns))
        delay_ns = frames.arrival_ns - frames.time_ns
        timed: Flags = first & known
        late = segments.sums(timed & (delay_ns > self.wait_ns))
        self._live.late[rows] += late
        locked = are_synchronised(frames.time_quality, frames.stat) & (frames.stat & _DATA_ERROR == 0)
        counts = {
            "frames": segments.lengths,
            "good": segments.sums(locked & frames.valid & ~np.isnan(frames.frequency_hz)),
            "expected": slots.expected[rows] - expected,
            "unique": segments.sums(first),
            "late": late,
            "duplicated": slots.duplicated[rows] - duplicated,
        }
        recent.count(rows, counts)
        recent.add_frequency(segments, frames.frequency_hz)
        if timed.all():
            recent.add_delays(segments, delay_ns)
        elif timed.any():
            there = segments.sums(timed)
            some = there > 0
            recent.add_delays(Segments.of(rows[some], there[some].astype(np.intp)), delay_ns[timed])

    # --- looking

    def _rate(self, shown: npt.NDArray[np.intp], length_ns: int, now_ns: int) -> npt.NDArray[np.float64]:
        """Frames a second over the last ``length_ns``, or since the stream began if that is later."""
        recent, live = self._recent, self._live
        places, since_ns = recent.passed(length_ns)
        frames = recent.frames[shown][:, places].sum(1, dtype=np.int64)
        until_ns = max(int(recent.ended_ns[recent.at]), since_ns)
        if now_ns - until_ns > length_ns:
            frames[:] = 0
        passed_ns = until_ns - np.maximum(live.first_ns[shown], since_ns)
        begun = (live.last_ns[shown] != NO_TIME) & (passed_ns > 0)
        found: npt.NDArray[np.float64] = np.divide(frames * NS, passed_ns, out=np.full(len(shown), np.nan), where=begun)
        return found


def _key(flow: Flow, idcode: int | None) -> Key:
    """A device that connects again, or sends from another port, goes on in its row."""
    source = flow.host if flow.transport == "udp" else flow.source
    return flow.transport, source, flow.destination if flow.transport == "udp" else "", idcode


def _place(event: LinkEvent) -> Key:
    """The row of an endpoint that has no stream yet."""
    return event.where.partition("://")[0], event.where, "", event.idcode
