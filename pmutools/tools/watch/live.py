"""The last of each stream, and the blocks of a round as columns."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.measure.columns import any_station
from pmutools.timebase import NS
from pmutools.tools.watch.snapshot import STATES, StreamState
from pmutools.tools.watch.table import Column, Flags, Ints, Segments, Table

QUIET_NS = 2 * NS
QUIET_PERIODS = 5
"""A stream is silent after 2 s, or five reporting intervals if that is longer."""
HIDDEN, STREAMING, SILENT = -1, STATES.index(StreamState.STREAMING), STATES.index(StreamState.SILENT)
"""Codes of states; a hidden row is an endpoint's that has streams by now."""


class Live(Table):
    """The last of each stream."""

    COLUMNS: ClassVar = {
        "state": Column(np.int8, STATES.index(StreamState.WAITING)),
        "first_ns": Column(np.int64, NO_TIME),
        "last_ns": Column(np.int64, NO_TIME),
        "quiet_ns": Column(np.int64, QUIET_NS),
        "rate": Column(np.float64, np.nan),
        "per_second": Column(np.int64),
        "seconds_per_frame": Column(np.int64, 1),
        "frames": Column(np.int64),
        "late": Column(np.int64),
        "stat": Column(np.uint16),
        "time_quality": Column(np.uint8),
        "frequency_hz": Column(np.float64, np.nan),
        "news_ns": Column(np.int64, NO_TIME),
    }
    state: npt.NDArray[np.int8]
    first_ns: Ints
    """Monotonic time of the round before the first frame."""
    last_ns: Ints
    """... of the round with the last one."""
    quiet_ns: Ints
    rate: npt.NDArray[np.float64]
    per_second: Ints
    """Frames; 0 where the configuration names no rate."""
    seconds_per_frame: Ints
    frames: Ints
    late: Ints
    stat: npt.NDArray[np.uint16]
    time_quality: npt.NDArray[np.uint8]
    frequency_hz: npt.NDArray[np.float64]
    news_ns: Ints

    def set_rate(self, row: int, rate: Fraction) -> float:
        """Note the rate that a configuration names (0: none); gives the reporting interval in ns, 0 for none."""
        period_ns = NS * rate.denominator / rate.numerator if rate else 0.0
        self.rate[row] = float(rate) if rate else np.nan
        self.per_second[row], self.seconds_per_frame[row] = rate.numerator, rate.denominator
        self.quiet_ns[row] = max(QUIET_NS, round(QUIET_PERIODS * period_ns))
        return period_ns

    def slots(self, segments: Segments, time_ns: Ints, head: Ints) -> Ints:
        """Slots of frames (N,) of streams of any rates, as of :func:`pmutools.timebase.slots_array`.

        Without a rate every frame has the slot after the one before it; ``head`` (R,) is the last of each stream.
        """
        row = segments.row
        soc, frac_ns = np.divmod(time_ns, NS)
        per_second, per_frame = self.per_second[row], self.seconds_per_frame[row]
        slot: Ints = soc * per_second + (frac_ns * per_second + NS // 2) // NS
        if (slow := per_frame > 1).any():
            seconds = soc + (frac_ns >= NS // 2)
            slot = np.where(slow, (seconds + per_frame // 2) // per_frame, slot)
        if (unknown := per_second == 0).any():
            slot = np.where(unknown, head[row] + 1 + segments.place, slot)
        return slot

    def note(self, segments: Segments, frames: Frames, before_ns: int, now_ns: int) -> None:
        """Frames have come between two times."""
        rows, ends = segments.rows, segments.ends
        self.frames[rows] += segments.lengths
        self.first_ns[rows[self.last_ns[rows] == NO_TIME]] = before_ns
        self.last_ns[rows], self.state[rows] = now_ns, STREAMING
        self.stat[rows], self.time_quality[rows] = frames.stat[ends], frames.time_quality[ends]
        self.frequency_hz[rows] = frames.frequency_hz[ends]

    def states(self, rows: npt.NDArray[np.intp], now_ns: int) -> npt.NDArray[np.int8]:
        """Codes of states now."""
        state = self.state[rows]
        quiet = now_ns - self.last_ns[rows] > self.quiet_ns[rows]
        found: npt.NDArray[np.int8] = np.where((state == STREAMING) & quiet, np.int8(SILENT), state)
        return found

    def since_s(self, times_ns: Ints, now_ns: int) -> npt.NDArray[np.float64]:
        """Seconds since times; NaN where there was none."""
        found: npt.NDArray[np.float64] = np.where(times_ns == NO_TIME, np.nan, (now_ns - times_ns) / NS)
        return found


class Frames(NamedTuple):
    """What is looked at of N data frames of any streams."""

    arrival_ns: Ints
    time_ns: Ints
    time_quality: npt.NDArray[np.uint8]
    stat: npt.NDArray[np.uint16]
    """(N,) the bits that any station sets."""
    valid: Flags
    """(N,) at all stations."""
    frequency_hz: npt.NDArray[np.float64]
    """(N,) of the first station."""


class Round:
    """The blocks of one round."""

    def __init__(self) -> None:
        self.rows: list[int] = []
        self._parts: list[Frames] = []

    def add(self, row: int, batch: Batch) -> None:
        """Take a block of the stream in a row."""
        match batch.stat.shape[1]:
            case 0:  # a concentrator without a PMU
                stat, valid = np.zeros(len(batch), np.uint16), np.zeros(len(batch), np.bool_)
                frequency_hz = np.full(len(batch), np.nan)
            case 1:
                stat, valid, frequency_hz = batch.stat[:, 0], batch.valid[:, 0], batch.frequency[:, 0]
            case _:
                stat, valid = any_station(batch.stat), np.logical_and.reduce(batch.valid, axis=1)
                frequency_hz = batch.frequency[:, 0]
        self.rows.append(row)
        self._parts.append(Frames(batch.arrival_ns, batch.time_ns, batch.time_quality, stat, valid, frequency_hz))

    def gathered(self) -> tuple[Segments, Frames]:
        """A segment a stream, also where it came in several blocks."""
        rows = np.array(self.rows, np.intp)
        lengths = np.array([len(part.time_ns) for part in self._parts], np.intp)
        columns: list[npt.NDArray[Any]] = [np.concatenate(column) for column in zip(*self._parts, strict=True)]
        if len(set(self.rows)) == len(self.rows):
            return Segments.of(rows, lengths), Frames._make(columns)
        order = np.argsort(np.repeat(rows, lengths), kind="stable")
        found, where = np.unique(rows, return_inverse=True)
        together = np.bincount(where, lengths).astype(np.intp)
        return Segments.of(found, together), Frames._make(column[order] for column in columns)
