"""One data frame and its stations, by the names that they and their channels have in tables."""

from __future__ import annotations

import cmath
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import DataError, Stat, stat_data_error
from pmutools.c37118.demux import Message
from pmutools.c37118.frames import Data, unpack_data
from pmutools.c37118.layout import layout_of
from pmutools.flow import Flow, StampSource
from pmutools.formats.columns import columns_of
from pmutools.parsers import suggestion
from pmutools.sites import Site

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class _Names(NamedTuple):
    """Names of one station and its channels, in the order of the frame: trimmed, ``#2`` after what comes again."""

    station: str
    phasors: tuple[str, ...]
    analogs: tuple[str, ...]
    digitals: tuple[str, ...]


@lru_cache(maxsize=1024)
def _names(config: StreamConfig) -> tuple[_Names, ...]:
    found: list[dict[str, list[str]]] = []
    titles: list[str] = []
    for column in columns_of(config, "rect"):
        if column.quantity == "stat":
            titles.append(column.station)
            found.append({"re": [], "analog": [], "digital": []})
        elif column.quantity in found[-1]:
            found[-1][column.quantity].append(column.channel)
    return tuple(
        _Names(title, tuple(names["re"]), tuple(names["analog"]), tuple(names["digital"]))
        for title, names in zip(titles, found, strict=True)
    )


class StationValues:
    """One station in one frame; decoded when asked for. Absent numbers are NaN."""

    __slots__ = ("_data", "_names", "number")

    number: int
    """Its place in the frame, from 0."""

    def __init__(self, data: Data, number: int) -> None:
        self._data, self.number = data, number
        self._names = _names(data.config)[number]

    @property
    def name(self) -> str:
        """As sent, trimmed; ``#2`` after what comes again."""
        return self._names.station

    @property
    def freq_hz(self) -> float:
        """Absolute, Hz."""
        return self._data.frequency(self.number)

    @property
    def rocof_hz_s(self) -> float:
        """Hz/s."""
        return self._data.rocof(self.number)

    @property
    def phasors(self) -> dict[str, complex]:
        """V or A RMS, by the channel's name."""
        columns = self._data.layout.slots[self.number].phasor_columns
        return dict(zip(self._names.phasors, map(self._data.phasor, columns), strict=True))

    @property
    def analogs(self) -> dict[str, float]:
        """As sent with CFG-1/2, scaled with CFG-3; by the channel's name."""
        columns = self._data.layout.slots[self.number].analog_columns
        return dict(zip(self._names.analogs, map(self._data.analog, columns), strict=True))

    @property
    def digitals(self) -> dict[str, int]:
        """Words of 16 bits: ``WORD1`` ..."""
        slots = self._data.layout.slots[self.number]
        words = self._data.values[slots.digitals.start : slots.digitals.stop]
        return dict(zip(self._names.digitals, map(int, words), strict=True))

    @property
    def stat(self) -> int:
        """The STAT word."""
        return self._data.stat(self.number)

    @property
    def valid(self) -> bool:
        """STAT calls the data good, and a phasor or the frequency is there."""
        return self._data.valid(self.number)

    @property
    def data_error(self) -> DataError:
        """STAT bits 15-14."""
        return stat_data_error(self.stat)

    @property
    def synchronised(self) -> bool:
        """STAT does not say that the PMU has lost UTC."""
        return not self.stat & Stat.NOT_SYNCHRONISED

    @property
    def triggered(self) -> bool:
        """STAT bit 11."""
        return bool(self.stat & Stat.TRIGGER)

    def __repr__(self) -> str:
        phasors = ", ".join(f"{name}={_polar(value)}" for name, value in self.phasors.items())
        return f"<{self.name} stat={self.stat:#06x} {self.freq_hz:.4f} Hz {phasors}>"


def _polar(value: complex) -> str:
    return f"{abs(value):.6g}<{cmath.phase(value) * 180 / cmath.pi:.3f}"


