"""Single frames: data, header and command, decoded to values and encoded to bytes.

:func:`decode_data` is the live path: one precompiled struct, values left in wire units until they are asked for.
Many equal frames at once: :mod:`pmutools.c37118.batch`. Configurations: :mod:`pmutools.c37118.config`.
"""

from __future__ import annotations

import cmath
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pmutools import timebase
from pmutools.c37118.checksum import chk, sealed
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import (
    CHK_SIZE,
    INT16_FILLER,
    MAX_FRAME_SIZE,
    PREFIX_SIZE,
    STAT_DATA_ERROR_MASK,
    FrameType,
    command_name,
)
from pmutools.c37118.layout import Layout, layout_of
from pmutools.c37118.prefix import Prefix, decode_prefix, encode_prefix, verified
from pmutools.errors import EncodeError, LengthError, WireError

NAN = float("nan")
_NAN_PHASOR = complex(NAN, NAN)
RAD_PER_COUNT = 1e-4


class StationData(NamedTuple):
    """One station's values in SI units: phasors V or A RMS, frequency Hz, ROCOF Hz/s; absent values are NaN."""

    stat: int
    valid: bool
    phasors: tuple[complex, ...]
    frequency: float
    rocof: float
    analogs: tuple[float, ...]
    digitals: tuple[int, ...]


class Data:
    """One data frame: its wire values (``values``, exactly as sent) and, on request, what they mean.

    Channel numbers run over the whole frame, all stations' phasors (or analogs) in order.
    """

    __slots__ = ("config", "layout", "values")

    def __init__(self, config: StreamConfig, values: tuple[int | float, ...]) -> None:
        self.config = config
        self.layout = layout_of(config)
        self.values = values

    @property
    def prefix(self) -> Prefix:
        sync, framesize, idcode, soc, word = self.values[:5]
        return Prefix(sync, framesize, idcode, soc, word >> 24, word & 0xFFFFFF)  # type: ignore[arg-type,operator]

    @property
    def idcode(self) -> int:
        return self.values[2]  # type: ignore[return-value]

    @property
    def time_quality(self) -> int:
        """The whole time quality byte: leap flags and MSG_TQ."""
        return self.values[4] >> 24  # type: ignore[operator]

    @property
    def time_ns(self) -> int:
        """Time of measurement, POSIX UTC."""
        values = self.values
        return timebase.to_ns(values[3], values[4] & 0xFFFFFF, self.layout.time_base)  # type: ignore[arg-type,operator]

    def stat(self, station: int = 0) -> int:
        return self.values[self.layout.slots[station].stat]  # type: ignore[return-value]

    def valid(self, station: int = 0) -> bool:
        """STAT calls the data good, and something was measured: a phasor or the frequency is present."""
        if self.stat(station) & STAT_DATA_ERROR_MASK:
            return False
        return not math.isnan(self.frequency(station)) or any(
            not cmath.isnan(self.phasor(column)) for column in self.layout.slots[station].phasor_columns
        )

    def phasor(self, column: int) -> complex:
        """Phasor in V or A RMS; NaN where the frame holds a filler."""
        at, polar, floating, factor, turn = self.layout.phasors[column]
        first, second = self.values[at], self.values[at + 1]
        if polar:
            angle = (second if floating else second * RAD_PER_COUNT) - turn
            if math.isinf(angle) or (second == INT16_FILLER and not floating):
                return _NAN_PHASOR
            magnitude = factor * first
            return complex(magnitude * math.cos(angle), magnitude * math.sin(angle))
        if not floating and first == INT16_FILLER and second == INT16_FILLER:
            return _NAN_PHASOR
        value = complex(factor * first, factor * second)
        return value * cmath.exp(-1j * turn) if turn else value

    def frequency(self, station: int = 0) -> float:
        """Absolute frequency in Hz."""
        slots = self.layout.slots[station]
        raw = self.values[slots.freq]
        if slots.freq_float:
            return raw
        return NAN if raw == INT16_FILLER else slots.fnom_hz + raw / 1000

    def rocof(self, station: int = 0) -> float:
        """Rate of change of frequency in Hz/s."""
        slots = self.layout.slots[station]
        raw = self.values[slots.freq + 1]
        if slots.freq_float:
            return raw
        return NAN if raw == INT16_FILLER else raw / 100

    def analog(self, column: int) -> float:
        """The wire value, with CFG-3 multiplied and shifted by ANSCALE."""
        at, multiplier, offset = self.layout.analogs[column]
        return self.values[at] * multiplier + offset

    def station(self, station: int = 0) -> StationData:
        values, slots = self.values, self.layout.slots[station]
        phasors = self.phasors(station)
        stat, frequency = values[slots.stat], self.frequency(station)
        present = not math.isnan(frequency) or not all(map(cmath.isnan, phasors))
        return StationData(
            stat,  # type: ignore[arg-type]
            present and not stat & STAT_DATA_ERROR_MASK,  # type: ignore[operator]
            phasors,
            frequency,
            self.rocof(station),
            tuple(map(self.analog, slots.analog_columns)) if slots.analog_columns else (),
            values[slots.digitals.start : slots.digitals.stop],  # type: ignore[arg-type]
        )

    def phasors(self, station: int = 0) -> tuple[complex, ...]:
        """All phasors of a station in V or A RMS, at once where they stand in the frame as they are."""
        slots = self.layout.slots[station]
        if slots.parts is not None:
            first, second = self.values[slots.parts[0]], self.values[slots.parts[1]]
            if not slots.polar:
                return tuple(map(complex, first, second))
            try:
                phasors = tuple(map(cmath.rect, first, second))
            except ValueError:  # an infinite angle
                phasors = (_NAN_PHASOR,)
            if all(map(cmath.isfinite, phasors)):
                return phasors
        return tuple(map(self.phasor, slots.phasor_columns))

    @property
    def stations(self) -> tuple[StationData, ...]:
        return tuple(map(self.station, range(len(self.layout.slots))))


