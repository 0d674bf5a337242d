"""What leaves when: a reel on its way through time, loop after loop, through the fault pipelines. No clock, no socket.

Two times. *Stream time* is that of the recording: the position in it, plus ``round_ns`` for each loop played before.
*Offsets* are wall time from the start of play. The playback clock maps one to the other; a seek, a pause, another speed
and the wrap of an A-B loop each give it a new anchor, and every offset is computed from the last anchor alone. Delays
are wall time, and are added to offsets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from pmutools import timebase
from pmutools.errors import SettingsError
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import Action
from pmutools.pacing import Playback
from pmutools.parsers import Place
from pmutools.timebase import NS
from pmutools.tools.player.cast import Cast
from pmutools.tools.player.dress import dress
from pmutools.tools.player.reel import I64, Reel
from pmutools.tools.player.route import Gate, Route
from pmutools.tools.player.sheet import EMPTY, Sheet, joined
from pmutools.tools.player.stamps import StampPolicy, on_grid, shifted

_BUCKET_NS = 10_000_000
"""What waits for its time is sorted into buckets of this length."""


class Plan:
    """The plan of a run, made as far as it is asked for.

    Parameters
    ----------
    now_ns
        POSIX UTC: the run begins here, with ``shift`` at most a second later. With ``shift`` the first frame is due at
        its own new stamp (plus its recorded latency), so latency at the receiver is what it was in the recording;
        ``now-grid`` begins at a reporting instant. :attr:`start_utc_ns` says when, offset 0.
    loops
        0: for ever.
    timeline
        Actions that concern the player itself, by stream time.
    marks
        Whether anyone wants the ledger's lists of faults.
    """

    def __init__(
        self,
        cast: Cast,
        policy: StampPolicy,
        pipelines: Sequence[Pipeline],
        now_ns: int,
        *,
        speed: Fraction = Fraction(1),
        loops: int = 1,
        timeline: Sequence[Action] = (),
        marks: bool = True,
    ) -> None:
        self.cast, self.policy, self.loops = cast, policy, loops
        self._reel = cast.reel
        self._playback = Playback(0, 0, speed)
        self._route = Route(cast, pipelines, marks=marks)
        self._timeline = deque(timeline)
        self._totals = np.array([track.total for track in self._reel.tracks], np.int64)
        self._period_ns = _shortest_period_ns(cast.reel)
        self._planned_ns = 0
        self._cursor_ns = 0
        self._loop = 0
        self._span_ns = cast.reel.length_ns + cast.latest_ns + 1
        self._spills = False
        """Whether late frames of the round before may still come."""
        self._stop_ns: int | None = None
        self._resumes_ns = 0
        """When a pause for some time ends by itself."""
        self._waiting: dict[int, list[Sheet]] = {}
        self.between_ns: tuple[int, int] | None = None
        """Positions A and B of a loop within the recording."""
        self.ended = False
        """Nothing more comes from the recording; copies that are delayed may still wait."""
        self.start_utc_ns = 0
        self._shift_ns = 0
        self.start_utc_ns = self._aligned(now_ns)

    # --- where it is

    @property
    def position_ns(self) -> int:
        """Position in the recording up to which everything is planned."""
        return self._cursor_ns - self._round_start(self._loop)

    @property
    def loop(self) -> int:
        return self._loop

    @property
    def speed(self) -> Fraction:
        return self._playback.rate

    @property
    def paused(self) -> bool:
        """Whether it waits to be told to go on, or is on its way there by steps."""
        return not self._playback.running or self._stop_ns is not None

    def next_ns(self) -> int | None:
        """When something is to leave, or to be done, next; None while nothing is."""
        times = [sheet.offset_ns[0] for sheet in self._waiting.get(min(self._waiting, default=0), ())]
        if self._playback.running and not self.ended:
            row_ns, until_ns = self._next_row_ns(), self._until_ns()
            times.append(self._playback.target_ns(until_ns if row_ns is None else min(row_ns, until_ns)))
        return int(min(times)) if times else None

    # --- going on

    def until(self, offset_ns: int) -> Sheet:
        """The copies that are to leave before ``offset_ns`` and were not given before, in the order in which they do.

        Copies that will not be sent are among them. A stream's copies of one offset leave in the order of the source.
        """
        fresh: list[Sheet] = []
        while self._playback.running and not self.ended:
            bound_ns = self._playback.media_from(offset_ns)
            to_ns = min(bound_ns, self._until_ns())
            if to_ns > self._cursor_ns:
                fresh.append(self._play(to_ns))
            if not self._turn():
                break
        self._planned_ns = max(self._planned_ns, offset_ns)
        due = [self._part(sheet.in_order(), offset_ns) for sheet in fresh if len(sheet)]
        waited = self._due(offset_ns)
        if not len(waited) and len(due) == 1:
            return due[0]
        return joined([waited, *due]).in_order()

    def _part(self, sheet: Sheet, offset_ns: int) -> Sheet:
        """What leaves before ``offset_ns``; the rest waits."""
        last = int(sheet.offset_ns.searchsorted(offset_ns))
        if last == len(sheet):
            return sheet
        self._wait(sheet.take(slice(last, None)))
        return sheet.take(slice(0, last))

    def _turn(self) -> bool:
        """Do what is to be done where the cursor is; false if there is nothing."""
        if self._stop_ns is not None and self._cursor_ns >= self._stop_ns:
            self._stop_ns = None
            self._playback = Playback(self._here_ns(), self._cursor_ns, self.speed, running=False)
        elif self._timeline and self._timeline[0].at_ns <= self._cursor_ns:
            self._follow(self._timeline.popleft())
        elif self.between_ns is not None and self.position_ns >= self.between_ns[1]:
            self._loop += 1
            before_ns = self._cursor_ns
            self._go(self._here_ns(), self._round_start(self._loop) + self.between_ns[0])
            if self._stop_ns is not None:
                self._stop_ns += self._cursor_ns - before_ns
        elif self._cursor_ns >= self._round_end() and not self._last_round:
            self._loop += 1
            self._spills = self._span_ns > self._reel.round_ns
        elif self._last_round and self._next_row_ns() is None:
            self._end()
        else:
            return False
        return True

    def _follow(self, action: Action) -> None:
        """Do what the timeline says, if it can be done."""
        try:
            self.act(action, self._here_ns())
        except SettingsError as error:
            self._route.warnings.append(f"[at {action.at_ns / NS:g}] {action.verb} {action.argument}: {error}")

    @property
    def _last_round(self) -> bool:
        return self.between_ns is None and self.loops > 0 and self._loop >= self.loops - 1

    def _until_ns(self) -> int:
        """Stream time up to which rows follow each other without anything else to be done."""
        stops = [self._round_end()]
        if self.between_ns is not None:
            stops.append(self._round_start(self._loop) + self.between_ns[1])
        if self._timeline:
            stops.append(self._timeline[0].at_ns)
        if self._stop_ns is not None:
            stops.append(self._stop_ns)
        return max(min(stops), self._cursor_ns)

    def _round_start(self, loop: int) -> int:
        return loop * self._reel.round_ns.numerator // self._reel.round_ns.denominator

    def _round_end(self) -> int:
        start_ns, end_ns = self._round_start(self._loop), self._round_start(self._loop + 1)
        last = self._last_round or self.between_ns is not None  # B may be as late as the last frame
        return max(end_ns, start_ns + self._span_ns) if last else end_ns

    def _rounds(self) -> list[int]:
        """The rounds that rows at the cursor may belong to: the present one, and one whose last frames are late."""
        if self._spills and self._cursor_ns - self._round_start(self._loop - 1) >= self._span_ns:
            self._spills = False
        return [self._loop - 1, self._loop] if self._spills else [self._loop]

    def _next_row_ns(self) -> int | None:
        """Stream time of the first row from the cursor on; None where there is none."""
        times = []
        for loop in self._rounds():
            base_ns = self._round_start(loop)
            if (position := self.cast.next_position(self._cursor_ns - base_ns)) is not None:
                times.append(base_ns + position)
        return min(times, default=None)

    def _here_ns(self) -> int:
        """The offset of the cursor."""
        return self._playback.target_ns(self._cursor_ns)

    def _play(self, to_ns: int) -> Sheet:
        """What becomes of the rows from the cursor to ``to_ns``."""
        sheets = [self._play_round(loop, to_ns) for loop in self._rounds()]
        self._cursor_ns = to_ns
        return joined(sheets)

    def _play_round(self, loop: int, to_ns: int) -> Sheet:
        base_ns, reel = self._round_start(loop), self._reel
        rows, parts, position = self.cast.between(self._cursor_ns - base_ns, to_ns - base_ns)
        if not len(rows):
            return EMPTY
        stream_ns = position + base_ns
        offsets = self._playback.targets_ns(stream_ns)
        stamps = self._stamps(rows, loop, offsets)
        whole = self.policy is StampPolicy.SHIFT and reel.fps is None
        dressed = dress(
            self.cast, rows, parts, None if self.policy is StampPolicy.KEEP else stamps, whole_seconds=whole
        )
        index = reel.rows.number[rows] + loop * self._totals[reel.rows.track[rows]]
        return self._route.through(rows, parts, index, offsets, stream_ns, stamps, dressed)

    def _stamps(self, rows: I64, loop: int, offsets: I64) -> I64:
        """What the rows' frames are to carry in a round, POSIX UTC ns."""
        stamps = self._reel.rows.stamp_ns[rows]
        if self.policy is StampPolicy.KEEP:
            return self._reel.rows.source_ns[rows]
        if self.policy is StampPolicy.SHIFT:
            return shifted(stamps, self._reel, loop, self._shift_ns)
        times = self.start_utc_ns + offsets
        if self.policy is StampPolicy.NOW:
            return times
        editions = self._reel.rows.edition[rows]
        for edition in np.unique(editions):
            chosen = editions == edition
            if rate := self._rate(int(edition)):
                times[chosen] = on_grid(times[chosen], rate)
        return times

    def _rate(self, edition: int) -> Fraction:
        return Fraction(self._reel.fps) if self._reel.fps is not None else self._reel.editions[edition].rate

    def _wait(self, sheet: Sheet) -> None:
        """Keep copies until their time comes."""
        sheet = sheet.in_order()
        buckets = sheet.offset_ns // _BUCKET_NS
        if not len(sheet):
            return
        if buckets[0] == buckets[-1]:
            self._waiting.setdefault(int(buckets[0]), []).append(sheet.compact())
            return
        edges = np.flatnonzero(np.diff(buckets)) + 1
        for first, last in zip([0, *edges], [*edges, len(sheet)], strict=True):
            piece = sheet.take(slice(first, last)).compact()
            self._waiting.setdefault(int(buckets[first]), []).append(piece)

    def _due(self, offset_ns: int) -> Sheet:
        """What waits and leaves before ``offset_ns``."""
        if not self._waiting:
            return EMPTY
        keys = sorted(key for key in self._waiting if key * _BUCKET_NS < offset_ns)
        if not keys:
            return EMPTY
        found = joined([sheet for key in keys for sheet in self._waiting.pop(key)]).in_order()
        last = int(np.searchsorted(found.offset_ns, offset_ns))
        if last < len(found):
            self._waiting[int(found.offset_ns[last]) // _BUCKET_NS] = [found.take(slice(last, None))]
            found = found.take(slice(0, last))
        return found

    def _end(self) -> None:
        self.ended = True
        self._wait(self._route.end())

    # --- being told

    def act(self, action: Action, offset_ns: int) -> None:
        """Do a player's verb at ``offset_ns``, or as soon after what is planned already as can be.

        Raises SettingsError for what the recording does not have.
        """
        offset_ns = max(offset_ns, self._planned_ns)
        self._catch_up(offset_ns)
        match action.verb, *action.values:
            case ["pause"]:
                self._playback = Playback(offset_ns, self._cursor_ns, self.speed, running=False)
                self._stop_ns = None
            case ["pause", int(for_ns)]:
                self._go(offset_ns + for_ns, self._cursor_ns)
                self._stop_ns, self._resumes_ns = None, offset_ns + for_ns
            case ["resume"]:
                if self.paused or offset_ns < self._resumes_ns:
                    self._go(offset_ns, self._cursor_ns)
                    self._stop_ns = None
            case ["step", int(count)]:
                self._step(offset_ns, count)
            case ["speed", Fraction() as speed]:
                at_ns = self._here_ns() if self._playback.running else offset_ns
                self._playback = Playback(at_ns, self._cursor_ns, speed, self._playback.running)
            case ["seek", Place() as place]:
                self.seek(offset_ns, self._position(place))
            case ["loop"]:
                self.between_ns = None
            case ["loop", Place() as a, Place() as b]:
                self._loop_between(offset_ns, self._position(a), self._position(b))
            case _:
                raise AssertionError(f"{action} is no order to a player")

    def _catch_up(self, offset_ns: int) -> None:
        """Bring the cursor to where it is at ``offset_ns``, but not beyond what is to leave, or to be done, before."""
        if not self._playback.running or self.ended:
            return
        stops = [self._playback.media_from(offset_ns), self._until_ns()]
        if (row_ns := self._next_row_ns()) is not None:
            stops.append(row_ns)
        self._cursor_ns = max(self._cursor_ns, min(stops))

    def _loop_between(self, offset_ns: int, first_ns: int, last_ns: int) -> None:
        """Play a part of the recording over and over; a part of less than a reporting interval is refused."""
        last_ns = min(last_ns, max(self._span_ns, self._round_start(1)))
        if last_ns - first_ns < round(self._period_ns):
            raise SettingsError(
                f"a loop from {first_ns / NS:g} s to {last_ns / NS:g} s is shorter than a reporting interval"
                if last_ns > first_ns
                else f"a loop from {first_ns / NS:g} s on: its end, or the recording's, is before it"
            )
        next_ns = self.cast.next_position(first_ns)
        if next_ns is None or next_ns >= last_ns:
            raise SettingsError(f"no frame is due between {first_ns / NS:g} s and {last_ns / NS:g} s")
        self.between_ns = (first_ns, last_ns)
        if not first_ns <= self.position_ns < last_ns:
            self.seek(offset_ns, first_ns)

    def _position(self, place: Place) -> int:
        """Within the recording; of a UTC time that of the first frame of then, or after."""
        if place.relative:
            return place.ns
        reel = self._reel
        later = np.flatnonzero(reel.rows.source_ns >= place.ns)
        if not len(later):
            return reel.length_ns
        due_ns, row = reel.rows.due_ns, int(later[0])
        early_ns = int(due_ns[row]) - (int(reel.rows.source_ns[row]) - place.ns)
        if row:
            early_ns = min(max(early_ns, int(due_ns[row - 1]) + 1), int(due_ns[row]))
        return early_ns - reel.first_due_ns

    def seek(self, offset_ns: int, position_ns: int) -> None:
        """Go to a position, in the present round; a paused player stays paused."""
        running = not self.paused
        self.ended, self._stop_ns = False, None
        position_ns = min(max(position_ns, 0), self._reel.length_ns)
        self._go(offset_ns, self._round_start(self._loop) + position_ns)
        if not running:
            self._playback = Playback(offset_ns, self._cursor_ns, self.speed, running=False)

    def _step(self, offset_ns: int, count: int) -> None:
        """Play on for ``count`` reporting intervals; what is due within one, of all streams, is one instant."""
        if self._stop_ns is not None:  # still on the way
            self._stop_ns += int(self._period_ns * count)
            return
        if not self._find_frame(offset_ns):
            self._playback = replace(self._playback, running=False)
            return
        margin_ns = max(self._period_ns - self.cast.latest_ns, Fraction(0)) / 2
        self._stop_ns = self._cursor_ns + max(1, int(self._period_ns * count - margin_ns))
        self._playback = Playback(offset_ns, self._cursor_ns, self.speed)
        if self.policy is StampPolicy.SHIFT:
            behind_ns = self.start_utc_ns + offset_ns - self._recorded_due_ns()
            self._shift_ns = behind_ns // NS * NS

    def _find_frame(self, offset_ns: int) -> bool:
        """Bring the cursor to the next frame, and do what is to be done before; false where there is none."""
        while not self.ended:
            position, until_ns = self.cast.next_position(self.position_ns), self._until_ns()
            if position is not None and (stream_ns := self._round_start(self._loop) + position) < until_ns:
                self._cursor_ns = stream_ns
                return True
            if position is None and self._last_round:
                return False
            self._cursor_ns = until_ns
            self._playback = Playback(offset_ns, self._cursor_ns, self.speed)
            if not self._turn():
                return False
        return False

    def _go(self, offset_ns: int, stream_ns: int) -> None:
        """Go on at ``stream_ns``, from ``offset_ns`` or as soon after it as the stamps allow."""
        self._cursor_ns, self._resumes_ns, self._spills = stream_ns, 0, False
        at_ns = self._aligned(self.start_utc_ns + offset_ns) - self.start_utc_ns
        self._playback = Playback(at_ns, stream_ns, self.speed)

    def _aligned(self, utc_ns: int) -> int:
        """The first UTC time from ``utc_ns`` on at which what is at the cursor may be sent."""
        if self.policy is StampPolicy.SHIFT:
            due_ns = self._recorded_due_ns()
            self._shift_ns = -((due_ns - utc_ns) // NS) * NS
            return due_ns + self._shift_ns
        if self.policy is StampPolicy.NOW_GRID and (rate := self._rate(int(self._reel.rows.edition[0]))):
            position = self.cast.next_position(self.position_ns)
            wait_ns = 0 if position is None else int((position - self.position_ns) / self.speed)
            since_ns = utc_ns + wait_ns - self.start_utc_ns  # so offsets are the same whenever a run begins
            index = -(-since_ns * rate.numerator // (rate.denominator * NS))
            return self.start_utc_ns + timebase.slot_time_ns(index, rate) - wait_ns
        return utc_ns

    def _recorded_due_ns(self) -> int:
        """When what is at the cursor was due by its recorded stamps, this round's seconds added."""
        reel, position_ns = self._reel, self.position_ns
        row = min(int(np.searchsorted(reel.rows.due_ns, reel.first_due_ns + position_ns)), len(reel.rows) - 1)
        stamp_ns = int(shifted(reel.rows.stamp_ns[row : row + 1], reel, self._loop, 0)[0])
        due_ns = int(reel.rows.due_ns[row])
        latency_ns = 0 if reel.interval_ns is not None else due_ns - int(reel.rows.stamp_ns[row])
        return stamp_ns + latency_ns - (due_ns - reel.first_due_ns - position_ns)

    # --- streams

    def warnings(self) -> list[str]:
        """What a person should know of what was planned since last asked."""
        warnings, self._route.warnings = self._route.warnings, []
        return warnings

    def gates(self) -> list[Gate]:
        """What TCP clients are to see of streams that fall silent, and come back, since this was last asked."""
        gates, self._route.gates = self._route.gates, []
        return gates

    def fault(self, action: Action) -> list[int]:
        """Do a stream's verb, from the next planned frame on; gives the parts that it concerns."""
        return self._route.act(action)


def _shortest_period_ns(reel: Reel) -> Fraction:
    """The shortest time between two frames of a stream; a second where no rate is known."""
    periods = [reel.period_ns(reel.editions[edition].rate) for edition in np.unique(reel.rows.edition)]
    return min(filter(None, periods), default=Fraction(NS))
