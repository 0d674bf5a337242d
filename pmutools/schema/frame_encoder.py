"""``PmuFrame`` messages straight from a frame's values, for what is logged between two ticks of a controller.

The same bytes as :func:`pmutools.schema.pmu_log.encode_frame` gives, at a third of the time, for the layout that
phasor measurement units mostly have: one station, floats as they stand. Any other goes that way.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from math import copysign

from pmutools.c37118 import Data, Frame
from pmutools.c37118.layout import Layout
from pmutools.flow import StampSource
from pmutools.schema.messages import MESSAGES
from pmutools.schema.pmu_log import encode_frame, pmu_frame

_NUMBERS = {field.name: number for number, field in enumerate(MESSAGES["PmuFrame"].fields, 1)}
_VARINT, _FIXED64, _BYTES = 0, 1, 2


def _tag(field: str, kind: int) -> bytes:
    return bytes((_NUMBERS[field] << 3 | kind,))


@lru_cache(maxsize=256)
def _varint(value: int) -> bytes:
    """Of a number that is not negative; many frames share their times."""
    octets = bytearray()
    while value > 0x7F:
        octets.append(value & 0x7F | 0x80)
        value >>= 7
    octets.append(value)
    return bytes(octets)


_TIME, _ARRIVAL, _TICK = (_tag(name, _VARINT) for name in ("time_ns", "arrival_ns", "tick_ns"))
_WIRE, _STAT, _QUALITY = _tag("wire", _BYTES), _tag("stat", _VARINT), _tag("time_quality", _VARINT)
_SOURCES = {source: _tag("stamp_source", _BYTES) + _varint(len(source)) + source.encode() for source in StampSource}
_V1_RE, _V1_IM, _FREQUENCY, _ROCOF = (
    _tag(name, _FIXED64)[0] for name in ("v1_re", "v1_im", "frequency_hz", "rocof_hz_s")
)
_THREE, _FOUR = struct.Struct("<BdBdBd"), struct.Struct("<BdBdBdBd")


class FrameEncoder:
    """Of the frames of one layout; ``station`` is the PMU's own, ``name`` the PMU's."""

    def __init__(self, name: str, layout: Layout, station: int) -> None:
        self._name = name
        self._station = station
        slots = layout.slots[station]
        self._slots = slots
        self._plain = len(layout.slots) == 1 and not (slots.analog_columns or slots.digitals) and layout.time_base > 0
        count = len(slots.phasor_columns)
        size = _varint(8 * count)
        heads = (_tag(field, _BYTES) + size for field in ("phasor_re", "phasor_im"))
        self._heads = tuple(heads)
        self._doubles = struct.Struct(f"<{count}d")
        self._time_base = _tag("time_base", _VARINT) + _varint(layout.time_base)

    def encode(self, frame: Frame, data: Data, v1: complex, tick_ns: int) -> bytes:
        """The message of ``frame``, which decodes to ``data``, as tick ``tick_ns`` took it."""
        values, slots, wire = data.values, self._slots, frame.data
        frequency, rocof, time_ns = data.frequency(self._station), data.rocof(self._station), data.time_ns
        arrival_ns = frame.arrival_ns or 0
        numbers = v1.real and v1.imag and frequency and time_ns > 0 and tick_ns > 0  # proto3 leaves zeros out
        if slots.parts is None or not (self._plain and numbers and arrival_ns >= 0):
            return self._other(frame, data, v1, tick_ns)
        first, second = values[slots.parts[0]], values[slots.parts[1]]
        if slots.polar:
            phasors = data.phasors(self._station)
            first, second = tuple(z.real for z in phasors), tuple(z.imag for z in phasors)
        stat, quality = data.stat(self._station), data.time_quality
        return b"".join(
            (
                _TIME + _varint(time_ns),
                _ARRIVAL + _varint(arrival_ns) if arrival_ns else b"",
                _TICK + _varint(tick_ns),
                _SOURCES[frame.stamp_source],
                _WIRE + _varint(len(wire)),
                wire,
                self._time_base,
                _STAT + _varint(stat) if stat else b"",
                _QUALITY + _varint(quality) if quality else b"",
                _FOUR.pack(_V1_RE, v1.real, _V1_IM, v1.imag, _FREQUENCY, frequency, _ROCOF, rocof)
                if rocof or copysign(1, rocof) < 0
                else _THREE.pack(_V1_RE, v1.real, _V1_IM, v1.imag, _FREQUENCY, frequency),
                self._heads[0],
                self._doubles.pack(*first),
                self._heads[1],
                self._doubles.pack(*second),
            )
        )

    def _other(self, frame: Frame, data: Data, v1: complex, tick_ns: int) -> bytes:
        return encode_frame(pmu_frame(self._name, frame, data, station=self._station, v1=v1), tick_ns)
