"""tshark as a neutral oracle: its dissection of a capture as the objects of ``pmu dump --json``.

What is taken from tshark is where each field lies and what it is (name, number format, unit, factor, flag). Numbers
are computed here from the bytes tshark gives a field, because it prints only three decimals; and each is held
against what it prints, so that a reading of ours that tshark does not share raises :class:`OracleError`. Where the
oracle itself is known to be wrong (:data:`FAULTS`), the value is :class:`Masked` and :func:`differences` leaves it out.
"""

from __future__ import annotations

import cmath
import io
import math
import re
import struct
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from support.frames import COMMAND_NAMES, FILLER, FREQ_FLOAT, NAN, PHASOR_FLOAT, POLAR, Object, Stamp, expected_prefix
from support.requires import requires

PRINTED_PLACES = 3
"""tshark prints phasors, frequencies and analogs with three decimals."""
TOLERANCE = 1e-9
"""Relative difference allowed between numbers of ours and the oracle's exact ones (a phasor's: of its magnitude)."""

FAULTS = {
    "cfg3-float-scaling": "PHSCALE and ANSCALE of a CFG-3 are applied to integers only; floats are shown as sent",
    "freq-filler": "an integer FREQ of -32768 is shown as nominal - 32.768 Hz, not as absent",
    "rocof-filler": "an integer DFREQ of -32768 is shown as -327.68 Hz/s, not as absent",
    "half-filler": "one part of an integer rectangular phasor being -32768 makes the whole phasor absent",
    "command-time": "commands and headers have no TIME_BASE; FRACSEC is shown under that of the conversation",
    "no-config": "without a configuration in the same conversation a data frame is not dissected",
}
"""Known faults of the oracle: what :class:`Masked` values refer to.

Faults that need no mask, for the bytes are read: the label of the leap direction bit is inverted, names are shown as
ASCII, ``fracsec_ms`` and scaled analogs of a CFG-3 are single precision. And some that are not to be fed: frames of 16
bytes are not seen, a PHSCALE type above 15 reads past a table, any PHUNIT type but 0 is called a current, fragments of
a CFG-3 are refused, and data is decoded by CFG-2 and CFG-3 only, found by conversation and not by IDCODE.
"""

_COMMAND_LABELS = {
    "data transmission off": "stop_data",
    "data transmission on": "start_data",
    "send HDR frame": "send_header",
    "send CFG-1 frame": "send_cfg1",
    "send CFG-2 frame": "send_cfg2",
    "send CFG-3 frame": "send_cfg3",
    "extended frame": "extended",
}
_TYPES = ("data", "header", "cfg1", "cfg2", "command", "cfg3")
_NUMBER = r"\s*([-+]?(?:nan|inf|[\d.]+))"
_PHASOR = re.compile(
    rf",{_NUMBER}([VA]) ∠{_NUMBER}° alt{_NUMBER}\+j{_NUMBER}[VA](?:; unscaled:{_NUMBER},{_NUMBER})?$", re.I
)
_ANALOG = re.compile(rf"\",{_NUMBER}(?: \(conversion factor: (?:0x)?([0-9a-f]+)\))?$", re.I)


class OracleError(AssertionError):
    """tshark failed, or what it prints contradicts the bytes it gives the field."""


class Masked(NamedTuple):
    """A value not to be compared; ``fault`` is a key of :data:`FAULTS`."""

    fault: str


@dataclass(frozen=True)
class _Phasor:
    name: str
    kind: str
    factor: float
    turn: float
    flags: int
    component: int


@dataclass(frozen=True)
class _Analog:
    name: str
    multiplier: float
    offset: float
    anunit: int


@dataclass(frozen=True)
class _Station:
    name: str
    idcode: int
    format: int
    fnom_hz: int
    cfgcnt: int
    phasors: tuple[_Phasor, ...]
    analogs: tuple[_Analog, ...]
    words: tuple[tuple[str, ...], ...]
    masks: tuple[tuple[int, int], ...]
    details: Object
    """What only a CFG-3 says of the station."""


