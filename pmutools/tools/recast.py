"""Streams made into other streams on their way to a player or a file: IDCODE, names, FORMAT, concentration.

Each function takes the blocks, frames and losses of a source (:meth:`~pmutools.formats.source.Source.blocks`) and
yields the same kinds of items. None holds more than a part of the source. What they did, and could not do, is counted
in a :class:`Changes` that the caller hands in, and told by :func:`described`.

Data frames keep stamps, arrivals and time quality; their CHK is made anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, Batch, decode_batch, encode_batch
from pmutools.c37118.checksum import chk_array
from pmutools.c37118.config import AnalogScale, PhasorScale, Station, StreamConfig, as_kind, encode_config
from pmutools.c37118.constants import (
    CHK_SIZE,
    MAX_FRAME_SIZE,
    NAME_SIZE,
    PHSCALE_CURRENT,
    PREFIX_SIZE,
    STAT_ABSENT,
    Format,
    FrameType,
)
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.frames import restamp
from pmutools.c37118.layout import dtype_of, layout_of
from pmutools.c37118.prefix import decode_prefix
from pmutools.errors import EncodeError, SettingsError
from pmutools.flow import Flow
from pmutools.formats.source import BLOCK_FRAMES, Block, frames_of, gather

Item = Block | Message | Loss
Stream = tuple[Flow, int]

FIRST_IDCODE, LAST_IDCODE = 1, 65534
NAME_SIZE_CFG3 = 255
HEADROOM = 4
"""Integer phasors and scaled analogs reach this many times the largest value of their stream's first block."""
UNIT_STEP = 1e-5
"""V or A: what PHUNIT counts in."""
_FULL_SCALE = {"V": 1e6, "I": 2e4}
"""What a 16-bit phasor reaches whose channel, and all others of its kind, show nothing in the first block."""


@dataclass
class Changes:
    """What the functions of this module did; they fill it in as they go."""

    renumbered: dict[int, int] = field(default_factory=dict)
    """IDCODEs of streams that were seen, old to new."""
    renamed: dict[str, str] = field(default_factory=dict)
    """Names of stations that were seen, old to new."""
    missing: set[str] = field(default_factory=set)
    """IDCODEs and names to be changed that were not seen (yet)."""
    reformatted: int = 0
    """Frames encoded anew."""
    clipped: int = 0
    """Values beyond the range of their integer field; the end of the range was sent."""
    concentrated: int = 0
    """Frames of the concentrated stream."""
    filled: int = 0
    """Stations in them without a frame at that instant."""
    late: int = 0
    """Frames left out because their instant had been sent before they came."""
    repeated: int = 0
    """Frames left out because their station had one for the instant already."""
    reconfigured: int = 0
    """Frames left out because their stream's channels were no longer those that it began with."""


def described(changes: Changes) -> list[str]:
    """What was done and what was lost by it, one line each; nothing for what did not happen."""
    lines = [f"stream {old} sent as {new}" for old, new in changes.renumbered.items()]
    lines += [f"station {old} sent as {new}" for old, new in changes.renamed.items()]
    lines += [f"{name}: not in the source, so nothing was changed" for name in sorted(changes.missing)]
    if changes.concentrated:
        lines.append(f"{changes.concentrated} frames concentrated, {changes.filled} stations filled in as absent")
    for count, text in (
        (changes.reformatted, "frames encoded in another FORMAT"),
        (changes.clipped, "values clipped to the range of their 16-bit field"),
        (changes.late, "frames came too late to be concentrated and were left out"),
        (changes.repeated, "frames left out whose station had sent that instant already"),
        (changes.reconfigured, "frames left out after their stream changed its channels"),
    ):
        if count:
            lines.append(f"{count} {text}")
    return lines


# --- IDCODE -----------------------------------------------------------------------------------------------------


