"""Configuration frames out of PDML."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

from support.meaning import Object, json_number
from support.oracle.elements import child, group, number, octets, single, text, value_of
from support.oracle.faults import OracleError


@dataclass(frozen=True)
class Phasor:
    name: str
    kind: str
    factor: float
    turn: float
    flags: int
    component: int


@dataclass(frozen=True)
class Analog:
    name: str
    multiplier: float
    offset: float
    anunit: int


@dataclass(frozen=True)
class Station:
    name: str
    idcode: int
    format: int
    fnom_hz: int
    cfgcnt: int
    phasors: tuple[Phasor, ...]
    analogs: tuple[Analog, ...]
    words: tuple[tuple[str, ...], ...]
    masks: tuple[tuple[int, int], ...]
    details: Object
    """What only a CFG-3 says of the station."""


@dataclass(frozen=True)
class Config:
    kind: str
    time_base: int
    data_rate: int
    stations: tuple[Station, ...]


def read_config(body: ET.Element, kind: str) -> Config:
    blocks = [field for field in body if field.get("show", "").startswith("Station #")]
    if len(blocks) != value_of(body, "synphasor.conf.numpmu", "show"):
        raise OracleError(f"{len(blocks)} stations dissected, NUM_PMU is another number")
    return Config(
        kind,
        value_of(body, "synphasor.conf.timebase", "show"),
        value_of(body, "synphasor.rate_of_transmission", "show"),
        tuple(_station(block, kind) for block in blocks),
    )


def _station(block: ET.Element, kind: str) -> Station:
    third = kind == "cfg3"
    raw = octets(block)
    name = raw[1 : 1 + raw[0]] if third else raw[:16]
    fmt = next(field for field in block if field.get("show") == "Data format in data frame")
    names = ("dfreq_format", "analog_format", "phasor_format", "phasor_notation")
    bits = [number(child(fmt, f"synphasor.conf.{name}")) for name in names]
    word = int(fmt.get("value", ""), 16)
    if word & 0xF != bits[0] << 3 | bits[1] << 2 | bits[2] << 1 | bits[3]:
        raise OracleError(f"FORMAT {word:#06x} is dissected as {bits}")
    phasors, analogs = _names(block, "Phasor names", third), _names(block, "Analog values (", third)
    labels = _names(block, "Digital labels" if third else "Digital status labels", third)
    units, scales = _phasor_units(block, third), _analog_units(block, third)
    return Station(
        text(name),
        value_of(block, "synphasor.idcode_data_source", "show"),
        word,
        50 if number(child(block, "synphasor.conf.fnom")) else 60,
        value_of(block, "synphasor.conf.cfgcnt", "show"),
        tuple(Phasor(name, *unit) for name, unit in zip(phasors, units, strict=True)),
        tuple(Analog(name, *scale) for name, scale in zip(analogs, scales, strict=True)),
        tuple(tuple(labels[at : at + 16]) for at in range(0, len(labels), 16)),
        tuple(_masks(block)),
        _details(block) if third else {},
    )


def _names(block: ET.Element, title: str, third: bool) -> list[str]:
    raws = [octets(field) for field in group(block, title)]
    return [text(raw[1:] if third else raw) for raw in raws]


def _phasor_units(block: ET.Element, third: bool) -> Iterator[tuple[str, float, float, int, int]]:
    """(kind, factor to V or A, angle offset in rad, modification flags, component) of each phasor."""
    if third:
        for field in group(block, "Phasor scaling and data flags"):
            kind = "I" if number(child(field, "synphasor.conf.phasor_type")) else "V"
            flags = next(f for f in field.iter("field") if f.get("show", "").startswith("Modification Flags"))
            factor, turn = (
                single(child(field, f"synphasor.conf.phasor_{key}")) for key in ("scale_factor", "angle_offset")
            )
            component = number(child(field, "synphasor.conf.phasor_component"))
            yield kind, factor, turn, int(flags.get("value", ""), 16), component
        return
    for field in group(block, "Phasor conversion factors"):
        shown = re.fullmatch(r"#\d+ factor: (\d+) \* 10\^-5, unit: (Volt|Ampere)", field.get("showname", ""))
        if shown is None:
            raise OracleError(f"PHUNIT is shown as {field.get('showname')!r}")
        yield "I" if shown[2] == "Ampere" else "V", int(shown[1]) * 1e-5, 0.0, 0, 0


def _analog_units(block: ET.Element, third: bool) -> Iterator[tuple[float, float, int]]:
    """(multiplier, offset, raw ANUNIT) of each analog."""
    for field in group(block, "Analog values conversion factors"):
        if third:
            yield (*(single(child(field, f"synphasor.conf.analog_{key}")) for key in ("scale_factor", "offset")), 0)
        else:
            yield 1.0, 0.0, int(field.get("unmaskedvalue", ""), 16)


def _masks(block: ET.Element) -> Iterator[tuple[int, int]]:
    for field in group(block, "Masks for digital status words"):
        normal, valid = (
            number(child(field, f"synphasor.status_word_mask.{key}")) for key in ("normal_state", "valid_bits")
        )
        yield normal, valid


def _details(block: ET.Element) -> Object:
    service = child(block, "synphasor.conf.svc_class")
    letter = octets(service).decode("ascii")
    if service.get("show") != {"P": "Protection", "M": "Monitoring"}[letter]:
        raise OracleError(f"SVC_CLASS {letter!r} is shown as {service.get('show')!r}")
    place = ("latitude_deg", "longitude_deg", "elevation_m")
    times = {"window_us": "window", "group_delay_us": "grp_dly"}
    return {
        "g_pmu_id": octets(child(block, "synphasor.gpmuid")).hex(),
        **{key: json_number(single(child(block, f"synphasor.conf.pmu_{key.partition('_')[0]}"))) for key in place},
        "service_class": letter,
        **{
            key: int.from_bytes(octets(child(block, f"synphasor.conf.{name}")), "big", signed=True)
            for key, name in times.items()
        },
    }


def config_object(config: Config) -> Object:
    rate = Fraction(config.data_rate) if config.data_rate >= 0 else Fraction(-1, config.data_rate)
    return {
        "time_base": config.time_base,
        "data_rate": config.data_rate,
        "rate_hz": float(rate),
        "stations": [
            {
                "name": station.name,
                "idcode": station.idcode,
                "format": station.format,
                "fnom_hz": station.fnom_hz,
                "cfgcnt": station.cfgcnt,
                "phasors": [_phasor_object(phasor, config.kind) for phasor in station.phasors],
                "analogs": [analog.name for analog in station.analogs],
                "analog_scales": [_analog_object(analog, config.kind) for analog in station.analogs],
                "digitals": [list(word) for word in station.words],
                "digital_masks": [{"normal": normal, "valid": valid} for normal, valid in station.masks],
            }
            | station.details
            for station in config.stations
        ],
    }


def _phasor_object(phasor: Phasor, kind: str) -> Object:
    found = {"name": phasor.name, "kind": phasor.kind, "unit": phasor.factor}
    if kind == "cfg3":
        found |= {"flags": phasor.flags, "component": phasor.component, "angle_offset_rad": phasor.turn}
    return found


def _analog_object(analog: Analog, kind: str) -> Object:
    if kind == "cfg3":
        return {"multiplier": analog.multiplier, "offset": analog.offset}
    unit = int.from_bytes(analog.anunit.to_bytes(4, "big")[1:], "big", signed=True)
    return {"kind": analog.anunit >> 24, "unit": unit}
