"""Configurations: what a stream carries, decoded from and encoded to CFG-1, CFG-2 and CFG-3 frames.

A :class:`StreamConfig` is the same object whichever frame it came from. What a frame holds beyond the meaning of
its fields (reserved bits, padding other than spaces) is kept beside it, so that encoding gives the bytes back.

Layouts: CFG-1 and CFG-2 clause 6.4 and Table 8, CFG-3 clause 6.5 and Table 10.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from itertools import accumulate
from typing import Literal, NamedTuple

from pmutools.c37118.checksum import sealed
from pmutools.c37118.config_names import encode_name2, encode_name3, name2, name3, named
from pmutools.c37118.constants import (
    CHK_SIZE,
    FNOM_50_HZ,
    LABELS_PER_WORD,
    MAX_FRAME_SIZE,
    MIN_FRAME_SIZE,
    NAME_SIZE,
    PHSCALE_CURRENT,
    PREFIX_SIZE,
    TIME_BASE_MASK,
    Format,
    FrameType,
)
from pmutools.c37118.prefix import Prefix, encode_prefix, verified
from pmutools.errors import ConfigError, EncodeError

FIRST_FRAGMENT, LAST_FRAGMENT = 1, 0xFFFF
"""CONT_IDX of a CFG-3 in several frames; it is 0 of one in a single frame."""
FRAGMENT_SIZE = 65_507
"""Of a frame of several at most: a UDP datagram holds no more."""
PhasorKind = Literal["V", "I"]


class PhasorScale(NamedTuple):
    """PHSCALE of CFG-3: value = scale * X * exp(-1j * angle_offset_rad), in primary V or A."""

    flags: int
    type: int
    user: int
    scale: float
    angle_offset_rad: float


class AnalogScale(NamedTuple):
    """ANSCALE of CFG-3: value = multiplier * X + offset."""

    multiplier: float
    offset: float


@dataclass(frozen=True, slots=True)
class PhasorChannel:
    """One phasor. ``phunit`` is the raw PHUNIT word of CFG-1/2 (1e-5 V or A a count), ``phscale`` that of CFG-3."""

    name: str
    phunit: int = 0
    phscale: PhasorScale | None = None
    wire_name: bytes | None = field(default=None, repr=False)

    @property
    def kind(self) -> PhasorKind:
        if self.phscale is not None:
            return "I" if self.phscale.type & PHSCALE_CURRENT else "V"
        return "I" if self.phunit >> 24 & 1 else "V"

    @property
    def unit(self) -> float:
        """V or A a count of a 16-bit phasor, as PHUNIT says."""
        return (self.phunit & 0xFFFFFF) * 1e-5


@dataclass(frozen=True, slots=True)
class AnalogChannel:
    """One analog. ``anunit`` is the raw ANUNIT word of CFG-1/2, whose scaling only the user knows."""

    name: str
    anunit: int = 0
    anscale: AnalogScale | None = None
    wire_name: bytes | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class DigitalWord:
    """One 16-bit digital status word; ``labels[j]`` names bit j. Masks as in DIGUNIT."""

    labels: tuple[str, ...]
    normal: int = 0
    valid: int = 0xFFFF
    wire_names: tuple[bytes | None, ...] = field(default=(None,) * LABELS_PER_WORD, repr=False)


@dataclass(frozen=True, slots=True)
class StationDetails:
    """What only CFG-3 says of a PMU: global id, place (degrees, metres; infinity = unspecified), class, filter (us)."""

    g_pmu_id: bytes = bytes(16)
    latitude_deg: float = float("inf")
    longitude_deg: float = float("inf")
    elevation_m: float = float("inf")
    service_class: str = "M"
    window_us: int = 0
    group_delay_us: int = 0


@dataclass(frozen=True, slots=True)
class Station:
    """One PMU block of a stream; ``idcode`` is the PMU's own, which may differ from the stream's."""

    name: str
    idcode: int
    format: Format
    phasors: tuple[PhasorChannel, ...] = ()
    analogs: tuple[AnalogChannel, ...] = ()
    digitals: tuple[DigitalWord, ...] = ()
    fnom: int = 0
    cfgcnt: int = 0
    details: StationDetails | None = None
    wire_name: bytes | None = field(default=None, repr=False)

    @property
    def fnom_hz(self) -> float:
        return 50.0 if self.fnom & FNOM_50_HZ else 60.0

    @property
    def block_size(self) -> int:
        """Bytes of this station's block in a data frame."""
        phasor = 8 if self.format & Format.PHASOR_FLOAT else 4
        frequency = 8 if self.format & Format.FREQ_FLOAT else 4
        analog = 4 if self.format & Format.ANALOG_FLOAT else 2
        return 2 + len(self.phasors) * phasor + frequency + len(self.analogs) * analog + len(self.digitals) * 2


