"""COMTRADE records (``.cfg`` with ``.dat``, or ``.cff``) as streams of synchrophasors. Read only.

Two kinds of records are read:

- **phasor data**, as C37.111-2013 Annex H and the PSRC schema lay them out: analog channels ``STATION:CHANNEL`` whose
  ``ph`` says ``Am Aa`` (magnitude, angle), ``Ar Ai`` (real, imaginary), ``F`` or ``df``; what other programs write is
  understood too, by endings of names (``:PM :PA :PR :PI``, ``_MAG``, `` ANG`` ...) and by units (deg, rad, Hz, Hz/s);
- **waveforms**: phasors are estimated at the reporting instants of UTC (:mod:`pmutools.formats.estimate`), a channel
  each, V1 and I1 from three phases, frequency from V1, else from the strongest channel. It is an estimate.

A record is of phasors if it has a pair of them, or no more than 240 samples/s. Magnitudes are V and A RMS, primary.
Status channels become digital words of 16, other analog channels analogs. Times are UTC unless the time code of 2013
says otherwise. Records are held in memory whole.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import DigitalWord, StationDetails, StreamConfig
from pmutools.c37118.constants import LABELS_PER_WORD
from pmutools.errors import SettingsError, SourceError
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.columns import Column, FrameValues, unique
from pmutools.formats.comtrade_record import AnalogRecord, Record, StatusRecord, read_record
from pmutools.formats.estimate import (
    MIN_SAMPLES_PER_CYCLE,
    Complexes,
    Floats,
    Windows,
    corrected,
    frequency_of,
    positive_sequence,
    whole_windows,
    windows,
)
from pmutools.formats.infer import Plan, data_rate_of, infer, nominal_hz_of, wire_names
from pmutools.formats.rows import NO_IDCODE, Rows, planned_source, stamp_code
from pmutools.formats.source import BLOCK_FRAMES, TableSource
from pmutools.timebase import NS

MAX_RATE = 240
"""Frames/s; what has more samples is a waveform."""
DEVIATION_HZ = 5.0
_FACTORS = {"": 1.0, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "k": 1e3, "K": 1e3, "M": 1e6}
_UNIT = re.compile(r"([uµmkKM]?)([VvAa])(?:olts?|mps?|mperes?)?(?:[ _]?(?:rms|RMS))?")
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
_PHASES = {**dict.fromkeys("AR1", "A"), **dict.fromkeys("BS2", "B"), **dict.fromkeys("CT3", "C")}
_PHASE_IN_NAME = re.compile(r"(?:^|[ _.:\-])[VUI]?L?([ABC123])(?:[ _.:\-]?N)?$|[VUI]([ABC])(?![A-Z]{3})", re.IGNORECASE)


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open a record. ``configs`` are not looked at: its channels are its own.

    Raises SourceError for one that cannot be read or holds nothing to make a stream of, SettingsError for a rate that
    it cannot have.
    """
    record = read_record(path)
    channels = [_channel(record, number) for number in range(len(record.analogs))]
    if _has_pairs(channels) or _highest_rate(record) <= MAX_RATE:
        return _phasor_source(path, record, channels, nominal)
    return _waveform_source(path, record, nominal)


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
    kind, scale = _electrical(unit)
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


def _electrical(unit: str) -> tuple[str, float]:
    """V or A and the factor to it; empty for another unit."""
    match = _UNIT.fullmatch(unit)
    return (match[2].upper(), _FACTORS[match[1]]) if match else ("", 1.0)


def _split(name: str, title: str, *, frequency: bool) -> tuple[str, str]:
    """Station and channel of ``STATION:CHANNEL``, else the record's own station; a frequency is of what it names."""
    station, colon, channel = name.partition(":")
    if frequency:
        return station.strip() or title, ""
    return (station.strip(), channel.strip()) if colon and channel.strip() and station.strip() else (title, name)


