"""PMU blocks of data and configuration frames as scapy packets."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar, cast

from scapy.base_classes import Packet_metaclass
from scapy.fields import (
    BitEnumField,
    BitField,
    Field,
    FieldLenField,
    FlagsField,
    ShortField,
    SignedIntField,
    StrFixedLenField,
    XByteField,
    XIntField,
    XShortField,
)
from scapy.packet import Packet

from pmutools.c37118 import layout
from pmutools.c37118.config import Station, StreamConfig
from pmutools.c37118.constants import (
    CHK_SIZE,
    LABELS_PER_WORD,
    PREFIX_SIZE,
    DataError,
    Format,
    PhasorComponent,
    TriggerReason,
)
from pmutools.c37118.frames import Data, StationData
from pmutools.c37118_scapy.fields import FloatField, ItemsField, Name2Field, Name3Field, PacketsField, WireField, labels
from pmutools.c37118_scapy.registry import MAX_CONFIGS


class _Block(Packet):
    """Part of a frame: what follows belongs to the frame."""

    def extract_padding(self, s: bytes) -> tuple[bytes, bytes]:
        return b"", s


# --- data -------------------------------------------------------------------------------------------------------


class DataBlock(_Block):
    """One PMU's values in a data frame, in wire units; subclasses, one a station, add the fields after STAT."""

    fields_desc: ClassVar[list[Any]] = [
        BitEnumField("data_error", 0, 2, labels(DataError)),
        BitField("not_synchronised", 0, 1),
        BitField("sorted_by_arrival", 0, 1),
        BitField("trigger", 0, 1),
        BitField("config_change", 0, 1),
        BitField("data_modified", 0, 1),
        BitField("pmu_tq", 0, 3),
        BitField("unlocked_time", 0, 2),
        BitEnumField("trigger_reason", 0, 4, labels(TriggerReason)),
    ]
    station: ClassVar[Station]
    config: ClassVar[StreamConfig]

    @property
    def measured(self) -> StationData:
        """What the block says, in SI units."""
        values = layout.layout_of(self.config).unpacker.unpack(bytes(PREFIX_SIZE) + self.build() + bytes(CHK_SIZE))
        return Data(self.config, values).station()


@lru_cache(maxsize=MAX_CONFIGS)
def data_block_classes(config: StreamConfig) -> tuple[type[DataBlock], ...]:
    """The class of each station's blocks, its fields made by the layout that every decoder goes by."""
    return tuple(_data_block_class(config, station) for station in config.stations)


def _data_block_class(config: StreamConfig, station: Station) -> type[DataBlock]:
    runs = [run for run in layout.station_fields(station, PREFIX_SIZE, 0) if run.name != "stat"]
    members = {
        "name": f"PMU {station.name}",
        "fields_desc": [*DataBlock.fields_desc, *(WireField(run, _SHOWN[run.name]) for run in runs)],
        "station": station,
        "config": replace(config, stations=(station,)),
    }
    # The leading underscore keeps scapy from registering the class for good.
    return cast("type[DataBlock]", Packet_metaclass("_DataBlock", (DataBlock,), members))


def data_blocks(config: StreamConfig) -> list[DataBlock]:
    """Blocks for a data frame under ``config``, all values zero: ``C37118(idcode=..., blocks=data_blocks(config))``."""
    return [block_class() for block_class in data_block_classes(config)]


def _show_phasors(block: Packet, wire: list[tuple[float, float]]) -> str:
    assert isinstance(block, DataBlock)
    lines = []
    for channel, value, pair in zip(block.station.phasors, block.measured.phasors, wire, strict=True):
        angle_deg = math.degrees(cmath.phase(value))
        unit = "A" if channel.kind == "I" else "V"
        lines.append(f"{channel.name}: {abs(value):.6g} {unit} at {angle_deg:.3f} deg, sent {pair}")
    return "\n".join(lines)


def _show_analogs(block: Packet, wire: list[float]) -> str:
    assert isinstance(block, DataBlock)
    channels = zip(block.station.analogs, block.measured.analogs, wire, strict=True)
    return "\n".join(f"{channel.name}: {value:.6g}, sent {sent}" for channel, value, sent in channels)


