"""The columns of a table of measurements: one row a data frame, the same list for writing and for reading.

Five columns say which frame a row is (:data:`FRAME_COLUMNS`); the rest are one :class:`Column` each, made from the
configuration by :func:`columns_of`. A column is found in a :class:`Batch` by its quantity and place, so that neither
direction needs a case per quantity::

    config -> columns_of -> (name, quantity, at)          quantities(batch)[quantity][:, at]
                                                          batch_of(columns, the file's values by name)

Phasors are magnitude and angle, or real and imaginary part. Polar columns of a polar FORMAT are taken from the wire
values and put back there, so they keep what a complex number cannot: an angle beside magnitude 0, or beyond ±180°.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import Batch, encode_batch
from pmutools.c37118.checksum import seal_array
from pmutools.c37118.config import Station, StreamConfig
from pmutools.c37118.constants import INT16_FILLER, STAT_ABSENT, STAT_DATA_ERROR_MASK, Format
from pmutools.c37118.frames import RAD_PER_COUNT
from pmutools.c37118.layout import dtype_of, layout_of
from pmutools.parsers import unique as unique

Phasors = Literal["polar", "rect"]
Floats = npt.NDArray[np.float64]

FRAME_COLUMNS = ("time_ns", "arrival_ns", "stamp_source", "idcode", "time_quality")
"""Columns of the frame itself; CSV has ``time`` for ``time_ns``."""
PHASOR_PARTS = {"polar": ("mag", "deg"), "rect": ("re", "im")}
INTEGERS = ("stat", "digital")
"""Quantities of 16-bit words; all others are floats."""


class Column(NamedTuple):
    """One column: its name, and what of which station and channel it holds; ``channel`` is empty for STAT and FREQ.

    ``quantity`` is stat, freq_hz, rocof_hz_s, mag, deg, re, im, analog or digital; ``at`` is the place among all of
    that quantity in the frame: station number, phasor, analog or digital word.
    """

    name: str
    station: str
    channel: str
    quantity: str
    at: int
    unit: str = ""


class FrameValues(NamedTuple):
    """The frame columns of N rows; ``stamp_source`` indexes :data:`~pmutools.c37118.batch.STAMP_SOURCES`."""

    time_ns: npt.NDArray[np.int64]
    arrival_ns: npt.NDArray[np.int64]
    stamp_source: npt.NDArray[np.uint8]
    time_quality: npt.NDArray[np.uint8]


@lru_cache(maxsize=8192)
def columns_of(config: StreamConfig, phasors: Phasors) -> tuple[Column, ...]:
    """The columns of ``config``'s stations in the order of the frame, with unique names."""
    at = Counter[str]()
    columns: list[Column] = []
    titles = unique(station.name.strip() or f"PMU{station.idcode}" for station in config.stations)
    for title, station in zip(titles, config.stations, strict=True):
        for name, channel, quantity, unit in _station_columns(title, station, phasors):
            columns.append(Column(name, title, channel, quantity, at[quantity], unit))
            at[quantity] += 1
    names = unique((column.name for column in columns), FRAME_COLUMNS)
    return tuple(column._replace(name=name) for column, name in zip(columns, names, strict=True))


def _station_columns(title: str, station: Station, phasors: Phasors) -> Iterable[tuple[str, str, str, str]]:
    for quantity, unit in (("stat", ""), ("freq_hz", "Hz"), ("rocof_hz_s", "Hz/s")):
        yield f"{title}.{quantity}", "", quantity, unit
    names = unique(channel.name.strip() or f"PH{k}" for k, channel in enumerate(station.phasors, 1))
    for name, phasor in zip(names, station.phasors, strict=True):
        for part in PHASOR_PARTS[phasors]:
            unit = "deg" if part == "deg" else "A" if phasor.kind == "I" else "V"
            yield f"{title}.{name}.{part}", name, part, unit
    for name in unique(channel.name.strip() or f"AN{k}" for k, channel in enumerate(station.analogs, 1)):
        yield f"{title}.{name}", name, "analog", ""
    for number in range(1, len(station.digitals) + 1):
        yield f"{title}.WORD{number}", f"WORD{number}", "digital", ""


