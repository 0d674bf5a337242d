"""A player's ledger beside what was measured: true one-way delays, and whether every frame met the fate it says.

Rows of the ledger and of ``samples.parquet`` are joined by stream and stamp. A stamp that was sent in several copies is
told apart by time: each arrival belongs to the latest copy that had left by then (or, where clocks differ by more, to
the copies in order). The join goes through both files window by window of stamps, each of about :data:`WINDOW_ROWS`
rows of the ledger, of which only the row groups that can hold it are read: so memory is that of one window, some
200 bytes a row, however long the run was. Stamps that a loop repeats (``--stamp keep --loop``) are all in one window.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME
from pmutools.errors import SourceError
from pmutools.measure.columns import Ints
from pmutools.measure.histogram import Histogram
from pmutools.measure.stream import StreamResult
from pmutools.measure.summary import safe

WINDOW_ROWS = 1 << 20
SENT = "sent"
DAMAGED = "sent damaged"
"""Sent on purpose as what is no frame."""
_DAMAGE = "corrupt:"
_EDGE_NS = 1_000_000_000
"""Stamps in the ledger may differ by this, at TIME_BASE 1, from those on the wire."""
_COLUMNS = ("stream", "time_ns", "scheduled_ns", "sent_ns", "tx_stamp_ns", "fate", "faults")
_MEASURED = ("stream", "time_ns", "arrival_ns", "state")


@dataclass
class Agreement:
    """Of one stream: what the ledger says, and what was measured."""

    received: dict[str, int] = field(default_factory=dict)
    """Copies by fate that arrived; of other fates than ``sent`` there should be none."""
    missing: dict[str, int] = field(default_factory=dict)
    """Copies by fate that did not arrive while the measurement ran; of ``sent``: lost on the way."""
    outside: int = 0
    """Copies that left before the measurement began or after it ended."""
    unknown: int = 0
    """Frames measured that are in no row: another sender's, or copies that the network made."""
    one_way: Histogram = field(default_factory=Histogram)
    """Departure to arrival."""
    at_sender: Histogram = field(default_factory=Histogram)
    """Stamp to departure."""
    stamped: int = 0
    """Departures that the sender's kernel stamped; the others are from when the call returned."""

    def merge(self, other: Agreement) -> None:
        """Add another stream's."""
        for mine, others in ((self.received, other.received), (self.missing, other.missing)):
            for fate, count in others.items():
                mine[fate] = mine.get(fate, 0) + count
        self.outside += other.outside
        self.unknown += other.unknown
        self.stamped += other.stamped
        self.one_way.merge(other.one_way)
        self.at_sender.merge(other.at_sender)

    def to_json(self) -> dict[str, Any]:
        """Counts and both distributions."""
        departed = self.at_sender.count
        return {
            "received": dict(self.received),
            "missing": dict(self.missing),
            "lost_on_the_way": self.missing.get(SENT, 0),
            "contradictions": sum(count for fate, count in self.received.items() if fate not in (SENT, DAMAGED)),
            "outside": self.outside,
            "unknown": self.unknown,
            "one_way_ms": self.one_way.summary_ms(),
            "at_sender_ms": self.at_sender.summary_ms(),
            "departures_stamped_by_kernel": self.stamped / departed if departed else None,
        }


@dataclass
class Truth:
    """The whole join, in the order of the results it was made for."""

    agreements: list[Agreement]
    names: list[str | None]
    """The ledger's name of each stream; None where it has none of it."""
    unmatched: list[str]
    """Streams of the ledger that were not measured."""

    def to_json(self, path: Path, results: Sequence[StreamResult]) -> dict[str, Any]:
        """``ledger`` of the summary."""
        whole = Agreement()
        for agreement in self.agreements:
            whole.merge(agreement)
        streams = [
            {"name": result.identity.name, "ledger_name": name, **agreement.to_json()}
            for result, name, agreement in zip(results, self.names, self.agreements, strict=True)
        ]
        told = {"file": str(path), "streams": streams, "not_measured": self.unmatched, "all": whole.to_json()}
        return safe(told)


class _Frames(NamedTuple):
    """What was measured within a window of stamps."""

    stream: npt.NDArray[np.int32]
    key: Ints
    when: Ints
    """Arrival; NO_TIME where nobody saw it."""


