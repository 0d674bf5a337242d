"""One stream described by another configuration frame: CFG-2 as CFG-3 and back, and whether two say the same."""

from __future__ import annotations

from dataclasses import replace

from pmutools.c37118.config import (
    AnalogChannel,
    AnalogScale,
    DigitalWord,
    PhasorChannel,
    Station,
    StationDetails,
    StreamConfig,
    scale_of,
)
from pmutools.c37118.constants import NAME_SIZE, Format, FrameType


def as_kind(config: StreamConfig, kind: FrameType) -> StreamConfig:
    """The same stream described by another frame type.

    CFG-3 gets scales that give the values CFG-2 gives, CFG-2 the nearest PHUNIT and names cut to 16 bytes. Analog
    scaling of CFG-3 has no place in CFG-2 and is lost.
    """
    if (kind is FrameType.CFG3) == (config.kind is FrameType.CFG3):
        return replace(config, kind=kind, version=kind.version)
    convert = _station_to_3 if kind is FrameType.CFG3 else _station_to_2
    return replace(
        config, kind=kind, version=kind.version, stations=tuple(convert(station) for station in config.stations)
    )


def abridges(short: StreamConfig, full: StreamConfig) -> bool:
    """Whether a CFG-2 says of a stream what a CFG-3 says, as far as it can: a device may send it unasked, now and then.

    Units and digital masks, which devices fill in each in its own way, are not compared; PHUNIT is where it counts.
    """
    if (short.kind, full.kind, short.idcode) != (FrameType.CFG2, FrameType.CFG3, full.idcode):
        return False
    cut = as_kind(full, FrameType.CFG2)
    return _gist(short) == _gist(cut) and all(
        abs(said.phunit - known.phunit) <= 1
        for ours, theirs in zip(short.stations, cut.stations, strict=True)
        for said, known in zip(ours.phasors, theirs.phasors, strict=True)
        if not ours.format & Format.PHASOR_FLOAT
    )


def _gist(config: StreamConfig) -> tuple[object, ...]:
    names = [
        (
            (station.name, station.idcode, station.format, station.fnom, station.cfgcnt),
            *(channel.name for channel in station.phasors),
            *(channel.name for channel in station.analogs),
            *(word.labels for word in station.digitals),
        )
        for station in config.stations
    ]
    return config.time_base, config.data_rate, [len(station.phasors) for station in config.stations], names


def _station_to_3(station: Station) -> Station:
    return replace(
        station,
        wire_name=None,
        phasors=tuple(PhasorChannel(c.name, c.phunit, scale_of(c, station.format)) for c in station.phasors),
        analogs=tuple(AnalogChannel(c.name, c.anunit, AnalogScale(1.0, 0.0)) for c in station.analogs),
        digitals=tuple(DigitalWord(w.labels, w.normal, w.valid) for w in station.digitals),
        details=station.details or StationDetails(),
    )


def cut_name(name: str, size: int = NAME_SIZE) -> str:
    """``name`` cut to ``size`` bytes of UTF-8, at a character's end."""
    return name.encode("utf-8")[:size].decode("utf-8", "ignore").rstrip()


def _station_to_2(station: Station) -> Station:
    def phasor(channel: PhasorChannel) -> PhasorChannel:
        current = (channel.kind == "I") << 24
        scale = channel.phscale.scale if channel.phscale else 0.0
        count = round(scale * 1e5) if scale == scale and abs(scale) < 1e9 else 0
        return PhasorChannel(cut_name(channel.name), current | min(max(count, 0), 0xFFFFFF))

    return replace(
        station,
        name=cut_name(station.name),
        wire_name=None,
        phasors=tuple(phasor(channel) for channel in station.phasors),
        analogs=tuple(AnalogChannel(cut_name(c.name), c.anunit) for c in station.analogs),
        digitals=tuple(
            DigitalWord(tuple(cut_name(label) for label in w.labels), w.normal, w.valid) for w in station.digitals
        ),
        details=None,
    )