def decode_data(frame: bytes, config: StreamConfig) -> Data:
    """Decode one data frame sent under ``config``; CHK, IDCODE and FRAMESIZE are checked.

    Raises
    ------
    LengthError, ChecksumError, WireError
        The frame is not a data frame of this stream and configuration, or is damaged.
    """
    layout = layout_of(config)
    if len(frame) != layout.frame_size:
        raise LengthError(f"data frame of {config.idcode}", layout.frame_size, len(frame), idcode=config.idcode)
    if chk(frame):
        verified(frame)  # says which of SYNC, FRAMESIZE and CHK is wrong
    return unpack_data(frame, config, layout)


def unpack_data(frame: bytes, config: StreamConfig, layout: Layout) -> Data:
    """:func:`decode_data` of a frame whose length and CHK are known to hold (a framer's)."""
    data = Data.__new__(Data)
    data.config = config
    data.layout = layout
    data.values = values = layout.unpacker.unpack(frame)
    if values[0] & 0xFFF0 != 0xAA00 or values[1] != layout.unpacker.size or values[2] != config.idcode:
        prefix = verified(frame)
        raise WireError(f"{prefix.type.name} frame of {prefix.idcode} where data of {config.idcode} was expected")
    return data


def stamp_ns(frame: bytes, config: StreamConfig) -> int:
    """SOC and FRACSEC of a frame of this stream, POSIX UTC: of a data frame, when it was measured."""
    prefix = decode_prefix(frame)
    return timebase.to_ns(prefix.soc, prefix.fracsec, config.time_base)


def encode_data(data: Data) -> bytes:
    """The frame of ``data.values``, with FRAMESIZE and CHK computed; raises EncodeError for a value out of range."""
    values = list(data.values)
    values[1] = data.layout.frame_size
    try:
        frame = data.layout.unpacker.pack(*values)
    except struct.error as error:
        raise EncodeError(f"data frame of {data.config.idcode}: {error}") from None
    return sealed(frame[:-CHK_SIZE])


def restamp(frame: bytes, soc: int, fracsec: int, *, idcode: int | None = None) -> bytes:
    """The same frame at another time (and for another stream): SOC, FRACSEC, IDCODE and CHK alone change."""
    stamp = soc.to_bytes(4, "big") + frame[10:11] + fracsec.to_bytes(3, "big")
    head = frame[:4] + (frame[4:6] if idcode is None else idcode.to_bytes(2, "big"))
    return sealed(head + stamp + frame[PREFIX_SIZE:-CHK_SIZE])