class _Copies(NamedTuple):
    """What the ledger says of a window of stamps."""

    stream: npt.NDArray[np.int32]
    key: Ints
    when: Ints
    """Departure; NO_TIME of what never left."""
    due: Ints
    """Departure, or what was scheduled."""
    fate: npt.NDArray[np.int32]
    stamped: npt.NDArray[np.bool_]
    """Whether a kernel took the departure."""


def open_ledger(path: Path) -> Any:
    """A ledger's Parquet file; raises SourceError for one that is none, or is not finished."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        file = parquet.ParquetFile(path)
    except FileNotFoundError:
        raise SourceError(f"{path}: there is no such ledger (yet); it is complete when the player has ended") from None
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise SourceError(f"{path}: no ledger, or not finished (the player must have ended): {reason}") from None
    if missing := [name for name in _COLUMNS if name not in file.schema_arrow.names]:
        raise SourceError(f"{path}: no ledger of pmu play; it lacks the column {missing[0]!r}")
    return file


def hold_to(
    ledger: Path, samples: Path, results: Sequence[StreamResult], begin_ns: int, end_ns: int, rows: int = WINDOW_ROWS
) -> Truth:
    """Join a ledger with the samples of a run, which lasted from ``begin_ns`` to ``end_ns`` (UTC of the receiver).

    Raises SourceError for a file that cannot be read.
    """
    from pyarrow import parquet

    said, seen = open_ledger(ledger), parquet.ParquetFile(samples)
    names = _names(said)
    theirs = _matched(names, results)
    mine = {result.identity.name: number for number, result in enumerate(results)}
    bases = [result.config.time_base for result in results]
    agreements = [Agreement() for _ in results]
    span = begin_ns, end_ns
    for low, high in _windows(said, rows):
        copies, fates = _copies(said, low, high, theirs, bases)
        _join(copies, fates, _frames(seen, low, high, mine), agreements, span)
    found: list[str | None] = [None] * len(results)
    for name, number in theirs.items():
        found[number] = name
    return Truth(agreements, found, [name for name in names if name not in theirs])


def _names(said: Any) -> list[str]:
    found: dict[str, None] = {}
    for batch in said.iter_batches(WINDOW_ROWS, columns=["stream"]):
        found |= dict.fromkeys(batch.column(0).unique().to_pylist())
    return list(found)


def _matched(names: Sequence[str], results: Sequence[StreamResult]) -> dict[str, int]:
    """Results by the ledger's names: those that are called so, then those that are also called so, if only one is."""
    found: dict[str, int] = {}
    for name in names:
        wanted = name.casefold()
        exact = [n for n, result in enumerate(results) if result.identity.name.casefold() == wanted]
        also = [n for n, result in enumerate(results) if wanted in {o.casefold() for o in result.identity.others}]
        for candidates in (exact, also):
            free = [number for number in candidates if number not in found.values()]
            if len(free) == 1:
                found[name] = free[0]
                break
    return found


def _windows(said: Any, rows: int) -> Iterator[tuple[int, int]]:
    """Ranges [low, high) of stamps that hold about so many rows each, and together all."""
    column = said.schema_arrow.get_field_index("time_ns")
    metadata = said.metadata
    groups = []
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        statistics = group.column(column).statistics
        if group.num_rows:
            groups.append((statistics.min, group.num_rows))
    groups.sort()
    low, gathered = -(1 << 62), 0
    for first, count in groups:
        if gathered >= rows and first > low:
            yield low, first
            low, gathered = first, 0
        gathered += count
    yield low, 1 << 62


def _groups(file: Any, low: int, high: int) -> list[int]:
    """Row groups that may hold stamps within the range."""
    column, metadata = file.schema_arrow.get_field_index("time_ns"), file.metadata
    found = []
    for number in range(metadata.num_row_groups):
        statistics = metadata.row_group(number).column(column).statistics
        if statistics is None or (statistics.max >= low - _EDGE_NS and statistics.min < high + _EDGE_NS):
            found.append(number)
    return found