class StreamFrame:
    """One data frame: when, from whom, and its stations. Nothing is decoded before it is asked for."""

    __slots__ = ("_data", "_sites", "_time_ns", "arrival_ns", "config", "flow", "stamp_source", "wire")

    arrival_ns: int | None
    """When it arrived: POSIX UTC, ns; unknown where nobody saw it."""
    stamp_source: StampSource
    """Who took the arrival."""
    config: StreamConfig
    """The configuration that it was sent by."""
    flow: Flow
    """Where it came from and to."""
    wire: bytes
    """The frame as sent."""

    def __init__(self, message: Message, sites: tuple[Site, ...] = ()) -> None:
        frame, self.flow, config = message
        assert config is not None, "data frames have a configuration"
        self.config, self.wire = config, frame.data
        self.arrival_ns, self.stamp_source = frame.arrival_ns, frame.stamp_source
        self._sites = sites
        self._data: Data | None = None
        self._time_ns: int | None = None

    @property
    def data(self) -> Data:
        """The frame's values by number (:mod:`pmutools.c37118.frames`)."""
        if self._data is None:
            self._data = unpack_data(self.wire, self.config, layout_of(self.config))
        return self._data

    @property
    def idcode(self) -> int:
        """Of the stream."""
        return self.config.idcode

    @property
    def time_ns(self) -> int:
        """When it was measured: POSIX UTC, ns."""
        if self._time_ns is None:
            self._time_ns = self.data.time_ns
        return self._time_ns

    @property
    def time(self) -> datetime:
        """The same as a datetime in UTC, cut to microseconds."""
        return _EPOCH + timedelta(microseconds=self.time_ns // 1000)

    @property
    def delay_ns(self) -> int | None:
        """Arrival less stamp: estimation, network and the two clocks' difference; unknown without an arrival."""
        return None if self.arrival_ns is None else self.arrival_ns - self.time_ns

    @property
    def time_quality(self) -> int:
        """The time quality byte: leap flags and MSG_TQ."""
        return self.data.time_quality

    @property
    def locked(self) -> bool:
        """MSG_TQ says that the clock is locked."""
        return self.time_quality & 0xF == 0

    @property
    def stations(self) -> dict[str, StationValues]:
        """By name, in the order of the frame."""
        data = self.data
        return {names.station: StationValues(data, number) for number, names in enumerate(_names(self.config))}

    @property
    def pmus(self) -> dict[str, StationValues]:
        """By the names of the initialisation file, where the stream was opened from one; else the stations."""
        if not self._sites:
            return self.stations
        data, names = self.data, _names(self.config)
        found = {}
        for site in self._sites:
            numbers = site.stations(self.config)
            for number in numbers:
                name = site.name if len(numbers) == 1 else f"{site.name}.{names[number].station}"
                found[name] = StationValues(data, number)
        return found

    def __getitem__(self, station: str) -> StationValues:
        """A station by its name. Raises KeyError, which says which there are."""
        for number, names in enumerate(_names(self.config)):
            if names.station == station:
                return StationValues(self.data, number)
        raise KeyError(f"{station}: no such station; {suggestion(station, (n.station for n in _names(self.config)))}")

    @property
    def station(self) -> StationValues:
        """The only station. Raises LookupError where there is not one."""
        if len(self.config.stations) != 1:
            there = ", ".join(names.station for names in _names(self.config)) or "none"
            raise LookupError(f"stream {self.idcode} has {len(self.config.stations)} stations: name one of {there}")
        return StationValues(self.data, 0)

    @property
    def freq_hz(self) -> float:
        """Of the only :attr:`station`."""
        return self.station.freq_hz

    @property
    def rocof_hz_s(self) -> float:
        """Of the only :attr:`station`."""
        return self.station.rocof_hz_s

    @property
    def phasors(self) -> dict[str, complex]:
        """Of the only :attr:`station`."""
        return self.station.phasors

    @property
    def analogs(self) -> dict[str, float]:
        """Of the only :attr:`station`."""
        return self.station.analogs

    @property
    def digitals(self) -> dict[str, int]:
        """Of the only :attr:`station`."""
        return self.station.digitals

    @property
    def stat(self) -> int:
        """Of the only :attr:`station`."""
        return self.station.stat

    @property
    def valid(self) -> bool:
        """Of the only :attr:`station`."""
        return self.station.valid

    def __repr__(self) -> str:
        return f"<frame of {self.idcode} at {self.time:%Y-%m-%dT%H:%M:%S.%f}Z: {', '.join(self.stations)}>"
