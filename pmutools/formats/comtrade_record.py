"""COMTRADE files (IEEE C37.111-1991, 1999, 2013 / IEC 60255-24) as arrays, by the library ``comtrade``.

The library reads headers and data; what it takes on trust (counts, lengths, times) is held to the file first, so that a
damaged one is a SourceError or a counted defect. Values come out in the primary of the transformers.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.errors import SourceError
from pmutools.formats.files import END_NS
from pmutools.timebase import NS

DEFAULT_START_NS = timebase.parse_utc("2000-01-01T00:00:00Z")
"""When a recording begins whose file gives no date."""
_CFF_HEADER = re.compile(
    rb"^--- file type: (\w+)(?:[ \t]+(\w+))?(?:[ \t]*:[ \t]*(\d+))?[ \t]*---[ \t]*\r?\n", re.I | re.M
)
_STAMP = re.compile(r"^\s*(\d{1,2}/\d{1,2}/\d{2,4})\s*,\s*(\d{1,2}:\d{2}:\d{1,2})(?:\.(\d*))?\s*$")
_OFFSET = re.compile(r"([+-]?)(\d{1,2})(?:[hH:](\d{2}))?")
_ANALOG_BYTES = {"BINARY": 2, "BINARY32": 4, "FLOAT32": 4}
_DAMAGE = (ValueError, TypeError, IndexError, KeyError, AttributeError, ArithmeticError, EOFError)
"""What the library raises on files that are not as they should be."""


class AnalogRecord(NamedTuple):
    """An analog channel: ``values`` (N,) in ``unit``, primary, NaN where missing, taken ``skew_s`` after the times."""

    name: str
    phase: str
    component: str
    unit: str
    skew_s: float
    values: npt.NDArray[np.float64]


class StatusRecord(NamedTuple):
    """A status channel: ``values`` (N,) 0 or 1, ``normal`` the one of them that is no event."""

    name: str
    normal: int
    values: npt.NDArray[np.int64]


class Stretch(NamedTuple):
    """Samples ``first`` to ``last`` - 1, evenly spaced, ``rate_hz`` a second."""

    first: int
    last: int
    rate_hz: float


@dataclass(frozen=True, eq=False)
class Record:
    """One recording of N samples; ``times_s`` (N,) rise and count from ``start_ns`` (POSIX UTC)."""

    station: str
    device: str
    line_hz: float
    start_ns: int
    time_quality: int
    times_s: npt.NDArray[np.float64]
    analogs: tuple[AnalogRecord, ...]
    statuses: tuple[StatusRecord, ...]
    defects: Counter[str] = field(default_factory=Counter)

    @property
    def stretches(self) -> list[Stretch]:
        """Where the samples are evenly spaced; a gap or another rate begins a new one."""
        steps = np.diff(self.times_s)
        if not len(steps):
            return []
        # alike within a quarter: stamps are rounded to microseconds
        breaks = np.flatnonzero(np.abs(steps[1:] - steps[:-1]) > 0.25 * np.minimum(steps[1:], steps[:-1])) + 1
        bounds = [0, *(int(at) for at in breaks), len(steps)]
        found = []
        for first, last in pairwise(bounds):
            if last > first:
                mean_s = (self.times_s[last] - self.times_s[first]) / (last - first)
                found.append(Stretch(first, last + 1, float(1 / mean_s)))
        return found


def read_record(path: Path) -> Record:
    """Read a ``.cfg`` with its ``.dat`` (either may be named), or a ``.cff``.

    Raises
    ------
    SourceError
        The other file is missing, the header cannot be understood, or there are no samples.
    """
    from comtrade import ComtradeError

    text, data, named = _parts(path)
    defects = Counter[str]()
    try:
        return _record(path, text, data, named, defects)
    except SourceError:
        raise
    except (*_DAMAGE, ComtradeError) as error:
        reason = (str(error).partition("\n")[0] or type(error).__name__)[:100]
        raise SourceError(f"{path} is no readable COMTRADE record ({reason}); export it again") from None


# --- the files --------------------------------------------------------------------------------------------------


def _parts(path: Path) -> tuple[str, bytes, str]:
    """Header, data, and what the data are where a ``.cff`` says so."""
    try:
        if path.suffix.lower() == ".cff":
            return _cff_parts(path, path.read_bytes())
        header, data = _beside(path, ".cfg"), _beside(path, ".dat")
        return _decoded(header.read_bytes()), data.read_bytes(), ""
    except OSError as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from None


def _beside(path: Path, suffix: str) -> Path:
    """The file of the same name with ``suffix``, in whatever case."""
    if path.suffix.lower() == suffix:
        return path
    wanted = (path.stem + suffix).lower()
    found = sorted(other for other in path.parent.iterdir() if other.name.lower() == wanted)
    if not found:
        raise SourceError(f"{path}: there is no {path.stem}{suffix} beside it; a COMTRADE record is both")
    return found[0]


def _cff_parts(path: Path, content: bytes) -> tuple[str, bytes, str]:
    heads = list(_CFF_HEADER.finditer(content))
    parts: dict[str, tuple[bytes, str]] = {}
    for number, head in enumerate(heads):
        kind, form = head[1].decode().upper(), (head[2] or b"").decode().upper()
        end = heads[number + 1].start() if number + 1 < len(heads) else len(content)
        if kind == "DAT" and form != "ASCII":  # bytes that look like a header are data
            end = min(head.end() + int(head[3]), len(content)) if head[3] else len(content)
        parts.setdefault(kind, (content[head.end() : end], form))
        if kind == "DAT":
            break
    if "CFG" not in parts or "DAT" not in parts:
        raise SourceError(f"{path} has no CFG and DAT part; is it a COMTRADE .cff?")
    return _decoded(parts["CFG"][0]), *parts["DAT"]


def _decoded(raw: bytes) -> str:
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


# --- the header -------------------------------------------------------------------------------------------------


class _Head(NamedTuple):
    """The lines of a header as the library shall see them, and what is read here."""

    lines: list[str]
    rate_line: int
    """Number of the line that holds the last sample number."""
    start_ns: int
    time_quality: int


def _head(path: Path, text: str, defects: Counter[str]) -> tuple[_Head, Any]:
    from comtrade import Cfg

    lines = text.replace("\x1a", "").splitlines()
    counts = re.fullmatch(r"\s*(\d+)\s*,\s*(\d+)\s*[aA]\s*,\s*(\d+)\s*[dD]\s*", lines[1]) if len(lines) > 1 else None
    if counts is None or int(counts[2]) + int(counts[3]) > len(lines):
        raise SourceError(f"{path} is no COMTRADE header: its second line does not count its channels")
    rates_at = 2 + int(counts[2]) + int(counts[3]) + 1
    rates = max(int(lines[rates_at]), 1)
    start_at = rates_at + 1 + rates
    if start_at + 2 >= len(lines):
        raise SourceError(f"{path} is cut: its header ends before the data format is named")
    first = lines[0].split(",")
    is_1991 = len(first) < 3 or first[2].strip() == "1991"
    start_ns = _stamp_ns(lines[start_at], is_1991)
    if start_ns is None:
        defects["no date of recording"] = 1
        start_ns = DEFAULT_START_NS
    code, quality = (lines[start_at + 4], lines[start_at + 5]) if len(lines) > start_at + 5 else ("", "")
    start_ns -= _offset_ns(code)
    # of the stamps, which the library reads to the microsecond, only the resolution; what it does not tell is left out
    fine = any((match := _STAMP.match(line)) and len(match[3] or "") > 6 for line in lines[start_at : start_at + 2])
    plain = f"01/01/2000,00:00:00.{'0' * (9 if fine else 6)}"
    kept = [*lines[:start_at], plain, plain, *lines[start_at + 2 : start_at + 4]]
    cfg = Cfg(ignore_warnings=True)
    cfg.read("\n".join(kept))
    if not 0 <= start_ns < END_NS - NS * 86400 * 366:
        raise SourceError(f"{path}: it begins at a time that C37.118 cannot tell")
    return _Head(kept, start_at - 1, start_ns, _quality(quality)), cfg


def _stamp_ns(line: str, month_first: bool) -> int | None:
    """ns of a header's date and time, taken as UTC; None where there is none."""
    match = _STAMP.match(line)
    if match is None:
        return None
    first, second, year = (int(part) for part in match[1].split("/"))
    day, month = (second, first) if month_first else (first, second)
    if year < 100:
        year += 1900 if year >= 70 else 2000
    hours, minutes, seconds = (int(part) for part in match[2].split(":"))
    try:
        midnight = datetime(year, month, day, tzinfo=UTC)
    except ValueError:
        return None
    fraction_ns = int((match[3] or "").ljust(9, "0")[:9])
    return (round(midnight.timestamp()) + hours * 3600 + minutes * 60 + seconds) * NS + fraction_ns