def _phasor_source(path: Path, record: Record, channels: Sequence[_Channel], nominal: Nominal) -> TableSource:
    title = record.station or record.device or "STATION"
    channels = _with_frequencies(_split_at_dots(channels, title), record, title)
    time_ns = _absolute_ns(record, record.times_s)
    rate = nominal.data_rate or data_rate_of(time_ns)
    columns: list[Column] = []
    values: dict[str, Floats] = {}
    for channel, column in _placed(channels):
        columns.append(column)
        values[column.name] = record.analogs[channel.number].values * channel.scale
    frequencies = [values[column.name] for column in columns if column.quantity == "freq_hz"]
    fnom_hz = nominal.fnom_hz or _line_hz(record) or nominal_hz_of(_joined(frequencies), rate)
    for known in frequencies:
        if np.isfinite(known).any() and abs(float(np.nanmedian(known))) < DEVIATION_HZ:
            known += fnom_hz
    words = _words(record, columns, [title])
    values |= words.values
    plan = _plan(path, [*columns, *words.columns], rate or round(fnom_hz), fnom_hz, words)
    blocks = [slice(first, first + BLOCK_FRAMES) for first in range(0, len(time_ns), BLOCK_FRAMES)]
    rows = (_rows(record, time_ns[piece], {name: column[piece] for name, column in values.items()}) for piece in blocks)
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


def _line_hz(record: Record) -> float | None:
    """50 or 60 where the header says about that."""
    return next((line for line in (50.0, 60.0) if abs(record.line_hz - line) < DEVIATION_HZ), None)


# --- status channels --------------------------------------------------------------------------------------------


class _Words(NamedTuple):
    """Status channels as words of 16, bit 0 first: columns, (N,) values, and the words by station."""

    columns: list[Column]
    values: dict[str, Floats]
    words: dict[str, tuple[DigitalWord, ...]]


def _words(record: Record, columns: Sequence[Column], titles: Sequence[str]) -> _Words:
    """Status channels go to the station that their name begins with, else to the last of ``titles``."""
    stations = {column.station for column in columns}
    groups: dict[str, list[StatusRecord]] = {}
    for status in record.statuses:
        head, colon, rest = status.name.partition(":")
        own = bool(colon) and head.strip() in stations and bool(rest.strip())
        title = head.strip() if own else titles[-1]
        groups.setdefault(title, []).append(status._replace(name=rest.strip()) if own else status)
    found = _Words([], {}, {})
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


