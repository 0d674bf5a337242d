"""Valid C37.118 frames made at random, each with the values that must be read from it.

An oracle for the codec: everything is packed with plain :mod:`struct` from a description, and nothing here imports
pmutools. One seeded generator serves loops and, through :func:`streams`, hypothesis (which then shrinks)::

    stream = random_stream(random.Random(1), formats=[0b0101])
    stream.config("cfg2"), stream.expected_config("cfg2")     # bytes, object of ``pmu dump --json``
    stream.data, stream.expected_data("cfg3")                 # frames, their objects when read under the CFG-3

Numbers in the objects are exact: ints as sent, floats computed in double precision from what was sent.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

from support.meaning import Object, expected_command, expected_config, expected_data, expected_header
from support.wire import (
    ALL_FORMATS,
    ANALOG_FLOAT,
    CONFIG_KINDS,
    FILLER,
    FREQ_FLOAT,
    NAN,
    PHASOR_FLOAT,
    POLAR,
    AnalogSpec,
    Block,
    Name,
    PhasorSpec,
    Stamp,
    StationSpec,
    StreamSpec,
    WordSpec,
    command_frame,
    config_frame,
    data_frame,
    header_frame,
)

__all__ = [
    "ALL_FORMATS",
    "CONFIG_KINDS",
    "Described",
    "Object",
    "Stamp",
    "command_frame",
    "config_frame",
    "data_frame",
    "expected_command",
    "expected_config",
    "expected_data",
    "expected_header",
    "header_frame",
    "random_stream",
    "streams",
    "with_format",
]


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
