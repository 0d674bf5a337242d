"""Reading PDML, the XML that ``tshark -T pdml`` writes: fields by name, their bytes, and what is printed of them."""

from __future__ import annotations

import math
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from typing import Any

from support.oracle.faults import OracleError

PRINTED_PLACES = 3
"""tshark prints phasors, frequencies and analogs with three decimals."""


def child(parent: ET.Element, name: str) -> ET.Element:
    found = parent.find(f".//field[@name='{name}']")
    if found is None:
        raise OracleError(f"no {name} in {parent.get('showname') or parent.get('show') or parent.tag!r}")
    return found


def number(field: ET.Element) -> int:
    """A number as tshark cuts it out of its word: shifted and masked."""
    return int(field.get("value", ""), 16)


def value_of(parent: ET.Element, name: str, attribute: str) -> int:
    return int(child(parent, name).get(attribute, ""), 0)


def octets(field: ET.Element) -> bytes:
    return bytes.fromhex(field.get("value", ""))


def single(field: ET.Element) -> float:
    return float(struct.unpack(">f", octets(field))[0])


def group(block: ET.Element, title: str) -> Sequence[ET.Element]:
    """Children of the subtree whose title begins with ``title``; none where it is absent."""
    return next((list(field) for field in block if field.get("show", "").startswith(title)), [])


def children(block: ET.Element, title: str, channels: Sequence[Any]) -> Iterator[tuple[Any, ET.Element]]:
    return zip(channels, group(block, title), strict=True)


def text(raw: bytes) -> str:
    """A name as sent, trimmed."""
    return raw.decode("utf-8", "replace").rstrip(" \0")


def same_name(shown: str, name: str) -> bool:
    """Whether tshark's showing of a name, ASCII and up to the first NUL, can be that of ``name``."""
    return shown.rstrip(" ") == name or not name.isascii() or "\0" in name


def agree(printed: str, value: float, field: ET.Element) -> None:
    """Raise unless ``printed`` is ``value`` to three decimals (and to single precision, which tshark uses at times)."""
    try:
        shown = float(printed)
    except ValueError:
        raise OracleError(f"no number in {field.get('showname')!r}") from None
    margin = 0.51 * 10**-PRINTED_PLACES + 2e-7 * abs(value)
    same = math.isnan(shown) if math.isnan(value) else shown == value or abs(shown - value) <= margin
    if not same:
        raise OracleError(f"{field.get('showname')!r} is {value!r} by its bytes {field.get('value')}")