def check_renumbering(idcodes: Mapping[int, int], there: Iterable[int] = ()) -> None:
    """Hold ``idcodes`` (old to new) against the standard, each other and the streams that are ``there``.

    Raises SettingsError for an IDCODE outside 1..65534 and for one that two streams would have.
    """
    streams = set(there) | set(idcodes)
    owners: dict[int, int] = {}
    for old, new in idcodes.items():
        if not FIRST_IDCODE <= new <= LAST_IDCODE:
            raise SettingsError(f"IDCODE {old}={new}: an IDCODE is {FIRST_IDCODE} to {LAST_IDCODE}")
        if new in owners:
            raise SettingsError(f"IDCODE {old}={new}: stream {owners[new]} becomes {new} too; choose another")
        owners[new] = old
    for old, new in idcodes.items():
        if new in streams and new not in idcodes:
            raise SettingsError(f"IDCODE {old}={new}: the source has a stream {new} already; choose another")


def renumbered(items: Iterable[Item], idcodes: Mapping[int, int], changes: Changes | None = None) -> Iterator[Item]:
    """Streams under other IDCODEs, old to new; a single station of the same IDCODE moves along.

    Commands to a stream move too. Raises SettingsError as :func:`check_renumbering` does, for the streams of the
    source when they turn up.
    """
    check_renumbering(idcodes)
    done = Changes() if changes is None else changes
    done.missing |= {f"IDCODE {old}" for old in idcodes}
    moved: dict[StreamConfig, StreamConfig] = {}
    seen: set[int] = set()
    for item in items:
        if isinstance(item, Loss):
            yield item
            continue
        old = item.batch.config.idcode if isinstance(item, Block) else item.frame.idcode
        if old not in seen:
            seen.add(old)
            check_renumbering({known: new for known, new in idcodes.items() if known in seen}, seen)
            if old in idcodes:
                done.renumbered[old] = idcodes[old]
                done.missing.discard(f"IDCODE {old}")
        if old not in idcodes:
            yield item
        elif isinstance(item, Block):
            yield item._replace(batch=_renumbered_batch(item.batch, idcodes[old], moved))
        else:
            yield _renumbered_message(item, idcodes[old], moved)


def _renumbered_batch(batch: Batch, new: int, moved: dict[StreamConfig, StreamConfig]) -> Batch:
    config = _renumbered_config(batch.config, new, moved)
    if batch.wire is None or not len(batch):
        return replace(batch, config=config)
    wire = batch.wire.copy()
    wire["idcode"] = new
    return replace(batch, config=config, wire=_sealed(wire, config))


def _renumbered_config(config: StreamConfig, new: int, moved: dict[StreamConfig, StreamConfig]) -> StreamConfig:
    if config not in moved:
        stations = config.stations
        if len(stations) == 1 and stations[0].idcode == config.idcode:
            stations = (replace(stations[0], idcode=new),)
        moved[config] = replace(config, idcode=new, stations=stations)
    return moved[config]


def _renumbered_message(message: Message, new: int, moved: dict[StreamConfig, StreamConfig]) -> Message:
    frame, _, config = message
    own = None if config is None else _renumbered_config(config, new, moved)
    if own is not None and frame.type.is_config:
        return _configured(message, own)
    prefix = decode_prefix(frame.data)
    data = restamp(frame.data, prefix.soc, prefix.fracsec, idcode=new)
    return message._replace(frame=frame._replace(data=data), config=own)


def _configured(message: Message, config: StreamConfig) -> Message:
    """A configuration frame with another content, at the same time."""
    prefix = decode_prefix(message.frame.data)
    data = encode_config(config, soc=prefix.soc, fracsec=prefix.fracsec, time_quality=prefix.time_quality)
    return message._replace(frame=message.frame._replace(data=data), config=config)


def _sealed(wire: npt.NDArray[np.void], config: StreamConfig) -> npt.NDArray[np.void]:
    """``wire``, which is ours, with its CHK made anew."""
    octets = wire.view(np.uint8).reshape(len(wire), config.frame_size)
    wire["chk"] = chk_array(octets[:, :-2])
    wire.flags.writeable = False
    return wire


# --- names ------------------------------------------------------------------------------------------------------


