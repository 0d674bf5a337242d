"""Where every value of a data frame lies: one walk over the configuration makes every decoder's layout.

The same list of fields gives the precompiled :class:`struct.Struct` for a live frame, the numpy dtype for a batch,
the field offsets that fault injection needs, and the fields that the scapy layer shows (clause 6.3, Table 6).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakValueDictionary

from pmutools.c37118.config import PhasorChannel, Station, StreamConfig
from pmutools.c37118.constants import PREFIX_SIZE, Format

if TYPE_CHECKING:
    import numpy as np


class Field(NamedTuple):
    """A run of equal items in a data frame. ``code`` is the struct code of one item, of ``width`` values.

    ``offset`` counts bytes from the frame's start; ``first`` is the place of the first value in the tuple that the
    layout's struct unpacks.
    """

    name: str
    code: str
    width: int
    items: int
    offset: int
    first: int

    @property
    def size(self) -> int:
        return struct.calcsize(">" + self.code) * self.items


class PhasorSlot(NamedTuple):
    """How to read one phasor from unpacked values: at ``first``, times ``factor``, turned by -``angle_offset_rad``."""

    first: int
    polar: bool
    floating: bool
    factor: float
    angle_offset_rad: float


class AnalogSlot(NamedTuple):
    """How to read one analog: the value at place ``at``, times ``multiplier``, plus ``offset``."""

    at: int
    multiplier: float
    offset: float


class StationSlots(NamedTuple):
    """Places of one station's values in the unpacked tuple, and its columns in the flat channel lists."""

    stat: int
    freq: int
    freq_float: bool
    fnom_hz: float
    digitals: range
    parts: tuple[slice, slice] | None
    """Real and imaginary parts, or magnitudes and angles, where these are the phasors as they stand: floats without
    factor and turn."""
    polar: bool
    """Which of the two ``parts`` are."""
    phasor_columns: range
    analog_columns: range
    digital_columns: range


class Run(NamedTuple):
    """Consecutive stations whose blocks are laid out alike, so that they decode as one array of shape (N, R).

    ``first`` and ``stations`` count stations, ``offset`` is the first block's byte, ``size`` a block's bytes. The
    ranges are columns over all stations of the stream; every station has an equal share of each.
    """

    first: int
    stations: int
    offset: int
    size: int
    fields: tuple[Field, ...]
    phasors: slice
    analogs: slice
    digitals: slice


PREFIX_FIELDS = (
    Field("sync", "H", 1, 1, 0, 0),
    Field("framesize", "H", 1, 1, 2, 1),
    Field("idcode", "H", 1, 1, 4, 2),
    Field("soc", "I", 1, 1, 6, 3),
    Field("fracsec", "I", 1, 1, 10, 4),
)
"""``fracsec`` here is the whole word: the time quality byte above 24 bits of FRACSEC."""


def station_fields(station: Station, offset: int, index: int) -> Iterator[Field]:
    """The fields of one PMU block that begins at byte ``offset`` and value ``index``."""
    fmt = station.format
    phasor = "ff" if fmt & Format.PHASOR_FLOAT else "Hh" if fmt & Format.POLAR else "hh"
    frequency = "f" if fmt & Format.FREQ_FLOAT else "h"
    runs = (
        ("stat", "H", 1),
        ("phasors", phasor, len(station.phasors)),
        ("freq", frequency, 1),
        ("dfreq", frequency, 1),
        ("analogs", "f" if fmt & Format.ANALOG_FLOAT else "h", len(station.analogs)),
        ("digitals", "H", len(station.digitals)),
    )
    for name, code, count in runs:
        if count:
            field = Field(name, code, len(code), count, offset, index)
            yield field
            offset += field.size
            index += field.width * count


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Layout:
    """Everything derived from a configuration that decoding its data frames needs; the same object for all alike."""

    stations: tuple[tuple[Field, ...], ...]
    unpacker: struct.Struct
    phasors: tuple[PhasorSlot, ...]
    analogs: tuple[AnalogSlot, ...]
    slots: tuple[StationSlots, ...]
    time_base: int
    runs: tuple[Run, ...]

    @property
    def frame_size(self) -> int:
        return self.unpacker.size


_known: WeakValueDictionary[tuple[object, ...], Layout] = WeakValueDictionary()
"""Layouts in use, by what they are made of."""