@dataclass(frozen=True)
class _Config:
    kind: str
    time_base: int
    data_rate: int
    stations: tuple[_Station, ...]


def dissect(pcap: Path, *, decode_as: Sequence[str] = (), timeout_s: float = 60) -> list[Object]:
    """Every C37.118 frame that tshark finds, in order, as objects of ``pmu dump --json``.

    ``decode_as`` are selectors of further ports, such as ``udp.port==4801`` or ``tcp.port==5000-5999``. Frames with a
    wrong CHK have ``chk_ok`` false and nothing but the prefix. Skips (fails in CI) where tshark is not installed.
    """
    command = [str(requires("tshark")), "-n", "-r", str(pcap), "-T", "pdml", "-J", "synphasor", "-Y", "synphasor"]
    for selector in decode_as:
        command += ["-d", f"{selector},synphasor"]
    done = subprocess.run(command, capture_output=True, timeout=timeout_s, check=False)
    if done.returncode:
        raise OracleError(f"tshark ended with {done.returncode}: {done.stderr.decode(errors='replace')[-500:]}")
    return list(_objects(done.stdout))


def differences(ours: Iterable[Object], oracle: Iterable[Object], *, ignore: Sequence[str] = ()) -> list[str]:
    """Where the two differ, one line each; empty if they agree. Masked values and keys in ``ignore`` are left out."""
    found: list[str] = []
    for index, (mine, theirs) in enumerate(zip_longest(ours, oracle)):
        if mine is None or theirs is None:
            return [*found, f"frame {index} and on: only the {'oracle' if mine is None else 'codec'} has them"]
        found += _differ(mine, theirs, f"frame {index} ({theirs['type']})", frozenset(ignore))
    return found


def masked(objects: Iterable[Object]) -> dict[str, int]:
    """How many values each fault masks."""
    counts: dict[str, int] = {}

    def visit(value: object) -> None:
        if isinstance(value, Masked):
            counts[value.fault] = counts.get(value.fault, 0) + 1
        elif isinstance(value, dict):
            for item in value.values():
                visit(item)
        elif isinstance(value, list):
            for item in value:
                visit(item)

    for one in objects:
        visit(one)
    return counts


# --- comparison -------------------------------------------------------------------------------------------------


def _differ(mine: Any, theirs: Any, at: str, ignore: frozenset[str]) -> Iterator[str]:
    if isinstance(theirs, Masked):
        return
    if isinstance(theirs, dict) and isinstance(mine, dict):
        margin = TOLERANCE * math.hypot(*(mine.get(part) or 0.0 for part in ("re", "im")))
        for key in sorted((theirs.keys() | mine.keys()) - ignore):
            if key not in mine or key not in theirs:
                yield f"{at}.{key}: only {'the oracle' if key in theirs else 'ours'} has it"
            elif key in ("re", "im") and None not in (mine[key], theirs[key]):
                if not isinstance(theirs[key], Masked) and not abs(mine[key] - theirs[key]) <= margin:
                    yield f"{at}.{key}: {mine[key]!r} is not the oracle's {theirs[key]!r}"
            else:
                yield from _differ(mine[key], theirs[key], f"{at}.{key}", ignore)
    elif isinstance(theirs, (list, tuple)) and isinstance(mine, (list, tuple)):
        if len(mine) != len(theirs):
            yield f"{at}: {len(mine)} items, the oracle has {len(theirs)}"
        for index, pair in enumerate(zip(mine, theirs, strict=False)):
            yield from _differ(*pair, f"{at}[{index}]", ignore)
    elif isinstance(theirs, float) and isinstance(mine, (int, float)):
        if not math.isclose(mine, theirs, rel_tol=TOLERANCE):
            yield f"{at}: {mine!r} is not the oracle's {theirs!r}"
    elif mine != theirs:
        yield f"{at}: {mine!r} is not the oracle's {theirs!r}"


# --- PDML -------------------------------------------------------------------------------------------------------