def renamed(items: Iterable[Item], names: Mapping[str, str], changes: Changes | None = None) -> Iterator[Item]:
    """Stations under other names, old to new, in every stream that has one of that name.

    Raises SettingsError for a name that is empty or too long (16 bytes of UTF-8 in CFG-1 and CFG-2, 255 in CFG-3),
    and for one that another station of the stream has.
    """
    for old, new in names.items():
        if not new.strip():
            raise SettingsError(f"name {old}={new}: a station's name cannot be empty")
        if len(new.encode()) > NAME_SIZE_CFG3:
            raise SettingsError(f"name {old}={new[:20]}...: {len(new.encode())} bytes, at most {NAME_SIZE_CFG3} fit")
    done = Changes() if changes is None else changes
    done.missing |= {f"station {old}" for old in names}
    made: dict[StreamConfig, StreamConfig] = {}

    def config_of(config: StreamConfig) -> StreamConfig:
        if config not in made:
            made[config] = _renamed_config(config, names, done)
        return made[config]

    for item in items:
        if isinstance(item, Block):
            config = config_of(item.batch.config)
            yield item if config is item.batch.config else item._replace(batch=replace(item.batch, config=config))
        elif isinstance(item, Message) and item.config is not None:
            config = config_of(item.config)
            if config is item.config:
                yield item
            else:
                yield _configured(item, config) if item.frame.type.is_config else item._replace(config=config)
        else:
            yield item


def _renamed_config(config: StreamConfig, names: Mapping[str, str], done: Changes) -> StreamConfig:
    """``config`` itself where none of its stations is named anew."""
    if not any(station.name in names for station in config.stations):
        return config
    limit = NAME_SIZE_CFG3 if config.kind is FrameType.CFG3 else NAME_SIZE
    stations = []
    for station in config.stations:
        new = names.get(station.name)
        if new is None:
            stations.append(station)
            continue
        if len(new.encode()) > limit:
            size = len(new.encode())
            raise SettingsError(f"name {station.name}={new}: {size} bytes, {config.kind.name} has room for {limit}")
        done.renamed[station.name] = new
        done.missing.discard(f"station {station.name}")
        stations.append(replace(station, name=new, wire_name=None))
    counts = Counter(station.name for station in stations)
    for station in config.stations:
        if (new := names.get(station.name)) is not None and counts[new] > 1:
            raise SettingsError(f"name {station.name}={new}: stream {config.idcode} would have two stations {new}")
    return replace(config, stations=tuple(stations))


# --- FORMAT -----------------------------------------------------------------------------------------------------


class Form(NamedTuple):
    """Which bits of FORMAT to set as in ``value``: those of ``mask``."""

    mask: Format
    value: Format

    def of(self, old: Format) -> Format:
        """The FORMAT that comes of ``old``; its reserved bits stay."""
        return Format(int(old) & ~int(self.mask) | int(self.value))


_PARTS = {"phasor": Format.PHASOR_FLOAT, "analog": Format.ANALOG_FLOAT, "freq": Format.FREQ_FLOAT}
_NUMBERS = {"int": False, "float": True}
_NOTATIONS = {"polar": True, "rect": False}
_FLOATS = Format.PHASOR_FLOAT | Format.ANALOG_FLOAT | Format.FREQ_FLOAT
_WORDS = "polar, rect, int, float, phasor=int|float, analog=int|float, freq=int|float"


def parse_form(text: str) -> Form:
    """A :class:`Form` from words such as ``polar,int`` or ``rect,phasor=int,freq=float``; what is not said stays.

    ``int`` and ``float`` alone are all three of phasor, analog and freq, whatever comes with ``=`` goes before them.
    Raises SettingsError for another word, and for two that contradict each other.
    """
    common: dict[Format, bool] = {}
    special: dict[Format, bool] = {}
    for word in (part.strip().lower() for part in text.split(",")):
        name, _, kind = word.partition("=")
        if word in _NOTATIONS:
            _settle(special, Format.POLAR, _NOTATIONS[word], word, text)
        elif word in _NUMBERS:
            _settle(common, _FLOATS, _NUMBERS[word], word, text)
        elif name in _PARTS and kind in _NUMBERS:
            _settle(special, _PARTS[name], _NUMBERS[kind], word, text)
        else:
            raise SettingsError(f"format {text!r}: {word!r} is none of {_WORDS}")
    mask = value = Format(0)
    for bits, on in (*common.items(), *special.items()):
        mask |= bits
        value = value & ~bits | (bits if on else Format(0))
    return Form(mask, value)


