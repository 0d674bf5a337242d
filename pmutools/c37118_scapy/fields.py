"""Scapy fields that C37.118 needs and scapy lacks: names, counted lists, and the fields of a data frame's layout."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterable
from enum import IntEnum, IntFlag
from typing import Any

from scapy.base_classes import BasePacket
from scapy.fields import BitField, Field, FieldListField, PacketListField, StrField, StrFixedLenField, XByteField
from scapy.packet import Packet
from scapy.volatile import RandBin, RandFloat, RandNum, VolatileValue

from pmutools.c37118 import layout
from pmutools.c37118.constants import NAME_SIZE


def labels(members: Iterable[IntEnum | IntFlag]) -> dict[int, str]:
    """Value -> lower-case name, as scapy's enumerations and flags want them."""
    return {int(member): str(member.name).lower() for member in members}


class SyncField(XByteField):
    """The first byte; a fuzzed frame still begins as a frame."""

    def randval(self) -> Any:
        return None


class ReservedBitField(BitField):
    """The upper bit of the second byte: set, it makes a frame of 2024, whose body would never be looked at."""

    def __init__(self, name: str) -> None:
        super().__init__(name, 0, 1)

    def randval(self) -> Any:
        return None


class FloatField(Field[float, float]):
    """An IEEE-754 single."""

    def __init__(self, name: str, default: float) -> None:
        super().__init__(name, default, ">f")

    def randval(self) -> RandFloat:
        return RandFloat(-1_000_000, 1_000_000)


class ItemsField(FieldListField):
    """A list of as many items as ``count_from`` says; fuzzing leaves it alone, so that the counts hold."""

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, list[Any]]:
        assert self.count_from is not None
        items = []
        for _ in range(self.count_from(pkt)):
            s, item = self.field.getfield(pkt, s)
            items.append(item)
        return s, items

    def randval(self) -> Any:
        return None


class PacketsField(PacketListField):
    """A list of packets, each of the class that ``next_class(pkt, number of packets so far)`` says, until it is None.

    Scapy's own stops at 100, and turns what it cannot dissect into raw bytes up to the frame's end.
    """

    __slots__ = ["next_class"]

    def __init__(self, name: str, next_class: Callable[[Packet, int], type[Packet] | None]) -> None:
        super().__init__(name, [])
        self.next_class = next_class

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, list[BasePacket]]:
        items: list[BasePacket] = []
        while (packet_class := self.next_class(pkt, len(items))) is not None:
            item = packet_class(s, _internal=1, _parent=pkt)
            s = bytes(item.payload)
            item.remove_payload()
            items.append(item)
        return s, items


class Name2Field(StrFixedLenField):
    """A name of CFG-1 or CFG-2: 16 bytes, padded with spaces."""

    def __init__(self, name: str) -> None:
        super().__init__(name, b"", length=NAME_SIZE)

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, bytes]:
        return s[NAME_SIZE:], s[:NAME_SIZE].rstrip(b" ")

    def addfield(self, pkt: Packet, s: bytes, val: Any) -> bytes:
        return s + self.i2m(pkt, val)[:NAME_SIZE].ljust(NAME_SIZE)


class Name3Field(StrField):
    """A name of CFG-3: one byte of length, then UTF-8."""

    def __init__(self, name: str) -> None:
        super().__init__(name, b"")

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, bytes]:
        return s[1 + s[0] :], s[1 : 1 + s[0]]

    def addfield(self, pkt: Packet, s: bytes, val: Any) -> bytes:
        raw = self.i2m(pkt, val)
        return s + bytes((len(raw),)) + raw

    def randval(self) -> RandBin:
        return RandBin(RandNum(0, 255))


class WireField(Field[Any, Any]):
    """A field of a data frame's layout in wire units: a number, a list, or a list of pairs (phasors).

    ``show`` turns the packet and the field's value into what ``show()`` prints.
    """

    __slots__ = ["islist", "run", "show", "wire"]

    def __init__(self, run: layout.Field, show: Callable[[Packet, Any], str]) -> None:
        self.run = run
        self.show = show
        self.wire = struct.Struct(f">{run.code * run.items}")
        self.islist = int(run.name in ("phasors", "analogs", "digitals"))
        zero = self.values_of(bytes(self.wire.size))
        super().__init__(run.name, tuple(zero) if self.islist else zero)  # fuzz() leaves default lists alone

    def values_of(self, octets: bytes) -> Any:
        values = self.wire.unpack(octets)
        if self.run.width == 2:
            return list(zip(values[::2], values[1::2], strict=True))
        return list(values) if self.islist else values[0]

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, Any]:
        return s[self.wire.size :], self.values_of(s[: self.wire.size])

    def addfield(self, pkt: Packet, s: bytes, val: Any) -> bytes:
        values = val._fix() if isinstance(val, VolatileValue) else val
        if self.run.width == 2:
            values = [part for pair in values for part in pair]
        return s + self.wire.pack(*(values if self.islist else (values,)))

    def i2repr(self, pkt: Packet | None, x: Any) -> str:
        return repr(x) if pkt is None or isinstance(x, VolatileValue) else self.show(pkt, x)

    def randval(self) -> VolatileValue[Any]:
        return _RandomWire(self)


class _RandomWire(VolatileValue[Any]):
    """Random bytes, as the values of a :class:`WireField`."""

    def __init__(self, field: WireField) -> None:
        self.field = field

    def _fix(self) -> Any:
        return self.field.values_of(random.randbytes(self.field.wire.size))
