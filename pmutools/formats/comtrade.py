"""COMTRADE records (``.cfg`` with ``.dat``, or ``.cff``) as streams of synchrophasors. Read only.

Two kinds of records are read:

- **phasor data**, as C37.111-2013 Annex H and the PSRC schema lay them out: analog channels ``STATION:CHANNEL`` whose
  ``ph`` says ``Am Aa`` (magnitude, angle), ``Ar Ai`` (real, imaginary), ``F`` or ``df``; what other programs write is
  understood too, by endings of names (``:PM :PA :PR :PI``, ``_MAG``, `` ANG`` ...) and by units (deg, rad, Hz, Hz/s);
- **waveforms**: phasors are estimated at the reporting instants of UTC (:mod:`pmutools.formats.comtrade_waves`), a
  channel each, V1 and I1 from three phases, frequency from V1, else from the strongest channel. It is an estimate.

A record is of phasors if it has a pair of them, or no more than 240 samples/s. Magnitudes are V and A RMS, primary.
Status channels become digital words of 16, other analog channels analogs. Times are UTC unless the time code of 2013
says otherwise. Records are held in memory whole.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pmutools.c37118.config import StreamConfig
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.columns import Column
from pmutools.formats.comtrade_record import Record, read_record
from pmutools.formats.comtrade_stream import (
    DEVIATION_HZ,
    MAX_RATE,
    absolute_ns,
    electrical,
    line_hz,
    planned,
    rows_of,
    words_of,
)
from pmutools.formats.comtrade_waves import waveform_source
from pmutools.formats.estimate import (
    Floats,
)
from pmutools.formats.infer import data_rate_of, nominal_hz_of
from pmutools.formats.rows import planned_source
from pmutools.formats.source import BLOCK_FRAMES, TableSource

_DEGREES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0, "rad": np.degrees(1.0), "radians": np.degrees(1.0)}
_HERTZ = {"hz": 1.0, "mhz": 1e-3}
_PARTS = {
    **dict.fromkeys(("PM", "MAG", "MAGNITUDE", "VPHM", "IPHM"), "mag"),
    **dict.fromkeys(("PA", "ANG", "ANGLE", "PHASE", "VPHA", "IPHA"), "deg"),
    **dict.fromkeys(("PR", "RE", "REAL"), "re"),
    **dict.fromkeys(("PI", "IM", "IMAG", "IMAGINARY"), "im"),
    **dict.fromkeys(("F", "FQ", "FREQ", "FREQUENCY"), "freq_hz"),
    **dict.fromkeys(("DF", "DFDT", "DF/DT", "DFREQ", "ROCOF"), "rocof_hz_s"),
}
_ENDING = re.compile(rf"(?:^|(.*?)[:._ \-])({'|'.join(map(re.escape, _PARTS))})\d?", re.IGNORECASE)
_PHASE_PARTS = {"m": "mag", "a": "deg", "r": "re", "i": "im"}


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a record. ``configs`` are not looked at: its channels are its own.

    Raises SourceError for one that cannot be read or holds nothing to make a stream of, SettingsError for a rate that
    it cannot have.
    """
    record = read_record(path)
    channels = [_channel(record, number) for number in range(len(record.analogs))]
    if _has_pairs(channels) or _highest_rate(record) <= MAX_RATE:
        return _phasor_source(path, record, channels, nominal)
    return waveform_source(path, record, nominal)


def _has_pairs(channels: Sequence[_Channel]) -> bool:
    """Whether some channel is beside its other part, of the same name."""
    names = {
        part: {(channel.station, channel.base) for channel in channels if channel.quantity == part}
        for part in _PHASE_PARTS.values()
    }
    return bool(names["mag"] & names["deg"] or names["re"] & names["im"])


def _highest_rate(record: Record) -> float:
    """Samples/s of the fastest stretch of more than two."""
    return max((part.rate_hz for part in record.stretches if part.last - part.first > 2), default=0.0)