def _settle(said: dict[Format, bool], bits: Format, on: bool, word: str, text: str) -> None:
    if said.setdefault(bits, on) is not on:
        raise SettingsError(f"format {text!r}: {word!r} contradicts what comes before it")


def reformatted(items: Iterable[Item], form: Form, changes: Changes | None = None) -> Iterator[Item]:
    """Data frames encoded anew under another FORMAT; CFGCNT stays.

    - Phasors that become 16-bit, or rectangular from polar, get a PHUNIT (CFG-3: PHSCALE) by channel: the smallest
      step of 1e-5 V or A with which four times the largest magnitude of the first block fits.
    - Analogs that become 16-bit are rounded to whole numbers where CFG-2 rules (it has no scale for them), and scaled
      by ANSCALE in the same way where CFG-3 does.
    - FREQ that becomes 16-bit is rounded to mHz, DFREQ to 0.01 Hz/s.
    - Values out of range are clipped, and counted.

    Streams that are in this FORMAT already pass through as they are. Of the others, configuration frames are replaced
    by one (CFG-2, or CFG-3 where that rules) before the first data frame it rules. Raises SettingsError where a frame
    would become longer than 65535 bytes.
    """
    done = Changes() if changes is None else changes
    made: dict[tuple[Flow, StreamConfig], StreamConfig] = {}
    shown: dict[Stream, StreamConfig] = {}
    for item in gather(items):
        if isinstance(item, Message) and item.frame.type.is_config and item.config is not None:
            if all(form.of(station.format) == station.format for station in item.config.stations):
                yield item
        elif isinstance(item, Block) and len(item.batch):
            flow, batch = item
            if (flow, batch.config) not in made:
                made[flow, batch.config] = _reformatted_config(batch, form)
            config = made[flow, batch.config]
            if config is batch.config:
                yield item
                continue
            if shown.get((flow, config.idcode)) is not config:
                shown[flow, config.idcode] = config
                yield _announcement(flow, config, batch)
            octets, clipped = encode_batch(replace(batch, config=config, wire=None))
            done.clipped += clipped
            done.reformatted += len(batch)
            yield Block(flow, _decoded(octets, config, batch))
        else:
            yield item


def _announcement(flow: Flow, config: StreamConfig, batch: Batch) -> Message:
    """The configuration frame of ``config``, stamped and arriving as the first frame of ``batch``."""
    return next(frames_of(Block(flow, replace(batch[:1], config=config, wire=None)), {}))


def _decoded(octets: npt.NDArray[np.uint8], config: StreamConfig, old: Batch) -> Batch:
    """What the frames say, with the arrivals of ``old``."""
    wire = octets.reshape(-1).view(dtype_of(config))
    wire.flags.writeable = False
    return decode_batch(wire, config, old.arrival_ns, old.stamp_source, check=False)


def _reformatted_config(batch: Batch, form: Form) -> StreamConfig:
    """``batch``'s own configuration where its FORMATs are as wanted."""
    config, layout = batch.config, layout_of(batch.config)
    if all(form.of(station.format) == station.format for station in config.stations):
        return config
    stations = []
    third = config.kind is FrameType.CFG3
    largest = _largest_by_kind(batch)
    for station, slots in zip(config.stations, layout.slots, strict=True):
        fmt = form.of(station.format)
        phasors, analogs = slots.phasor_columns, slots.analog_columns
        magnitudes = _largest(np.abs(batch.phasors[:, phasors.start : phasors.stop]))
        sizes = _largest(np.abs(batch.analogs[:, analogs.start : analogs.stop]))
        station = _with_phasor_units(station, fmt, magnitudes, largest, third)
        station = _with_analog_scales(station, fmt, sizes) if third else station
        stations.append(replace(station, format=fmt))
    made = replace(config, stations=tuple(stations))
    if made.frame_size > MAX_FRAME_SIZE:
        raise SettingsError(f"stream {config.idcode} would have frames of {made.frame_size} bytes; use int")
    return made


