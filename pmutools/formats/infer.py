"""A configuration for measurements that come without one: read from the names of columns, and from their values.

The result is a valid C37.118 stream: all FORMATs float, polar or rectangular as the columns are, names of at most 16
bytes and unique, TIME_BASE 1e6, DATA_RATE the standard rate nearest to the spacing of the stamps.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.config import AnalogChannel, DigitalWord, PhasorChannel, Station, StreamConfig
from pmutools.c37118.config_kinds import cut_name
from pmutools.c37118.constants import FNOM_50_HZ, LABELS_PER_WORD, MAX_FRAME_SIZE, NAME_SIZE, Format
from pmutools.errors import SourceError
from pmutools.formats.columns import FRAME_COLUMNS, Column
from pmutools.timebase import NS

STANDARD_RATES = (1, 2, 5, 10, 12, 15, 20, 24, 25, 30, 40, 48, 50, 60, 100, 120, 200, 240)
"""Frames/s that stamps are taken to mean; see clause 6.4 and C37.118.1 for the required ones."""
RATE_TOLERANCE = 0.04
CURRENT = 1 << 24
"""PHUNIT of a current whose values are floats."""
_ALL_FLOAT = Format.PHASOR_FLOAT | Format.ANALOG_FLOAT | Format.FREQ_FLOAT
_STATION_QUANTITIES = ("stat", "freq_hz", "rocof_hz_s")
_PAIRS = {"mag": "deg", "deg": "mag", "re": "im", "im": "re"}
_POLAR = ("mag", "deg")
_WORD = re.compile(r"WORD\d+")


class Plan(NamedTuple):
    """A configuration, and where in its batches each column of the file belongs.

    ``exact`` says that the values were once frames of this configuration, whose bytes are to come back.
    """

    config: StreamConfig
    columns: tuple[Column, ...]
    exact: bool


# --- names of columns -> what they are --------------------------------------------------------------------------


def columns_from_names(names: Sequence[str], title: str) -> list[Column]:
    """What the columns of a table are, by their names alone; ``title`` is the station of those that name none.

    Names are ``STATION.CHANNEL.mag`` and so on, as :func:`~pmutools.formats.columns.columns_of` makes them; what does
    not look like that is left out. Channels whose name begins with I are currents.
    """
    present = set(names)
    heads = [name.rpartition(".") for name in names]
    stations = sorted({head for head, dot, tail in heads if dot and tail in _STATION_QUANTITIES}, key=len, reverse=True)
    columns = []
    for name in names:
        if name in FRAME_COLUMNS or name == "time":
            continue
        station, rest = _split(name, stations, title)
        channel, dot, part = rest.rpartition(".")
        if rest in _STATION_QUANTITIES:
            columns.append(Column(name, station, "", rest, 0))
        elif dot and part in _PAIRS and f"{name[: -len(part)]}{_PAIRS[part]}" in present:
            columns.append(Column(name, station, channel, part, 0, "A" if channel[:1] in "Ii" else "V"))
        elif rest and rest != name:
            columns.append(Column(name, station, rest, "digital" if _WORD.fullmatch(rest) else "analog", 0))
    return columns


def _split(name: str, stations: Iterable[str], title: str) -> tuple[str, str]:
    """Station and remainder of a column's name; stations may have dots in their names."""
    for station in stations:
        if name.startswith(f"{station}."):
            return station, name[len(station) + 1 :]
    head, dot, rest = name.partition(".")
    if not dot or rest in _PAIRS:
        return title, name
    return head, rest


# --- what the columns are -> configuration ----------------------------------------------------------------------