def _plan(
    path: Path,
    columns: Sequence[Column],
    rate: int,
    fnom_hz: float,
    words: _Words,
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


def _absolute_ns(record: Record, times_s: Floats) -> npt.NDArray[np.int64]:
    absolute: npt.NDArray[np.int64] = record.start_ns + np.rint(times_s * NS).astype(np.int64)
    return absolute


def _rows(record: Record, time_ns: npt.NDArray[np.int64], values: Mapping[str, Floats]) -> Rows:
    count = len(time_ns)
    quality = np.full(count, record.time_quality, np.uint8)
    frames = FrameValues(time_ns, np.full(count, NO_TIME), np.full(count, stamp_code(None), np.uint8), quality)
    return Rows(frames, np.full(count, NO_IDCODE), values.get)


# --- waveforms --------------------------------------------------------------------------------------------------


class _Wave(NamedTuple):
    """A voltage or current: its channel, name on the wire, V or A, phase A, B, C or none."""

    analog: AnalogRecord
    name: str
    unit: str
    phase: str
    scale: float


def _waves(record: Record) -> list[_Wave]:
    found = []
    for analog in record.analogs:
        unit, scale = _electrical(analog.unit.strip())
        if unit:
            found.append(_Wave(analog, analog.name.strip(), unit, _phase(analog), scale))
    return found


def _phase(analog: AnalogRecord) -> str:
    """A, B or C by the header's phase, else by the channel's name; empty for neutrals and what is between phases."""
    given = analog.phase.strip().upper().removeprefix("L")
    if given:
        return _PHASES.get(given, "") if given.rstrip("N-") not in ("", "N") and len(given.rstrip("N-")) == 1 else ""
    match = _PHASE_IN_NAME.search(analog.name.strip())
    return _PHASES.get((match[1] or match[2]).upper(), "") if match else ""


def _triples(waves: Sequence[_Wave]) -> list[tuple[int, int, int]]:
    """Places of phases A, B, C that belong together: of one unit and component, one after the other."""
    found: list[tuple[int, int, int]] = []
    for unit in "VA":
        current: dict[str, int] = {}
        component = None
        for number, wave in enumerate(waves):
            if wave.unit != unit or not wave.phase:
                continue
            if wave.phase in current or wave.analog.component != component:
                current, component = {}, wave.analog.component
            current[wave.phase] = number
            if len(current) == 3:
                found.append((current["A"], current["B"], current["C"]))
                current = {}
    return found


def _waveform_source(path: Path, record: Record, nominal: Nominal) -> TableSource:
    nominal_hz = nominal.fnom_hz or _line_hz(record)
    if nominal_hz is None:
        raise SourceError(f"{path}: its header says {record.line_hz:g} Hz; choose a nominal frequency of 50 or 60 Hz")
    rate = nominal.data_rate or int(nominal_hz)
    if not 0 < rate <= MAX_RATE:
        raise SettingsError(f"{path}: {rate} frames/s of synchrophasors: 1 to {MAX_RATE} can be estimated")
    waves = _waves(record)
    if not waves:
        raise SourceError(f"{path} has no channel in V, kV, A or kA: there is nothing to estimate phasors from")
    pieces = list(_instants(record, rate, nominal_hz))
    if not sum(len(instants) for instants in pieces):
        need_ms = 3000 / nominal_hz
        raise SourceError(
            f"{path}: no reporting instant has {need_ms:g} ms of samples about it, "
            f"{MIN_SAMPLES_PER_CYCLE} a cycle or more: too short, or sampled too slowly, to estimate phasors"
        )
    estimator = _Estimator(record, waves, nominal_hz)
    title = record.station or record.device or "STATION"
    words = _words(record, [], [title])
    columns = [*estimator.columns(title), *words.columns]
    details = StationDetails(service_class="P", window_us=round(2e6 / nominal_hz))
    plan = _plan(path, columns, rate, nominal_hz, words, details)
    rows = (block for instants in pieces for block in estimator.rows(instants, words))
    return planned_source(path, "comtrade", plan, rows, record.defects)


def _instants(record: Record, rate: int, nominal_hz: float) -> Iterator[npt.NDArray[np.int64]]:
    """Reporting instants (UTC ns) whose windows lie wholly within evenly spaced samples, stretch by stretch."""
    least_hz = MIN_SAMPLES_PER_CYCLE * nominal_hz
    good = [part for part in record.stretches if part.rate_hz >= least_hz]
    counts = [part.last - part.first for part in record.stretches if part.rate_hz < least_hz]
    slow = sum(count for count in counts if count > 2)  # two are the ends of a gap
    if slow:
        record.defects[f"samples fewer than {MIN_SAMPLES_PER_CYCLE} a cycle"] = slow
    for part in good:
        first_s, last_s = float(record.times_s[part.first]), float(record.times_s[part.last - 1])
        first, last = (record.start_ns + round(at_s * NS) for at_s in (first_s, last_s))
        grid_ns = _grid_ns(np.arange(first * rate // NS, last * rate // NS + 2), rate)
        since_s = (grid_ns - record.start_ns).astype(np.float64) * 1e-9
        yield grid_ns[whole_windows(since_s, first_s, last_s, nominal_hz)]


def _grid_ns(slots: npt.NDArray[np.int64], rate: int) -> npt.NDArray[np.int64]:
    """Times of slots, whose numbers times 1e9 are beyond 64 bits."""
    seconds, number = np.divmod(slots, rate)
    grid: npt.NDArray[np.int64] = seconds * NS + (number * NS + rate // 2) // rate
    return grid


class _Estimator:
    """Columns and rows of a waveform record."""

    def __init__(self, record: Record, waves: Sequence[_Wave], nominal_hz: float) -> None:
        self._record, self._waves, self._nominal_hz = record, waves, nominal_hz
        self._second_s = record.start_ns % NS * 1e-9
        self._times_s = record.times_s + self._second_s
        self._triples = _triples(waves)
        self._others = [analog for analog in record.analogs if not _electrical(analog.unit.strip())[0]]
        sequences = [f"{'V' if waves[triple[0]].unit == 'V' else 'I'}1" for triple in self._triples]
        self._names = unique([*(wave.name for wave in waves), *sequences])
        self._units = [*(wave.unit for wave in waves), *(waves[triple[0]].unit for triple in self._triples)]
        self._leader = self._lead()

    def columns(self, title: str) -> list[Column]:
        """Column names are numbers of phasors, and names of analogs."""
        found = [Column("freq", title, "", "freq_hz", 0), Column("rocof", title, "", "rocof_hz_s", 0)]
        for number, (name, unit) in enumerate(zip(self._names, self._units, strict=True)):
            found += [Column(f"{part} {number}", title, name, part, 0, unit) for part in ("re", "im")]
        names = unique(analog.name.strip() for analog in self._others)
        found += [Column(f"analog {number}", title, name, "analog", 0) for number, name in enumerate(names)]
        return found

    def rows(self, instants_ns: npt.NDArray[np.int64], words: _Words) -> Iterator[Rows]:
        whole_ns = self._record.start_ns // NS * NS
        instants_s = (instants_ns - whole_ns).astype(np.float64) * 1e-9
        for piece, about in windows(self._times_s, instants_s, self._nominal_hz):
            with np.errstate(all="ignore"):  # a file of floats may hold any
                values = self._phasor_values(about)
            at = np.searchsorted(self._times_s, instants_s[piece] + 1e-9, side="right") - 1
            values |= {name: column[at] for name, column in words.values.items()}
            for number, analog in enumerate(self._others):
                values[f"analog {number}"] = np.interp(instants_s[piece], self._times_s, analog.values)
            yield _rows(self._record, instants_ns[piece], values)

    def _phasor_values(self, about: Windows) -> dict[str, Floats]:
        found = [self._of(wave, about) for wave in self._waves]
        found += [positive_sequence(*(found[number] for number in triple)) for triple in self._triples]
        frequency_hz, rocof_hz_s = frequency_of(found[self._leader], self._nominal_hz)
        values = {"freq": frequency_hz, "rocof": rocof_hz_s}
        for number, phasors in enumerate(found):
            whole = corrected(phasors[:, 1], frequency_hz, self._nominal_hz)
            values |= {f"re {number}": whole.real, f"im {number}": whole.imag}
        return values

    def _of(self, wave: _Wave, about: Windows) -> Complexes:
        """A sample taken later shows a phase that is ahead."""
        late = np.exp(-2j * np.pi * self._nominal_hz * wave.analog.skew_s)
        phasors: Complexes = about.phasors(wave.analog.values) * (wave.scale * late)
        return phasors

    def _lead(self) -> int:
        """What the frequency is taken from: V1 if there is one, else the strongest voltage, else I1 or a current."""
        best = [
            (
                self._units[number] == "V",
                number >= len(self._waves),
                -1.0 if number >= len(self._waves) else _strength(self._waves[number]),
                -number,
            )
            for number in range(len(self._names))
        ]
        return -max(best)[3]


def _strength(wave: _Wave) -> float:
    finite = wave.analog.values[np.isfinite(wave.analog.values)]
    return float(np.abs(finite).mean()) * wave.scale if len(finite) else 0.0
