"""A small two-station stream and short ways to send it through the fault pipeline."""

from __future__ import annotations

import struct
from collections.abc import Iterable

from pmutools.c37118 import Format, PhasorChannel, Station, StreamConfig, encode_config
from pmutools.c37118.checksum import chk
from pmutools.impair import Outgoing, Pipeline, Profile, profile_of_options

RATE = 60
PERIOD_NS = 1_000_000_000 // RATE
CONFIG = StreamConfig(
    idcode=101,
    stations=(
        Station("NORTH", 1, Format.PHASOR_FLOAT | Format.FREQ_FLOAT, (PhasorChannel("V1"), PhasorChannel("I1"))),
        Station("SOUTH", 2, Format(0), (PhasorChannel("V1", 915527),)),
    ),
    data_rate=RATE,
)
CONFIG_FRAME = encode_config(CONFIG)
SOC = 1_473_354_311
_FRAME = struct.Struct(">HHHII Hffff ff Hhhhh")


def frame(index: int) -> bytes:
    """Data frame ``index``: every value differs from that of its neighbours, STAT is 0."""
    soc, fraction = divmod(index, RATE)
    north = (0, 1e5 + index, 1.0, 300.0 + index, 2.0, 60.0 + index * 1e-3, 0.1 + index * 1e-3)
    south = (0, 1000 + index % 100, -(index % 100), index % 90 + 1, -(index % 90) - 1)
    body = _FRAME.pack(
        0xAA01, CONFIG.frame_size, CONFIG.idcode, SOC + soc, fraction * 1_000_000 // RATE, *north, *south
    )
    return body + chk(body).to_bytes(2, "big")


def options(*pairs: str) -> Profile:
    """``options("loss=5%", "delay=normal(16,2)")``, as on a command line."""
    return profile_of_options((name, value) for name, _, value in (pair.partition("=") for pair in pairs))


def pipeline(profile: Profile | str, stream: str = "N1", seed: int = 1) -> Pipeline:
    if isinstance(profile, str):
        profile = options(profile)
    return Pipeline(profile, stream, seed, config=CONFIG, aliases=("101", "north"))


def play(faults: Pipeline, count: int, first: int = 0, *, close: bool = True) -> list[Outgoing]:
    """Rows of frames ``first`` to ``first + count - 1``, due one period apart from time 0 at index 0."""
    rows = list[Outgoing]()
    for index in range(first, first + count):
        rows += faults.apply(index, frame(index), index * PERIOD_NS)
    return rows + list(faults.close() if close else ())


def delays_ms(rows: Iterable[Outgoing]) -> list[float]:
    return [row.delay_ns / 1e6 for row in rows]
