"""A recording as the player wants it: read once, each frame with the time at which it is due, in that order.

Columns of a row a frame (some 50 bytes) are in memory; the frames themselves go to a temporary file where they are
more than :data:`SPOOL_BYTES`, and the operating system keeps of it what is needed. So any time of any recording can be
gone to at once, and a loop reads nothing again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch, encode_batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Loss, Message
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Flow
from pmutools.formats.columns import unique
from pmutools.formats.source import Block
from pmutools.parsers import no_such_stream
from pmutools.timebase import NS
from pmutools.tools.window import FOREVER, Window

LATENCY_MAX_NS = NS
"""A recorded latency outside 0..1 s is a clock's doing, and counts as 0."""
SPOOL_BYTES = 64 << 20
"""Frames up to this size in all stay in memory."""

I64 = npt.NDArray[np.int64]


@dataclass
class Track:
    """One stream of the recording; times POSIX UTC ns, over the frames that are played."""

    name: str
    flow: Flow
    config: StreamConfig
    """Its first."""
    total: int = 0
    """Data frames in the recording."""
    frames: int = 0
    """Those of them that are played."""
    first_ns: int = FOREVER
    last_ns: int = -FOREVER
    first_due_ns: int = FOREVER

    @property
    def names(self) -> tuple[str, ...]:
        """What patterns may call it: its name, its IDCODE, its stations."""
        return (self.name, str(self.config.idcode), *(station.name for station in self.config.stations))

    def add(self, stamp_ns: I64, due_ns: I64) -> None:
        """Take note of frames (N,) that are played."""
        self.frames += len(stamp_ns)
        self.first_ns, self.last_ns = min(self.first_ns, int(stamp_ns.min())), max(self.last_ns, int(stamp_ns.max()))
        self.first_due_ns = min(self.first_due_ns, int(due_ns.min()))