# --- batch -> columns -------------------------------------------------------------------------------------------


def quantities(batch: Batch, phasors: Phasors, wanted: Collection[str]) -> dict[str, npt.NDArray[Any]]:
    """The values of ``batch`` by quantity, each (N, places), at least those ``wanted``; angles in degrees."""
    values: dict[str, npt.NDArray[Any]] = {
        "stat": batch.stat,
        "freq_hz": batch.frequency,
        "rocof_hz_s": batch.rocof,
        "analog": batch.analogs,
        "digital": batch.digitals,
    }
    if phasors == "rect":
        return values | {"re": batch.phasors.real, "im": batch.phasors.imag}
    if not {"mag", "deg"}.isdisjoint(wanted):
        values["mag"], values["deg"] = _polar(batch)
    return values


def _polar(batch: Batch) -> tuple[Floats, Floats]:
    """Magnitudes and angles (N, P)."""
    if batch.wire is not None and _is_polar(batch.config):
        magnitude, degrees = np.empty(batch.phasors.shape), np.empty(batch.phasors.shape)
    else:
        magnitude, degrees = np.abs(batch.phasors), np.degrees(np.angle(batch.phasors))
    if batch.wire is not None:
        _read_polar(batch.wire, batch.config, magnitude, degrees)
    return magnitude, degrees


@lru_cache(maxsize=8192)
def _is_polar(config: StreamConfig) -> bool:
    """Whether all stations send polar phasors."""
    return all(station.format & Format.POLAR for station in config.stations)


@lru_cache(maxsize=8192)
def _polar_stations(config: StreamConfig) -> tuple[tuple[str, slice, Floats, Floats], ...]:
    """dtype field, phasor columns, factors and angle offsets (rad) of the stations that send polar phasors."""
    return tuple(_found_polar(config))


def _found_polar(config: StreamConfig) -> Iterable[tuple[str, slice, Floats, Floats]]:
    layout = layout_of(config)
    for number, (station, slots) in enumerate(zip(config.stations, layout.slots, strict=True)):
        if station.format & Format.POLAR and station.phasors:
            columns = slice(slots.phasor_columns.start, slots.phasor_columns.stop)
            factors = np.array([slot.factor for slot in layout.phasors[columns]])
            turns = np.array([slot.angle_offset_rad for slot in layout.phasors[columns]])
            yield f"s{number}", columns, factors, turns


def _read_polar(wire: npt.NDArray[np.void], config: StreamConfig, magnitude: Floats, degrees: Floats) -> None:
    for name, columns, factors, turns in _polar_stations(config):
        raw = wire[name]["phasors"]
        if raw.dtype.names:  # int16: a magnitude and an angle in counts
            angle = np.where(raw["angle"] == INT16_FILLER, np.nan, raw["angle"] * RAD_PER_COUNT)
            magnitude[:, columns] = np.where(np.isnan(angle), np.nan, raw["mag"] * factors)
        else:
            angle = raw[..., 1].astype(np.float64)
            magnitude[:, columns] = raw[..., 0] * factors
        degrees[:, columns] = np.degrees(angle - turns)


# --- columns -> batch -------------------------------------------------------------------------------------------