def _objects(pdml: bytes) -> Iterator[Object]:
    configs: dict[int, _Config] = {}
    for _, packet in ET.iterparse(io.BytesIO(pdml)):
        if packet.tag != "packet":
            continue
        number = int(_one(packet, "num").get("show", ""))
        seconds, _, fraction = _one(packet, "timestamp").get("value", "").partition(".")
        arrival_ns = int(seconds) * 10**9 + int(fraction.ljust(9, "0"))
        for proto in packet.iterfind("proto[@name='synphasor']"):
            yield _frame(proto, number, configs) | {"arrival_ns": arrival_ns}
        packet.clear()


def _frame(proto: ET.Element, number: int, configs: dict[int, _Config]) -> Object:
    kind = _TYPES[_value(_one(proto, "synphasor.frtype"))]
    stamp, idcode = _stamp(proto), _value(_one(proto, "synphasor.idcode_stream_source"))
    body = _one(proto, "synphasor.data")
    if _value_of(proto, "synphasor.checksum.status", "show") != 1:
        return _untimed(kind, idcode, stamp) | {"chk_ok": False}
    if kind == "header":
        return _untimed(kind, idcode, stamp) | {"text": _bytes(body).decode("ascii", "replace")}
    if kind == "command":
        return _untimed(kind, idcode, stamp) | _command(body)
    if kind == "data":
        used = body.find("field[@name='synphasor.data.conf_frame']")
        if used is None:
            return _untimed(kind, idcode, stamp) | {"stations": Masked("no-config")}
        config = configs[int(used.get("show", ""))]
        blocks = [field for field in body if field.get("show", "").startswith("Station: ")]
        stations = [_block(*pair, config.kind) for pair in zip(config.stations, blocks, strict=True)]
        return expected_prefix(kind, idcode, stamp, config.time_base) | {"stations": stations}
    config = _config(body, kind)
    if kind != "cfg1":  # tshark decodes data by CFG-2 and CFG-3 only
        configs[number] = config
    return expected_prefix(kind, idcode, stamp, config.time_base) | _config_object(config)


def _stamp(proto: ET.Element) -> Stamp:
    flags = next(field for field in proto if field.get("show") == "Time quality flags")
    bits = [_value(_one(flags, f"synphasor.timeqal.{name}")) for name in ("lsdir", "lsocc", "lspend", "timequalindic")]
    quality = bits[0] << 6 | bits[1] << 5 | bits[2] << 4 | bits[3] | int(flags.get("value", ""), 16) & 0x80
    soc = int(_one(proto, "synphasor.soc").get("value", ""), 16)
    return Stamp(soc, quality, int(_one(proto, "synphasor.fracsec_raw").get("show", "")))


def _untimed(kind: str, idcode: int, stamp: Stamp) -> Object:
    """Prefix keys of a frame whose TIME_BASE is not known."""
    prefix = expected_prefix(kind, idcode, stamp, 1)
    fault = Masked("no-config" if kind == "data" else "command-time")
    return prefix | {"time_ns": fault, "time": fault}


def _command(body: ET.Element) -> Object:
    command = _one(body, "synphasor.command")
    code = _value(command)
    label = command.get("showname", "").partition("Command: ")[2].partition(" (")[0]
    ranges = {"user designation": "user", "reserved codes": "reserved"}
    name = _COMMAND_LABELS.get(label) or f"{ranges[label]}-{code:#06x}"
    if COMMAND_NAMES.get(code, name) != name:
        raise OracleError(f"command {code} is shown as {label!r}")
    tags = ("synphasor.extended_frame_data", "synphasor.data.unknown")
    extra = next((field for tag in tags if (field := body.find(f"field[@name='{tag}']")) is not None), None)
    return {"command": name, "code": code, "extended": "" if extra is None else extra.get("value", "").lower()}


# --- configurations ---------------------------------------------------------------------------------------------


def _config(body: ET.Element, kind: str) -> _Config:
    blocks = [field for field in body if field.get("show", "").startswith("Station #")]
    if len(blocks) != _value_of(body, "synphasor.conf.numpmu", "show"):
        raise OracleError(f"{len(blocks)} stations dissected, NUM_PMU is another number")
    return _Config(
        kind,
        _value_of(body, "synphasor.conf.timebase", "show"),
        _value_of(body, "synphasor.rate_of_transmission", "show"),
        tuple(_station(block, kind) for block in blocks),
    )