# --- records of phasors -----------------------------------------------------------------------------------------


class _Channel(NamedTuple):
    """An analog channel: ``quantity`` is mag, deg, re, im, freq_hz, rocof_hz_s or analog; ``base`` is what it is of."""

    number: int
    station: str
    base: str
    quantity: str
    unit: str
    scale: float
    name: str
    """As it stands, without the station."""


def _channel(record: Record, number: int) -> _Channel:
    analog = record.analogs[number]
    unit, phase = analog.unit.strip(), analog.phase.strip()
    kind, scale = electrical(unit)
    match = _ENDING.fullmatch(analog.name.strip())
    base, quantity = (match[1] or "", _PARTS[match[2].upper()]) if match else (analog.name.strip(), "")
    if quantity == "deg" and kind:
        base, quantity = analog.name.strip(), ""  # VOLTAGE A PHASE
    if phase.lower() in ("f", "df"):
        quantity = {"f": "freq_hz", "df": "rocof_hz_s"}[phase.lower()]
    elif len(phase) == 2 and phase[1] in _PHASE_PARTS and kind + unit:
        quantity = _PHASE_PARTS[phase[1]]
    elif unit.lower() in _DEGREES:
        quantity = "deg"
    elif unit.lower() in _HERTZ:
        quantity = "freq_hz"
    elif unit.lower().partition("/")[0] in _HERTZ and "/" in unit:
        quantity = "rocof_hz_s"
    elif kind and quantity in ("", "freq_hz", "rocof_hz_s"):
        base, quantity = analog.name.strip(), "mag"
    if quantity == "deg":
        scale = _DEGREES.get(unit.lower(), 1.0)
    elif quantity in ("freq_hz", "rocof_hz_s"):
        scale = _HERTZ.get(unit.lower().partition("/")[0], 1.0)
        base = base if match else analog.name.strip().partition(":")[0]
    if not quantity:
        base, quantity = analog.name.strip(), "analog"
    title = record.station or record.device or "STATION"
    station, base = _split(base, title, frequency=quantity.startswith(("freq", "rocof")))
    name = analog.name.strip().removeprefix(f"{station}:").strip()
    return _Channel(number, station, base, quantity, kind or ("A" if base[:1] in "Ii" else "V"), scale, name)


def _split(name: str, title: str, *, frequency: bool) -> tuple[str, str]:
    """Station and channel of ``STATION:CHANNEL``, else the record's own station; a frequency is of what it names."""
    station, colon, channel = name.partition(":")
    if frequency:
        return station.strip() or title, ""
    return (station.strip(), channel.strip()) if colon and channel.strip() and station.strip() else (title, name)


def _phasor_source(path: Path, record: Record, channels: Sequence[_Channel], nominal: Nominal) -> TableSource:
    title = record.station or record.device or "STATION"
    channels = _with_frequencies(_split_at_dots(channels, title), record, title)
    time_ns = absolute_ns(record, record.times_s)
    rate = nominal.data_rate or data_rate_of(time_ns)
    columns: list[Column] = []
    values: dict[str, Floats] = {}
    for channel, column in _placed(channels):
        columns.append(column)
        values[column.name] = record.analogs[channel.number].values * channel.scale
    frequencies = [values[column.name] for column in columns if column.quantity == "freq_hz"]
    fnom_hz = nominal.fnom_hz or line_hz(record) or nominal_hz_of(_joined(frequencies), rate)
    for known in frequencies:
        if np.isfinite(known).any() and abs(float(np.nanmedian(known))) < DEVIATION_HZ:
            known += fnom_hz
    words = words_of(record, columns, [title])
    values |= words.values
    plan = planned(path, [*columns, *words.columns], rate or round(fnom_hz), fnom_hz, words)
    blocks = [slice(first, first + BLOCK_FRAMES) for first in range(0, len(time_ns), BLOCK_FRAMES)]
    rows = (
        rows_of(record, time_ns[piece], {name: column[piece] for name, column in values.items()}) for piece in blocks
    )
    return planned_source(path, "comtrade", plan, rows, record.defects)


