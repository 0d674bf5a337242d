"""CSV with four header rows, as in the UTK / ISO New England library of oscillation test cases. Read only.

===  ===========================================  ==============================================================
row  holds                                        e.g.
===  ===========================================  ==============================================================
1    name of the line terminal, once a quantity   ``Time, Sub:1:Ln:1, Sub:1:Ln:1, Sub:1:Ln:1, ...``
2    kind                                         ``T, F, VM, VA, IM, IA``
3    unit                                         ``Sec, Hz, kV, Deg, A, Deg``; also mHz, V, Rad, kA
4    start (UTC) under the time, labels of lines  ``2016-06-17 13:00:00, Ln:1, ...``; either may be missing
===  ===========================================  ==============================================================

Each name becomes a station, for each has its own frequency; a name with several frequencies becomes one station a
label. Magnitudes and angles of one label are paired to phasors in order; what finds no partner, and kinds other than
these, become analogs. The kinds of the WECC JSIS layout (VMP, VPM, IAP, DF ...) are read too. Time is seconds from the
start, or from 1970 where it is beyond 1e8, or ISO-8601; without a start it counts from :data:`DEFAULT_START_NS`. A
frequency within 5 Hz of zero is taken as a deviation from nominal.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from functools import cache
from itertools import chain, compress
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME
from pmutools.errors import SourceError
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.columns import Column, FrameValues, unique
from pmutools.formats.files import END_NS, TextTable, without_blank_end
from pmutools.formats.infer import data_rate_of, infer, nominal_hz_of
from pmutools.formats.rows import NO_IDCODE, Rows, planned_source, stamp_code
from pmutools.formats.source import TableSource
from pmutools.timebase import NS

DEFAULT_START_NS = timebase.parse_utc("2000-01-01T00:00:00Z")
"""When a recording begins whose file does not say."""
DEVIATION_HZ = 5.0
_EPOCH_S = 1e8
_KIND = re.compile(r"([VI])(?:([MA])([PABC]?)|([PABC])([MA]))")
_FREQUENCY = {"F": "freq_hz", "DF": "rocof_hz_s", "ROCOF": "rocof_hz_s"}
_UNITS = {
    "freq_hz": {"": 1.0, "hz": 1.0, "mhz": 1e-3},
    "rocof_hz_s": {"": 1.0, "hz/s": 1.0, "hz/sec": 1.0, "mhz/s": 1e-3, "mhz/sec": 1e-3},
    "V": {"": 1.0, "v": 1.0, "kv": 1e3, "pu": 1.0, "p.u.": 1.0},
    "I": {"": 1.0, "a": 1.0, "amp": 1.0, "amps": 1.0, "ka": 1e3, "pu": 1.0, "p.u.": 1.0},
    "deg": {"": 1.0, "deg": 1.0, "degree": 1.0, "degrees": 1.0, "rad": np.degrees(1.0), "radians": np.degrees(1.0)},
}
"""Factor to the unit of our columns, by quantity (V and I: magnitudes) and lower-case unit."""
_DATES = (
    "%Y-%m-%d %H:%M",
    "%Y-%m-%d",
    "%Y/%m/%d %H:%M:%S",
    "%m/%d/%Y %H:%M:%S.%f",
    "%m/%d/%Y %H:%M:%S",
    "%m/%d/%Y %H:%M",
    "%m/%d/%Y %I:%M:%S %p",
    "%m/%d/%Y %I:%M %p",
    "%m/%d/%Y",
    "%m/%d/%y %H:%M:%S",
    "%d-%b-%Y %H:%M:%S",
    "%d-%b-%Y",
)


class _Head(NamedTuple):
    """A column's header: ``letter`` is V, I or empty; ``scale`` brings its numbers to the unit of ``quantity``."""

    number: int
    name: str
    label: str
    kind: str
    quantity: str
    letter: str
    phase: str
    scale: float


def is_kinds(row: Sequence[str]) -> bool:
    """Whether a file's second row makes it one of these."""
    return len(row) > 1 and row[0].upper() == "T"