def _show_digitals(block: Packet, wire: list[int]) -> str:
    assert isinstance(block, DataBlock)
    lines = []
    for word, value in zip(block.station.digitals, wire, strict=True):
        names = [name or f"bit {bit}" for bit, name in enumerate(word.labels) if value >> bit & 1]
        lines.append(f"{value:#06x} {', '.join(names)}".rstrip())
    return "\n".join(lines)


_SHOWN: dict[str, Callable[[Any, Any], str]] = {
    "phasors": _show_phasors,
    "freq": lambda block, wire: f"{block.measured.frequency:.6f} Hz, sent {wire}",
    "dfreq": lambda block, wire: f"{block.measured.rocof:.6g} Hz/s, sent {wire}",
    "analogs": _show_analogs,
    "digitals": _show_digitals,
}


# --- configurations ---------------------------------------------------------------------------------------------


def _counts(name_field: Callable[[str], Field[Any, Any]]) -> list[Any]:
    """FORMAT, the three counts and the names, which CFG-2 and CFG-3 encode each in its own way."""
    return [
        FlagsField("format", 0, 16, labels(Format)),
        FieldLenField("phnmr", None, count_of="phasor_names"),
        FieldLenField("annmr", None, count_of="analog_names"),
        FieldLenField("dgnmr", None, count_of="digital_labels", adjust=lambda pkt, n: n // LABELS_PER_WORD),
        ItemsField("phasor_names", [], name_field("name"), count_from=lambda pkt: pkt.phnmr),
        ItemsField("analog_names", [], name_field("name"), count_from=lambda pkt: pkt.annmr),
        ItemsField("digital_labels", [], name_field("label"), count_from=lambda pkt: LABELS_PER_WORD * pkt.dgnmr),
    ]


def _tail() -> list[Any]:
    return [BitField("fnom_reserved", 0, 15), BitEnumField("fnom", 0, 1, ["60 Hz", "50 Hz"]), ShortField("cfgcnt", 0)]


class CfgStation(_Block):
    """One PMU in a CFG-1 or CFG-2: as many ``phunit`` and ``anunit`` as names, a ``digunit`` to 16 labels."""

    name = "PMU configuration"
    fields_desc: ClassVar[list[Any]] = [
        Name2Field("stn"),
        ShortField("idcode", 1),
        *_counts(Name2Field),
        ItemsField("phunit", [], XIntField("unit", 0), count_from=lambda pkt: pkt.phnmr),
        ItemsField("anunit", [], XIntField("unit", 0), count_from=lambda pkt: pkt.annmr),
        ItemsField("digunit", [], XIntField("masks", 0), count_from=lambda pkt: pkt.dgnmr),
        *_tail(),
    ]


class PhasorScaling(_Block):
    """PHSCALE of CFG-3."""

    name = "PHSCALE"
    fields_desc: ClassVar[list[Any]] = [
        XShortField("flags", 0),
        BitField("reserved", 0, 4),
        BitEnumField("kind", 0, 1, ["voltage", "current"]),
        BitEnumField("component", PhasorComponent.POSITIVE_SEQUENCE, 3, labels(PhasorComponent)),
        XByteField("user", 0),
        FloatField("scale", 1.0),
        FloatField("angle_offset", 0.0),
    ]


class AnalogScaling(_Block):
    """ANSCALE of CFG-3."""

    name = "ANSCALE"
    fields_desc: ClassVar[list[Any]] = [FloatField("multiplier", 1.0), FloatField("offset", 0.0)]


class Cfg3Station(_Block):
    """One PMU in a CFG-3: as many ``phscale`` and ``anscale`` as names, a ``digunit`` to 16 labels."""

    name = "PMU configuration 3"
    fields_desc: ClassVar[list[Any]] = [
        Name3Field("stn"),
        ShortField("idcode", 1),
        StrFixedLenField("g_pmu_id", bytes(16), length=16),
        *_counts(Name3Field),
        PacketsField("phscale", lambda pkt, done: PhasorScaling if done < pkt.phnmr else None),
        PacketsField("anscale", lambda pkt, done: AnalogScaling if done < pkt.annmr else None),
        ItemsField("digunit", [], XIntField("masks", 0), count_from=lambda pkt: pkt.dgnmr),
        FloatField("latitude", math.inf),
        FloatField("longitude", math.inf),
        FloatField("elevation", math.inf),
        StrFixedLenField("svc_class", b"M", length=1),
        SignedIntField("window", 0),
        SignedIntField("grp_dly", 0),
        *_tail(),
    ]
