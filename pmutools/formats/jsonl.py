"""``.jsonl``: the objects of ``pmu dump --json``, one a line; made frames again, and written.

A data object follows the configuration object (``cfg2`` or ``cfg3``) of its IDCODE that came last; its frame is encoded
under that. Where none came before, one is inferred: the names in the object, all FORMATs float and rectangular, analogs
and labels without names. Numbers come back as they are printed, integers exactly. Headers, commands, CFG-1 and
``skipped`` are passed over; lines that are no such objects are counted. A stream is told by its flow and its IDCODE.
"""

from __future__ import annotations

import io
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, Batch
from pmutools.c37118.config import (
    AnalogChannel,
    AnalogScale,
    DigitalWord,
    PhasorChannel,
    PhasorScale,
    Station,
    StationDetails,
    StreamConfig,
    decode_config,
    encode_config,
)
from pmutools.c37118.constants import (
    FNOM_50_HZ,
    LABELS_PER_WORD,
    PHSCALE_CURRENT,
    STAT_ABSENT,
    STAT_DATA_ERROR_MASK,
    Format,
    FrameType,
)
from pmutools.errors import PmuError, SourceError
from pmutools.flow import Flow
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.capture.window import Window
from pmutools.formats.describe import Json, flow_of
from pmutools.formats.files import END_NS, WindowFile
from pmutools.formats.infer import data_rate_of, nominal_hz_of, wire_names
from pmutools.formats.jsonl_sink import create as create
from pmutools.formats.rows import stamp_code
from pmutools.formats.source import Block, TableSource

_Key = tuple[Flow, int]
BLOCK_ROWS = 1024
"""Objects of a stream held at one time; each takes some kB."""
_CONFIGS = {"cfg2": FrameType.CFG2, "cfg3": FrameType.CFG3}
_TYPES = {"data", "cfg1", "cfg2", "cfg3", "header", "command", "skipped"}
_FLOATS = Format.PHASOR_FLOAT | Format.ANALOG_FLOAT | Format.FREQ_FLOAT
_CURRENT = 1 << 24
_MISFITS = (KeyError, TypeError, ValueError, OverflowError, PmuError)
"""What comes of an object that lacks something, or holds something else than it should."""


def read(path: Path, configs: Iterable[StreamConfig] = (), nominal: Nominal = UNSAID) -> TableSource:
    """Open such a file; ``configs`` are for streams that it has no configuration of.

    Raises SourceError where it has no data objects.
    """
    defects = Counter[str]()
    blocks = _Reader(path, {config.idcode: config for config in configs}, nominal, defects).blocks()
    first = next(blocks, None)
    if first is None:
        found = ", ".join(f"{name}: {count}" for name, count in defects.items())
        raise SourceError(
            f"{path} holds no data objects of pmu dump --json{found and f' ({found})'}; name another file"
        )
    return TableSource(path, "jsonl", chain([first], blocks), lambda: dict(+defects))


class _Reader:
    def __init__(self, path: Path, configs: dict[int, StreamConfig], nominal: Nominal, defects: Counter[str]) -> None:
        self._path, self._nominal, self._defects = path, nominal, defects
        self._known = configs
        self._configs: dict[_Key, StreamConfig] = {}
        self._waiting: dict[_Key, list[Json]] = {}

    def blocks(self) -> Iterator[Block]:
        for item in self._objects():
            if (kind := _CONFIGS.get(item["type"])) is not None:
                yield from self._configure(item, kind)
            elif item["type"] == "data":
                idcode = item.get("idcode")
                if not isinstance(idcode, int) or not 0 <= idcode <= 0xFFFF or _time_ns(item) == NO_TIME:
                    self._defects["data without a time or IDCODE"] += 1
                    continue
                key = self._flow(item), idcode
                waiting = self._waiting.setdefault(key, [])
                waiting.append(item)
                if len(waiting) >= BLOCK_ROWS:
                    yield from self._flush(key)
        for key in list(self._waiting):
            yield from self._flush(key)

    def _flow(self, item: Json) -> Flow:
        name = item.get("flow")
        return flow_of(name) if isinstance(name, str) else Flow("file", self._path.name)

    def _objects(self) -> Iterator[Json]:
        with Window(self._path) as window:
            for line in io.TextIOWrapper(io.BufferedReader(WindowFile(window), 1 << 16), "utf-8-sig", errors="replace"):
                if not line.strip():
                    continue
                try:
                    item = json.loads(line)
                except (ValueError, RecursionError):
                    item = None
                if isinstance(item, dict) and item.get("type") in _TYPES:
                    yield item
                else:
                    self._defects["lines that are no objects of pmu dump"] += 1
            if window.failed:
                self._defects["compression damaged"] = 1

    def _configure(self, item: Json, kind: FrameType) -> Iterator[Block]:
        if item.get("undecodable") and kind is FrameType.CFG3:
            return  # a fragment; the last one has the whole
        try:
            config = config_of(item, kind)
        except _MISFITS:
            self._defects["unreadable configurations"] += 1
            return
        self._nominal.refuse(self._path)
        key = self._flow(item), config.idcode
        if self._configs.get(key) != config:
            yield from self._flush(key)
            self._configs[key] = config

    def _flush(self, key: _Key) -> Iterator[Block]:
        rows = self._waiting.pop(key, [])
        if not rows:
            return
        flow, idcode = key
        config = self._configs.get(key) or self._known.get(idcode) or self._infer(idcode, rows)
        if config is None:
            return
        self._configs[key] = config
        fitting = [row for row in rows if _fits(row, config)]
        if len(fitting) < len(rows):
            self._defects["data that do not fit their configuration"] += len(rows) - len(fitting)
        if fitting:
            yield Block(flow, batch_of_objects(fitting, config))

    def _infer(self, idcode: int, rows: Sequence[Json]) -> StreamConfig | None:
        for row in rows:
            try:
                return _inferred_config(idcode, row, rows, self._nominal)
            except _MISFITS:
                continue
        self._defects["data that do not fit their configuration"] += len(rows)
        return None