def read_rows(text: TextTable, names: Sequence[str], kinds: Sequence[str], nominal: Nominal = UNSAID) -> TableSource:
    """The source of a file whose first two rows have been read.

    Raises SourceError, with the line, for units that are not known and for a file without rows of numbers.
    """
    kinds = without_blank_end(kinds)
    units: Sequence[str] = ()
    labels: Sequence[str] = ()
    for row in iter(text.row, None):
        if labels or not _is_header(row):
            text.put_back(row)
            break
        if not units and re.fullmatch(r"s|secs?|seconds?", row[0], re.IGNORECASE):
            units = row
        else:
            labels = row
    heads = [
        _head(text, number, *(row[number] if number < len(row) else "" for row in (names, kinds, units, labels)))
        for number in range(1, len(kinds))
    ]
    rows = _Rows(text, heads, len(kinds), _start_ns(labels[0]) if labels and labels[0] else None)
    walk = iter(rows)
    first = next(walk, None)
    if first is None:
        raise SourceError(f"{text.path}: no rows of numbers after the header; name another file")
    columns = _columns(heads)
    rate = nominal.data_rate or data_rate_of(first.frames.time_ns)
    rows.refer_to_nominal(first, nominal.fnom_hz or nominal_hz_of(np.empty(0), rate))
    frequencies = [rows.values(first, head) for head in heads if head.quantity == "freq_hz"]
    fnom_hz = nominal.fnom_hz or nominal_hz_of(np.concatenate(frequencies) if frequencies else np.empty(0), rate)
    try:
        plan = infer(columns, idcode=NO_IDCODE, data_rate=rate or round(fnom_hz), fnom_hz=fnom_hz)
    except SourceError as error:
        raise SourceError(f"{text.path}: {error}") from None
    return planned_source(text.path, "ieee-csv", plan, chain([first], walk), text.defects)


def _is_header(row: Sequence[str]) -> bool:
    """Whether a row holds words, or nothing but a date; a row of numbers may begin with a date."""
    others = [cell for cell in row[1:] if cell]
    return not all(map(_is_number, others)) or not (others or _is_number(row[0]))


def _is_number(cell: str) -> bool:
    try:
        float(cell or "0")
    except ValueError:
        return False
    return True


def _head(text: TextTable, number: int, name: str, kind: str, unit: str, label: str) -> _Head:
    kind = kind.upper()
    name = name or label or f"column {number + 1}"
    if len(name) > len(kind) and name.upper().endswith(kind) and name[-len(kind) - 1] in " ._:-":
        name = name[: -len(kind) - 1]  # Bus1_VM and Bus1_VA are of one station
    letter = phase = ""
    quantity = _FREQUENCY.get(kind, "analog")
    if match := _KIND.fullmatch(kind):
        letter, phase = match[1], (match[3] or match[4] or "").replace("P", "")
        quantity = "mag" if (match[2] or match[5]) == "M" else "deg"
    known = _UNITS.get(letter if quantity == "mag" else quantity)
    scale = 1.0 if known is None else known.get(unit.lower())
    if scale is None:
        options = ", ".join(filter(None, known or ()))
        raise SourceError(f"{text.path}:3: column {number + 1} ({kind}) has unit {unit!r}; use one of {options}")
    return _Head(number, name, label, kind, quantity, letter, phase, scale)


def _start_ns(cell: str) -> int | None:
    """The start of a recording, if the cell holds a date after 1970."""
    try:
        time_ns = timebase.parse_utc(cell)
        return time_ns if 0 < time_ns < END_NS else None
    except ValueError:
        pass
    for form in _DATES:
        try:
            moment = datetime.strptime(cell, form).replace(tzinfo=UTC)
        except ValueError:
            continue
        return round(moment.timestamp()) * NS + moment.microsecond * 1000 if moment.year >= 1970 else None
    return None


# --- stations and channels --------------------------------------------------------------------------------------


def _columns(heads: Sequence[_Head]) -> list[Column]:
    """What each column is; its name here is its number."""
    frequencies = Counter(head.name for head in heads if head.quantity == "freq_hz")
    stations: dict[str, list[_Head]] = {}
    for head in heads:
        title = f"{head.name} {head.label}".strip() if frequencies[head.name] > 1 else head.name
        stations.setdefault(title, []).append(head)
    return [column for title, own in stations.items() for column in _station_columns(title, own)]


