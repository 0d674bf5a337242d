"""Valid C37.118 frames made at random, each with the values that must be read from it.

An oracle for the codec: everything is packed with plain :mod:`struct` from a description, and nothing here imports
pmutools. One seeded generator serves loops and, through :func:`streams`, hypothesis (which then shrinks)::

    stream = random_stream(random.Random(1), formats=[0b0101])
    stream.config("cfg2"), stream.expected_config("cfg2")     # bytes, object of ``pmu dump --json``
    stream.data, stream.expected_data("cfg3")                 # frames, their objects when read under the CFG-3

Numbers in the objects are exact: ints as sent, floats computed in double precision from what was sent.
"""

from __future__ import annotations

import binascii
import cmath
import math
import random
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

Object = dict[str, Any]
"""One line of ``pmu dump --json``."""

SYNC = {"data": 0xAA01, "header": 0xAA11, "cfg1": 0xAA21, "cfg2": 0xAA31, "command": 0xAA41, "cfg3": 0xAA52}
CONFIG_KINDS = ("cfg1", "cfg2", "cfg3")
POLAR, PHASOR_FLOAT, ANALOG_FLOAT, FREQ_FLOAT = 1, 2, 4, 8
ALL_FORMATS = range(16)
COMMAND_NAMES = {
    1: "stop_data",
    2: "start_data",
    3: "send_header",
    4: "send_cfg1",
    5: "send_cfg2",
    6: "send_cfg3",
    8: "extended",
}
FILLER = -0x8000
NAN = float("nan")


# --- descriptions -----------------------------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Described:
    """A stream: its configuration frames and data frames as bytes, and what each of them says."""

    spec: StreamSpec
    stamp: Stamp
    """Time of transmission of the configuration frames."""
    stamps: tuple[Stamp, ...]
    blocks: tuple[tuple[Block, ...], ...]
    """One tuple of blocks, one a station, for each data frame."""

    def config(self, kind: str = "cfg2") -> bytes:
        return config_frame(self.spec, kind, self.stamp)

    def expected_config(self, kind: str = "cfg2") -> Object:
        return expected_config(self.spec, kind, self.stamp)

    @cached_property
    def data(self) -> tuple[bytes, ...]:
        return tuple(data_frame(self.spec, *frame) for frame in zip(self.stamps, self.blocks, strict=True))

    def expected_data(self, kind: str = "cfg2") -> tuple[Object, ...]:
        """Objects of the data frames when the configuration of ``kind`` is in force."""
        return tuple(expected_data(self.spec, kind, *frame) for frame in zip(self.stamps, self.blocks, strict=True))


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


# --- expectations -----------------------------------------------------------------------------------------------


def expected_prefix(kind: str, idcode: int, stamp: Stamp, time_base: int) -> Object:
    """The keys every object has; ``leap`` is the leap bits (0x40 direction, 0x20 occurred, 0x10 pending)."""
    time_ns = math.floor((stamp.soc + Fraction(stamp.fracsec, time_base)) * 10**9 + Fraction(1, 2))
    seconds, rest_ns = divmod(time_ns, 10**9)
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=seconds)
    return {
        "type": kind,
        "idcode": idcode,
        "time_ns": time_ns,
        "time": f"{moment:%Y-%m-%dT%H:%M:%S}.{rest_ns:09d}Z",
        "time_quality": stamp.time_quality,
        "leap": stamp.time_quality & 0x70,
        "chk_ok": True,
        "version": SYNC[kind] & 0xF,
        "soc": stamp.soc,
        "fracsec": stamp.fracsec,
    }


def expected_command(idcode: int, code: int, stamp: Stamp, time_base: int, extended: bytes = b"") -> Object:
    name = COMMAND_NAMES.get(code) or f"{'user' if 0x100 <= code <= 0xFFF else 'reserved'}-{code:#06x}"
    fields = {"command": name, "code": code, "extended": extended.hex()}
    return expected_prefix("command", idcode, stamp, time_base) | fields


def expected_header(idcode: int, text: str, stamp: Stamp, time_base: int) -> Object:
    return expected_prefix("header", idcode, stamp, time_base) | {"text": text}


