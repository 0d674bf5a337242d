"""All streams of a source as one, as a concentrator sends them: aligned by timestamp, filler where one is absent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, Batch, decode_batch, encode_batch
from pmutools.c37118.config import StreamConfig, encode_config
from pmutools.c37118.config_kinds import as_kind
from pmutools.c37118.constants import (
    CHK_SIZE,
    FIRST_IDCODE,
    LAST_IDCODE,
    MAX_FRAME_SIZE,
    PREFIX_SIZE,
    STAT_ABSENT,
    FrameType,
)
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.layout import dtype_of, layout_of
from pmutools.errors import EncodeError, SettingsError
from pmutools.flow import Flow
from pmutools.formats.source import BLOCK_FRAMES, Block, gather
from pmutools.tools.recast.changes import Changes, Item, Stream, announcement, sealed_frames

WINDOW_NS = 4 * timebase.NS
"""Frames may come this much later, in time of stamps, than any other of the same instant."""
WINDOW_FRAMES = 2 * BLOCK_FRAMES
"""Frames of a stream that wait for the others: what blocks need, which overlap in time."""


class _Seen(NamedTuple):
    """A stream as the first pass saw it."""

    config: StreamConfig
    frames: int


def concentrated(
    open_again: Callable[[], Iterable[Item]], idcode: int, *, name: str = "", changes: Changes | None = None
) -> Iterator[Item]:
    """All streams of a source as one, IDCODE ``idcode``, as a concentrator would send it.

    ``open_again`` opens the source, and is called twice: the first time to know its streams.

    The stations stand side by side in the order in which their streams appear, their bytes as they were. A frame has
    what belongs to one reporting instant of the common rate: the stamp of the first station present, the worst time
    quality and the latest arrival of those present. A station without a frame at that instant is filled in: STAT
    0x8000, and NaN or the fillers of its FORMAT. No frame is made for an instant of which nobody has any. CFG-3 rules
    the stream if it rules any of its parts; TIME_BASE is the largest of them.

    An instant is sent when all streams have gone :data:`WINDOW_NS` beyond it, or one has :data:`WINDOW_FRAMES` waiting;
    what comes for it later is counted, as are second frames of a station for one instant. Losses pass through, headers,
    commands and the old configurations do not.

    Raises
    ------
    SettingsError
        No streams, streams of different rates or none, an IDCODE outside 1..65534, frames of more than 65535 bytes.
    """
    done = Changes() if changes is None else changes
    if not FIRST_IDCODE <= idcode <= LAST_IDCODE:
        raise SettingsError(f"IDCODE {idcode} of the concentrated stream: it is {FIRST_IDCODE} to {LAST_IDCODE}")
    seen = _survey(open_again())
    config, parts = _joined_config(seen, idcode)
    flow = Flow("file", name or f"PDC{idcode}")
    joiner = _Joiner(config, parts, {key: each.frames for key, each in seen.items()}, done)
    shown: dict[Stream, StreamConfig] = {}
    for item in gather(open_again()):
        if isinstance(item, Loss):
            yield item
        elif isinstance(item, Block) and len(item.batch):
            joiner.add(_stream_of(item), item.batch)
            yield from _with_config(flow, joiner.due(), shown)
    yield from _with_config(flow, joiner.rest(), shown)


def _stream_of(block: Block) -> Stream:
    """Connections between the same two endpoints are one stream."""
    return block.flow.ends, block.batch.config.idcode


def _with_config(flow: Flow, batches: Iterable[Batch], shown: dict[Stream, StreamConfig]) -> Iterator[Item]:
    for batch in batches:
        if not shown:
            shown[flow, batch.config.idcode] = batch.config
            yield announcement(flow, batch.config, batch)
        yield Block(flow, batch)


def _survey(items: Iterable[Item]) -> dict[Stream, _Seen]:
    """The streams that have data, in the order in which they, or their configurations, first appear."""
    order: dict[Stream, None] = {}
    found: dict[Stream, _Seen] = {}
    for item in gather(items):
        if isinstance(item, Message) and item.frame.type.rules_data:
            order.setdefault((item.flow.ends, item.frame.idcode))
        elif isinstance(item, Block) and len(item.batch):
            key = _stream_of(item)
            order.setdefault(key)
            old = found.get(key, _Seen(item.batch.config, 0))
            found[key] = old._replace(frames=old.frames + len(item.batch))
    return {key: found[key] for key in order if key in found}


def _joined_config(seen: Mapping[Stream, _Seen], idcode: int) -> tuple[StreamConfig, dict[Stream, StreamConfig]]:
    """The configuration of the whole, and that of each part, of the same kind."""
    if not seen:
        raise SettingsError("there are no data frames to concentrate")
    configs = [each.config for each in seen.values()]
    highest = max(configs, key=lambda config: config.rate)
    odd = [config for config in configs if config.rate != highest.rate]
    if odd:
        there = ", ".join(f"{config.idcode} ({float(config.rate):g}/s)" for config in odd)
        raise SettingsError(f"streams of one rate only can be concentrated: {there}, others {float(highest.rate):g}/s")
    if not highest.rate:
        raise SettingsError("streams without a DATA_RATE cannot be concentrated: their reporting instants are unknown")
    third = any(config.kind is FrameType.CFG3 for config in configs)
    kind = FrameType.CFG3 if third else FrameType.CFG2
    parts = {key: as_kind(each.config, kind) for key, each in seen.items()}
    stations = tuple(station for part in parts.values() for station in part.stations)
    time_base = max(config.time_base for config in configs)
    whole = StreamConfig(idcode, stations, highest.data_rate, time_base, kind, version=kind.version)
    if whole.frame_size > MAX_FRAME_SIZE:
        size = whole.frame_size
        raise SettingsError(
            f"{len(stations)} stations make frames of {size} bytes, more than {MAX_FRAME_SIZE}; leave some out"
        )
    try:
        encode_config(whole)
    except EncodeError as error:
        raise SettingsError(f"{error}; leave some stations out") from None
    return whole, parts


class _Waiting(NamedTuple):
    """Frames of one stream that wait for those of the others: (N,) each, ``body`` (N, bytes of its stations)."""

    slot: npt.NDArray[np.int64]
    time_ns: npt.NDArray[np.int64]
    arrival_ns: npt.NDArray[np.int64]
    stamp_source: npt.NDArray[np.uint8]
    time_quality: npt.NDArray[np.uint8]
    body: npt.NDArray[np.uint8]

    def rows(self, chosen: npt.NDArray[Any]) -> _Waiting:
        return _Waiting._make(column[chosen] for column in self)


_FAR = np.iinfo(np.int64).max
_BEFORE_ALL = np.iinfo(np.int64).min


class _Joiner:
    """Puts frames of the parts side by side, slot by slot."""

    def __init__(
        self, config: StreamConfig, parts: Mapping[Stream, StreamConfig], left: dict[Stream, int], changes: Changes
    ) -> None:
        self._config, self._parts, self._left, self._changes = config, dict(parts), left, changes
        self._waiting: dict[Stream, list[_Waiting]] = {key: [] for key in parts}
        self._reached: dict[Stream, int] = dict.fromkeys(parts, _BEFORE_ALL)
        self._sent = _BEFORE_ALL
        """Slots up to this one are gone."""
        self._window = max(int(WINDOW_NS * config.rate / timebase.NS), 1)
        self._filler = _filler(config)
        self._places: dict[Stream, slice] = {}
        at = PREFIX_SIZE
        for key, part in self._parts.items():
            size = part.frame_size - PREFIX_SIZE - CHK_SIZE
            self._places[key] = slice(at, at + size)
            at += size

    def add(self, key: Stream, batch: Batch) -> None:
        self._left[key] -= len(batch)
        part = self._parts[key]
        octets = _octets(batch, part)
        if octets is None:
            self._changes.reconfigured += len(batch)
            return
        slots = timebase.slots_array(batch.time_ns, self._config.rate)
        self._reached[key] = int(slots[-1]) if self._left[key] else _FAR
        rows = _Waiting(
            slots,
            batch.time_ns,
            batch.arrival_ns,
            batch.stamp_source,
            batch.time_quality,
            octets[:, PREFIX_SIZE:-CHK_SIZE],
        )
        early = slots > self._sent
        self._changes.late += len(batch) - int(np.count_nonzero(early))
        self._waiting[key].append(rows.rows(early))

    def due(self) -> Iterator[Batch]:
        """What need not, or cannot, wait longer."""
        limit = min(self._reached.values())
        if limit != _BEFORE_ALL:
            limit -= self._window if limit != _FAR else 0
        for waiting in self._waiting.values():
            count = sum(len(rows.slot) for rows in waiting)
            if count > WINDOW_FRAMES:
                slots = np.sort(np.concatenate([rows.slot for rows in waiting]))
                limit = max(limit, int(slots[count - WINDOW_FRAMES - 1]))
        if limit > self._sent:
            yield from self._send(limit)

    def rest(self) -> Iterator[Batch]:
        yield from self._send(_FAR)

    def _send(self, limit: int) -> Iterator[Batch]:
        """All that waits up to slot ``limit``."""
        self._sent = limit
        going: dict[Stream, _Waiting] = {}
        for key, waiting in self._waiting.items():
            if not waiting:
                continue
            rows = _Waiting._make(np.concatenate(columns) for columns in zip(*waiting, strict=True))
            now = rows.slot <= limit
            kept = rows.rows(~now)
            self._waiting[key] = [kept] if len(kept.slot) else []
            _, first = np.unique(rows.slot[now], return_index=True)  # of equal slots the frame that came first
            going[key] = rows.rows(np.flatnonzero(now)[first])
            self._changes.repeated += int(np.count_nonzero(now)) - len(first)
        slots = np.unique(np.concatenate([rows.slot for rows in going.values()])) if going else np.empty(0, np.int64)
        for first_row in range(0, len(slots), BLOCK_FRAMES):
            yield self._joined(slots[first_row : first_row + BLOCK_FRAMES], going)

    def _joined(self, slots: npt.NDArray[np.int64], going: Mapping[Stream, _Waiting]) -> Batch:
        count, config = len(slots), self._config
        octets = np.tile(self._filler, (count, 1))
        time_ns, arrival_ns = np.full(count, NO_TIME), np.full(count, NO_TIME)
        stamp_source = np.zeros(count, np.uint8)
        worst, flags = np.zeros(count, np.uint8), np.zeros(count, np.uint8)
        absent = count * len(config.stations)
        for key, rows in going.items():
            part = rows.rows((rows.slot >= slots[0]) & (rows.slot <= slots[-1]))
            at = np.searchsorted(slots, part.slot)
            absent -= len(at) * len(self._parts[key].stations)
            octets[at, self._places[key]] = part.body
            fresh = at[time_ns[at] == NO_TIME]
            time_ns[fresh] = part.time_ns[time_ns[at] == NO_TIME]
            arrival_ns[at] = np.maximum(arrival_ns[at], part.arrival_ns)
            stamp_source[at] = np.maximum(stamp_source[at], part.stamp_source)  # worse ones have higher numbers
            worst[at] = np.maximum(worst[at], part.time_quality & 0xF)
            flags[at] |= part.time_quality & 0xF0
        soc, fracsec = timebase.from_ns_array(time_ns, config.time_base)
        wire = octets.reshape(-1).view(dtype_of(config))
        wire["soc"], wire["fracsec"] = soc, fracsec | (worst | flags).astype(np.int64) << 24
        sealed_frames(wire, config)
        self._changes.concentrated += count
        self._changes.filled += absent
        return decode_batch(wire, config, arrival_ns, stamp_source, check=False)


def _octets(batch: Batch, part: StreamConfig) -> npt.NDArray[np.uint8] | None:
    """Frames of ``batch`` under ``part``'s stations, (N, FRAMESIZE); None where the channels are not the same."""
    config = batch.config if batch.config.kind is part.kind else as_kind(batch.config, part.kind)
    if config.stations == part.stations:
        if batch.wire is not None:
            return np.ascontiguousarray(batch.wire).view(np.uint8).reshape(len(batch), part.frame_size)
        return encode_batch(batch)[0]
    if _shape(config) != _shape(part):
        return None
    return encode_batch(replace(batch, config=part, wire=None))[0]  # another FORMAT or PHUNIT


def _shape(config: StreamConfig) -> list[tuple[int, int, int]]:
    return [(len(each.phasors), len(each.analogs), len(each.digitals)) for each in config.stations]


def _filler(config: StreamConfig) -> npt.NDArray[np.uint8]:
    """(FRAMESIZE,) a frame in which every station is absent."""
    layout = layout_of(config)
    stations, words = len(layout.slots), sum(len(slots.digitals) for slots in layout.slots)
    nothing = Batch(
        config,
        np.zeros(1, np.int64),
        np.full(1, NO_TIME),
        np.full(1, len(STAMP_SOURCES) - 1, np.uint8),
        np.zeros(1, np.uint8),
        np.full((1, stations), STAT_ABSENT, np.uint16),
        np.full((1, len(layout.phasors)), complex(np.nan, np.nan)),
        np.full((1, stations), np.nan),
        np.full((1, stations), np.nan),
        np.full((1, len(layout.analogs)), np.nan),
        np.zeros((1, words), np.uint16),
        np.zeros((1, stations), np.bool_),
    )
    frame: npt.NDArray[np.uint8] = encode_batch(nothing)[0][0]
    return frame
