"""Names of stations and channels on the wire: 16 bytes in CFG-1 and CFG-2, up to 255 with their length in CFG-3."""

from __future__ import annotations

from collections.abc import Callable

from pmutools.c37118.constants import NAME_SIZE
from pmutools.errors import EncodeError

_PAD = " \0"


def decode_name(raw: bytes) -> str:
    """The text of a name field, its padding left out; latin-1 where it is no UTF-8."""
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return text.rstrip(_PAD)


def name2(name: str) -> bytes:
    """The 16 bytes of a name in CFG-1 and CFG-2; raises EncodeError for a longer one."""
    raw = name.encode("utf-8")
    if len(raw) > NAME_SIZE:
        raise EncodeError(f"name {name!r} takes {len(raw)} bytes, CFG-1 and CFG-2 have {NAME_SIZE}")
    return raw.ljust(NAME_SIZE)


def name3(name: str) -> bytes:
    """The bytes of a name in CFG-3, without their length; raises EncodeError for more than 255."""
    raw = name.encode("utf-8")
    if len(raw) > 0xFF:
        raise EncodeError(f"name {name[:20]!r}... takes {len(raw)} bytes, CFG-3 has 255")
    return raw


def encode_name2(name: str, wire_name: bytes | None) -> bytes:
    """The field in CFG-1 and CFG-2: ``wire_name`` as it came, where that is given."""
    return name2(name) if wire_name is None else wire_name


def encode_name3(name: str, wire_name: bytes | None) -> bytes:
    """The field in CFG-3, its length first: ``wire_name`` as it came, where that is given."""
    raw = name3(name) if wire_name is None else wire_name
    return bytes((len(raw),)) + raw


def named(raw: bytes, canonical: Callable[[str], bytes]) -> tuple[str, bytes | None]:
    """A name, and its bytes where encoding the name would not give them back."""
    name = decode_name(raw)
    try:
        return name, None if canonical(name) == raw else raw
    except EncodeError:  # latin-1 text that grows in UTF-8
        return name, raw
