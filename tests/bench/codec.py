"""Decoding, encoding and stamping frames, beside pypmu, pyc37 and a plain copy of the same bytes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from bench.layouts import LAYOUTS, C, Frames, Layout
from bench.stopwatch import Rate, Work, measure
from bench.table import Row, faster, within
from support.pypmu_shim import pypmu_frame
from support.requires import requires_module

from pmutools.c37118 import Data, decode_data, encode_config, restamp
from pmutools.c37118.batch import decode_batch, encode_batch
from pmutools.c37118.layout import layout_of


@dataclass(frozen=True)
class Sizes:
    """How much is worked on in a round."""

    nbytes: int
    """By batches, and by the copy; more than a cache holds."""
    singles: int
    """Frames decoded one at a time."""
    peer: float
    """Seconds, about, that a peer may take."""
    rounds: int


FULL = Sizes(nbytes=32 << 20, singles=10_000, peer=0.1, rounds=9)
QUICK = Sizes(nbytes=1 << 20, singles=100, peer=0.01, rounds=1)
_PEER_FRAMES_PER_S = {"A": 50_000, "B": 20_000, "C": 4_000}


class Peer:
    """pypmu, or pyc37, which has the same interface."""

    def __init__(self, name: str, module: ModuleType, layout: Layout) -> None:
        self.name, self._frame = name, module.CommonFrame
        self._config = self._frame.convert2frame(encode_config(layout.config))

    def decode(self, frame: bytes) -> Any:
        return self._frame.convert2frame(frame, self._config)

    def wire_values(self, frame: bytes) -> list[float]:
        """All values of a frame but STAT, in wire units, in the order of the wire."""
        found = self.decode(frame)
        columns = [
            self._config._data_format,
            found._phasors,  # get_phasors() makes all of them polar, and scales integer angles
            found.get_freq(),
            found.get_dfreq(),
            found.get_analog(),
            found.get_digital(),
        ]
        if not self._config.is_multistreaming():
            columns = [[column] for column in columns]
        flat: list[float] = []
        for form, phasors, freq, dfreq, analogs, digitals in zip(*columns, strict=True):
            flat += [part for phasor in phasors for part in found._int2phasor(phasor, form)]
            flat += [freq, dfreq, *analogs, *digitals]
        return flat


def peers(layout: Layout) -> tuple[Peer, Peer]:
    """pypmu and pyc37 with the layout's configuration."""
    return Peer("pypmu", pypmu_frame(), layout), Peer("pyc37", requires_module("pyc37.frame"), layout)


def wire_values(data: Data) -> list[float]:
    """The same of ours."""
    stats = {slots.stat for slots in layout_of(data.config).slots}
    last = len(data.values) - 1
    return [value for at, value in enumerate(data.values) if 5 <= at < last and at not in stats]


def controller_view(frame: bytes, layout: Layout) -> tuple[int, list[tuple[int, complex, float]]]:
    """What a controller takes from a frame: time, and of each PMU STAT, its first phasor and its frequency."""
    data = decode_data(frame, layout.config)
    slots = data.layout.slots
    return data.time_ns, [
        (data.stat(station), data.phasor(slots[station].phasor_columns[0]), data.frequency(station))
        for station in range(len(slots))
    ]


def check(frames: Frames) -> None:
    """Hold all ways of reading the same frames to each other; raises AssertionError."""
    layout, config = frames.layout, frames.layout.config
    some = frames.singles[:50]
    batch = decode_batch(b"".join(some), config)
    for row, frame in enumerate(some):
        data = decode_data(frame, config)
        for peer in peers(layout):
            assert peer.wire_values(frame) == wire_values(data), f"{peer.name} reads layout {layout.name} otherwise"
        time_ns, seen = controller_view(frame, layout)
        assert time_ns == data.time_ns == batch.time_ns[row]
        phasors = [phasor for station in data.stations for phasor in station.phasors]
        np.testing.assert_allclose(batch.phasors[row], phasors, rtol=1e-12)
        assert [station.frequency for station in data.stations] == batch.frequency[row].tolist()
        assert [(each.stat, each.phasors[0], each.frequency) for each in data.stations] == seen
        soc, fracsec = data.prefix.soc, data.prefix.fracsec
        assert restamp(restamp(frame, 1, 2), soc, fracsec) == frame
    for block, decoded in zip(frames.blocks, frames.batches, strict=True):
        octets, clipped = encode_batch(decoded)
        assert (octets.tobytes(), clipped) == (block, 0)


