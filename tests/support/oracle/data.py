"""PMU blocks of data frames out of PDML."""

from __future__ import annotations

import cmath
import math
import re
import struct
import xml.etree.ElementTree as ET
from typing import Any

from support.meaning import Object, json_number
from support.oracle.config import Analog, Phasor, Station
from support.oracle.elements import agree, child, children, number, octets, same_name, single
from support.oracle.faults import Masked, OracleError
from support.wire import FILLER, FREQ_FLOAT, NAN, PHASOR_FLOAT, POLAR

_NUMBER = r"\s*([-+]?(?:nan|inf|[\d.]+))"
_PHASOR = re.compile(
    rf",{_NUMBER}([VA]) ∠{_NUMBER}° alt{_NUMBER}\+j{_NUMBER}[VA](?:; unscaled:{_NUMBER},{_NUMBER})?$", re.I
)
_ANALOG = re.compile(rf"\",{_NUMBER}(?: \(conversion factor: (?:0x)?([0-9a-f]+)\))?$", re.I)


def read_block(station: Station, block: ET.Element, kind: str) -> Object:
    shown = block.get("show", "")[len('Station: "') : -1]
    if not same_name(shown, station.name):
        raise OracleError(f"block of {shown!r} under the configuration of {station.name!r}")
    stat = _stat(next(field for field in block if field.get("show") == "Flags"))
    phasors = [_phasor(*pair, station.format, kind) for pair in children(block, "Phasors (", station.phasors)]
    frequency, rocof = _frequency(station, block)
    analogs = [_analog(*pair, kind) for pair in children(block, "Analog values (", station.analogs)]
    digitals = [number(field) for _, field in children(block, "Digital status words (", station.words)]
    present = frequency is not None and not isinstance(frequency, Masked)
    present = present or any(item["re"] is not None and item["im"] is not None for item in phasors)
    return {
        "name": station.name,
        "idcode": station.idcode,
        "stat": stat,
        "valid": present and stat < 0x4000,
        "phasors": phasors,
        "frequency": frequency,
        "rocof": rocof,
        "analogs": analogs,
        "digitals": digitals,
    }


_STAT_FIELDS = {
    "status": 14,
    "sync": 13,
    "sorting": 12,
    "trigger": 11,
    "CFGchange": 10,
    "data_modified": 9,
    "pmu_tq": 6,
    "t_unlock": 4,
    "trigger_reason": 0,
}


def _stat(flags: ET.Element) -> int:
    stat = sum(number(child(flags, f"synphasor.data.{name}")) << shift for name, shift in _STAT_FIELDS.items())
    if stat != int(flags.get("value", ""), 16):
        raise OracleError(f"STAT {flags.get('value')} is dissected as {stat:04x}")
    return stat


def _phasor(channel: Phasor, field: ET.Element, fmt: int, kind: str) -> Object:
    raw, printed = octets(field), _PHASOR.search(field.get("showname", ""))
    if printed is None or not same_name(field.get("show", ""), channel.name):
        raise OracleError(f"phasor {channel.name!r} is shown as {field.get('showname')!r}")
    if (printed[2] == "A") != (channel.kind == "I"):
        raise OracleError(f"phasor {channel.name!r} is a {channel.kind}, shown in {printed[2]}")
    floating, polar = bool(fmt & PHASOR_FLOAT), bool(fmt & POLAR)
    first, second = struct.unpack(">ff" if floating else ">Hh" if polar else ">hh", raw)
    fault = None
    if floating:
        factor, turn = 1.0, 0.0
        if kind == "cfg3" and (channel.factor, channel.turn) != (1.0, 0.0):
            fault = "cfg3-float-scaling"
    else:
        factor, turn = channel.factor, channel.turn
        absent = [second == FILLER] if polar else [first == FILLER, second == FILLER]
        if any(absent):
            fault = None if all(absent) else "half-filler"
            first = second = NAN
        if printed[6] is not None:
            agree(printed[6], first, field)
            agree(printed[7], second, field)
    if math.isnan(first) or math.isnan(second):
        value = complex(NAN, NAN)
    elif polar:
        value = cmath.rect(factor * first, second * (1 if floating else 1e-4) - turn)
    else:
        value = factor * complex(first, second) * cmath.exp(-1j * turn)
    agree(printed[1], abs(value), field)
    agree(printed[4], value.real, field)
    agree(printed[5], value.imag, field)
    if math.isfinite(abs(value)):
        angle_deg = math.degrees(cmath.phase(value))
        if abs(value) > 1e-3 and abs((float(printed[3]) - angle_deg + 180) % 360 - 180) > 1e-3:
            raise OracleError(f"{field.get('showname')!r}: the angle is {angle_deg} degrees by its bytes")
    parts: Object = {"re": json_number(value.real), "im": json_number(value.imag)}
    if fault == "half-filler" or (fault and not cmath.isnan(value)):
        parts = dict.fromkeys(parts, Masked(fault))
    return {"name": channel.name, "kind": channel.kind} | parts


def _frequency(station: Station, block: ET.Element) -> tuple[Any, Any]:
    rocof = child(block, "synphasor.rate_change_frequency")
    if station.format & FREQ_FLOAT:
        frequency = child(block, "synphasor.actual_frequency_value")
        return json_number(single(frequency)), json_number(single(rocof))
    deviation = child(block, "synphasor.frequency_deviation_from_nominal")
    freq, dfreq = (int.from_bytes(octets(field), "big", signed=True) for field in (deviation, rocof))
    shown = [
        re.search(rf"{_NUMBER}{unit}", field.get("showname", ""))
        for field, unit in ((deviation, "Hz"), (rocof, "Hz/s"))
    ]
    values = (station.fnom_hz + freq / 1000, dfreq / 100)
    for match, value, field in zip(shown, values, (deviation, rocof), strict=True):
        agree(match[1] if match else "", value, field)
    return (
        Masked("freq-filler") if freq == FILLER else values[0],
        Masked("rocof-filler") if dfreq == FILLER else values[1],
    )


def _analog(channel: Analog, field: ET.Element, kind: str) -> Any:
    raw, printed = octets(field), _ANALOG.search(field.get("showname", ""))
    if printed is None or not same_name(field.get("show", ""), channel.name):
        raise OracleError(f"analog {channel.name!r} is shown as {field.get('showname')!r}")
    floating = len(raw) == 4
    wire = struct.unpack(">f" if floating else ">h", raw)[0]
    scaled = kind == "cfg3" and (channel.multiplier, channel.offset) != (1.0, 0.0)
    if floating:
        agree(printed[1], wire, field)
        return Masked("cfg3-float-scaling") if scaled and wire == wire else json_number(wire)
    value = wire * channel.multiplier + channel.offset if kind == "cfg3" else wire
    agree(printed[1], value, field)
    if kind != "cfg3" and int(printed[2] or "0", 16) != channel.anunit:
        raise OracleError(f"{field.get('showname')!r}: ANUNIT is {channel.anunit:#010x}")
    return value
