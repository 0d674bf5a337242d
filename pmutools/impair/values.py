"""Decoded values by the names that tables give them, and comparisons of them: ``value N1.freq_hz < 59.95``.

Names: ``STATION.freq_hz``, ``.rocof_hz_s``, ``.stat``, ``STATION.CHANNEL.mag`` and ``.deg`` of a phasor,
``STATION.CHANNEL`` of an analog, ``STATION.WORD1`` of a digital word. The station may be left out where a stream has
only one.
"""

from __future__ import annotations

import cmath
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.frames import Data
from pmutools.c37118.layout import layout_of
from pmutools.impair.moment import Moment, Test
from pmutools.parsers import integer, number, suggestion, unique


class Reader(NamedTuple):
    """How one value is read. ``word``: it is a 16-bit word, which a mask may be laid on."""

    read: Callable[[Data], float]
    word: bool = False


@lru_cache(maxsize=256)
def readers(config: StreamConfig) -> Mapping[str, Reader]:
    """Every value of a stream's data frames by its name."""
    found = list(_readers(config))
    names = unique(name for name, _ in found)
    table = {name: reader for name, (_, reader) in zip(names, found, strict=True)}
    if len(config.stations) == 1:
        prefix = f"{_title(config, 0)}."
        table = {name.removeprefix(prefix): reader for name, reader in table.items()} | table
    return table


def _title(config: StreamConfig, number_: int) -> str:
    return unique(station.name.strip() or f"PMU{station.idcode}" for station in config.stations)[number_]


def _readers(config: StreamConfig) -> Iterator[tuple[str, Reader]]:
    layout = layout_of(config)
    titles = unique(station.name.strip() or f"PMU{station.idcode}" for station in config.stations)
    for number_, (title, station, slots) in enumerate(zip(titles, config.stations, layout.slots, strict=True)):
        yield f"{title}.stat", _station_value(Data.stat, number_, word=True)
        yield f"{title}.freq_hz", _station_value(Data.frequency, number_)
        yield f"{title}.rocof_hz_s", _station_value(Data.rocof, number_)
        phasors = unique(channel.name.strip() or f"PH{k}" for k, channel in enumerate(station.phasors, 1))
        for name, column in zip(phasors, slots.phasor_columns, strict=True):
            yield f"{title}.{name}.mag", _phasor_value(abs, column)
            yield f"{title}.{name}.deg", _phasor_value(lambda phasor: math.degrees(cmath.phase(phasor)), column)
        analogs = unique(channel.name.strip() or f"AN{k}" for k, channel in enumerate(station.analogs, 1))
        for name, column in zip(analogs, slots.analog_columns, strict=True):
            yield f"{title}.{name}", _station_value(Data.analog, column)
        for word, at in enumerate(slots.digitals, 1):
            yield f"{title}.WORD{word}", _word(at)


def _station_value(read: Callable[[Data, int], float], place: int, *, word: bool = False) -> Reader:
    return Reader(lambda data: read(data, place), word)


def _phasor_value(of: Callable[[complex], float], column: int) -> Reader:
    return Reader(lambda data: of(data.phasor(column)))


def _word(at: int) -> Reader:
    return Reader(lambda data: data.values[at], word=True)


def _masked(value: float, mask: float) -> bool:
    return bool(int(value) & int(mask))


_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "&": _masked,
}
_COMPARISON = re.compile(rf'(?:"([^"]+)"|([^<>=!&"]+?))\s*({"|".join(_OPERATORS)})\s*([^\s<>=!&]+)')


class Comparison(NamedTuple):
    """``name operator limit``; ``&`` asks whether any bit of the mask is set. An absent value (NaN) never fits."""

    name: str
    operator: str
    limit: float

    def reader(self, config: StreamConfig) -> Reader:
        """How the value is read in this stream; raises ValueError where it has none of that name."""
        known = readers(config)
        if self.name not in known:
            raise ValueError(f"no value {self.name!r}; {suggestion(self.name, known)}")
        found = known[self.name]
        if self.operator == "&" and not found.word:
            raise ValueError(f"{self.name} & mask: only STAT and digital words have bits; compare with <, > or ==")
        return found

    def test(self) -> Test:
        """Whether a data frame's value fits. A frame that cannot be decoded does not."""
        compare, limit = _OPERATORS[self.operator], self.limit
        config: StreamConfig | None = None
        read: Callable[[Data], float] | None = None

        def fits(at: Moment) -> bool:
            nonlocal config, read
            data = at.original.data if at.type is FrameType.DATA else None
            if data is None:
                return False
            if read is None or data.config is not config:
                config, read = data.config, self.reader(data.config).read
            value = read(data)
            return value == value and compare(value, limit)

        return fits


def comparison(text: str) -> Comparison:
    """``N1.freq_hz < 59.95``, ``"BUS 5, LINE.V1.mag" > 1e5``, ``stat & 0x2000``; raises ValueError."""
    match = _COMPARISON.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text.strip()!r} is not of the form NAME < NUMBER (or <=, >, >=, ==, !=, & MASK)")
    quoted, plain, sign, limit = match.groups()
    whole = sign == "&" or limit[:2].lower() == "0x"
    return Comparison((quoted or plain).strip(), sign, integer(0, 0xFFFF)(limit) if whole else number()(limit))