def _station(block: ET.Element, kind: str) -> _Station:
    third = kind == "cfg3"
    raw = _bytes(block)
    name = raw[1 : 1 + raw[0]] if third else raw[:16]
    fmt = next(field for field in block if field.get("show") == "Data format in data frame")
    names = ("dfreq_format", "analog_format", "phasor_format", "phasor_notation")
    bits = [_value(_one(fmt, f"synphasor.conf.{name}")) for name in names]
    word = int(fmt.get("value", ""), 16)
    if word & 0xF != bits[0] << 3 | bits[1] << 2 | bits[2] << 1 | bits[3]:
        raise OracleError(f"FORMAT {word:#06x} is dissected as {bits}")
    phasors, analogs = _names(block, "Phasor names", third), _names(block, "Analog values (", third)
    labels = _names(block, "Digital labels" if third else "Digital status labels", third)
    units, scales = _phasor_units(block, third), _analog_units(block, third)
    return _Station(
        _text(name),
        _value_of(block, "synphasor.idcode_data_source", "show"),
        word,
        50 if _value(_one(block, "synphasor.conf.fnom")) else 60,
        _value_of(block, "synphasor.conf.cfgcnt", "show"),
        tuple(_Phasor(name, *unit) for name, unit in zip(phasors, units, strict=True)),
        tuple(_Analog(name, *scale) for name, scale in zip(analogs, scales, strict=True)),
        tuple(tuple(labels[at : at + 16]) for at in range(0, len(labels), 16)),
        tuple(_masks(block)),
        _details(block) if third else {},
    )


def _names(block: ET.Element, title: str, third: bool) -> list[str]:
    raws = [_bytes(field) for field in _group(block, title)]
    return [_text(raw[1:] if third else raw) for raw in raws]


def _phasor_units(block: ET.Element, third: bool) -> Iterator[tuple[str, float, float, int, int]]:
    """(kind, factor to V or A, angle offset in rad, modification flags, component) of each phasor."""
    if third:
        for field in _group(block, "Phasor scaling and data flags"):
            kind = "I" if _value(_one(field, "synphasor.conf.phasor_type")) else "V"
            flags = next(f for f in field.iter("field") if f.get("show", "").startswith("Modification Flags"))
            factor, turn = (
                _float(_one(field, f"synphasor.conf.phasor_{key}")) for key in ("scale_factor", "angle_offset")
            )
            component = _value(_one(field, "synphasor.conf.phasor_component"))
            yield kind, factor, turn, int(flags.get("value", ""), 16), component
        return
    for field in _group(block, "Phasor conversion factors"):
        shown = re.fullmatch(r"#\d+ factor: (\d+) \* 10\^-5, unit: (Volt|Ampere)", field.get("showname", ""))
        if shown is None:
            raise OracleError(f"PHUNIT is shown as {field.get('showname')!r}")
        yield "I" if shown[2] == "Ampere" else "V", int(shown[1]) * 1e-5, 0.0, 0, 0


def _analog_units(block: ET.Element, third: bool) -> Iterator[tuple[float, float, int]]:
    """(multiplier, offset, raw ANUNIT) of each analog."""
    for field in _group(block, "Analog values conversion factors"):
        if third:
            yield (*(_float(_one(field, f"synphasor.conf.analog_{key}")) for key in ("scale_factor", "offset")), 0)
        else:
            yield 1.0, 0.0, int(field.get("unmaskedvalue", ""), 16)


def _masks(block: ET.Element) -> Iterator[tuple[int, int]]:
    for field in _group(block, "Masks for digital status words"):
        normal, valid = (
            _value(_one(field, f"synphasor.status_word_mask.{key}")) for key in ("normal_state", "valid_bits")
        )
        yield normal, valid


