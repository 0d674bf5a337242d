"""The frames that are measured: layouts A, B and C, made by the codec and valid for every peer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pmutools.c37118.batch import Batch, decode_batch, encode_batch
from pmutools.c37118.config import AnalogChannel, DigitalWord, PhasorChannel, Station, StreamConfig, encode_config
from pmutools.c37118.constants import Format
from pmutools.flow import Chunk, Flow
from pmutools.formats.capture import CaptureWriter
from pmutools.timebase import NS

START_NS = 1_700_000_000 * NS
RATE = 60
CURRENT = 1 << 24
FLOW = Flow("udp", "192.0.2.1:4713", "192.0.2.2:4713")


@dataclass(frozen=True)
class Layout:
    """``text`` says what a frame of the layout holds."""

    name: str
    text: str
    config: StreamConfig

    def batch(self, count: int) -> Batch:
        """``count`` frames of numbers as a PMU measures them, on the reporting grid."""
        size = self.config.frame_size
        batch = decode_batch(bytes(size * count), self.config, check=False)
        rng = np.random.default_rng(1)
        batch.time_ns[...] = START_NS + np.arange(count, dtype=np.int64) * NS // RATE
        angles = rng.uniform(-np.pi, np.pi, batch.phasors.shape)
        batch.phasors[...] = rng.uniform(90, 110, batch.phasors.shape) * np.exp(1j * angles)
        # pypmu and pyc37 refuse a float FREQ above 32.767 Hz (they take it for a deviation): a frequency they can read
        low = 0.0 if self.config.stations[0].format & Format.FREQ_FLOAT else 59.99
        batch.frequency[...] = low + rng.uniform(0, 0.02, batch.frequency.shape)
        batch.rocof[...] = rng.uniform(-0.1, 0.1, batch.rocof.shape)
        batch.analogs[...] = rng.integers(0, 1000, batch.analogs.shape)
        batch.valid[...] = True
        return batch

    def frames(self, count: int) -> bytes:
        """The same as bytes, end to end."""
        return encode_batch(self.batch(count))[0].tobytes()

    def capture(self, path: Path, count: int) -> Path:
        """The same as a pcap of UDP datagrams to port 4713, its CFG-2 first."""
        size, raw = self.config.frame_size, self.frames(count)
        with CaptureWriter(path) as writer:
            writer.write(Chunk(encode_config(self.config), START_NS, FLOW))
            for row in range(count):
                writer.write(Chunk(raw[row * size : (row + 1) * size], START_NS + row * NS // RATE + 1000, FLOW))
        return path


def _station(number: int, fmt: Format, phasors: int, analogs: int = 0, words: int = 0) -> Station:
    return Station(
        f"STATION {number}",
        number,
        fmt,
        tuple(PhasorChannel(f"V{k}", 100_000) for k in range(phasors)),
        tuple(AnalogChannel(f"A{k}", 1) for k in range(analogs)),
        tuple(DigitalWord(tuple(f"W{k} BIT {bit}" for bit in range(16))) for k in range(words)),
    )


_FLOAT_RECT = Format.PHASOR_FLOAT | Format.ANALOG_FLOAT | Format.FREQ_FLOAT

LAYOUTS = (
    Layout("A", "1 PMU, 1 float phasor", StreamConfig(7, (_station(1, _FLOAT_RECT, 1),), RATE)),
    Layout(
        "B",
        "1 PMU, 10 int polar phasors, 2 analogs, 1 digital word",
        StreamConfig(7, (_station(1, Format.POLAR, 10, 2, 1),), RATE),
    ),
    Layout(
        "C",
        "8 PMUs, 4 float rectangular phasors each",
        StreamConfig(7, tuple(_station(number, _FLOAT_RECT, 4) for number in range(1, 9)), RATE),
    ),
)
