"""The quick encoder writes what the protobuf library writes, byte for byte."""

from __future__ import annotations

import math
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.c37118 import Frame
from pmutools.c37118.config import AnalogChannel, DigitalWord, PhasorChannel, Station, StreamConfig
from pmutools.c37118.constants import Format
from pmutools.c37118.frames import Data
from pmutools.c37118.layout import layout_of
from pmutools.flow import StampSource
from pmutools.schema.frame_encoder import FrameEncoder
from pmutools.schema.pmu_log import encode_frame, pmu_frame

FLOATS = (0.0, -0.0, 1.5, -2.25e5, math.nan, math.inf, -math.inf, 1e-40, 3.0, 60.0)


def station(form: Format, phasors: int, others: int = 0) -> Station:
    return Station(
        "N1",
        101,
        form,
        tuple(PhasorChannel(f"V{k}", 0) for k in range(phasors)),
        tuple(AnalogChannel(f"A{k}", 0) for k in range(others)),
        tuple(DigitalWord(tuple(f"D{k}{bit}" for bit in range(16))) for k in range(others)),
    )


def values(config: StreamConfig, rng: random.Random) -> Data:
    layout = layout_of(config)
    codes = layout.unpacker.format[1:]
    made: list[int | float] = []
    for code in _expanded(codes):
        low, high = {"H": (0, 65535), "h": (-32768, 32767), "I": (0, 2**32 - 1)}.get(code, (0, 0))
        real = struct.unpack(">f", struct.pack(">f", rng.choice((*FLOATS, rng.gauss(0, 1e5)))))[0]
        made.append(real if code == "f" else rng.choice((0, low, high, rng.randint(low, high))))
    made[3:5] = [rng.randrange(1, 2**31), rng.choice((0, 0x0F000000, 0xFF000000)) | rng.randrange(config.time_base)]
    return Data(config, tuple(made))


def _expanded(codes: str) -> str:
    out, count = "", ""
    for code in codes:
        if code.isdigit():
            count += code
        else:
            out, count = out + code * int(count or 1), ""
    return out


FLOAT = Format.FREQ_FLOAT | Format.PHASOR_FLOAT | Format.ANALOG_FLOAT
CONFIGS = {
    "polar": StreamConfig(7, (station(FLOAT | Format.POLAR, 5),), 60),
    "rectangular": StreamConfig(7, (station(FLOAT, 5),), 60),
    "one phasor, FREQ in mHz": StreamConfig(
        7, (station(Format.PHASOR_FLOAT | Format.POLAR, 1),), 60, time_base=1 << 20
    ),
    "no phasor": StreamConfig(7, (station(FLOAT, 0),), 60),
    "integers": StreamConfig(7, (station(Format.POLAR, 3),), 60),
    "analogs and digitals": StreamConfig(7, (station(FLOAT | Format.POLAR, 2, 2),), 60),
    "two stations": StreamConfig(7, (station(FLOAT | Format.POLAR, 2), station(FLOAT, 2)), 60),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32))
def test_byte_for_byte(config: StreamConfig, seed: int) -> None:
    rng = random.Random(seed)
    data = values(config, rng)
    wire = rng.randbytes(rng.choice((18, 70, 300)))
    arrival_ns = rng.choice((None, 0, -5, data.time_ns + 1, data.time_ns + rng.randrange(1 << 30)))
    frame = Frame(wire, arrival_ns, rng.choice(list(StampSource)), 0)
    v1 = complex(rng.choice(FLOATS), rng.choice(FLOATS)) if rng.random() < 0.3 else complex(rng.gauss(0, 1e5), 2.0)
    for index in range(len(config.stations)):
        encoder = FrameEncoder("N1", layout_of(config), index)
        for tick_ns in (0, data.time_ns + 71_000_000):
            expected = encode_frame(pmu_frame("N1", frame, data, station=index, v1=v1), tick_ns)
            assert encoder.encode(frame, data, v1, tick_ns) == expected


def test_a_float_of_any_bits() -> None:
    """NaN payloads and signs pass as they are."""
    config = CONFIGS["rectangular"]
    data = values(config, random.Random(1))
    odd = [
        struct.unpack(">f", bits)[0] for bits in (b"\x7f\xc1\x23\x45", b"\xff\xc0\0\1", b"\x80\0\0\0", b"\x80\0\0\1")
    ]
    slots = data.layout.slots[0]
    assert slots.parts is not None
    made = list(data.values)
    made[slots.parts[0]] = [*odd, odd[0]]
    made[slots.freq + 1] = odd[2]
    data = Data(config, tuple(made))
    frame = Frame(b"x" * 70, 5, StampSource.KERNEL, 0)
    encoder = FrameEncoder("N1", layout_of(config), 0)
    assert encoder.encode(frame, data, 1 + 2j, 9) == encode_frame(pmu_frame("N1", frame, data, v1=1 + 2j), 9)