def infer(columns: Sequence[Column], *, idcode: int, data_rate: int, fnom_hz: float) -> Plan:
    """The configuration of a stream with these columns, whose ``at`` is filled in.

    Stations and channels come in the order of their first columns. Raises SourceError for more than a data frame
    holds, or for none at all.
    """
    titles = list(dict.fromkeys(column.station for column in columns))
    if not titles:
        raise SourceError("no columns of measurements: name them STATION.freq_hz, STATION.CHANNEL.mag, .deg and so on")
    stations: list[Station] = []
    placed: list[Column] = []
    bases = dict.fromkeys(("phasor", "analog", "digital"), 0)
    for number, (title, name) in enumerate(zip(titles, wire_names(titles), strict=True)):
        own = [column for column in columns if column.station == title]
        channels: dict[str, list[str]] = {group: [] for group in bases}
        for column in own:
            group = _group(column)
            if group is None:
                placed.append(column._replace(at=number))
                continue
            if column.channel not in channels[group]:
                channels[group].append(column.channel)
            placed.append(column._replace(at=bases[group] + channels[group].index(column.channel)))
        for group, found in channels.items():
            bases[group] += len(found)
        own_idcode = idcode if len(titles) == 1 else (idcode + number) % 0xFFFE + 1
        stations.append(_station(name, own_idcode, own, channels, fnom_hz))
    config = StreamConfig(idcode, tuple(stations), data_rate)
    if config.frame_size > MAX_FRAME_SIZE:
        raise SourceError(f"{len(columns)} columns make data frames of {config.frame_size} bytes; leave some out")
    return Plan(config, tuple(placed), exact=False)


def _group(column: Column) -> str | None:
    if column.quantity in _PAIRS:
        return "phasor"
    return column.quantity if column.quantity in ("analog", "digital") else None


def _station(name: str, idcode: int, own: Sequence[Column], channels: dict[str, list[str]], fnom_hz: float) -> Station:
    currents = {column.channel for column in own if column.quantity in _PAIRS and column.unit == "A"}
    first = next((column.quantity for column in own if column.quantity in _PAIRS), "mag")
    # one name space: a channel called WORD1 keeps clear of the words
    phasors = wire_names(channels["phasor"])
    analogs = wire_names(channels["analog"])
    return Station(
        name,
        idcode,
        _ALL_FLOAT | (Format.POLAR if first in _POLAR else Format(0)),
        tuple(
            PhasorChannel(short, CURRENT if channel in currents else 0)
            for short, channel in zip(phasors, channels["phasor"], strict=True)
        ),
        tuple(AnalogChannel(short) for short in analogs),
        tuple(
            DigitalWord(tuple(f"{word} BIT{bit}"[:NAME_SIZE] for bit in range(LABELS_PER_WORD)))
            for word in channels["digital"]
        ),
        FNOM_50_HZ if fnom_hz == 50 else 0,
    )


def wire_names(names: Iterable[str]) -> list[str]:
    """Names cut to the 16 bytes of CFG-2, told apart by ``#2``, ``#3`` ... where that makes them equal."""
    out: list[str] = []
    for name in names:
        fresh, count = cut_name(name.strip()) or "?", 1
        while fresh in out:
            count += 1
            fresh = cut_name(name.strip(), NAME_SIZE - len(f"#{count}")) + f"#{count}"
        out.append(fresh)
    return out


# --- values -> rate and nominal frequency -----------------------------------------------------------------------


def data_rate_of(time_ns: npt.NDArray[np.int64]) -> int | None:
    """DATA_RATE of stamps (N,): > 0 frames/s, < 0 seconds a frame; None where fewer than two tell nothing.

    The mean of spacings near their median counts, so neither gaps nor rounded stamps matter.
    """
    steps = np.diff(np.unique(time_ns))
    if not len(steps):
        return None
    usual = np.sort(steps)[(len(steps) - 1) // 2]  # the lower median: one that occurs
    period_s = float(steps[np.abs(steps - usual) <= usual / 2].mean()) / NS
    if period_s > 1.5:
        return -min(round(period_s), 0x7FFF)
    rate = 1 / period_s
    nearest = min(STANDARD_RATES, key=lambda standard: abs(standard - rate))
    return nearest if abs(nearest - rate) <= RATE_TOLERANCE * nearest else min(max(round(rate), 1), 0x7FFF)


def nominal_hz_of(frequencies: npt.NDArray[np.float64], data_rate: int | None) -> float:
    """50 or 60 Hz, whichever is nearer to the median of plausible frequencies, or else goes with the rate."""
    known = frequencies[(frequencies > 40) & (frequencies < 65)]
    if len(known):
        return 50.0 if float(np.median(known)) < 55 else 60.0
    return 50.0 if data_rate in (25, 50, 100, 200) else 60.0