@dataclass(frozen=True, slots=True)
class CommandFrame:
    """A command to the stream ``prefix.idcode``; ``extended`` is the EXTFRAME, user data."""

    prefix: Prefix
    code: int
    extended: bytes = b""

    @property
    def name(self) -> str:
        return command_name(self.code)


@dataclass(frozen=True, slots=True)
class HeaderFrame:
    """Free text about a stream. ``raw`` are its bytes."""

    prefix: Prefix
    raw: bytes

    @property
    def text(self) -> str:
        return self.raw.decode("ascii", "replace")


def decode_command(frame: bytes) -> CommandFrame:
    """Decode a command frame (clause 6.6); raises WireError as :func:`~pmutools.c37118.prefix.verified` does."""
    prefix = _expect(frame, FrameType.COMMAND)
    if len(frame) < PREFIX_SIZE + 2 + CHK_SIZE:
        raise LengthError("command frame", PREFIX_SIZE + 2 + CHK_SIZE, len(frame), idcode=prefix.idcode)
    return CommandFrame(prefix, int.from_bytes(frame[14:16], "big"), frame[16:-CHK_SIZE])


def decode_header(frame: bytes) -> HeaderFrame:
    """Decode a header frame (clause 6.2.3); raises WireError as :func:`~pmutools.c37118.prefix.verified` does."""
    return HeaderFrame(_expect(frame, FrameType.HEADER), frame[PREFIX_SIZE:-CHK_SIZE])


def encode_command(
    idcode: int, code: int, *, soc: int = 0, fracsec: int = 0, time_quality: int = 0, extended: bytes = b""
) -> bytes:
    """A command frame for stream ``idcode``; raises EncodeError where it does not fit."""
    return _encode(FrameType.COMMAND, idcode, code.to_bytes(2, "big") + extended, soc, fracsec, time_quality)


def encode_header(idcode: int, text: str, *, soc: int = 0, fracsec: int = 0, time_quality: int = 0) -> bytes:
    """A header frame; what ASCII lacks is sent as ``?``. Raises EncodeError where it does not fit."""
    return _encode(FrameType.HEADER, idcode, text.encode("ascii", "replace"), soc, fracsec, time_quality)


def encode_message(message: CommandFrame | HeaderFrame) -> bytes:
    """The exact bytes of a decoded command or header, its prefix (version nibble too) kept."""
    if isinstance(message, HeaderFrame):
        return _seal(message.prefix, message.raw)
    return _seal(message.prefix, message.code.to_bytes(2, "big") + message.extended)


def _expect(frame: bytes, kind: FrameType) -> Prefix:
    prefix = verified(frame)
    if prefix.type is not kind:
        raise WireError(f"a {prefix.type.name} frame is no {kind.name} frame", idcode=prefix.idcode)
    return prefix


def _encode(kind: FrameType, idcode: int, payload: bytes, soc: int, fracsec: int, time_quality: int) -> bytes:
    size = PREFIX_SIZE + len(payload) + CHK_SIZE
    if size > MAX_FRAME_SIZE:
        raise EncodeError(f"{kind.name} frame of {size} bytes, FRAMESIZE ends at {MAX_FRAME_SIZE}")
    return _seal(Prefix(kind.sync, size, idcode, soc, time_quality, fracsec), payload)


def _seal(prefix: Prefix, payload: bytes) -> bytes:
    return sealed(encode_prefix(prefix) + payload)


def wire_values(config: StreamConfig, prefix: Sequence[int], stations: Sequence[Sequence[int | float]]) -> Data:
    """A :class:`Data` from wire values: ``prefix`` as in :class:`Prefix`, one flat sequence a station, CHK left 0."""
    sync, framesize, idcode, soc, time_quality, fracsec = prefix
    flat = [value for station in stations for value in station]
    return Data(config, (sync, framesize, idcode, soc, time_quality << 24 | fracsec, *flat, 0))