def _details(block: ET.Element) -> Object:
    service = _one(block, "synphasor.conf.svc_class")
    letter = _bytes(service).decode("ascii")
    if service.get("show") != {"P": "Protection", "M": "Monitoring"}[letter]:
        raise OracleError(f"SVC_CLASS {letter!r} is shown as {service.get('show')!r}")
    place = ("latitude_deg", "longitude_deg", "elevation_m")
    times = {"window_us": "window", "group_delay_us": "grp_dly"}
    return {
        "g_pmu_id": _bytes(_one(block, "synphasor.gpmuid")).hex(),
        **{key: _json(_float(_one(block, f"synphasor.conf.pmu_{key.partition('_')[0]}"))) for key in place},
        "service_class": letter,
        **{
            key: int.from_bytes(_bytes(_one(block, f"synphasor.conf.{name}")), "big", signed=True)
            for key, name in times.items()
        },
    }


def _config_object(config: _Config) -> Object:
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


def _phasor_object(phasor: _Phasor, kind: str) -> Object:
    found = {"name": phasor.name, "kind": phasor.kind, "unit": phasor.factor}
    if kind == "cfg3":
        found |= {"flags": phasor.flags, "component": phasor.component, "angle_offset_rad": phasor.turn}
    return found


def _analog_object(analog: _Analog, kind: str) -> Object:
    if kind == "cfg3":
        return {"multiplier": analog.multiplier, "offset": analog.offset}
    unit = int.from_bytes(analog.anunit.to_bytes(4, "big")[1:], "big", signed=True)
    return {"kind": analog.anunit >> 24, "unit": unit}


# --- data -------------------------------------------------------------------------------------------------------


def _block(station: _Station, block: ET.Element, kind: str) -> Object:
    shown = block.get("show", "")[len('Station: "') : -1]
    if not _same_name(shown, station.name):
        raise OracleError(f"block of {shown!r} under the configuration of {station.name!r}")
    stat = _stat(next(field for field in block if field.get("show") == "Flags"))
    phasors = [_phasor(*pair, station.format, kind) for pair in _children(block, "Phasors (", station.phasors)]
    frequency, rocof = _frequency(station, block)
    analogs = [_analog(*pair, kind) for pair in _children(block, "Analog values (", station.analogs)]
    digitals = [_value(field) for _, field in _children(block, "Digital status words (", station.words)]
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
    stat = sum(_value(_one(flags, f"synphasor.data.{name}")) << shift for name, shift in _STAT_FIELDS.items())
    if stat != int(flags.get("value", ""), 16):
        raise OracleError(f"STAT {flags.get('value')} is dissected as {stat:04x}")
    return stat


def _phasor(channel: _Phasor, field: ET.Element, fmt: int, kind: str) -> Object:
    raw, printed = _bytes(field), _PHASOR.search(field.get("showname", ""))
    if printed is None or not _same_name(field.get("show", ""), channel.name):
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
            _agree(printed[6], first, field)
            _agree(printed[7], second, field)
    if math.isnan(first) or math.isnan(second):
        value = complex(NAN, NAN)
    elif polar:
        value = cmath.rect(factor * first, second * (1 if floating else 1e-4) - turn)
    else:
        value = factor * complex(first, second) * cmath.exp(-1j * turn)
    _agree(printed[1], abs(value), field)
    _agree(printed[4], value.real, field)
    _agree(printed[5], value.imag, field)
    if math.isfinite(abs(value)):
        angle_deg = math.degrees(cmath.phase(value))
        if abs(value) > 1e-3 and abs((float(printed[3]) - angle_deg + 180) % 360 - 180) > 1e-3:
            raise OracleError(f"{field.get('showname')!r}: the angle is {angle_deg} degrees by its bytes")
    parts: Object = {"re": _json(value.real), "im": _json(value.imag)}
    if fault == "half-filler" or (fault and not cmath.isnan(value)):
        parts = dict.fromkeys(parts, Masked(fault))
    return {"name": channel.name, "kind": channel.kind} | parts