def _columns(file: Any, low: int, high: int, names: Sequence[str]) -> Iterator[Mapping[str, Any]]:
    """Record batches of a range, as columns by name."""
    if groups := _groups(file, low, high):
        for batch in file.iter_batches(1 << 16, row_groups=groups, columns=list(names)):
            yield dict(zip(names, (batch.column(batch.schema.get_field_index(name)) for name in names), strict=True))


def _codes(column: Any, known: Mapping[str, int]) -> npt.NDArray[np.int32]:
    """(N,) codes of words, -1 for those not known."""
    import pyarrow as pa

    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    table = np.array([known.get(word, -1) for word in column.dictionary.to_pylist()] or [-1], np.int32)
    codes: npt.NDArray[np.int32] = table[column.indices.fill_null(0).to_numpy(zero_copy_only=False)]
    return codes


def _damaged(faults: Any) -> npt.NDArray[np.bool_]:
    """(N,) whether a copy was corrupted."""
    import pyarrow.compute as pc

    found: npt.NDArray[np.bool_] = pc.match_substring(faults, _DAMAGE).fill_null(False).to_numpy(zero_copy_only=False)
    return found


def _times(column: Any) -> Ints:
    return np.array(column.fill_null(NO_TIME).to_numpy(zero_copy_only=False), np.int64)


def _copies(
    said: Any, low: int, high: int, theirs: Mapping[str, int], bases: Sequence[int]
) -> tuple[_Copies, list[str]]:
    """Rows of the ledger, and the words of their fates."""
    fates: dict[str, int] = {SENT: 0, DAMAGED: 1}
    parts: list[tuple[Any, ...]] = []
    for columns in _columns(said, low, high, _COLUMNS):
        for fate in columns["fate"].unique().to_pylist():
            fates.setdefault(fate, len(fates))
        stream, key = _codes(columns["stream"], theirs), _times(columns["time_ns"])
        for number in np.unique(stream[stream >= 0]).tolist():  # as the wire tells it
            rows = stream == number
            soc, fracsec = timebase.from_ns_array(key[rows], bases[number])
            key[rows] = timebase.to_ns_array(soc.astype(np.uint64), fracsec.astype(np.uint64), bases[number])
        sent, stamps = _times(columns["sent_ns"]), _times(columns["tx_stamp_ns"])
        stamped = stamps != NO_TIME
        rows = (key >= low) & (key < high) & (stream >= 0)
        fate = _codes(columns["fate"], fates)
        fate[_damaged(columns["faults"]) & (fate == fates[SENT])] = fates[DAMAGED]
        when = np.where(stamped, stamps, sent)
        due = np.where(when == NO_TIME, _times(columns["scheduled_ns"]), when)
        column = (stream, key, when, due, fate, stamped)
        parts.append(tuple(each[rows] for each in column))
    return _Copies(*_joined(parts, _Copies)), list(fates)


def _frames(seen: Any, low: int, high: int, mine: Mapping[str, int]) -> _Frames:
    """Rows of frames among the samples."""
    parts: list[tuple[Any, ...]] = []
    for columns in _columns(seen, low, high, _MEASURED):
        stream, key, when = _codes(columns["stream"], mine), _times(columns["time_ns"]), _times(columns["arrival_ns"])
        came = _codes(columns["state"], {"lost": 1}) < 0
        rows = (key >= low) & (key < high) & (stream >= 0) & came
        parts.append(tuple(each[rows] for each in (stream, key, when)))
    return _Frames(*_joined(parts, _Frames))


