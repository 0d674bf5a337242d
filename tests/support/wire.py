"""Descriptions of C37.118 streams and their frames, packed with plain :mod:`struct`. Nothing here imports pmutools."""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

SYNC = {"data": 0xAA01, "header": 0xAA11, "cfg1": 0xAA21, "cfg2": 0xAA31, "command": 0xAA41, "cfg3": 0xAA52}
CONFIG_KINDS = ("cfg1", "cfg2", "cfg3")
POLAR, PHASOR_FLOAT, ANALOG_FLOAT, FREQ_FLOAT = 1, 2, 4, 8
ALL_FORMATS = range(16)
FILLER = -0x8000
NAN = float("nan")


class Stamp(NamedTuple):
    """Time fields of a frame; ``time_quality`` is the whole byte."""

    soc: int = 0
    time_quality: int = 0
    fracsec: int = 0


EPOCH = Stamp()


class Name(NamedTuple):
    """What CFG-1/2 (at most 16 bytes, ASCII) and what CFG-3 (at most 255 bytes, UTF-8) call one thing."""

    short: str
    long: str

    def under(self, kind: str) -> str:
        return self.long if kind == "cfg3" else self.short


@dataclass(frozen=True, slots=True)
class PhasorSpec:
    name: Name
    current: bool
    phunit: int
    """Lower 24 bits: 1e-5 V or A per count."""
    flags: int = 0
    component: int = 1
    user: int = 0
    scale: float = 1.0
    angle_offset_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class AnalogSpec:
    name: Name
    anunit: int = 0
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class WordSpec:
    labels: tuple[Name, ...]
    normal: int = 0
    valid: int = 0xFFFF


@dataclass(frozen=True, slots=True)
class StationSpec:
    name: Name
    idcode: int
    format: int
    phasors: tuple[PhasorSpec, ...] = ()
    analogs: tuple[AnalogSpec, ...] = ()
    words: tuple[WordSpec, ...] = ()
    fnom: int = 0
    cfgcnt: int = 0
    g_pmu_id: bytes = bytes(16)
    place: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    service_class: str = "M"
    window_us: int = 0
    group_delay_us: int = 0

    @property
    def fnom_hz(self) -> int:
        return 50 if self.fnom & 1 else 60


@dataclass(frozen=True, slots=True)
class StreamSpec:
    idcode: int
    stations: tuple[StationSpec, ...]
    data_rate: int
    time_base: int


class Block(NamedTuple):
    """One station's values in a data frame, in wire units."""

    stat: int
    phasors: tuple[tuple[float, float], ...]
    freq: float
    dfreq: float
    analogs: tuple[float, ...]
    digitals: tuple[int, ...]


# --- bytes ------------------------------------------------------------------------------------------------------


def frame(kind: str, idcode: int, stamp: Stamp, payload: bytes) -> bytes:
    """A whole frame around ``payload``, with FRAMESIZE and CHK."""
    head = struct.pack(">HHHI", SYNC[kind], 16 + len(payload), idcode, stamp.soc)
    body = head + struct.pack(">I", stamp.time_quality << 24 | stamp.fracsec) + payload
    return body + struct.pack(">H", binascii.crc_hqx(body, 0xFFFF))


def command_frame(idcode: int, code: int, stamp: Stamp = EPOCH, extended: bytes = b"") -> bytes:
    return frame("command", idcode, stamp, struct.pack(">H", code) + extended)


def header_frame(idcode: int, text: str, stamp: Stamp = EPOCH) -> bytes:
    return frame("header", idcode, stamp, text.encode("ascii"))


def config_frame(spec: StreamSpec, kind: str, stamp: Stamp = EPOCH) -> bytes:
    block = _station3 if kind == "cfg3" else _station2
    parts = [b"\0\0"] if kind == "cfg3" else []
    parts.append(struct.pack(">IH", spec.time_base, len(spec.stations)))
    parts += [block(station) for station in spec.stations]
    parts.append(struct.pack(">h", spec.data_rate))
    return frame(kind, spec.idcode, stamp, b"".join(parts))


def data_frame(spec: StreamSpec, stamp: Stamp, blocks: Sequence[Block]) -> bytes:
    payload = b"".join(_block(*pair) for pair in zip(spec.stations, blocks, strict=True))
    return frame("data", spec.idcode, stamp, payload)


def _names(station: StationSpec) -> list[Name]:
    channels = [channel.name for channel in (*station.phasors, *station.analogs)]
    return channels + [label for word in station.words for label in word.labels]


def _counts(station: StationSpec) -> bytes:
    return struct.pack(">HHHH", station.format, len(station.phasors), len(station.analogs), len(station.words))


def _masks(station: StationSpec) -> bytes:
    return b"".join(struct.pack(">HH", word.normal, word.valid) for word in station.words)


def _station2(station: StationSpec) -> bytes:
    parts = [f"{station.name.short:16}".encode("ascii"), struct.pack(">H", station.idcode), _counts(station)]
    parts += [f"{name.short:16}".encode("ascii") for name in _names(station)]
    parts += [struct.pack(">I", phasor.current << 24 | phasor.phunit) for phasor in station.phasors]
    parts += [struct.pack(">I", analog.anunit) for analog in station.analogs]
    parts += [_masks(station), struct.pack(">HH", station.fnom, station.cfgcnt)]
    return b"".join(parts)


def _station3(station: StationSpec) -> bytes:
    parts = [_name3(station.name), struct.pack(">H", station.idcode), station.g_pmu_id, _counts(station)]
    parts += [_name3(name) for name in _names(station)]
    for phasor in station.phasors:
        kind = phasor.current << 3 | phasor.component
        scales = (phasor.scale, phasor.angle_offset_rad)
        parts.append(struct.pack(">HBBff", phasor.flags, kind, phasor.user, *scales))
    parts += [struct.pack(">ff", analog.multiplier, analog.offset) for analog in station.analogs]
    parts += [_masks(station), struct.pack(">fff", *station.place), station.service_class.encode("ascii")]
    parts.append(struct.pack(">iiHH", station.window_us, station.group_delay_us, station.fnom, station.cfgcnt))
    return b"".join(parts)


def _name3(name: Name) -> bytes:
    raw = name.long.encode("utf-8")
    return bytes((len(raw),)) + raw


def _block(station: StationSpec, block: Block) -> bytes:
    phasor = "ff" if station.format & PHASOR_FLOAT else "Hh" if station.format & POLAR else "hh"
    freq = "f" if station.format & FREQ_FLOAT else "h"
    analog = "f" if station.format & ANALOG_FLOAT else "h"
    parts = [struct.pack(">H", block.stat)]
    parts += [struct.pack(">" + phasor, *pair) for pair in block.phasors]
    parts.append(struct.pack(">" + freq * 2, block.freq, block.dfreq))
    parts += [struct.pack(">" + analog, value) for value in block.analogs]
    parts += [struct.pack(">H", word) for word in block.digitals]
    return b"".join(parts)