# --- configurations ---------------------------------------------------------------------------------------------


def config_of(item: Mapping[str, Any], kind: FrameType) -> StreamConfig:
    """The configuration that an object describes. Raises KeyError, TypeError, ValueError or PmuError for others."""
    stations = tuple(_station(station, kind) for station in item["stations"])
    rate = item["data_rate"] if "data_rate" in item else _rate(float(item["rate_hz"]))
    config = StreamConfig(int(item["idcode"]), stations, rate, int(item["time_base"]), kind, version=kind.version)
    return decode_config(encode_config(config))[1]  # what cannot be encoded is none


def _rate(rate_hz: float) -> int:
    return round(rate_hz) if rate_hz >= 1 or not rate_hz else -round(1 / rate_hz)


def _station(item: Mapping[str, Any], kind: FrameType) -> Station:
    third = kind is FrameType.CFG3
    scales = item.get("analog_scales") or [{}] * len(item["analogs"])
    masks = item.get("digital_masks") or [{}] * len(item["digitals"])
    return Station(
        str(item["name"]),
        int(item["idcode"]),
        Format(int(item["format"])),
        tuple(_phasor(channel, third) for channel in item["phasors"]),
        tuple(_analog(str(name), scale, third) for name, scale in zip(item["analogs"], scales, strict=True)),
        tuple(
            DigitalWord(tuple(map(str, labels)), int(mask.get("normal", 0)), int(mask.get("valid", 0xFFFF)))
            for labels, mask in zip(item["digitals"], masks, strict=True)
        ),
        FNOM_50_HZ if float(item["fnom_hz"]) == 50 else 0,
        int(item["cfgcnt"]),
        _details(item) if third else None,
    )


def _phasor(item: Mapping[str, Any], third: bool) -> PhasorChannel:
    current = item["kind"] == "I"
    if not third:
        return PhasorChannel(str(item["name"]), current * _CURRENT | round(float(item["unit"]) * 1e5))
    kind = int(item.get("component", 1)) | (PHSCALE_CURRENT if current else 0)
    unit, turn = _number(item["unit"]), _number(item.get("angle_offset_rad", 0.0))
    return PhasorChannel(str(item["name"]), 0, PhasorScale(int(item.get("flags", 0)), kind, 0, unit, turn))


def _analog(name: str, scale: Mapping[str, Any], third: bool) -> AnalogChannel:
    if third:
        return AnalogChannel(
            name, 0, AnalogScale(_number(scale.get("multiplier", 1.0)), _number(scale.get("offset", 0.0)))
        )
    return AnalogChannel(name, int(scale.get("kind", 0)) << 24 | int(scale.get("unit", 0)) & 0xFFFFFF)


def _details(item: Mapping[str, Any]) -> StationDetails:
    known = StationDetails()
    places = {
        name: float("inf") if (value := item.get(name)) is None else float(value)
        for name in ("latitude_deg", "longitude_deg", "elevation_m")
    }
    return replace(
        known,
        g_pmu_id=bytes.fromhex(item.get("g_pmu_id", known.g_pmu_id.hex())),
        service_class=str(item.get("service_class", known.service_class)),
        window_us=int(item.get("window_us", 0)),
        group_delay_us=int(item.get("group_delay_us", 0)),
        **places,
    )