def expected_config(spec: StreamSpec, kind: str, stamp: Stamp) -> Object:
    rate = Fraction(spec.data_rate) if spec.data_rate >= 0 else Fraction(-1, spec.data_rate)
    return expected_prefix(kind, spec.idcode, stamp, spec.time_base) | {
        "time_base": spec.time_base,
        "data_rate": spec.data_rate,
        "rate_hz": float(rate),
        "stations": [_expected_station(station, kind) for station in spec.stations],
    }


def _expected_station(station: StationSpec, kind: str) -> Object:
    expected: Object = {
        "name": station.name.under(kind),
        "idcode": station.idcode,
        "format": station.format,
        "fnom_hz": station.fnom_hz,
        "cfgcnt": station.cfgcnt,
        "phasors": [_expected_phasor_channel(phasor, kind) for phasor in station.phasors],
        "analogs": [analog.name.under(kind) for analog in station.analogs],
        "analog_scales": [_expected_analog_scale(analog, kind) for analog in station.analogs],
        "digitals": [[label.under(kind) for label in word.labels] for word in station.words],
        "digital_masks": [{"normal": word.normal, "valid": word.valid} for word in station.words],
    }
    if kind != "cfg3":
        return expected
    place = zip(("latitude_deg", "longitude_deg", "elevation_m"), station.place, strict=True)
    return expected | {
        "g_pmu_id": station.g_pmu_id.hex(),
        **{key: _json(value) for key, value in place},
        "service_class": station.service_class,
        "window_us": station.window_us,
        "group_delay_us": station.group_delay_us,
    }


def _expected_phasor_channel(phasor: PhasorSpec, kind: str) -> Object:
    channel = {"name": phasor.name.under(kind), "kind": "I" if phasor.current else "V"}
    if kind != "cfg3":
        return channel | {"unit": phasor.phunit * 1e-5}
    return channel | {
        "unit": phasor.scale,
        "flags": phasor.flags,
        "component": phasor.component,
        "angle_offset_rad": phasor.angle_offset_rad,
    }


def _expected_analog_scale(analog: AnalogSpec, kind: str) -> Object:
    if kind == "cfg3":
        return {"multiplier": analog.multiplier, "offset": analog.offset}
    unit = analog.anunit & 0xFFFFFF
    return {"kind": analog.anunit >> 24, "unit": unit - (1 << 24) if unit >> 23 else unit}


def expected_data(spec: StreamSpec, kind: str, stamp: Stamp, blocks: Sequence[Block]) -> Object:
    pairs = zip(spec.stations, blocks, strict=True)
    stations = [_expected_block(station, kind, block) for station, block in pairs]
    return expected_prefix("data", spec.idcode, stamp, spec.time_base) | {"stations": stations}


def _expected_block(station: StationSpec, kind: str, block: Block) -> Object:
    phasors = [
        si_phasor(channel, station.format, kind, *pair)
        for channel, pair in zip(station.phasors, block.phasors, strict=True)
    ]
    frequency = si_frequency(station, block.freq)
    present = not math.isnan(frequency) or any(not cmath.isnan(phasor) for phasor in phasors)
    return {
        "name": station.name.under(kind),
        "idcode": station.idcode,
        "stat": block.stat,
        "valid": present and block.stat < 0x4000,
        "phasors": [
            {
                "name": channel.name.under(kind),
                "kind": "I" if channel.current else "V",
                "re": _json(phasor.real),
                "im": _json(phasor.imag),
            }
            for channel, phasor in zip(station.phasors, phasors, strict=True)
        ],
        "frequency": _json(frequency),
        "rocof": _json(si_rocof(station, block.dfreq)),
        "analogs": [
            _json(value * channel.multiplier + channel.offset if kind == "cfg3" else value)
            for channel, value in zip(station.analogs, block.analogs, strict=True)
        ],
        "digitals": list(block.digitals),
    }


def si_phasor(channel: PhasorSpec, fmt: int, kind: str, first: float, second: float) -> complex:
    """V or A of one wire phasor; NaN where it is the filler."""
    floating, polar = fmt & PHASOR_FLOAT, fmt & POLAR
    if math.isnan(first) or math.isnan(second):
        return complex(NAN, NAN)
    if not floating and second == FILLER and (polar or first == FILLER):
        return complex(NAN, NAN)
    if kind == "cfg3":
        factor, turn = channel.scale, channel.angle_offset_rad
    else:
        factor, turn = 1.0 if floating else channel.phunit * 1e-5, 0.0
    if polar:
        return cmath.rect(factor * first, (second if floating else second * 1e-4) - turn)
    return factor * complex(first, second) * cmath.exp(-1j * turn)