@dataclass(frozen=True, eq=False)
class StreamConfig:
    """Everything needed to decode a stream's data frames; equal configurations have equal wire bytes.

    ``time_base`` is ticks per second; ``data_rate`` the raw DATA_RATE (> 0 frames/s, < 0 seconds per frame).
    ``time_base_flags`` are the reserved upper bits of TIME_BASE, ``version`` the version nibble sent.
    """

    idcode: int
    stations: tuple[Station, ...]
    data_rate: int
    time_base: int = 1_000_000
    kind: FrameType = FrameType.CFG2
    time_base_flags: int = 0
    version: int = 1

    @property
    def name(self) -> str:
        """What the stream is called by itself: as its only station, else ``PDC`` and IDCODE."""
        lone = self.stations[0].name.strip() if len(self.stations) == 1 else ""
        return lone or f"PDC{self.idcode}"

    @property
    def rate(self) -> Fraction:
        """Frames per second; 0 where the device left it undefined."""
        return Fraction(self.data_rate) if self.data_rate >= 0 else Fraction(1, -self.data_rate)

    @cached_property
    def frame_size(self) -> int:
        """FRAMESIZE of every data frame under this configuration."""
        return PREFIX_SIZE + sum(station.block_size for station in self.stations) + CHK_SIZE

    @cached_property
    def stat_offsets(self) -> tuple[int, ...]:
        """Where the high byte of each station's STAT lies in a data frame."""
        sizes = (station.block_size for station in self.stations[:-1])
        return tuple(accumulate(sizes, initial=PREFIX_SIZE)) if self.stations else ()

    @cached_property
    def body(self) -> bytes:
        """Payload of the configuration frame, between prefix and CHK."""
        return _encode_body(self)

    @cached_property
    def _hash(self) -> int:  # decoding looks its layout up by it, frame by frame
        return hash(self._key)

    @cached_property
    def _key(self) -> tuple[int, int, bytes]:
        return self.kind, self.idcode, self.body

    @cached_property
    def digest(self) -> str:
        """What tells it from others that are not equal: 64 bits in hexadecimal."""
        return hashlib.sha256(f"{self.kind:d} {self.idcode} ".encode() + self.body).hexdigest()[:16]

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, StreamConfig) and self._key == other._key)

    def __hash__(self) -> int:
        return self._hash


def decode_config(frame: bytes) -> tuple[Prefix, StreamConfig]:
    """Decode a CFG-1, CFG-2 or CFG-3 frame, or all fragments of a CFG-3 end to end; the prefix is the first one's.

    Raises
    ------
    WireError
        Not a configuration frame, wrong CHK or FRAMESIZE, counts that do not fill the frame, TIME_BASE 0, or not all
        fragments of a CFG-3 that was sent in several frames.
    """
    first, *more = frames_in(frame)
    prefix = verified(first)
    if not prefix.type.is_config:
        raise ConfigError(f"a {prefix.type.name} frame is no configuration", idcode=prefix.idcode)
    body = first[PREFIX_SIZE:-CHK_SIZE]
    if more:
        if any((other.sync, other.idcode) != (prefix.sync, prefix.idcode) for other in map(verified, more)):
            raise ConfigError("frames of several kinds or IDCODEs", idcode=prefix.idcode)
        parts = [each[PREFIX_SIZE:-CHK_SIZE] for each in (first, *more)]
        if [int.from_bytes(part[:2], "big") for part in parts] != [*range(FIRST_FRAGMENT, len(parts)), LAST_FRAGMENT]:
            raise ConfigError("fragments of a CFG-3 that do not follow each other", idcode=prefix.idcode)
        body = b"\0\0" + b"".join(part[2:] for part in parts)
    return prefix, decode_config_body(prefix, body)


