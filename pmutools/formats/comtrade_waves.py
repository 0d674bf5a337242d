"""COMTRADE records of waveforms: phasors estimated at the reporting instants of UTC."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.config import StationDetails
from pmutools.errors import SettingsError, SourceError
from pmutools.formats import Nominal
from pmutools.formats.columns import Column, unique
from pmutools.formats.comtrade_record import AnalogRecord, Record
from pmutools.formats.comtrade_stream import MAX_RATE, Words, electrical, line_hz, planned, rows_of, words_of
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
from pmutools.formats.rows import Rows, planned_source
from pmutools.formats.source import TableSource
from pmutools.timebase import NS

_PHASES = {**dict.fromkeys("AR1", "A"), **dict.fromkeys("BS2", "B"), **dict.fromkeys("CT3", "C")}
_PHASE_IN_NAME = re.compile(r"(?:^|[ _.:\-])[VUI]?L?([ABC123])(?:[ _.:\-]?N)?$|[VUI]([ABC])(?![A-Z]{3})", re.IGNORECASE)


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
        unit, scale = electrical(analog.unit.strip())
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


def waveform_source(path: Path, record: Record, nominal: Nominal) -> TableSource:
    """Phasors estimated from a record of waveforms; raises what :func:`~pmutools.formats.comtrade.read` does."""
    nominal_hz = nominal.fnom_hz or line_hz(record)
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
    words = words_of(record, [], [title])
    columns = [*estimator.columns(title), *words.columns]
    details = StationDetails(service_class="P", window_us=round(2e6 / nominal_hz))
    plan = planned(path, columns, rate, nominal_hz, words, details)
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
        self._others = [analog for analog in record.analogs if not electrical(analog.unit.strip())[0]]
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

    def rows(self, instants_ns: npt.NDArray[np.int64], words: Words) -> Iterator[Rows]:
        whole_ns = self._record.start_ns // NS * NS
        instants_s = (instants_ns - whole_ns).astype(np.float64) * 1e-9
        for piece, about in windows(self._times_s, instants_s, self._nominal_hz):
            with np.errstate(all="ignore"):  # a file of floats may hold any
                values = self._phasor_values(about)
            at = np.searchsorted(self._times_s, instants_s[piece] + 1e-9, side="right") - 1
            values |= {name: column[at] for name, column in words.values.items()}
            for number, analog in enumerate(self._others):
                values[f"analog {number}"] = np.interp(instants_s[piece], self._times_s, analog.values)
            yield rows_of(self._record, instants_ns[piece], values)

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