def si_frequency(station: StationSpec, freq: float) -> float:
    if station.format & FREQ_FLOAT:
        return freq
    return NAN if freq == FILLER else station.fnom_hz + freq / 1000


def si_rocof(station: StationSpec, dfreq: float) -> float:
    if station.format & FREQ_FLOAT:
        return dfreq
    return NAN if dfreq == FILLER else dfreq / 100


def _json(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- chance -----------------------------------------------------------------------------------------------------

COMMON_TIME_BASES = (1, 1000, 1_000_000, 0xFFFFFF)
COMMON_DATA_RATES = (1, 10, 25, 30, 50, 60, 100, 120, -1, -5, -60, 32767, -32767)
_LONG_TAILS = ("", "", " of the northern interconnection", " Δf", " 変電所", " Ω–Å")


def random_stream(
    rng: random.Random,
    *,
    stations: int | None = None,
    formats: Sequence[int] | None = None,
    frames: int = 4,
    idcode: int | None = None,
    time_base: int | None = None,
    data_rate: int | None = None,
    absent: float = 0.1,
    long_names: bool = True,
    scaled_floats: bool = True,
) -> Described:
    """A stream of ``stations`` (default 1 to 4) PMUs and ``frames`` data frames.

    ``formats`` gives each station's FORMAT (and so their number). ``absent`` is the share of fillers and NaN.
    ``long_names`` lets CFG-3 names be longer than CFG-2's and leave ASCII; ``scaled_floats`` lets the PHSCALE and
    ANSCALE of float channels be other than one and zero.
    """
    count = len(formats) if formats is not None else stations or rng.randint(1, 4)
    chosen = formats if formats is not None else [rng.choice(ALL_FORMATS) for _ in range(count)]
    spec = StreamSpec(
        idcode if idcode is not None else rng.randint(1, 65534),
        tuple(_random_station(rng, number, fmt, long_names, scaled_floats) for number, fmt in enumerate(chosen)),
        data_rate if data_rate is not None else rng.choice(COMMON_DATA_RATES),
        time_base if time_base is not None else rng.choice((*COMMON_TIME_BASES, rng.randint(1, 0xFFFFFF))),
    )
    first = Stamp(rng.randint(0, 0xFFFF_0000), rng.randint(0, 0x7F), rng.randrange(spec.time_base))
    return Described(
        spec,
        first,
        tuple(_next_stamp(rng, spec, first, k) for k in range(frames)),
        tuple(tuple(_random_block(rng, station, absent) for station in spec.stations) for _ in range(frames)),
    )


def streams(**options: Any) -> Any:
    """Hypothesis strategy for :class:`Described`; ``options`` as for :func:`random_stream`."""
    from hypothesis import strategies as st

    return st.randoms(use_true_random=False).map(lambda rng: random_stream(rng, **options))


def with_format(spec: StreamSpec, fmt: int) -> StreamSpec:
    """The same stream with every station's FORMAT set to ``fmt``."""
    return replace(spec, stations=tuple(replace(station, format=fmt) for station in spec.stations))


def _next_stamp(rng: random.Random, spec: StreamSpec, first: Stamp, index: int) -> Stamp:
    """Frame ``index`` after ``first``, on the reporting grid rounded to ticks."""
    period = Fraction(1, spec.data_rate) if spec.data_rate > 0 else Fraction(-spec.data_rate)
    soc, fraction = divmod(first.soc + period * index, 1)
    return Stamp(int(soc), rng.choice((0, first.time_quality)), int(fraction * spec.time_base))


def _random_station(rng: random.Random, number: int, fmt: int, long_names: bool, scaled_floats: bool) -> StationSpec:
    tail = rng.choice(_LONG_TAILS) if long_names else ""
    scaled = scaled_floats or not fmt & PHASOR_FLOAT
    scaled_analogs = scaled_floats or not fmt & ANALOG_FLOAT
    return StationSpec(
        Name(f"STATION {number}", f"STATION {number}{tail}"),
        rng.randint(1, 65534),
        fmt,
        tuple(_random_phasor(rng, number, k, tail, scaled) for k in range(rng.randint(0, 5))),
        tuple(_random_analog(rng, k, tail, scaled_analogs) for k in range(rng.randint(0, 3))),
        tuple(_random_word(rng, k, tail) for k in range(rng.randint(0, 2))),
        rng.randint(0, 1),
        rng.choice((0, 1, 22, 65535)),
        rng.getrandbits(128).to_bytes(16, "big"),
        rng.choice(((math.inf,) * 3, (45.5, -122.25, 12.0), (-33.75, 151.125, -0.5))),
        rng.choice("MP"),
        rng.choice((0, 16667, -1, 2**31 - 1)),
        rng.choice((0, 8333, -1)),
    )


def _random_phasor(rng: random.Random, station: int, index: int, tail: str, scaled: bool) -> PhasorSpec:
    name = f"{rng.choice('VI')}{rng.choice('ABC1')} {station}.{index}"
    return PhasorSpec(
        Name(name, name + tail),
        rng.random() < 0.5,
        rng.choice((0, 1, 915527, 45776, 0xFFFFFF, rng.randint(0, 0xFFFFFF))),
        rng.choice((0, 0x0002, 0x0400, 0x87FE)),
        rng.choice((0, 1, 2, 4, 5, 6)),
        rng.randint(0, 255),
        _float32(rng.choice((0.5, 9.15527, rng.uniform(0.001, 100)))) if scaled else 1.0,
        _float32(rng.choice((0.0, math.pi / 6, rng.uniform(-math.pi, math.pi)))) if scaled else 0.0,
    )


def _random_analog(rng: random.Random, index: int, tail: str, scaled: bool) -> AnalogSpec:
    name = f"ANALOG {index}"
    anunit = rng.choice((0, 1, 2, 65, 255)) << 24 | rng.choice((0, 1, 0xFFFFFF, rng.randint(0, 0xFFFFFF)))
    multiplier = _float32(rng.choice((1.0, -0.125, rng.uniform(0.01, 10)))) if scaled else 1.0
    return AnalogSpec(Name(name, name + tail), anunit, multiplier, _float32(rng.uniform(-5, 5)) if scaled else 0.0)


def _random_word(rng: random.Random, index: int, tail: str) -> WordSpec:
    labels = tuple(Name(f"BREAKER {index}.{bit}", f"BREAKER {index}.{bit}{tail}" * (bit % 7 > 0)) for bit in range(16))
    return WordSpec(labels, rng.choice((0, 0xFFFF, rng.getrandbits(16))), rng.choice((0, 0xFFFF, 0x0FF0)))


def _random_block(rng: random.Random, station: StationSpec, absent: float) -> Block:
    floating, polar = station.format & PHASOR_FLOAT, station.format & POLAR
    missing = rng.random() < absent
    freq, dfreq = (
        (_float32(rng.uniform(45, 66)), _float32(rng.uniform(-9, 9)))
        if station.format & FREQ_FLOAT
        else (_int16(rng), _int16(rng))
    )
    if missing:
        freq = dfreq = NAN if station.format & FREQ_FLOAT else FILLER
    analog_nan = rng.random() < absent
    return Block(
        0x8000 if missing else rng.choice((0, 0, rng.getrandbits(16))),
        tuple(_random_pair(rng, floating, polar, missing or rng.random() < absent) for _ in station.phasors),
        freq,
        dfreq,
        tuple(
            (NAN if analog_nan else _magnitude(rng)) if station.format & ANALOG_FLOAT else _int16(rng)
            for _ in station.analogs
        ),
        tuple(rng.getrandbits(16) for _ in station.words),
    )


def _random_pair(rng: random.Random, floating: int, polar: int, missing: bool) -> tuple[float, float]:
    if floating:
        if missing:
            return NAN, NAN
        if polar:
            return abs(_magnitude(rng)), _float32(rng.uniform(-3.14159, 3.14159))
        return _magnitude(rng), _magnitude(rng)
    if polar:
        return rng.choice((0, 0xFFFF, rng.getrandbits(16))), FILLER if missing else rng.randint(-31416, 31416)
    return (FILLER, FILLER) if missing else (_int16(rng), _int16(rng))


def _int16(rng: random.Random) -> int:
    return rng.choice((0, 1, -32767, 32767, rng.randint(-32767, 32767)))


def _magnitude(rng: random.Random) -> float:
    """A float32 of either sign, between 1e-3 and 1e6 in size, or zero."""
    size = math.exp(rng.uniform(math.log(1e-3), math.log(1e6)))
    return _float32(rng.choice((size, -size, size, -size, 0.0)))


def _float32(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])