def _largest(values: npt.NDArray[np.float64]) -> list[float]:
    """The largest finite value of each column, 0 where there is none."""
    finite = np.where(np.isfinite(values), values, 0.0)
    largest: list[float] = finite.max(axis=0, initial=0.0).tolist()
    return largest


def _largest_by_kind(batch: Batch) -> dict[str, float]:
    largest = {"V": 0.0, "I": 0.0}
    channels = [channel for station in batch.config.stations for channel in station.phasors]
    for channel, size in zip(channels, _largest(np.abs(batch.phasors)), strict=True):
        largest[channel.kind] = max(largest[channel.kind], size)
    return largest


def _with_phasor_units(
    station: Station, fmt: Format, magnitudes: Sequence[float], by_kind: Mapping[str, float], third: bool
) -> Station:
    was, floating = station.format, bool(fmt & Format.PHASOR_FLOAT)
    turned_to_rect = bool(was & Format.POLAR) and not fmt & Format.POLAR  # a magnitude has 16 bits, a part 15
    if not floating and not was & Format.PHASOR_FLOAT and not turned_to_rect:
        return station
    if floating and not third:
        return station  # PHUNIT says nothing of floats but V or A
    channels = []
    for channel, magnitude in zip(station.phasors, magnitudes, strict=True):
        kind = channel.kind
        reach = HEADROOM * (magnitude or by_kind[kind]) or _FULL_SCALE[kind]
        counts = 0xFFFF if fmt & Format.POLAR else 0x7FFF
        steps = min(max(int(np.ceil(reach / counts / UNIT_STEP)), 1), 0xFFFFFF)
        if third:
            old = channel.phscale or PhasorScale(0, PHSCALE_CURRENT * (kind == "I") | 1, 0, 1.0, 0.0)
            scale = 1.0 if floating else float(np.float32(steps * UNIT_STEP))  # as the frame will have it
            channels.append(replace(channel, phscale=old._replace(scale=scale, angle_offset_rad=0.0)))
        else:
            channels.append(replace(channel, phunit=channel.phunit & 0xFF000000 | steps))
    return replace(station, phasors=tuple(channels))


def _with_analog_scales(station: Station, fmt: Format, sizes: Sequence[float]) -> Station:
    """CFG-3 only."""
    if station.format & Format.ANALOG_FLOAT == fmt & Format.ANALOG_FLOAT:
        return station
    scales = [1.0 if fmt & Format.ANALOG_FLOAT or not size else HEADROOM * size / 0x7FFF for size in sizes]
    return replace(
        station,
        analogs=tuple(
            replace(channel, anscale=AnalogScale(float(np.float32(scale)), 0.0))
            for channel, scale in zip(station.analogs, scales, strict=True)
        ),
    )


# --- concentration ----------------------------------------------------------------------------------------------

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
    return block.flow._replace(connection=0), block.batch.config.idcode


def _with_config(flow: Flow, batches: Iterable[Batch], shown: dict[Stream, StreamConfig]) -> Iterator[Item]:
    for batch in batches:
        if not shown:
            shown[flow, batch.config.idcode] = batch.config
            yield _announcement(flow, batch.config, batch)
        yield Block(flow, batch)


def _survey(items: Iterable[Item]) -> dict[Stream, _Seen]:
    """The streams that have data, in the order in which they, or their configurations, first appear."""
    order: dict[Stream, None] = {}
    found: dict[Stream, _Seen] = {}
    for item in gather(items):
        if isinstance(item, Message) and item.frame.type.rules_data:
            order.setdefault((item.flow._replace(connection=0), item.frame.idcode))
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
        _sealed(wire, config)
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
