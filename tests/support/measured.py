"""Streams for the meters, made from stamps and arrivals alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, Batch
from pmutools.c37118.config import PhasorChannel, Station, StreamConfig
from pmutools.c37118.constants import Format
from pmutools.flow import StampSource
from pmutools.measure.stream import Identity, StreamMeter, StreamResult

START_NS = 1_700_000_000 * timebase.NS
MS = 1_000_000
Ints = npt.NDArray[np.int64]


def config(rate: int = 60, idcode: int = 101, phasors: int = 1, cfgcnt: int = 0) -> StreamConfig:
    channels = tuple(PhasorChannel(f"V{number}") for number in range(phasors))
    return StreamConfig(idcode, (Station("N1", idcode, Format(0xF), channels, cfgcnt=cfgcnt),), rate)


def stamps(slots: Iterable[int], rate: int = 60, start_ns: int = START_NS) -> Ints:
    """Stamps of reporting instants, counted from ``start_ns``."""
    return np.array([start_ns + (slot * timebase.NS + rate // 2) // rate for slot in slots], np.int64)


def batch(
    time_ns: npt.ArrayLike,
    delay_ms: npt.ArrayLike | None = 20.0,
    *,
    of: StreamConfig | None = None,
    stat: npt.ArrayLike = 0,
    time_quality: npt.ArrayLike = 0,
    source: StampSource = StampSource.KERNEL,
    values: npt.ArrayLike | None = None,
) -> Batch:
    """Frames of one station in the order given; ``delay_ms`` None: nobody saw them come."""
    of = of or config()
    time = np.asarray(time_ns, np.int64)
    count = len(time)
    arrival = np.full(count, NO_TIME)
    if delay_ms is not None:
        arrival = time + np.rint(np.broadcast_to(np.asarray(delay_ms, float), count) * MS).astype(np.int64)
    phasors = sum(len(station.phasors) for station in of.stations)
    value = np.ones(count) if values is None else np.asarray(values, float)
    return Batch(
        of,
        time,
        arrival,
        np.full(count, STAMP_SOURCES.index(source), np.uint8),
        np.broadcast_to(np.asarray(time_quality, np.uint8), count).copy(),
        np.broadcast_to(np.asarray(stat, np.uint16), (count,)).copy().reshape(-1, 1),
        np.repeat(value[:, None] + 0j, phasors, axis=1),
        np.full((count, 1), 60.0),
        np.zeros((count, 1)),
        np.zeros((count, 0)),
        np.zeros((count, 0), np.uint16),
        np.ones((count, 1), np.bool_),
    )


def arranged(frames: Batch) -> Batch:
    """The frames in the order they came."""
    order = np.argsort(frames.arrival_ns, kind="stable")
    return rows(frames, order)


def rows(frames: Batch, chosen: Any) -> Batch:
    """Some of the frames, in any order."""
    chosen_rows: Batch = frames[chosen]
    return chosen_rows


def measured(frames: Batch | Sequence[Batch], end_ns: int | None = None, **options: Any) -> StreamResult:
    """What a meter says of one stream."""
    parts = [frames] if isinstance(frames, Batch) else list(frames)
    identity = options.pop("identity", Identity("N1", 101, "udp"))
    meter = StreamMeter(identity, parts[0].config, **options)
    for part in parts:
        meter.add(part)
    return meter.result(end_ns)