def _frequency(station: _Station, block: ET.Element) -> tuple[Any, Any]:
    rocof = _one(block, "synphasor.rate_change_frequency")
    if station.format & FREQ_FLOAT:
        frequency = _one(block, "synphasor.actual_frequency_value")
        return _json(_float(frequency)), _json(_float(rocof))
    deviation = _one(block, "synphasor.frequency_deviation_from_nominal")
    freq, dfreq = (int.from_bytes(_bytes(field), "big", signed=True) for field in (deviation, rocof))
    shown = [
        re.search(rf"{_NUMBER}{unit}", field.get("showname", ""))
        for field, unit in ((deviation, "Hz"), (rocof, "Hz/s"))
    ]
    values = (station.fnom_hz + freq / 1000, dfreq / 100)
    for match, value, field in zip(shown, values, (deviation, rocof), strict=True):
        _agree(match[1] if match else "", value, field)
    return (
        Masked("freq-filler") if freq == FILLER else values[0],
        Masked("rocof-filler") if dfreq == FILLER else values[1],
    )


def _analog(channel: _Analog, field: ET.Element, kind: str) -> Any:
    raw, printed = _bytes(field), _ANALOG.search(field.get("showname", ""))
    if printed is None or not _same_name(field.get("show", ""), channel.name):
        raise OracleError(f"analog {channel.name!r} is shown as {field.get('showname')!r}")
    floating = len(raw) == 4
    wire = struct.unpack(">f" if floating else ">h", raw)[0]
    scaled = kind == "cfg3" and (channel.multiplier, channel.offset) != (1.0, 0.0)
    if floating:
        _agree(printed[1], wire, field)
        return Masked("cfg3-float-scaling") if scaled and wire == wire else _json(wire)
    value = wire * channel.multiplier + channel.offset if kind == "cfg3" else wire
    _agree(printed[1], value, field)
    if kind != "cfg3" and int(printed[2] or "0", 16) != channel.anunit:
        raise OracleError(f"{field.get('showname')!r}: ANUNIT is {channel.anunit:#010x}")
    return value


def _agree(printed: str, value: float, field: ET.Element) -> None:
    """Raise unless ``printed`` is ``value`` to three decimals (and to single precision, which tshark uses at times)."""
    try:
        shown = float(printed)
    except ValueError:
        raise OracleError(f"no number in {field.get('showname')!r}") from None
    margin = 0.51 * 10**-PRINTED_PLACES + 2e-7 * abs(value)
    same = math.isnan(shown) if math.isnan(value) else shown == value or abs(shown - value) <= margin
    if not same:
        raise OracleError(f"{field.get('showname')!r} is {value!r} by its bytes {field.get('value')}")


# --- elements ---------------------------------------------------------------------------------------------------


def _one(parent: ET.Element, name: str) -> ET.Element:
    found = parent.find(f".//field[@name='{name}']")
    if found is None:
        raise OracleError(f"no {name} in {parent.get('showname') or parent.get('show') or parent.tag!r}")
    return found


def _value(field: ET.Element) -> int:
    """A number as tshark cuts it out of its word: shifted and masked."""
    return int(field.get("value", ""), 16)


def _value_of(parent: ET.Element, name: str, attribute: str) -> int:
    return int(_one(parent, name).get(attribute, ""), 0)


def _bytes(field: ET.Element) -> bytes:
    return bytes.fromhex(field.get("value", ""))


def _float(field: ET.Element) -> float:
    return float(struct.unpack(">f", _bytes(field))[0])


def _group(block: ET.Element, title: str) -> Sequence[ET.Element]:
    """Children of the subtree whose title begins with ``title``; none where it is absent."""
    return next((list(field) for field in block if field.get("show", "").startswith(title)), [])


def _children(block: ET.Element, title: str, channels: Sequence[Any]) -> Iterator[tuple[Any, ET.Element]]:
    return zip(channels, _group(block, title), strict=True)


def _text(raw: bytes) -> str:
    """A name as sent, trimmed."""
    return raw.decode("utf-8", "replace").rstrip(" \0")


def _same_name(shown: str, name: str) -> bool:
    """Whether tshark's showing of a name, ASCII and up to the first NUL, can be that of ``name``."""
    return shown.rstrip(" ") == name or not name.isascii() or "\0" in name


def _json(value: float) -> float | None:
    return value if math.isfinite(value) else None