def is_fragment(frame: bytes) -> bool:
    """Whether a configuration frame is one of several that make a CFG-3, by its CONT_IDX."""
    return frame[1] >> 4 == FrameType.CFG3 and frame[PREFIX_SIZE : PREFIX_SIZE + 2] != b"\0\0"


def whole(frame: bytes, config: StreamConfig) -> bytes:
    """What says ``config`` by itself: the frame that it came with, or all fragments, where that is one of them."""
    return encode_config(config) if is_fragment(frame) else frame


def frames_in(data: bytes) -> list[bytes]:
    """What :func:`encode_config` gives, frame by frame; one that is cut short or senseless is the last."""
    frames, at = list[bytes](), 0
    while at < len(data) or not frames:
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        end = at + size if size >= MIN_FRAME_SIZE and data[at + size : at + size + 1] == data[:1] else len(data)
        frames.append(data[at:end])
        at = end
    return frames


def decode_config_body(prefix: Prefix, body: bytes) -> StreamConfig:
    """Decode the payload of a configuration frame, or the joined payload of CFG-3 fragments (CONT_IDX first)."""
    reader = _Reader(body, prefix.idcode)
    if prefix.type is FrameType.CFG3:
        (cont_idx,) = reader.unpack(_U16)
        if cont_idx:
            raise ConfigError(f"fragment {cont_idx} of a CFG-3", idcode=prefix.idcode)
    time_base, num_pmu = reader.unpack(_HEAD)
    if not time_base & TIME_BASE_MASK:
        raise ConfigError("TIME_BASE is 0", idcode=prefix.idcode)
    station = _read_station3 if prefix.type is FrameType.CFG3 else _read_station2
    stations = tuple(station(reader) for _ in range(num_pmu))
    (data_rate,) = reader.unpack(_I16)
    if reader.at != len(body):
        raise ConfigError(f"{len(body) - reader.at} bytes left over after DATA_RATE", idcode=prefix.idcode)
    config = StreamConfig(
        idcode=prefix.idcode,
        stations=stations,
        data_rate=data_rate,
        time_base=time_base & TIME_BASE_MASK,
        kind=prefix.type,
        time_base_flags=time_base >> 24,
        version=prefix.version,
    )
    if config.frame_size > MAX_FRAME_SIZE:
        raise ConfigError(f"describes data frames of {config.frame_size} bytes", idcode=prefix.idcode)
    return config


def encode_config(config: StreamConfig, *, soc: int = 0, fracsec: int = 0, time_quality: int = 0) -> bytes:
    """The configuration frame of ``config.kind``, stamped with its time of transmission.

    A CFG-3 that is longer than a frame can be is cut into fragments (CONT_IDX), end to end: :func:`frames_in`.

    Raises
    ------
    EncodeError
        A name, count or value that the frame cannot carry, or more than 65535 bytes of a CFG-1 or CFG-2.
    """
    sync = config.kind.sync & 0xFFF0 | config.version
    body, around = config.body, PREFIX_SIZE + CHK_SIZE
    bodies = [body]
    if (size := len(body) + around) > MAX_FRAME_SIZE:
        if config.kind is not FrameType.CFG3:
            raise EncodeError(
                f"configuration of {config.idcode} takes {size} bytes, FRAMESIZE ends at {MAX_FRAME_SIZE}"
            )
        step = FRAGMENT_SIZE - around - 2
        parts = [body[at : at + step] for at in range(2, len(body), step)]
        indices = (*range(FIRST_FRAGMENT, len(parts)), LAST_FRAGMENT)
        bodies = [index.to_bytes(2, "big") + part for index, part in zip(indices, parts, strict=True)]
    prefix = Prefix(sync, 0, config.idcode, soc, time_quality, fracsec)
    return b"".join(sealed(encode_prefix(prefix._replace(framesize=len(each) + around)) + each) for each in bodies)


