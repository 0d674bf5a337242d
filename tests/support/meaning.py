"""What the frames of :mod:`support.wire` say, as the objects of ``pmu dump --json``, computed in double precision."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from typing import Any

from support.wire import (
    FILLER,
    FREQ_FLOAT,
    NAN,
    PHASOR_FLOAT,
    POLAR,
    SYNC,
    AnalogSpec,
    Block,
    PhasorSpec,
    Stamp,
    StationSpec,
    StreamSpec,
)

Object = dict[str, Any]
"""One line of ``pmu dump --json``."""

COMMAND_NAMES = {
    1: "stop_data",
    2: "start_data",
    3: "send_header",
    4: "send_cfg1",
    5: "send_cfg2",
    6: "send_cfg3",
    8: "extended",
}


def expected_prefix(kind: str, idcode: int, stamp: Stamp, time_base: int) -> Object:
    """The keys every object has; ``leap`` is the leap bits (0x40 direction, 0x20 occurred, 0x10 pending)."""
    time_ns = math.floor((stamp.soc + Fraction(stamp.fracsec, time_base)) * 10**9 + Fraction(1, 2))
    seconds, rest_ns = divmod(time_ns, 10**9)
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=seconds)
    return {
        "type": kind,
        "idcode": idcode,
        "time_ns": time_ns,
        "time": f"{moment:%Y-%m-%dT%H:%M:%S}.{rest_ns:09d}Z",
        "time_quality": stamp.time_quality,
        "leap": stamp.time_quality & 0x70,
        "chk_ok": True,
        "version": SYNC[kind] & 0xF,
        "soc": stamp.soc,
        "fracsec": stamp.fracsec,
    }


def expected_command(idcode: int, code: int, stamp: Stamp, time_base: int, extended: bytes = b"") -> Object:
    name = COMMAND_NAMES.get(code) or f"{'user' if 0x100 <= code <= 0xFFF else 'reserved'}-{code:#06x}"
    fields = {"command": name, "code": code, "extended": extended.hex()}
    return expected_prefix("command", idcode, stamp, time_base) | fields


def expected_header(idcode: int, text: str, stamp: Stamp, time_base: int) -> Object:
    return expected_prefix("header", idcode, stamp, time_base) | {"text": text}


def expected_config(spec: StreamSpec, kind: str, stamp: Stamp) -> Object:
    rate = Fraction(spec.data_rate) if spec.data_rate >= 0 else Fraction(-1, spec.data_rate)
    return expected_prefix(kind, spec.idcode, stamp, spec.time_base) | {
        "time_base": spec.time_base,
        "data_rate": spec.data_rate,
        "rate_hz": float(rate),
        "stations": [_expected_station(station, kind) for station in spec.stations],
    }


def _expected_station(station: StationSpec, kind: str) -> Object:
    expected: Object = {
        "name": station.name.under(kind),
        "idcode": station.idcode,
        "format": station.format,
        "fnom_hz": station.fnom_hz,
        "cfgcnt": station.cfgcnt,
        "phasors": [_expected_phasor_channel(phasor, kind) for phasor in station.phasors],
        "analogs": [analog.name.under(kind) for analog in station.analogs],
        "analog_scales": [_expected_analog_scale(analog, kind) for analog in station.analogs],
        "digitals": [[label.under(kind) for label in word.labels] for word in station.words],
        "digital_masks": [{"normal": word.normal, "valid": word.valid} for word in station.words],
    }
    if kind != "cfg3":
        return expected
    place = zip(("latitude_deg", "longitude_deg", "elevation_m"), station.place, strict=True)
    return expected | {
        "g_pmu_id": station.g_pmu_id.hex(),
        **{key: json_number(value) for key, value in place},
        "service_class": station.service_class,
        "window_us": station.window_us,
        "group_delay_us": station.group_delay_us,
    }


def _expected_phasor_channel(phasor: PhasorSpec, kind: str) -> Object:
    channel = {"name": phasor.name.under(kind), "kind": "I" if phasor.current else "V"}
    if kind != "cfg3":
        return channel | {"unit": phasor.phunit * 1e-5}
    return channel | {
        "unit": phasor.scale,
        "flags": phasor.flags,
        "component": phasor.component,
        "angle_offset_rad": phasor.angle_offset_rad,
    }


def _expected_analog_scale(analog: AnalogSpec, kind: str) -> Object:
    if kind == "cfg3":
        return {"multiplier": analog.multiplier, "offset": analog.offset}
    unit = analog.anunit & 0xFFFFFF
    return {"kind": analog.anunit >> 24, "unit": unit - (1 << 24) if unit >> 23 else unit}


def expected_data(spec: StreamSpec, kind: str, stamp: Stamp, blocks: Sequence[Block]) -> Object:
    pairs = zip(spec.stations, blocks, strict=True)
    stations = [_expected_block(station, kind, block) for station, block in pairs]
    return expected_prefix("data", spec.idcode, stamp, spec.time_base) | {"stations": stations}


def _expected_block(station: StationSpec, kind: str, block: Block) -> Object:
    phasors = [
        si_phasor(channel, station.format, kind, *pair)
        for channel, pair in zip(station.phasors, block.phasors, strict=True)
    ]
    frequency = si_frequency(station, block.freq)
    present = not math.isnan(frequency) or any(not cmath.isnan(phasor) for phasor in phasors)
    return {
        "name": station.name.under(kind),
        "idcode": station.idcode,
        "stat": block.stat,
        "valid": present and block.stat < 0x4000,
        "phasors": [
            {
                "name": channel.name.under(kind),
                "kind": "I" if channel.current else "V",
                "re": json_number(phasor.real),
                "im": json_number(phasor.imag),
            }
            for channel, phasor in zip(station.phasors, phasors, strict=True)
        ],
        "frequency": json_number(frequency),
        "rocof": json_number(si_rocof(station, block.dfreq)),
        "analogs": [
            json_number(value * channel.multiplier + channel.offset if kind == "cfg3" else value)
            for channel, value in zip(station.analogs, block.analogs, strict=True)
        ],
        "digitals": list(block.digitals),
    }


def si_phasor(channel: PhasorSpec, fmt: int, kind: str, first: float, second: float) -> complex:
    """V or A of one wire phasor; NaN where it is the filler."""
    floating, polar = fmt & PHASOR_FLOAT, fmt & POLAR
    if math.isnan(first) or math.isnan(second):
        return complex(NAN, NAN)
    if not floating and second == FILLER and (polar or first == FILLER):
        return complex(NAN, NAN)
    if kind == "cfg3":
        factor, turn = channel.scale, channel.angle_offset_rad
    else:
        factor, turn = 1.0 if floating else channel.phunit * 1e-5, 0.0
    if polar:
        return cmath.rect(factor * first, (second if floating else second * 1e-4) - turn)
    return factor * complex(first, second) * cmath.exp(-1j * turn)


def si_frequency(station: StationSpec, freq: float) -> float:
    if station.format & FREQ_FLOAT:
        return freq
    return NAN if freq == FILLER else station.fnom_hz + freq / 1000


def si_rocof(station: StationSpec, dfreq: float) -> float:
    if station.format & FREQ_FLOAT:
        return dfreq
    return NAN if dfreq == FILLER else dfreq / 100


def json_number(value: float) -> float | None:
    return value if math.isfinite(value) else None