def batch_of(
    config: StreamConfig,
    columns: Iterable[Column],
    frames: FrameValues,
    values: Callable[[str], npt.NDArray[Any] | None],
    *,
    exact: bool,
) -> Batch:
    """A batch of ``config`` from a file's columns: ``values`` gives N numbers by column name, None where it has none.

    What is missing is NaN; a missing or NaN STAT is 0, or says absent where the station has nothing in that row.
    With ``exact``, polar stations given by polar columns get their ``wire`` at once, for what only the columns hold.
    """
    count, layout = len(frames.time_ns), layout_of(config)
    stations, phasors = len(layout.slots), len(layout.phasors)
    places = {"stat": stations, "freq_hz": stations, "rocof_hz_s": stations, "analog": len(layout.analogs)}
    places |= {"digital": sum(len(slots.digitals) for slots in layout.slots)}
    places |= dict.fromkeys(("mag", "deg", "re", "im"), phasors)
    found = {quantity: np.full((count, width), np.nan) for quantity, width in places.items()}
    polar = False
    for column in columns:
        if (given := values(column.name)) is not None:
            found[column.quantity][:, column.at] = given
            polar = polar or column.quantity == "mag"
    complexes = np.empty((count, phasors), np.complex128)
    complexes.real, complexes.imag = found["re"], found["im"]
    if polar:
        _turn_to_complex(complexes, found)
    valid = _present(config, found["freq_hz"], complexes)
    stat = np.where(np.isnan(found["stat"]), np.where(valid, 0, STAT_ABSENT), found["stat"])
    stat_words = _words(stat)
    batch = Batch(
        config,
        frames.time_ns,
        frames.arrival_ns,
        frames.stamp_source,
        frames.time_quality,
        stat_words,
        complexes,
        found["freq_hz"],
        found["rocof_hz_s"],
        found["analog"],
        _words(np.nan_to_num(found["digital"])),
        valid & ((stat_words & STAT_DATA_ERROR_MASK) == 0),
    )
    return _with_polar_wire(batch, found["mag"], found["deg"]) if polar and exact else batch


def _words(values: Floats) -> npt.NDArray[np.uint16]:
    return np.clip(values, 0, 0xFFFF).astype(np.uint16)


def _turn_to_complex(out: npt.NDArray[np.complex128], found: Mapping[str, Floats]) -> None:
    """Fill ``out`` from magnitudes and degrees where it has no rectangular value; multiples of 90° come out exact."""
    magnitude, degrees = found["mag"], found["deg"]
    with np.errstate(invalid="ignore", over="ignore"):  # infinities, and NaN that signals
        quarters = np.rint(degrees / 90.0)
        rest = np.radians(degrees - 90.0 * quarters)
        cosine, sine = np.cos(rest), np.sin(rest)
        turn = [quarters % 4 == k for k in range(4)]
        real = magnitude * np.select(turn, [cosine, -sine, -cosine, sine], np.nan)
        imag = magnitude * np.select(turn, [sine, cosine, -sine, -cosine], np.nan)
    missing = np.isnan(out.real) & np.isnan(out.imag)
    out.real[missing], out.imag[missing] = real[missing], imag[missing]


def _present(config: StreamConfig, frequency: Floats, phasors: npt.NDArray[np.complex128]) -> npt.NDArray[np.bool_]:
    """(N, S) whether a station has a frequency or a phasor."""
    present: npt.NDArray[np.bool_] = ~np.isnan(frequency)
    for number, slots in enumerate(layout_of(config).slots):
        columns = slice(slots.phasor_columns.start, slots.phasor_columns.stop)
        present[:, number] |= ~np.isnan(phasors[:, columns]).all(axis=1)
    return present


def _with_polar_wire(batch: Batch, magnitude: Floats, degrees: Floats) -> Batch:
    """``batch`` with frames whose polar phasors come from the columns themselves, where there are such stations."""
    config = batch.config
    stations = _polar_stations(config)
    if not stations or not len(batch):
        return batch
    octets, _ = encode_batch(batch)
    wire = octets.reshape(-1).view(dtype_of(config))
    for name, columns, factors, turns in stations:
        raw, sizes, angles = wire[name]["phasors"], magnitude[:, columns], degrees[:, columns]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            counts = sizes / np.where(factors == 0, np.inf, factors)
            turned = np.radians(angles) + turns if turns.any() else np.radians(angles)  # adding 0 would lose -0
            if raw.dtype.names:
                given = ~np.isnan(sizes) & ~np.isnan(angles)
                angle_counts = np.clip(np.rint(turned / RAD_PER_COUNT), INT16_FILLER + 1, -INT16_FILLER - 1)
                raw["mag"][given] = np.clip(np.rint(counts), 0, 0xFFFF)[given]
                raw["angle"][given] = angle_counts[given]
            else:
                given = ~np.isnan(sizes) | ~np.isnan(angles)
                raw[..., 0][given], raw[..., 1][given] = counts[given], turned[given]
    seal_array(octets)
    wire.flags.writeable = False
    return replace(batch, wire=wire)