# --- reading ----------------------------------------------------------------------------------------------------

_U16 = struct.Struct(">H")
_I16 = struct.Struct(">h")
_HEAD = struct.Struct(">IH")
_BLOCK = struct.Struct(">HHHHH")
_TAIL = struct.Struct(">HH")
_PHSCALE = struct.Struct(">HBBff")
_ANSCALE = struct.Struct(">ff")
_DETAILS = struct.Struct(">fff1sii")


class _Reader:
    """A cursor over a configuration's payload that turns a short read into ConfigError."""

    def __init__(self, body: bytes, idcode: int) -> None:
        self.body, self.idcode, self.at = body, idcode, 0

    def take(self, count: int) -> bytes:
        if self.at + count > len(self.body):
            offset = PREFIX_SIZE + self.at
            raise ConfigError(f"ends inside a PMU block, at byte {offset}", idcode=self.idcode, offset=offset)
        self.at += count
        return self.body[self.at - count : self.at]

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        return layout.unpack(self.take(layout.size))

    def name2(self) -> tuple[str, bytes | None]:
        return named(self.take(NAME_SIZE), name2)

    def name3(self) -> tuple[str, bytes | None]:
        return named(self.take(self.take(1)[0]), name3)


def _read_station2(reader: _Reader) -> Station:
    name, wire_name = reader.name2()
    idcode, fmt, phnmr, annmr, dgnmr = reader.unpack(_BLOCK)
    names = [reader.name2() for _ in range(phnmr + annmr + LABELS_PER_WORD * dgnmr)]
    phunits = reader.unpack(struct.Struct(f">{phnmr}I"))
    anunits = reader.unpack(struct.Struct(f">{annmr}I"))
    masks = [reader.unpack(_TAIL) for _ in range(dgnmr)]
    fnom, cfgcnt = reader.unpack(_TAIL)
    return Station(
        name,
        idcode,
        Format(fmt),
        tuple(PhasorChannel(n, unit, None, raw) for (n, raw), unit in zip(names, phunits, strict=False)),
        tuple(AnalogChannel(n, unit, None, raw) for (n, raw), unit in zip(names[phnmr:], anunits, strict=False)),
        _words(names[phnmr + annmr :], masks),
        fnom,
        cfgcnt,
        None,
        wire_name,
    )


def _read_station3(reader: _Reader) -> Station:
    name, wire_name = reader.name3()
    (idcode,) = reader.unpack(_U16)
    g_pmu_id = reader.take(16)
    fmt, phnmr, annmr, dgnmr = reader.unpack(struct.Struct(">HHHH"))
    names = [reader.name3() for _ in range(phnmr + annmr + LABELS_PER_WORD * dgnmr)]
    phscales = [PhasorScale(*reader.unpack(_PHSCALE)) for _ in range(phnmr)]
    anscales = [AnalogScale(*reader.unpack(_ANSCALE)) for _ in range(annmr)]
    masks = [reader.unpack(_TAIL) for _ in range(dgnmr)]
    latitude, longitude, elevation, service, window, delay = _DETAILS.unpack(reader.take(_DETAILS.size))
    fnom, cfgcnt = reader.unpack(_TAIL)
    return Station(
        name,
        idcode,
        Format(fmt),
        tuple(PhasorChannel(n, 0, scale, raw) for (n, raw), scale in zip(names, phscales, strict=False)),
        tuple(AnalogChannel(n, 0, scale, raw) for (n, raw), scale in zip(names[phnmr:], anscales, strict=False)),
        _words(names[phnmr + annmr :], masks),
        fnom,
        cfgcnt,
        StationDetails(g_pmu_id, latitude, longitude, elevation, service.decode("latin-1"), window, delay),
        wire_name,
    )


