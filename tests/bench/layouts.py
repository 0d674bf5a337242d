"""The three frame layouts that everything is measured on, with plausible values.

FREQ as a float is that of a railway grid: pypmu and pyc37 refuse one above 32.767.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pmutools.c37118 import (
    AnalogChannel,
    DigitalWord,
    Format,
    PhasorChannel,
    Station,
    StreamConfig,
)
from pmutools.c37118.batch import NO_TIME, Batch, decode_batch, encode_batch
from pmutools.timebase import NS

FIRST_NS = 1_700_000_000 * NS
RATE = 60
BLOCK = 8192
"""Frames decoded at a time, as readers of recordings do."""
_FLOATS = Format.PHASOR_FLOAT | Format.FREQ_FLOAT


@dataclass(frozen=True)
class Layout:
    """One stream's configuration, and what its frames hold."""

    name: str
    text: str
    config: StreamConfig

    def frames(self, count: int) -> Frames:
        return Frames(self, encode_batch(self._batch(count))[0].tobytes())

    def _batch(self, count: int) -> Batch:
        rng = np.random.default_rng(1)
        stations = self.config.stations
        widths = [len([c for s in stations for c in s.phasors]), len([c for s in stations for c in s.analogs])]
        words = len([c for s in stations for c in s.digitals])
        nominal_hz = 16.7 if stations[0].format & Format.FREQ_FLOAT else 60.0
        size = (count, len(stations))
        angle = rng.uniform(-3.1, 3.1, (count, widths[0]))
        return Batch(
            self.config,
            FIRST_NS + np.arange(count) * NS // RATE,
            np.full(count, NO_TIME),
            np.zeros(count, np.uint8),
            np.zeros(count, np.uint8),
            np.zeros(size, np.uint16),
            rng.uniform(200e3, 300e3, angle.shape) * np.exp(1j * angle),
            nominal_hz + rng.normal(0, 0.01, size),
            rng.normal(0, 0.1, size),
            np.rint(rng.normal(0, 100, (count, widths[1]))),
            rng.integers(0, 1 << 16, (count, words)).astype(np.uint16),
            np.ones(size, np.bool_),
        )


@dataclass(frozen=True)
class Frames:
    """Data frames of one layout, end to end in ``data``."""

    layout: Layout
    data: bytes

    @cached_property
    def singles(self) -> list[bytes]:
        size = self.layout.config.frame_size
        return [self.data[at : at + size] for at in range(0, len(self.data), size)]

    @cached_property
    def blocks(self) -> list[bytes]:
        step = BLOCK * self.layout.config.frame_size
        return [self.data[at : at + step] for at in range(0, len(self.data), step)]

    @cached_property
    def batches(self) -> list[Batch]:
        return [decode_batch(block, self.layout.config) for block in self.blocks]

    def __len__(self) -> int:
        return len(self.data) // self.layout.config.frame_size


def _phasors(count: int, phunit: int = 0) -> tuple[PhasorChannel, ...]:
    return tuple(PhasorChannel(f"V{k + 1}", phunit) for k in range(count))


_WORD = DigitalWord(tuple(f"bit {k}" for k in range(16)))
_ANALOGS = (AnalogChannel("P"), AnalogChannel("Q"))
A = Layout(
    "A",
    "one PMU, 1 float phasor, 34 bytes",
    StreamConfig(7, (Station("A", 7, _FLOATS, _phasors(1)),), RATE),
)
B = Layout(
    "B",
    "one PMU, 10 integer polar phasors, 2 analogs, 1 digital word, 68 bytes",
    StreamConfig(7, (Station("B", 7, Format.POLAR, _phasors(10, 915_527), _ANALOGS, (_WORD,)),), RATE),
)
C = Layout(
    "C",
    "a concentrator's 8 PMUs with 4 float rectangular phasors each, 352 bytes",
    StreamConfig(7, tuple(Station(f"S{k}", 100 + k, _FLOATS, _phasors(4)) for k in range(8)), RATE),
)
LAYOUTS = (A, B, C)