def _offset_ns(line: str) -> int:
    """How far the stamps are ahead of UTC, by the time code of 2013: ``-5h30``; 0 where it says nothing."""
    match = _OFFSET.fullmatch(line.split(",")[0].strip())
    if match is None:
        return 0
    seconds = int(match[2]) * 3600 + int(match[3] or 0) * 60
    return (-seconds if match[1] == "-" else seconds) * NS


def _quality(line: str) -> int:
    """MSG_TQ, which is the time quality code of 2013."""
    code = line.split(",")[0].strip()
    return int(code, 16) if re.fullmatch(r"[0-9a-fA-F]", code) else 0


# --- the data ---------------------------------------------------------------------------------------------------


def _record(path: Path, text: str, data: bytes, named: str, defects: Counter[str]) -> Record:
    head, cfg = _head(path, text, defects)
    form = cfg.ft.upper()
    if form != "ASCII" and form not in _ANALOG_BYTES:
        raise SourceError(
            f"{path}: data of format {cfg.ft[:20]!r} are not read, only ASCII and {', '.join(_ANALOG_BYTES)}"
        )
    if named and named != form:
        raise SourceError(f"{path} contradicts itself: its header says {form}, its data part {named}")
    cells = cfg.analog_count + cfg.status_count + 2
    if form == "ASCII":
        rows: list[str] | bytes = [line for line in _decoded(data).replace("\x1a", "").splitlines() if line.strip()]
        there = len(rows)
    else:
        size = 8 + cfg.analog_count * _ANALOG_BYTES[form] + 2 * -(-cfg.status_count // 16)
        rows, there = data, len(data) // size
        if len(data) % size > 1:  # some writers end with a SUB character
            defects["bytes of a cut sample"] = len(data) % size
    promised = int(cfg.sample_rates[-1][1])
    if promised > there:
        defects["samples missing at the end"] = promised - there
    elif 0 < promised < there:
        defects["samples beyond the last that the header counts"] = there - promised
    count = min(promised, there) if promised > 0 else there
    if not count:
        raise SourceError(f"{path} holds no samples; name another file")
    loaded, count = _loaded(head, cfg, rows, count, cells, defects)
    times_s = np.asarray(loaded.time, np.float64)
    if -np.inf < times_s[0] < 0:  # a recorder that counts its samples from 0
        times_s = times_s - times_s[0]
    good = np.isfinite(times_s) & (times_s >= 0) & (times_s < 366 * 86400)
    good[good] = _rising(times_s[good])
    if not good.all():
        defects["samples out of time"] = int(np.count_nonzero(~good))
    if not good.any():
        raise SourceError(f"{path} holds no samples whose time can be told; name another file")
    return Record(
        cfg.station_name.strip(),
        cfg.rec_dev_id.strip(),
        cfg.frequency,
        head.start_ns,
        head.time_quality,
        times_s[good],
        tuple(
            AnalogRecord(
                channel.name or f"A{number}",
                channel.ph,
                channel.ccbm,
                channel.uu,
                channel.skew * 1e-6,
                np.asarray(values, np.float64)[good] * _to_primary(channel),
            )
            for number, (channel, values) in enumerate(zip(cfg.analog_channels, loaded.analog, strict=True), 1)
        ),
        tuple(
            StatusRecord(channel.name or f"D{number}", channel.y & 1, np.asarray(values, np.int64)[good] & 1)
            for number, (channel, values) in enumerate(zip(cfg.status_channels, loaded.status, strict=True), 1)
        ),
        defects,
    )


def _rising(times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """(N,) whether a time is later than all before it."""
    highest = np.maximum.accumulate(times_s)
    return np.concatenate([np.ones(min(len(times_s), 1), np.bool_), times_s[1:] > highest[:-1]])


def _to_primary(channel: Any) -> float:
    if channel.pors.strip().upper() != "S" or not channel.secondary or not channel.primary:
        return 1.0
    return float(channel.primary / channel.secondary)


def _loaded(
    head: _Head, cfg: Any, rows: list[str] | bytes, count: int, cells: int, defects: Counter[str]
) -> tuple[Any, int]:
    """The library's object with ``count`` samples, or as many as can be read."""
    if isinstance(rows, bytes):
        return _load(head, cfg, rows, count), count
    rows = rows[:count]
    try:
        return _load(head, cfg, "\n".join(rows), count), count
    except _DAMAGE:
        readable = [row for row in rows if _is_sample(row, cells)]
        defects["unreadable samples"] = len(rows) - len(readable)
        if not readable:
            raise
        return _load(head, cfg, "\n".join(readable), len(readable)), len(readable)


def _load(head: _Head, cfg: Any, rows: str | bytes, count: int) -> Any:
    from comtrade import Comtrade

    lines = list(head.lines)
    lines[head.rate_line] = f"{cfg.sample_rates[-1][0]!r},{count}"  # what is there, not what was promised
    loaded = Comtrade(ignore_warnings=True, use_numpy_arrays=True, use_double_precision=True)
    with np.errstate(all="ignore"):
        loaded.read("\n".join(lines), rows)
    return loaded


def _is_sample(row: str, cells: int) -> bool:
    parts = row.strip().split(",")
    if len(parts) != cells:
        return False
    try:
        int(parts[0])
        for number, part in enumerate(parts[1:]):
            float(part or "0" if number == 0 else part)
    except ValueError:
        return False
    return True