def _words(names: list[tuple[str, bytes | None]], masks: list[tuple[int, ...]]) -> tuple[DigitalWord, ...]:
    words = []
    for index, (normal, valid) in enumerate(masks):
        labels = names[index * LABELS_PER_WORD : (index + 1) * LABELS_PER_WORD]
        words.append(DigitalWord(tuple(n for n, _ in labels), normal, valid, tuple(raw for _, raw in labels)))
    return tuple(words)


# --- writing ----------------------------------------------------------------------------------------------------


def _encode_body(config: StreamConfig) -> bytes:
    third = config.kind is FrameType.CFG3
    if not 0 < config.time_base <= TIME_BASE_MASK:
        raise EncodeError(f"TIME_BASE {config.time_base} is outside 1..{TIME_BASE_MASK}")
    try:
        parts = [_U16.pack(0)] if third else []
        parts.append(_HEAD.pack(config.time_base_flags << 24 | config.time_base, len(config.stations)))
        parts += [_write_station3(station) if third else _write_station2(station) for station in config.stations]
        parts.append(_I16.pack(config.data_rate))
    except struct.error as error:
        raise EncodeError(f"configuration of {config.idcode}: {error}") from None
    return b"".join(parts)


def _labels(station: Station, encode: Callable[[str, bytes | None], bytes]) -> bytes:
    names = [encode(phasor.name, phasor.wire_name) for phasor in station.phasors]
    names += [encode(analog.name, analog.wire_name) for analog in station.analogs]
    for word in station.digitals:
        if len(word.labels) != LABELS_PER_WORD:
            raise EncodeError(f"station {station.name!r}: a digital word has {len(word.labels)} labels, not 16")
        names += [encode(label, raw) for label, raw in zip(word.labels, word.wire_names, strict=True)]
    return b"".join(names)


def _counts(station: Station) -> tuple[int, int, int]:
    return len(station.phasors), len(station.analogs), len(station.digitals)


def _masks(station: Station) -> bytes:
    return b"".join(_TAIL.pack(word.normal, word.valid) for word in station.digitals)


def _write_station2(station: Station) -> bytes:
    return b"".join(
        (
            encode_name2(station.name, station.wire_name),
            _BLOCK.pack(station.idcode, station.format, *_counts(station)),
            _labels(station, encode_name2),
            struct.pack(f">{len(station.phasors)}I", *(channel.phunit for channel in station.phasors)),
            struct.pack(f">{len(station.analogs)}I", *(channel.anunit for channel in station.analogs)),
            _masks(station),
            _TAIL.pack(station.fnom, station.cfgcnt),
        )
    )


def _write_station3(station: Station) -> bytes:
    details = station.details or StationDetails()
    if len(details.g_pmu_id) != 16:
        raise EncodeError(f"station {station.name!r}: G_PMU_ID has {len(details.g_pmu_id)} bytes, not 16")
    return b"".join(
        (
            encode_name3(station.name, station.wire_name),
            _U16.pack(station.idcode),
            details.g_pmu_id,
            struct.pack(">HHHH", station.format, *_counts(station)),
            _labels(station, encode_name3),
            *(_PHSCALE.pack(*(channel.phscale or scale_of(channel, station.format))) for channel in station.phasors),
            *(_ANSCALE.pack(*(channel.anscale or AnalogScale(1.0, 0.0))) for channel in station.analogs),
            _masks(station),
            _DETAILS.pack(
                details.latitude_deg,
                details.longitude_deg,
                details.elevation_m,
                details.service_class.encode("latin-1"),
                details.window_us,
                details.group_delay_us,
            ),
            _TAIL.pack(station.fnom, station.cfgcnt),
        )
    )


def scale_of(channel: PhasorChannel, fmt: Format) -> PhasorScale:
    """PHSCALE of a channel that has none: as CFG-2 scales it."""
    current = PHSCALE_CURRENT if channel.kind == "I" else 0
    scale = 1.0 if fmt & Format.PHASOR_FLOAT else channel.unit
    return PhasorScale(0, current | 1, 0, scale, 0.0)
