"""What streams made of COMTRADE records have in common: units, status channels, the configuration, rows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import DigitalWord, StationDetails
from pmutools.c37118.constants import LABELS_PER_WORD
from pmutools.errors import SourceError
from pmutools.formats.columns import Column, FrameValues
from pmutools.formats.comtrade_record import Record, StatusRecord
from pmutools.formats.estimate import (
    Floats,
)
from pmutools.formats.infer import Plan, infer, wire_names
from pmutools.formats.rows import NO_IDCODE, Rows, stamp_code
from pmutools.timebase import NS

MAX_RATE = 240
"""Frames/s; what has more samples is a waveform."""
DEVIATION_HZ = 5.0
_FACTORS = {"": 1.0, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "k": 1e3, "K": 1e3, "M": 1e6}
_UNIT = re.compile(r"([uµmkKM]?)([VvAa])(?:olts?|mps?|mperes?)?(?:[ _]?(?:rms|RMS))?")


def electrical(unit: str) -> tuple[str, float]:
    """V or A and the factor to it; empty for another unit."""
    match = _UNIT.fullmatch(unit)
    return (match[2].upper(), _FACTORS[match[1]]) if match else ("", 1.0)


def line_hz(record: Record) -> float | None:
    """50 or 60 where the header says about that."""
    return next((line for line in (50.0, 60.0) if abs(record.line_hz - line) < DEVIATION_HZ), None)


class Words(NamedTuple):
    """Status channels as words of 16, bit 0 first: columns, (N,) values, and the words by station."""

    columns: list[Column]
    values: dict[str, Floats]
    words: dict[str, tuple[DigitalWord, ...]]


def words_of(record: Record, columns: Sequence[Column], titles: Sequence[str]) -> Words:
    """Status channels go to the station that their name begins with, else to the last of ``titles``."""
    stations = {column.station for column in columns}
    groups: dict[str, list[StatusRecord]] = {}
    for status in record.statuses:
        head, colon, rest = status.name.partition(":")
        own = bool(colon) and head.strip() in stations and bool(rest.strip())
        title = head.strip() if own else titles[-1]
        groups.setdefault(title, []).append(status._replace(name=rest.strip()) if own else status)
    found = Words([], {}, {})
    for title, group in groups.items():
        words = []
        for number, first in enumerate(range(0, len(group), LABELS_PER_WORD), 1):
            bits = group[first : first + LABELS_PER_WORD]
            name = f"word {title} {number}"
            found.columns.append(Column(name, title, f"WORD{number}", "digital", 0))
            found.values[name] = sum(
                (status.values.astype(np.float64) * (1 << bit) for bit, status in enumerate(bits)),
                np.zeros(len(record.times_s)),
            )
            words.append(_word(bits))
        found.words[title] = tuple(words)
    return found


def _word(bits: Sequence[StatusRecord]) -> DigitalWord:
    names = wire_names([status.name for status in bits])
    normal = sum(status.normal << bit for bit, status in enumerate(bits))
    return DigitalWord((*names, *[""] * (LABELS_PER_WORD - len(bits))), normal, (1 << len(bits)) - 1)


def planned(
    path: Path,
    columns: Sequence[Column],
    rate: int,
    fnom_hz: float,
    words: Words,
    details: StationDetails | None = None,
) -> Plan:
    """The inferred configuration, with the labels of the status channels."""
    try:
        plan = infer(columns, idcode=NO_IDCODE, data_rate=rate, fnom_hz=fnom_hz)
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from None
    titles = list(dict.fromkeys(column.station for column in columns))
    stations = tuple(
        replace(station, digitals=words.words.get(title, ()), details=details)
        for title, station in zip(titles, plan.config.stations, strict=True)
    )
    return plan._replace(config=replace(plan.config, stations=stations))


def absolute_ns(record: Record, times_s: Floats) -> npt.NDArray[np.int64]:
    """POSIX UTC (N,) of times in seconds from the record's start."""
    absolute: npt.NDArray[np.int64] = record.start_ns + np.rint(times_s * NS).astype(np.int64)
    return absolute


def rows_of(record: Record, time_ns: npt.NDArray[np.int64], values: Mapping[str, Floats]) -> Rows:
    """Frames (N,) at ``time_ns`` of columns (N,) by name."""
    count = len(time_ns)
    quality = np.full(count, record.time_quality, np.uint8)
    frames = FrameValues(time_ns, np.full(count, NO_TIME), np.full(count, stamp_code(None), np.uint8), quality)
    return Rows(frames, np.full(count, NO_IDCODE), values.get)