def _station_columns(title: str, heads: Sequence[_Head]) -> Iterator[Column]:
    pairs = _pairs(heads)
    paired = {head.number for pair in pairs for head in pair}
    per_kind = Counter(pair[0].letter + pair[0].phase for pair in pairs)
    names = unique(_channel_name(pair[0], per_kind) for pair in pairs)
    for name, pair in zip(names, pairs, strict=True):
        for head in pair:
            yield Column(str(head.number), title, name, head.quantity, 0, "A" if head.letter == "I" else "V")
    seen: set[str] = set()
    for head in heads:
        if head.quantity in _UNITS and head.quantity != "deg" and head.quantity not in seen:
            seen.add(head.quantity)
            yield Column(str(head.number), title, "", head.quantity, 0)
            paired.add(head.number)
    rest = [head for head in heads if head.number not in paired]
    for name, head in zip(unique(f"{head.kind} {head.label}".strip() for head in rest), rest, strict=True):
        yield Column(str(head.number), title, name, "analog", 0)


def _pairs(heads: Sequence[_Head]) -> list[tuple[_Head, _Head]]:
    """Magnitudes with their angles, in the order of the magnitudes."""
    waiting: dict[tuple[str, str, str], list[_Head]] = {}
    for head in heads:
        if head.quantity == "deg":
            waiting.setdefault((head.letter, head.phase, head.label), []).append(head)
    magnitudes = [head for head in heads if head.quantity == "mag"]
    found = [(head, waiting.get((head.letter, head.phase, head.label))) for head in magnitudes]
    return [(head, angles.pop(0)) for head, angles in found if angles]


def _channel_name(head: _Head, per_kind: Counter[str]) -> str:
    kind = head.letter + head.phase
    return f"{kind} {head.label}".strip() if per_kind[kind] > 1 else kind


# --- numbers ----------------------------------------------------------------------------------------------------


class _Rows:
    """The rows of numbers, in blocks."""

    def __init__(self, text: TextTable, heads: Sequence[_Head], width: int, start_ns: int | None) -> None:
        self._text, self._width, self._start_ns = text, width, start_ns
        self._heads = {str(head.number): head for head in heads}
        self._offsets: dict[int, float] = {}

    def __iter__(self) -> Iterator[Rows]:
        for columns in self._text.blocks(self._width, fill=True):
            time_ns = np.array([self._time(cell) for cell in columns[0]], np.int64)
            good = time_ns != NO_TIME
            if not good.all():
                self._text.defects["rows without a time"] += int(np.count_nonzero(~good))
                columns = [tuple(compress(column, good)) for column in columns]
                time_ns = time_ns[good]
            if len(time_ns):
                yield self._block(columns, time_ns)

    def values(self, rows: Rows, head: _Head) -> npt.NDArray[np.float64]:
        found = rows.values(str(head.number))
        assert found is not None
        return found

    def refer_to_nominal(self, first: Rows, nominal_hz: float) -> None:
        """From now on add the nominal frequency where a column begins with deviations from it."""
        for head in self._heads.values():
            if head.quantity == "freq_hz":
                values = self.values(first, head)
                if np.isfinite(values).any() and abs(float(np.nanmedian(values))) < DEVIATION_HZ:
                    self._offsets[head.number] = nominal_hz

    def _block(self, columns: list[tuple[str, ...]], time_ns: npt.NDArray[np.int64]) -> Rows:
        count = len(time_ns)

        @cache
        def scaled(number: int) -> npt.NDArray[np.float64]:
            return self._text.numbers(columns[number]) * self._heads[str(number)].scale

        def values(name: str) -> npt.NDArray[np.float64] | None:
            return scaled(int(name)) + self._offsets.get(int(name), 0.0)

        stamps = np.full(count, stamp_code(None), np.uint8)
        frames = FrameValues(time_ns, np.full(count, NO_TIME), stamps, np.zeros(count, np.uint8))
        return Rows(frames, np.full(count, NO_IDCODE), values)

    def _time(self, cell: str) -> int:
        """ns of a time cell; NO_TIME where it holds none."""
        try:
            since_ns = int((Decimal(cell) * NS).to_integral_value())
        except (InvalidOperation, ValueError, OverflowError):
            try:
                since_ns, self._start_ns = timebase.parse_utc(cell), 0
            except ValueError:
                return NO_TIME
        if self._start_ns is None:
            self._start_ns = 0 if since_ns > _EPOCH_S * NS else DEFAULT_START_NS
        time_ns = self._start_ns + since_ns
        return time_ns if 0 <= time_ns < END_NS else NO_TIME
