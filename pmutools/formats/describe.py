"""Frames as plain objects for people and programs: the one-line JSON of ``pmu dump --json``.

SI units; NaN and infinity become null. Keys are only ever added to; the data model lists them.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

from pmutools import timebase
from pmutools.c37118.config import AnalogChannel, PhasorChannel, Station, StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.framer import Frame, Skipped, SkipReason
from pmutools.c37118.frames import Data, decode_command, decode_header, unpack_data
from pmutools.c37118.layout import layout_of
from pmutools.c37118.prefix import Prefix, decode_prefix
from pmutools.errors import WireError
from pmutools.flow import Flow

Json = dict[str, Any]


def number(value: float) -> float | None:
    """A finite float, else None."""
    return value if math.isfinite(value) else None


def describe(item: Message | Loss) -> Json:
    """One frame, or one run of skipped bytes, as a JSON object."""
    if isinstance(item, Loss):
        reason, offset, nbytes, _ = item.skipped
        told = {"type": "skipped", "reason": str(reason), "offset": offset, "nbytes": nbytes, "flow": flow_name(item)}
        return told | (_undecoded(item.undecoded) if item.undecoded is not None else {})
    frame, _, config = item
    if frame.type is FrameType.DATA and config is None:
        skipped = Skipped(SkipReason.NO_CONFIG, frame.offset, len(frame.data), frame.idcode)
        return describe(Loss(skipped, item.flow, frame))
    if frame.type is FrameType.DATA and config is not None:
        data = unpack_data(frame.data, config, layout_of(config))
        return _head(data.prefix, item) | {"stations": _stations(data)}
    head = _head(decode_prefix(frame.data), item)
    if frame.type.is_config:
        return head | (describe_config(config) if config else {"undecodable": True})
    try:
        if frame.type is FrameType.HEADER:
            return head | {"text": decode_header(frame.data).text}
        command = decode_command(frame.data)
    except WireError as error:
        return head | {"undecodable": str(error)}
    return head | {"command": command.name, "code": command.code, "extended": command.extended.hex()}


def _undecoded(frame: Frame) -> Json:
    """A whole frame that no configuration came for."""
    source = None if frame.arrival_ns is None else str(frame.stamp_source)
    return {
        "idcode": frame.idcode,
        "arrival_ns": frame.arrival_ns,
        "stamp_source": source,
        "wire": frame.data.hex(),
    }


def _head(prefix: Prefix, message: Message) -> Json:
    """What every object has. Without a configuration TIME_BASE is unknown, and so is the time."""
    frame, _, config = message
    time_ns = timebase.to_ns(prefix.soc, prefix.fracsec, config.time_base) if config else None
    return {
        "type": prefix.type.name.lower(),
        "idcode": prefix.idcode,
        "time_ns": time_ns,
        "time": None if time_ns is None else timebase.format_utc(time_ns),
        "time_quality": prefix.time_quality,
        "leap": int(prefix.leap),
        "chk_ok": True,
        "arrival_ns": frame.arrival_ns,
        "stamp_source": None if frame.arrival_ns is None else str(frame.stamp_source),
        "flow": flow_name(message),
        "version": prefix.version,
        "soc": prefix.soc,
        "fracsec": prefix.fracsec,
    }


def _stations(data: Data) -> list[Json]:
    """The values of a data frame in SI units."""
    return [
        {
            "name": station.name,
            "idcode": station.idcode,
            "stat": values.stat,
            "valid": values.valid,
            "phasors": [
                {"name": channel.name, "kind": channel.kind} | _parts(value)
                for channel, value in zip(station.phasors, values.phasors, strict=True)
            ],
            "frequency": number(values.frequency),
            "rocof": number(values.rocof),
            "analogs": [number(value) for value in values.analogs],
            "digitals": list(values.digitals),
        }
        for station, values in zip(data.config.stations, data.stations, strict=True)
    ]


def describe_config(config: StreamConfig) -> Json:
    """The content of a configuration frame."""
    return {
        "time_base": config.time_base,
        "data_rate": config.data_rate,
        "rate_hz": float(config.rate),
        "stations": [describe_station(station) for station in config.stations],
    }


def describe_station(station: Station) -> Json:
    """One PMU block of a configuration; units as the frame gives them."""
    described: Json = {
        "name": station.name,
        "idcode": station.idcode,
        "format": int(station.format),
        "fnom_hz": station.fnom_hz,
        "cfgcnt": station.cfgcnt,
        "phasors": [_phasor(channel) for channel in station.phasors],
        "analogs": [channel.name for channel in station.analogs],
        "analog_scales": [_analog(channel) for channel in station.analogs],
        "digitals": [list(word.labels) for word in station.digitals],
        "digital_masks": [{"normal": word.normal, "valid": word.valid} for word in station.digitals],
    }
    if (details := station.details) is not None:
        described |= {
            "g_pmu_id": details.g_pmu_id.hex(),
            "latitude_deg": number(details.latitude_deg),
            "longitude_deg": number(details.longitude_deg),
            "elevation_m": number(details.elevation_m),
            "service_class": details.service_class,
            "window_us": details.window_us,
            "group_delay_us": details.group_delay_us,
        }
    return described


def _parts(value: complex) -> Json:
    if cmath.isnan(value):
        return {"re": None, "im": None}
    return {"re": number(value.real), "im": number(value.imag)}


def _phasor(channel: PhasorChannel) -> Json:
    if (scale := channel.phscale) is None:
        return {"name": channel.name, "kind": channel.kind, "unit": (channel.phunit & 0xFFFFFF) * 1e-5}
    return {
        "name": channel.name,
        "kind": channel.kind,
        "unit": number(scale.scale),
        "flags": scale.flags,
        "component": scale.type & 7,
        "angle_offset_rad": number(scale.angle_offset_rad),
    }


def _analog(channel: AnalogChannel) -> Json:
    if channel.anscale is not None:
        multiplier, offset = channel.anscale
        return {"multiplier": number(multiplier), "offset": number(offset)}
    scale = channel.anunit & 0xFFFFFF
    signed = scale - (1 << 24) if scale & 0x800000 else scale
    return {"kind": channel.anunit >> 24, "unit": signed}


def flow_name(item: Message | Loss) -> str:
    """``udp 10.0.0.1:4713 > 10.0.0.2:4712``, ``tcp 10.0.0.1:4712``, or the file's name."""
    transport, source, destination, _ = item.flow
    if transport == "file":
        return source
    return f"{transport} {source} > {destination}" if destination else f"{transport} {source}"


def flow_of(name: str) -> Flow:
    """The flow of :func:`flow_name`."""
    transport, _, places = name.partition(" ")
    if transport not in ("udp", "tcp"):
        return Flow("file", name)
    source, _, destination = places.partition(" > ")
    return Flow(transport, source, destination)
