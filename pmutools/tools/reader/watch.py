"""Looks at rounds for what a trigger names; pure: time is an argument."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.config import StreamConfig
from pmutools.flow import Flow
from pmutools.formats.columns import columns_of
from pmutools.formats.source import Block
from pmutools.timebase import NS, format_utc
from pmutools.tools.reader.conditions import UNITS, Condition, Flag, Gap, Limit, Manual, Silence
from pmutools.tools.reader.reading import Round

Bools = npt.NDArray[np.bool_]


class Fired(NamedTuple):
    """A condition that has become true: where, when (a stamp, or UTC where nobody stamped it), and by what value."""

    condition: str
    where: str
    time_ns: int
    value: str = ""

    def __str__(self) -> str:
        return " ".join(
            part for part in (f"{self.condition}:", self.where, self.value, "at", format_utc(self.time_ns)) if part
        )


class _Place(NamedTuple):
    """A value that a condition looks at: its column among those of its quantity, its station's number, its name."""

    at: int
    station: int
    name: str


@dataclass
class _Stream:
    """What is remembered of a stream between rounds."""

    config: StreamConfig
    was: dict[int, Bools] = field(default_factory=dict)
    """Whether each place of a condition (by number) was true last."""
    latest_ns: int = NO_TIME
    """The latest stamp."""
    heard_ns: int = 0
    silent: set[int] = field(default_factory=set)


class Watch:
    """Tells which conditions become true, and whether any still is. Only values that STAT calls good are compared.

    Memory: some words a stream and condition.
    """

    def __init__(self, conditions: Sequence[Condition]) -> None:
        self._conditions = tuple(enumerate(conditions))
        self._streams: dict[tuple[Flow, int], _Stream] = {}
        self._looked = {number for number, each in self._conditions if isinstance(each, (Manual, Gap, Silence))}

    @property
    def holding(self) -> bool:
        """Whether a condition that has become true is so still."""
        return any(was.any() for stream in self._streams.values() for was in stream.was.values())

    @property
    def idle(self) -> tuple[str, ...]:
        """Conditions that no station or channel has fitted so far."""
        return tuple(each.text for number, each in self._conditions if number not in self._looked)

    def manual(self, kind: str, utc_ns: int) -> Fired | None:
        """A signal or a key; None where no trigger is of that kind."""
        wanted = any(isinstance(each, Manual) and each.text == kind for _, each in self._conditions)
        return Fired(kind, "", utc_ns) if wanted else None

    def look(self, found: Round, now_ns: int, utc_ns: int) -> list[Fired]:
        """What became true in a round that ended at ``now_ns`` (monotonic)."""
        fired = [each for item in found if isinstance(item, Block) for each in self._block(item, now_ns)]
        return fired + list(self._silences(now_ns, utc_ns))

    def _block(self, block: Block, now_ns: int) -> Iterator[Fired]:
        flow, batch = block
        key = flow.ends, batch.config.idcode
        stream = self._streams.get(key)
        if stream is None or stream.config != batch.config:
            stream = self._streams[key] = _Stream(batch.config)
        stream.heard_ns = now_ns
        stream.silent.clear()
        for number, condition in self._conditions:
            if isinstance(condition, Gap):
                yield from _gaps(condition, batch, stream.latest_ns)
            elif isinstance(condition, (Flag, Limit)):
                yield from self._edges(number, condition, batch, stream)
        stream.latest_ns = max(stream.latest_ns, int(batch.time_ns.max()))

    def _edges(self, number: int, condition: Flag | Limit, batch: Batch, stream: _Stream) -> Iterator[Fired]:
        places = _places(condition, batch.config)
        if not places:
            return
        self._looked.add(number)
        values, true = _judge(condition, batch, places)
        was = stream.was.get(number)
        before = np.zeros(len(places), bool) if was is None else was
        stream.was[number] = true[-1].copy()
        if not true.any():
            return
        rising = true & ~np.vstack((before, true[:-1]))
        for column in np.flatnonzero(rising.any(axis=0)).tolist():
            row = int(np.argmax(rising[:, column]))
            where = f"{places[column].name} (stream {batch.config.idcode})"
            yield Fired(condition.text, where, int(batch.time_ns[row]), _shown(condition, values[row, column]))

    def _silences(self, now_ns: int, utc_ns: int) -> Iterator[Fired]:
        for number, condition in self._conditions:
            if isinstance(condition, Silence):
                for (_, idcode), stream in self._streams.items():
                    silent_ns = now_ns - stream.heard_ns
                    if silent_ns >= condition.span_ns and number not in stream.silent:
                        stream.silent.add(number)
                        yield Fired(condition.text, f"stream {idcode}", utc_ns, f"{silent_ns / NS:.2f} s")


@lru_cache(maxsize=8192)
def _places(condition: Flag | Limit, config: StreamConfig) -> tuple[_Place, ...]:
    quantity = condition.quantity if isinstance(condition, Limit) else "stat"
    columns = columns_of(config, "polar")
    stations = {column.station: column.at for column in columns if column.quantity == "stat"}
    return tuple(
        _Place(column.at, stations[column.station], name)
        for column in columns
        if column.quantity == quantity and fnmatchcase(name := column.name.rpartition(".")[0], condition.where)
    )


def _judge(condition: Flag | Limit, batch: Batch, places: Sequence[_Place]) -> tuple[npt.NDArray[Any], Bools]:
    """Values (N, places), and whether the condition is true of them."""
    columns = [place.at for place in places]
    if isinstance(condition, Flag):
        words = batch.stat[:, columns]
        return words, (words & np.uint16(condition.mask)) != 0
    values = _values(batch, condition.quantity)[:, columns]
    compared = np.abs(values - condition.reference) if condition.distance else values
    with np.errstate(invalid="ignore"):
        true = compared > condition.limit if condition.above else compared < condition.limit
    return values, true & batch.valid[:, [place.station for place in places]]


def _values(batch: Batch, quantity: str) -> npt.NDArray[np.float64]:
    match quantity:
        case "freq_hz":
            return batch.frequency
        case "rocof_hz_s":
            return batch.rocof
    return np.abs(batch.phasors)


def _shown(condition: Flag | Limit, value: Any) -> str:
    if isinstance(condition, Flag):
        return f"STAT {int(value):#06x}"
    return f"{float(value):.6g} {UNITS[condition.quantity]}".strip()


def _gaps(condition: Gap, batch: Batch, latest_ns: int) -> Iterator[Fired]:
    """Holes between a stamp and the latest before it."""
    rate = batch.config.rate
    if not rate:
        return
    stamps = batch.time_ns
    before = np.maximum.accumulate(np.concatenate(([latest_ns if latest_ns != NO_TIME else stamps[0]], stamps)))[:-1]
    missing = np.rint((stamps - before) * float(rate) / NS).astype(np.int64) - 1
    for row in np.flatnonzero(missing > condition.frames).tolist():
        where = f"stream {batch.config.idcode}"
        yield Fired(condition.text, where, int(stamps[row]), f"{missing[row]} frames missing before")