def _joined(parts: Sequence[tuple[Any, ...]], of: type[_Frames] | type[_Copies]) -> list[npt.NDArray[Any]]:
    if not parts:
        return [np.zeros(0, np.bool_ if name == "stamped" else np.int64) for name in of._fields]
    return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def _join(
    copies: _Copies,
    fates: Sequence[str],
    frames: _Frames,
    agreements: Sequence[Agreement],
    span: tuple[int, int],
) -> None:
    """Find each frame's copy, and count."""
    whose = _pairs(copies, frames)
    arrival = np.full(len(copies.key), NO_TIME)
    met = np.zeros(len(copies.key), np.bool_)
    known = whose >= 0
    met[whose[known]] = True
    arrival[whose[known]] = frames.when[known]
    for number, agreement in enumerate(agreements):
        agreement.unknown += int(np.count_nonzero((frames.stream == number) & ~known))
        rows = np.flatnonzero(copies.stream == number)
        if not len(rows):
            continue
        departure, left = copies.when[rows], copies.when[rows] != NO_TIME
        here, due = met[rows], copies.due[rows]
        inside = here | ((due >= span[0]) & (due <= span[1]))
        agreement.outside += int(np.count_nonzero(~inside))
        for code, fate in enumerate(fates):
            of_fate = (copies.fate[rows] == code) & inside
            for table, hit in ((agreement.received, of_fate & here), (agreement.missing, of_fate & ~here)):
                if count := int(np.count_nonzero(hit)):
                    table[fate] = table.get(fate, 0) + count
        agreement.at_sender.add((departure - copies.key[rows])[left & inside])
        agreement.stamped += int(np.count_nonzero(copies.stamped[rows] & left & inside))
        both = here & left & (arrival[rows] != NO_TIME)
        agreement.one_way.add((arrival[rows] - departure)[both])


def _pairs(copies: _Copies, frames: _Frames) -> Ints:
    """(F,) the row of the copy that each frame is, or -1."""
    found = np.full(len(frames.key), -1)
    if not len(copies.key) or not len(frames.key):
        return found
    # sent copies first among those of one stamp, in order of departure
    when = np.where(copies.when == NO_TIME, 1 << 62, copies.when)
    order = np.lexsort((when, copies.key, copies.stream))
    stream, key = copies.stream[order], copies.key[order]
    starts = np.flatnonzero(np.concatenate(([True], (np.diff(stream) != 0) | (np.diff(key) != 0))))
    ends = np.append(starts[1:], len(order))
    at = _rank(stream[starts], key[starts], frames)
    alone = (at >= 0) & ((ends - starts)[np.maximum(at, 0)] == 1)
    rows = np.flatnonzero(alone)
    _, firsts = np.unique(at[rows], return_index=True)  # a second frame of a stamp that was sent once is no copy of it
    rows = rows[firsts]
    found[rows] = order[starts[at[rows]]]
    several = np.flatnonzero((at >= 0) & ~alone)
    by_group: dict[int, list[int]] = {}
    for row in several[np.argsort(frames.when[several], kind="stable")].tolist():
        by_group.setdefault(int(at[row]), []).append(row)
    for group, arrivals in by_group.items():
        mine = order[starts[group] : ends[group]].tolist()
        sent = [copy for copy in mine if copies.when[copy] != NO_TIME]
        unsent = mine[len(sent) :]
        for row, copy in zip(
            arrivals, _assigned(copies.when[sent].tolist(), frames.when[arrivals].tolist()), strict=True
        ):
            if copy is not None:
                found[row] = sent[copy]
            elif unsent:
                found[row] = unsent.pop(0)
    return found


def _assigned(departures: Sequence[int], arrivals: Sequence[int]) -> Iterator[int | None]:
    """Which of the departures each arrival belongs to, both in order: the latest by then that is not taken.

    In order where that fits, or where no clock explains the arrivals.
    """
    if len(departures) == len(arrivals) and all(left <= came for left, came in zip(departures, arrivals, strict=True)):
        yield from range(len(arrivals))
        return
    free = list(range(len(departures)))
    for came in arrivals:
        copy = next((copy for copy in reversed(free) if departures[copy] <= came), free[0] if free else None)
        if copy is not None:
            free.remove(copy)
        yield copy


def _rank(stream: npt.NDArray[np.int32], key: Ints, frames: _Frames) -> Ints:
    """(F,) the group of each frame's stream and stamp, or -1."""
    found = np.full(len(frames.key), -1)
    for number in np.unique(stream).tolist():
        low, high = np.searchsorted(stream, [number, number + 1])
        rows = np.flatnonzero(frames.stream == number)
        if not len(rows) or low == high:
            continue
        at = np.searchsorted(key[low:high], frames.key[rows])
        at = np.minimum(at, high - low - 1)
        hit = key[low:high][at] == frames.key[rows]
        found[rows[hit]] = low + at[hit]
    return found