@dataclass(frozen=True)
class Rows:
    """N frames, a column each; ``at`` is where the frame's bytes begin in the reel's ``wire``."""

    due_ns: I64
    """When it is due: its stamp plus its recorded latency."""
    stamp_ns: I64
    """The stamp it is played by, before it is moved to the present."""
    source_ns: I64
    """The stamp as recorded."""
    track: npt.NDArray[np.int32]
    number: I64
    """Zero-based, among the data frames of its track in the recording."""
    edition: npt.NDArray[np.int32]
    """Which of the reel's ``editions`` it is laid out by."""
    at: I64

    def __len__(self) -> int:
        return len(self.due_ns)

    def __getitem__(self, rows: npt.NDArray[Any]) -> Rows:
        return Rows(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Reel:
    """A recording, ready to be played: rows in order of their due times, rounds of ``round_ns`` if it is looped."""

    tracks: tuple[Track, ...]
    editions: tuple[StreamConfig, ...]
    rows: Rows
    wire: npt.NDArray[np.uint8]
    round_ns: Fraction
    """From one loop's first frame to the next one's."""
    round_stamp_ns: int
    """What a loop adds to stamps: whole seconds, so that FRACSEC keeps its phase."""
    fps: int | None = None
    """Stamps are not as recorded but consecutive reporting instants of this rate, ``round_slots`` of them a round."""
    round_slots: int = 0
    interval_ns: int | None = None
    """Due times have nothing to do with stamps: each track's are so far apart."""
    sizes: npt.NDArray[np.int64] = field(init=False)
    """FRAMESIZE by edition."""
    time_bases: npt.NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sizes", np.array([config.frame_size for config in self.editions], np.int64))
        object.__setattr__(self, "time_bases", np.array([config.time_base for config in self.editions], np.int64))

    def period_ns(self, rate: Fraction) -> Fraction:
        """From one frame of a stream of this rate (frames/s) to its next, as it is played; 0 where none is known."""
        if self.interval_ns is not None:
            return Fraction(self.interval_ns)
        rate = rate if self.fps is None else Fraction(self.fps)
        return NS / rate if rate else Fraction(0)

    @property
    def first_due_ns(self) -> int:
        """The due time of the first frame: position 0."""
        return int(self.rows.due_ns[0])

    @property
    def length_ns(self) -> int:
        """Position of the last frame."""
        return int(self.rows.due_ns[-1]) - self.first_due_ns


def record(
    items: Iterable[Block | Message | Loss],
    timing: str | None = None,
    window: Window | None = None,
    select: Collection[str] = (),
    exclude: Collection[str] = (),
) -> Reel:
    """Read a source to its end.

    ``timing`` is ``stamp``, ``arrival``, or None: by arrival where the source has arrivals (without any, the two are
    the same). ``window`` says from when to when; ``select`` and ``exclude`` hold stream names or IDCODEs. Raises
    SourceError where nothing is left to play, SettingsError for a name that fits no stream.
    """
    recorder = _Recorder(window or Window(), by_arrival=timing != "stamp")
    for item in items:
        if isinstance(item, Block) and len(item.batch):
            recorder.add(item.flow, item.batch)
    return recorder.reel(select, exclude)


class _Recorder:
    """Collects the rows of a source."""

    def __init__(self, window: Window, *, by_arrival: bool) -> None:
        self._window, self._by_arrival = window, by_arrival
        self._tracks: list[Track] = []
        self._places: dict[tuple[Flow, int], int] = {}
        self._spans: list[tuple[int, int]] = []
        """When the first and the last frame of each track came, by arrival where that is known."""
        self._editions: dict[tuple[int, StreamConfig], int] = {}
        self._rows: list[Rows] = []
        self._spool = tempfile.SpooledTemporaryFile(max_size=SPOOL_BYTES)  # noqa: SIM115  # lives as long as the reel
        self._bytes = 0

    def add(self, flow: Flow, batch: Batch) -> None:
        config, count = batch.config, len(batch)
        key = (flow, config.idcode)
        if key not in self._places:
            self._places[key] = len(self._tracks)
            self._tracks.append(Track("", flow, config))
            self._spans.append((FOREVER, -FOREVER))
        place = self._places[key]
        track = self._tracks[place]
        number = np.arange(track.total, track.total + count, dtype=np.int64)
        track.total += count
        stamps = batch.time_ns
        came = np.where(batch.arrival_ns == NO_TIME, stamps, batch.arrival_ns)
        first, last = self._spans[place]
        self._spans[place] = min(first, int(came.min())), max(last, int(came.max()))
        due = stamps + _latencies(stamps, batch.arrival_ns) if self._by_arrival else stamps
        low, high = self._window.bounds(int(stamps[0]))
        kept = np.flatnonzero((stamps >= low) & (stamps < high))
        if not len(kept):
            return
        track.add(stamps[kept], due[kept])
        wire = batch.wire if batch.wire is not None else encode_batch(batch)[0]
        size = config.frame_size
        rows = Rows(
            due[kept],
            stamps[kept],
            stamps[kept],
            np.full(len(kept), place, np.int32),
            number[kept],
            np.full(len(kept), self._edition(place, config), np.int32),
            self._bytes + size * np.arange(len(kept), dtype=np.int64),
        )
        self._rows.append(rows)
        self._bytes += self._spool.write(np.ascontiguousarray(wire)[kept].tobytes())

    def _edition(self, place: int, config: StreamConfig) -> int:
        return self._editions.setdefault((place, config), len(self._editions))

    def reel(self, select: Collection[str], exclude: Collection[str]) -> Reel:
        if not self._tracks:
            raise SourceError("there are no data frames to play")
        self._join()
        _name(self._tracks)
        chosen = [place for place in _chosen(self._tracks, select, exclude) if self._tracks[place].frames]
        if not chosen:
            raise SourceError("nothing is left to play; widen --start and --end, or --select and --exclude")
        renumbered = np.full(len(self._tracks), -1, np.int32)
        renumbered[chosen] = np.arange(len(chosen), dtype=np.int32)
        rows = Rows(*(np.concatenate([getattr(r, name) for r in self._rows]) for name in Rows.__dataclass_fields__))
        self._rows.clear()
        rows = replace(rows, track=renumbered[rows.track])
        rows = _sorted(rows[rows.track >= 0])
        tracks = tuple(self._tracks[place] for place in chosen)
        editions = tuple(config for _, config in self._editions)
        seconds = _round_ns(tracks, rows)
        return Reel(tracks, editions, rows, self._wire(), Fraction(seconds), seconds)

    def _join(self) -> None:
        """Make one track of what is one stream: a sender that was started again, a configuration that changed.

        Each has a flow of its own then, or a table. They follow one another; two that overlap are two streams.
        """
        into, numbers = list(range(len(self._tracks))), [0] * len(self._tracks)
        ends: dict[tuple[str, int], list[int]] = {}
        for place in sorted(range(len(self._tracks)), key=lambda place: self._spans[place]):
            track = self._tracks[place]
            chains = ends.setdefault((_sender(track), track.config.idcode), [])
            over = [number for number, end in enumerate(chains) if self._spans[end][1] < self._spans[place][0]]
            if len(over) != 1:
                chains.append(place)
                continue
            into[place] = into[chains[over[0]]]
            chains[over[0]] = place
            whole = self._tracks[into[place]]
            numbers[place] = whole.total
            whole.total += track.total
            if track.frames:
                whole.frames += track.frames
                whole.first_ns, whole.last_ns = min(whole.first_ns, track.first_ns), max(whole.last_ns, track.last_ns)
                whole.first_due_ns = min(whole.first_due_ns, track.first_due_ns)
        if into == list(range(len(self._tracks))):
            return
        kept = sorted(set(into))
        places = np.array([kept.index(whole) for whole in into], np.int32)
        shifts = np.array(numbers, np.int64)
        self._rows = [
            replace(rows, track=places[rows.track], number=rows.number + shifts[rows.track]) for rows in self._rows
        ]
        self._tracks = [self._tracks[whole] for whole in kept]

    def _wire(self) -> npt.NDArray[np.uint8]:
        self._spool.seek(0)
        if self._bytes <= SPOOL_BYTES:
            return np.frombuffer(self._spool.read(), np.uint8)
        self._spool.flush()
        return np.memmap(self._spool._file, np.uint8, "r")  # it is a file by now


def _sender(track: Track) -> str:
    """Who sends: a host, whose ports change from one start to the next; in tables, the stations."""
    flow = track.flow
    if flow.transport == "file":
        return "/".join(station.name for station in track.config.stations)
    return f"{flow.transport}://{flow.source.rpartition(':')[0]}"


def _latencies(stamps: I64, arrivals: I64) -> I64:
    """Recorded latencies (N,), 0 where there is none or it cannot be true."""
    known = arrivals != NO_TIME
    latencies = np.where(known, arrivals, stamps) - stamps
    return np.where((latencies >= 0) & (latencies <= LATENCY_MAX_NS), latencies, 0)


def _sorted(rows: Rows) -> Rows:
    """In order of due times; frames due at one time stay as recorded, stream by stream."""
    if np.all(rows.due_ns[1:] >= rows.due_ns[:-1]):
        return rows
    return rows[np.argsort(rows.due_ns, kind="stable")]


def _round_ns(tracks: Sequence[Track], rows: Rows) -> int:
    """Whole seconds from one loop to the next, so that no stamp comes twice.

    Recorded stamps are rounded, so one that is a tenth of a reporting interval late does not cost a second; neither
    does a last frame that is late by less than half of what a latency may be: it leaves amid the next round.
    """
    period_ns = max((round(NS / track.config.rate) for track in tracks if track.config.rate), default=NS)
    stamps_ns = max(track.last_ns for track in tracks) - min(track.first_ns for track in tracks)
    due_ns = int(rows.due_ns[-1] - rows.due_ns[0])
    return -(-max(stamps_ns + period_ns - period_ns // 10, due_ns - LATENCY_MAX_NS // 2, 1) // NS) * NS


def _name(tracks: Sequence[Track]) -> None:
    """Names that tell the streams apart: the only station's, else the IDCODE; repeated ones get ``#2``."""
    names = []
    for track in tracks:
        stations = track.config.stations
        names.append(stations[0].name if len(stations) == 1 and stations[0].name else str(track.config.idcode))
    for track, name in zip(tracks, unique(names), strict=True):
        track.name = name


def _chosen(tracks: Sequence[Track], select: Collection[str], exclude: Collection[str]) -> list[int]:
    for option, wanted in (("--select", select), ("--exclude", exclude)):
        for name in wanted:
            if not any(name in track.names for track in tracks):
                there = [f"{track.name} ({track.config.idcode})" for track in tracks]
                raise SettingsError(no_such_stream(f"{option} {name}", there))
    kept = [place for place, track in enumerate(tracks) if not select or any(name in select for name in track.names)]
    return [place for place in kept if not any(name in exclude for name in tracks[place].names)]


def of_tracks(reel: Reel, count: int) -> Reel:
    """The reel's first ``count`` tracks alone; its rounds stay as long as they are."""
    return replace(reel, tracks=reel.tracks[:count], rows=reel.rows[reel.rows.track < count])


# --- other times for the same frames --------------------------------------------------------------------------------


def without_gaps(reel: Reel, longest_ns: int) -> tuple[Reel, int]:
    """Silences of all streams together that last longer than ``longest_ns`` cut down to it; and how many there were.

    Whole seconds are taken out, of stamps as well, so that FRACSEC keeps its phase: what is left of a silence is at
    most a second longer than ``longest_ns``.
    """
    rows = reel.rows
    gaps = np.diff(rows.due_ns)
    cut = np.where(gaps > longest_ns, (gaps - longest_ns) // NS * NS, 0)
    if not cut.any():
        return reel, 0
    moved = np.concatenate(([0], np.cumsum(cut)))
    rows = replace(rows, due_ns=rows.due_ns - moved, stamp_ns=rows.stamp_ns - moved)
    tracks = tuple(_retimed(track, rows[rows.track == place]) for place, track in enumerate(reel.tracks))
    seconds = _round_ns(tracks, rows)
    cuts = int(np.count_nonzero(cut))
    return replace(reel, tracks=tracks, rows=rows, round_ns=Fraction(seconds), round_stamp_ns=seconds), cuts


def _retimed(track: Track, rows: Rows) -> Track:
    retimed = replace(track, frames=0, first_ns=FOREVER, last_ns=-FOREVER, first_due_ns=FOREVER)
    retimed.add(rows.stamp_ns, rows.due_ns)
    return retimed


def at_interval(reel: Reel, interval_ns: int) -> Reel:
    """Each track's frames ``interval_ns`` apart, in the order recorded; stamps as they are."""
    place = _places(reel)
    starts = np.array([track.first_due_ns for track in reel.tracks], np.int64)
    due = starts[reel.rows.track] + place * interval_ns
    lasts = [t.first_due_ns - reel.first_due_ns + t.frames * interval_ns for t in reel.tracks]
    rows = _sorted(replace(reel.rows, due_ns=due))
    return replace(reel, rows=rows, round_ns=Fraction(max(lasts)), interval_ns=interval_ns)


def at_rate(reel: Reel, fps: int) -> Reel:
    """Each track's frames at consecutive reporting instants of ``fps`` frames/s, with their recorded latencies.

    A track begins at the instant nearest to where it began relative to the first one.
    """
    rate = Fraction(fps)
    base_ns = min(track.first_ns for track in reel.tracks)
    base = timebase.slot(base_ns, rate)
    later = np.array([timebase.slot(track.first_ns - base_ns, rate) for track in reel.tracks], np.int64)
    slots = base + later[reel.rows.track] + _places(reel)
    stamps = slot_times(slots, fps)
    due = stamps + (reel.rows.due_ns - reel.rows.stamp_ns)
    rows = _sorted(replace(reel.rows, due_ns=due, stamp_ns=stamps))
    intervals = max(int(later[k]) + track.frames for k, track in enumerate(reel.tracks))
    round_ns = Fraction(intervals * NS, fps)
    return replace(reel, rows=rows, round_ns=round_ns, fps=fps, round_slots=intervals)


def slot_times(slots: I64, fps: int) -> I64:
    """Time of reporting instants (N,) of ``fps`` frames/s, POSIX UTC ns, rounded half up."""
    seconds, rest = np.divmod(slots, fps)
    times: I64 = seconds * NS + (rest * NS + fps // 2) // fps
    return times


def _places(reel: Reel) -> I64:
    """For each row, how many of the frames of its track that are played were recorded before it."""
    track = reel.rows.track
    order = np.lexsort((reel.rows.number, track))
    counts = np.bincount(track, minlength=len(reel.tracks))
    firsts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    places = np.empty(len(track), np.int64)
    places[order] = np.arange(len(track)) - firsts[track[order]]
    return places
