"""tshark as a neutral oracle: its dissection of a capture as the objects of ``pmu dump --json``.

What is taken from tshark is where each field lies and what it is (name, number format, unit, factor, flag). Numbers
are computed here from the bytes tshark gives a field, because it prints only three decimals; and each is held
against what it prints, so that a reading of ours that tshark does not share raises :class:`OracleError`. Where the
oracle itself is known to be wrong (:data:`FAULTS`), the value is :class:`Masked` and :func:`differences` leaves it out.
"""

from __future__ import annotations

import io
import math
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

from support.meaning import COMMAND_NAMES, Object, expected_prefix
from support.oracle.config import Config, config_object, read_config
from support.oracle.data import read_block
from support.oracle.elements import child, number, octets, value_of
from support.oracle.faults import FAULTS, Masked, OracleError
from support.requires import requires
from support.wire import Stamp

__all__ = ["FAULTS", "TOLERANCE", "Masked", "OracleError", "differences", "dissect", "masked"]

TOLERANCE = 1e-9
"""Relative difference allowed between numbers of ours and the oracle's exact ones (a phasor's: of its magnitude)."""

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
    """Where the two differ, one line each; empty if they agree. Masked values and keys in ``ignore`` are left out.

    So is how a frame came, of which the oracle is not asked.
    """
    found: list[str] = []
    for index, (mine, theirs) in enumerate(zip_longest(ours, oracle)):
        if mine is None or theirs is None:
            return [*found, f"frame {index} and on: only the {'oracle' if mine is None else 'codec'} has them"]
        found += _differ(mine, theirs, f"frame {index} ({theirs['type']})", {"flow", "stamp_source", *ignore})
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


def _differ(mine: Any, theirs: Any, at: str, ignore: set[str]) -> Iterator[str]:
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
    configs: dict[int, Config] = {}
    for _, packet in ET.iterparse(io.BytesIO(pdml)):
        if packet.tag != "packet":
            continue
        packet_number = int(child(packet, "num").get("show", ""))
        seconds, _, fraction = child(packet, "timestamp").get("value", "").partition(".")
        arrival_ns = int(seconds) * 10**9 + int(fraction.ljust(9, "0"))
        for proto in packet.iterfind("proto[@name='synphasor']"):
            version = number(child(proto, "synphasor.version"))
            yield _frame(proto, packet_number, configs) | {"arrival_ns": arrival_ns, "version": version}
        packet.clear()


def _frame(proto: ET.Element, packet_number: int, configs: dict[int, Config]) -> Object:
    kind = _TYPES[number(child(proto, "synphasor.frtype"))]
    stamp, idcode = _stamp(proto), number(child(proto, "synphasor.idcode_stream_source"))
    body = child(proto, "synphasor.data")
    if value_of(proto, "synphasor.checksum.status", "show") != 1:
        return _untimed(kind, idcode, stamp) | {"chk_ok": False}
    if kind == "header":
        return _untimed(kind, idcode, stamp) | {"text": octets(body).decode("ascii", "replace")}
    if kind == "command":
        return _untimed(kind, idcode, stamp) | _command(body)
    if kind == "data":
        used = body.find("field[@name='synphasor.data.conf_frame']")
        if used is None:
            return _untimed(kind, idcode, stamp) | {"stations": Masked("no-config")}
        config = configs[int(used.get("show", ""))]
        fraction_ms = 1000 * stamp.fracsec / config.time_base
        if not math.isclose(float(child(proto, "synphasor.fracsec_ms").get("show", "")), fraction_ms, rel_tol=1e-5):
            raise OracleError(f"FRACSEC {stamp.fracsec} is not shown as {fraction_ms} ms")
        blocks = [field for field in body if field.get("show", "").startswith("Station: ")]
        stations = [read_block(*pair, config.kind) for pair in zip(config.stations, blocks, strict=True)]
        return expected_prefix(kind, idcode, stamp, config.time_base) | {"stations": stations}
    config = read_config(body, kind)
    if kind != "cfg1":  # tshark decodes data by CFG-2 and CFG-3 only
        configs[packet_number] = config
    return expected_prefix(kind, idcode, stamp, config.time_base) | config_object(config)


def _stamp(proto: ET.Element) -> Stamp:
    flags = next(field for field in proto if field.get("show") == "Time quality flags")
    bits = [number(child(flags, f"synphasor.timeqal.{name}")) for name in ("lsdir", "lsocc", "lspend", "timequalindic")]
    quality = bits[0] << 6 | bits[1] << 5 | bits[2] << 4 | bits[3] | int(flags.get("value", ""), 16) & 0x80
    soc = int(child(proto, "synphasor.soc").get("value", ""), 16)
    return Stamp(soc, quality, int(child(proto, "synphasor.fracsec_raw").get("show", "")))


def _untimed(kind: str, idcode: int, stamp: Stamp) -> Object:
    """Prefix keys of a frame whose TIME_BASE is not known."""
    prefix = expected_prefix(kind, idcode, stamp, 1)
    fault = Masked("no-config" if kind == "data" else "command-time")
    return prefix | {"time_ns": fault, "time": fault}


def _command(body: ET.Element) -> Object:
    command = child(body, "synphasor.command")
    code = number(command)
    label = command.get("showname", "").partition("Command: ")[2].partition(" (")[0]
    ranges = {"user designation": "user", "reserved codes": "reserved"}
    name = _COMMAND_LABELS.get(label) or f"{ranges[label]}-{code:#06x}"
    if COMMAND_NAMES.get(code, name) != name:
        raise OracleError(f"command {code} is shown as {label!r}")
    tags = ("synphasor.extended_frame_data", "synphasor.data.unknown")
    extra = next((field for tag in tags if (field := body.find(f"field[@name='{tag}']")) is not None), None)
    return {"command": name, "code": code, "extended": "" if extra is None else extra.get("value", "").lower()}