def _inferred_config(idcode: int, row: Json, rows: Sequence[Json], nominal: Nominal) -> StreamConfig:
    """All float, named as ``row`` names its channels; rate and nominal frequency from all ``rows``."""
    rate = nominal.data_rate or data_rate_of(np.array([_time_ns(each) for each in rows], np.int64))
    frequencies = [
        _number(station.get("frequency"))
        for each in rows
        for station in each.get("stations", ())
        if isinstance(station, dict)
    ]
    fnom_hz = nominal.fnom_hz or nominal_hz_of(np.array(frequencies), rate)
    names = wire_names(str(station["name"]) for station in row["stations"])
    stations = tuple(
        Station(
            name,
            int(station.get("idcode", idcode)),
            _FLOATS,
            tuple(
                PhasorChannel(short, _CURRENT if channel.get("kind") == "I" else 0)
                for short, channel in zip(
                    wire_names(str(channel["name"]) for channel in station["phasors"]), station["phasors"], strict=True
                )
            ),
            tuple(AnalogChannel(f"AN{number}") for number in range(1, len(station["analogs"]) + 1)),
            (DigitalWord(("",) * LABELS_PER_WORD),) * len(station["digitals"]),
            FNOM_50_HZ if fnom_hz == 50 else 0,
        )
        for name, station in zip(names, row["stations"], strict=True)
    )
    config = StreamConfig(idcode, stations, rate or round(fnom_hz))
    encode_config(config)
    return config


# --- data -------------------------------------------------------------------------------------------------------


def batch_of_objects(rows: Sequence[Json], config: StreamConfig) -> Batch:
    """Data objects, all of which fit ``config``, as columns."""
    stations = [row["stations"] for row in rows]
    stat = _column(stations, lambda station: [int(station["stat"])], np.uint16)
    frequency = _column(stations, lambda station: [_number(station["frequency"])], np.float64)
    phasors = _column(stations, lambda station: [_complex(value) for value in station["phasors"]], np.complex128)
    present = ~np.isnan(frequency)
    at = 0
    for number, station in enumerate(config.stations):
        own = phasors[:, at : at + len(station.phasors)]
        present[:, number] |= ~np.isnan(own).all(axis=1)
        at += len(station.phasors)
    return Batch(
        config,
        np.array([_time_ns(row) for row in rows], np.int64),
        np.array([_arrival_ns(row) for row in rows], np.int64),
        np.array([stamp_code(row.get("stamp_source")) for row in rows], np.uint8),
        np.array([int(row.get("time_quality", 0)) & 0xFF for row in rows], np.uint8),
        stat,
        phasors,
        frequency,
        _column(stations, lambda station: [_number(station["rocof"])], np.float64),
        _column(stations, lambda station: [_number(value) for value in station["analogs"]], np.float64),
        _column(stations, lambda station: [int(value) for value in station["digitals"]], np.uint16),
        present & ((stat & STAT_DATA_ERROR_MASK) == 0),
    )


def _column(stations: Sequence[Sequence[Json]], values: Any, kind: Any) -> npt.NDArray[Any]:
    """(N, places) of what ``values`` gives for each station."""
    return np.array([[value for station in row for value in values(station)] for row in stations], kind)


def _fits(row: Json, config: StreamConfig) -> bool:
    """Whether a data object has the channels of ``config``, and numbers in them."""
    try:
        stations = row["stations"]
        counts = [(len(each["phasors"]), len(each["analogs"]), len(each["digitals"])) for each in stations]
        if counts != [(len(each.phasors), len(each.analogs), len(each.digitals)) for each in config.stations]:
            return False
        for station in stations:
            words = [int(station.setdefault("stat", 0 if station.get("valid", True) else STAT_ABSENT))]
            words += [int(value) for value in station["digitals"]]
            for value in (station.get("frequency"), station.get("rocof"), *station["analogs"]):
                _number(value)
            station.setdefault("frequency", None)
            station.setdefault("rocof", None)
            for phasor in station["phasors"]:
                _complex(phasor)
            if not all(0 <= word <= 0xFFFF for word in words):
                return False
        int(row.get("time_quality", 0))
    except (*_MISFITS, AttributeError):
        return False
    return True


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _complex(value: Mapping[str, Any]) -> complex:
    return complex(_number(value["re"]), _number(value["im"]))


def _time_ns(row: Mapping[str, Any]) -> int:
    """The object's stamp; NO_TIME where it has none."""
    value = row.get("time_ns")
    if value is None and isinstance(row.get("time"), str):
        try:
            value = timebase.parse_utc(row["time"])
        except ValueError:
            return NO_TIME
    return value if isinstance(value, int) and 0 <= value < END_NS else NO_TIME


def _arrival_ns(row: Mapping[str, Any]) -> int:
    value = row.get("arrival_ns")
    return value if isinstance(value, int) and 0 <= value < END_NS else NO_TIME