def _split_at_dots(channels: Sequence[_Channel], title: str) -> list[_Channel]:
    """Stations from ``STATION.CHANNEL`` too, where more than one channel begins so."""
    heads = Counter(channel.base.partition(".")[0] for channel in channels if "." in channel.base)
    out = []
    for channel in channels:
        head, dot, rest = channel.base.partition(".")
        if channel.station == title and dot and rest and heads[head] > 1:
            channel = channel._replace(station=head, base=rest, name=channel.name.removeprefix(f"{head}."))
        out.append(channel)
    return out


def _with_frequencies(channels: Sequence[_Channel], record: Record, title: str) -> list[_Channel]:
    """Frequencies of stations that only they name go to the record's own, but for names with a colon."""
    known = {channel.station for channel in channels if not channel.quantity.startswith(("freq", "rocof"))}
    return [
        channel
        if channel.station in known or ":" in record.analogs[channel.number].name
        else channel._replace(station=title)
        for channel in channels
    ]


def _placed(channels: Sequence[_Channel]) -> Iterator[tuple[_Channel, Column]]:
    """What each channel is a column of: parts of phasors in pairs, all others analogs."""
    taken: dict[int, tuple[str, str]] = {}
    for first, second in (("mag", "deg"), ("re", "im")):
        for one, other in _pairs(channels, first, second):
            name = one.base or other.base or ("I" if one.unit == "A" else "V")
            taken[one.number], taken[other.number] = (name, one.unit), (name, one.unit)
    names = _unique_by_pair(channels, taken)
    seen: set[tuple[str, str]] = set()
    for channel in channels:
        key = channel.station, channel.quantity
        if channel.number in taken:
            name, unit = names[channel.number], taken[channel.number][1]
            yield channel, Column(str(channel.number), channel.station, name, channel.quantity, 0, unit)
        elif channel.quantity in ("freq_hz", "rocof_hz_s") and key not in seen:
            seen.add(key)
            yield channel, Column(str(channel.number), channel.station, "", channel.quantity, 0)
        else:
            count = [other.name for other in channels if other.station == channel.station].count(channel.name)
            name = channel.name if count == 1 else f"{channel.name} {channel.number + 1}"
            yield channel, Column(str(channel.number), channel.station, name, "analog", 0)


def _pairs(channels: Sequence[_Channel], first: str, second: str) -> Iterator[tuple[_Channel, _Channel]]:
    """Channels of the two quantities with the same station and name, in order; then neighbours."""
    free = [channel for channel in channels if channel.quantity == second]
    left = []
    for channel in (channel for channel in channels if channel.quantity == first):
        key = channel.station, channel.base
        other = next((other for other in free if (other.station, other.base) == key), None)
        if other is None:
            left.append(channel)
            continue
        free.remove(other)
        yield channel, other
    for channel in left:
        other = next((other for other in free if abs(other.number - channel.number) == 1), None)
        if other is not None:
            free.remove(other)
            yield channel, other


def _unique_by_pair(channels: Sequence[_Channel], taken: Mapping[int, tuple[str, str]]) -> dict[int, str]:
    """Names of phasors by channel, the n-th phasor of a name in its station told apart from the first."""
    used: Counter[tuple[str, str, str]] = Counter()
    names: dict[int, str] = {}
    for channel in channels:
        if channel.number in taken:
            name = taken[channel.number][0]
            count = used[channel.station, name, channel.quantity]
            used[channel.station, name, channel.quantity] += 1
            names[channel.number] = f"{name}#{count + 1}" if count else name
    return names


def _joined(columns: Sequence[Floats]) -> Floats:
    return np.concatenate(columns) if columns else np.empty(0)