def contenders(frames: Frames, sizes: Sizes) -> dict[str, Work]:
    """Everything that one layout's frames are put through."""
    layout, config = frames.layout, frames.layout.config
    source = np.frombuffer(frames.data, np.uint8)
    target = np.empty_like(source)
    few = frames.singles[: max(10, int(sizes.peer * _PEER_FRAMES_PER_S[layout.name]))]
    singles = frames.singles[: sizes.singles]
    pypmu, pyc37 = peers(layout)
    objects = [pypmu.decode(frame) for frame in few]

    def copy() -> int:
        for _ in range(5):
            np.copyto(target, source)
        return 5 * len(frames)

    def decode_batches() -> int:
        return sum(len(decode_batch(block, config)) for block in frames.blocks)

    def encode_batches() -> int:
        return sum(len(encode_batch(batch)[0]) for batch in frames.batches)

    def decode_singles() -> int:
        for frame in singles:
            decode_data(frame, config)
        return len(singles)

    def view_singles() -> int:
        for frame in singles:
            controller_view(frame, layout)
        return len(singles)

    def read_singles() -> int:
        for frame in singles:
            _ = decode_data(frame, config).stations
        return len(singles)

    def restamp_singles() -> int:
        for number, frame in enumerate(singles):
            restamp(frame, 1_700_000_000, number)
        return len(singles)

    def pypmu_decode() -> int:
        for frame in few:
            pypmu.decode(frame)
        return len(few)

    def pypmu_read() -> int:
        for frame in few:
            pypmu.decode(frame).get_measurements()
        return len(few)

    def pypmu_encode() -> int:
        for each in objects:
            each.convert2bytes()
        return len(few)

    def pypmu_restamp() -> int:
        for number, each in enumerate(objects):
            each.set_time(1_700_000_000, number)
            each.convert2bytes()
        return len(few)

    def pyc37_decode() -> int:
        for frame in few:
            pyc37.decode(frame)
        return len(few)

    works = (copy, decode_batches, encode_batches, decode_singles, view_singles, read_singles, restamp_singles)
    works_of_peers = (pypmu_decode, pypmu_read, pypmu_encode, pypmu_restamp, pyc37_decode)
    return {work.__name__: work for work in (*works, *works_of_peers)}


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows; the budgets are for layout C."""
    for layout in LAYOUTS:
        frames = layout.frames(math.ceil(sizes.nbytes / layout.config.frame_size))
        check(layout.frames(200))
        yield from _compared(layout, measure(contenders(frames, sizes), sizes.rounds))


def _compared(layout: Layout, rate: dict[str, Rate]) -> Iterator[Row]:
    bound = layout is C
    name = layout.name
    batch, pypmu = rate["decode_batches"], rate["pypmu_decode"]
    what = f"{name}: batch decode to columns, CHK checked"
    yield faster("codec", what, batch, "pypmu, frame object", pypmu, 300 if bound else None)
    yield faster("codec", what, batch, "pyc37, frame object", rate["pyc37_decode"])
    yield within("codec", what, batch, "numpy.copyto of the same bytes", rate["copy"], 20 if bound else None)
    what = f"{name}: one frame at a time to a frame object, CHK checked"
    yield faster("codec", what, rate["decode_singles"], "pypmu, frame object", pypmu, 50 if bound else None)
    what = f"{name}: one frame at a time to what a controller uses"
    values = "pypmu, get_measurements"
    yield faster("codec", what, rate["view_singles"], values, rate["pypmu_read"], 50 if bound else None)
    what = f"{name}: one frame at a time to all its values"
    yield faster("codec", what, rate["read_singles"], values, rate["pypmu_read"])
    what = f"{name}: batch encode from columns"
    yield faster("codec", what, rate["encode_batches"], "pypmu, from frame objects", rate["pypmu_encode"])
    what = f"{name}: restamp one frame at a time"
    yield faster("codec", what, rate["restamp_singles"], "pypmu, set_time and encode", rate["pypmu_restamp"])