@lru_cache(maxsize=1 << 16)  # as many streams as a receiver knows; layouts are few
def layout_of(config: StreamConfig) -> Layout:
    """The layout of ``config``'s data frames, made once a configuration.

    It is the same object for configurations whose frames are decoded alike, such as those of PMUs of one model.
    """
    offset, index = PREFIX_SIZE, len(PREFIX_FIELDS)
    stations, phasors, analogs, slots = [], list[PhasorSlot](), list[AnalogSlot](), list[StationSlots]()
    digital_column = 0
    for station in config.stations:
        fields = {field.name: field for field in station_fields(station, offset, index)}
        first_phasor, first_analog = len(phasors), len(analogs)
        if "phasors" in fields:
            at = fields["phasors"].first
            phasors += [_phasor_slot(channel, station.format, at + 2 * k) for k, channel in enumerate(station.phasors)]
        for k, channel in enumerate(station.analogs):
            multiplier, shift = channel.anscale or (1.0, 0.0)
            analogs.append(AnalogSlot(fields["analogs"].first + k, multiplier, shift))
        last = fields.get("digitals") or fields.get("analogs") or fields["dfreq"]
        words = len(station.digitals)
        first_digital = fields["digitals"].first if words else 0
        slots.append(
            StationSlots(
                fields["stat"].first,
                fields["freq"].first,
                bool(station.format & Format.FREQ_FLOAT),
                station.fnom_hz,
                range(first_digital, first_digital + words),
                _parts(phasors[first_phasor:]),
                bool(station.format & Format.POLAR),
                range(first_phasor, len(phasors)),
                range(first_analog, len(analogs)),
                range(digital_column, digital_column + words),
            )
        )
        digital_column += words
        stations.append(tuple(fields.values()))
        offset, index = last.offset + last.size, last.first + last.width * last.items
    codes = [field.code for field in PREFIX_FIELDS]
    codes += [field.code * field.items for fields_ in stations for field in fields_]
    layout = Layout(
        tuple(stations),
        struct.Struct(f">{''.join(codes)}H"),
        tuple(phasors),
        tuple(analogs),
        tuple(slots),
        config.time_base,
        tuple(_runs(config, stations, slots)),
    )
    nominal = tuple(slot.fnom_hz for slot in slots)
    return _known.setdefault((layout.stations, layout.phasors, layout.analogs, layout.time_base, nominal), layout)


_PLAIN = PhasorSlot(0, polar=False, floating=True, factor=1.0, angle_offset_rad=0.0)[2:]


def _parts(phasors: Sequence[PhasorSlot]) -> tuple[slice, slice] | None:
    if not phasors or any(slot[2:] != _PLAIN for slot in phasors):
        return None
    first, last = phasors[0].first, phasors[-1].first
    return slice(first, last + 1, 2), slice(first + 1, last + 2, 2)


def _runs(config: StreamConfig, stations: Sequence[tuple[Field, ...]], slots: Sequence[StationSlots]) -> Iterator[Run]:
    """Stations laid out alike, gathered; what follows from another FORMAT, count or FNOM begins a new run."""
    shapes = [
        (slot.fnom_hz, *((f.name, f.code, f.items) for f in fields))
        for fields, slot in zip(stations, slots, strict=True)
    ]
    first = 0
    for after in range(1, len(shapes) + 1):
        if after < len(shapes) and shapes[after] == shapes[first]:
            continue
        head, last = slots[first], slots[after - 1]
        yield Run(
            first,
            after - first,
            stations[first][0].offset,
            config.stations[first].block_size,
            stations[first],
            slice(head.phasor_columns.start, last.phasor_columns.stop),
            slice(head.analog_columns.start, last.analog_columns.stop),
            slice(head.digital_columns.start, last.digital_columns.stop),
        )
        first = after


def _phasor_slot(channel: PhasorChannel, fmt: Format, index: int) -> PhasorSlot:
    floating = bool(fmt & Format.PHASOR_FLOAT)
    if channel.phscale is not None:
        factor, turn = channel.phscale.scale, channel.phscale.angle_offset_rad
    else:
        factor, turn = (1.0 if floating else channel.unit), 0.0
    return PhasorSlot(index, bool(fmt & Format.POLAR), floating, factor, turn)


_SCALARS = {"H": ">u2", "h": ">i2", "f": ">f4"}


def block_dtype(fields: Sequence[Field]) -> np.dtype[np.void]:
    """Big-endian dtype of one PMU block: ``stat phasors freq dfreq analogs digitals``, empty ones absent.

    Phasors are (P, 2), or (P,) of ``mag`` and ``angle`` for int polar.
    """
    import numpy as np

    columns: list[tuple[object, ...]] = []
    for field in fields:
        if field.name in ("stat", "freq", "dfreq"):
            columns.append((field.name, _SCALARS[field.code]))
        elif field.code == "Hh":
            columns.append((field.name, [("mag", ">u2"), ("angle", ">i2")], (field.items,)))
        elif field.width == 2:
            columns.append((field.name, _SCALARS[field.code[0]], (field.items, 2)))
        else:
            columns.append((field.name, _SCALARS[field.code], (field.items,)))
    return np.dtype(columns)


def dtype_of(config: StreamConfig) -> np.dtype[np.void]:
    """Big-endian dtype of one data frame; ``itemsize`` is FRAMESIZE.

    Fields ``sync framesize idcode soc fracsec``, one nested :func:`block_dtype` a station as ``s0, s1, ...``, ``chk``.
    """
    return _dtype_of(layout_of(config))


@lru_cache(maxsize=4096)
def _dtype_of(layout: Layout) -> np.dtype[np.void]:
    import numpy as np

    head = [("sync", ">u2"), ("framesize", ">u2"), ("idcode", ">u2"), ("soc", ">u4"), ("fracsec", ">u4")]
    blocks = [(f"s{number}", block_dtype(fields)) for number, fields in enumerate(layout.stations)]
    dtype: np.dtype[np.void] = np.dtype([*head, *blocks, ("chk", ">u2")])
    assert dtype.itemsize == layout.frame_size
    return dtype
