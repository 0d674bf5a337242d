"""Streams encoded anew under another FORMAT."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import Batch, decode_batch, encode_batch
from pmutools.c37118.config import AnalogScale, PhasorScale, Station, StreamConfig
from pmutools.c37118.constants import (
    MAX_FRAME_SIZE,
    PHSCALE_CURRENT,
    Format,
    FrameType,
)
from pmutools.c37118.demux import Message
from pmutools.c37118.layout import dtype_of, layout_of
from pmutools.errors import SettingsError
from pmutools.flow import Flow
from pmutools.formats.source import Block, gather
from pmutools.tools.recast.changes import Changes, Item, Stream, announcement

HEADROOM = 4
"""Integer phasors and scaled analogs reach this many times the largest value of their stream's first block."""
UNIT_STEP = 1e-5
"""V or A: what PHUNIT counts in."""
_FULL_SCALE = {"V": 1e6, "I": 2e4}
"""What a 16-bit phasor reaches whose channel, and all others of its kind, show nothing in the first block."""


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
                yield announcement(flow, config, batch)
            octets, clipped = encode_batch(replace(batch, config=config, wire=None))
            done.clipped += clipped
            done.reformatted += len(batch)
            yield Block(flow, _decoded(octets, config, batch))
        else:
            yield item


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
