"""What the control process ships to the server: bundles of log entries, one message of a sequenced packet socket each.

Big-endian::

    4s magic "DCL2" | Q sequence | I session | q tick_ns | Q tick | H entries | B kind | ? goes_on
    then each entry: B, H, I lengths of message, name, data | q log_time_ns | q publish_time_ns | the three themselves

Ticks, configurations and the end are numbered from 0 without a gap, so that the server knows what it missed. What is
repeated whenever a server connects (the head, configurations that it may not know) is not numbered. Ticks are counted
as well, so that it knows how many of them it missed.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

MAGIC = b"DCL2"
_HEAD = struct.Struct(">4sQIqQHB?")
_ENTRY = struct.Struct(">BHIqq")
LARGEST = 128 << 10
"""Bytes of a bundle: what one packet of a Unix socket can surely carry. A tick that has more takes several."""
UNNUMBERED = (1 << 64) - 1
"""Sequence of what is repeated."""


class Kind(IntEnum):
    """What a bundle is."""

    TICK = 0
    HEAD = 1
    """A piece of what the session is: the whole of them is read by :func:`joined`."""
    CONFIG = 2
    """A configuration frame: one entry, of the PMU ``name``, that came at ``log_time_ns``."""
    END = 3
    MORE = 4
    """The beginning of a tick that is too large for one bundle: more of it, and its ``TICK``, follow."""


class Entry(NamedTuple):
    """One message of the log: a name of the message table, the PMU it is of ("" for none), and its protobuf bytes."""

    message: str
    name: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class Bundle(NamedTuple):
    """Entries of the log that go together."""

    kind: Kind
    sequence: int
    session: int
    """Drawn at random when the control process starts."""
    tick_ns: int
    entries: tuple[Entry, ...] = ()
    tick: int = 0
    """Number of its tick in the session, from 0; that of the next where it is of none."""
    goes_on: bool = False
    """Its tick began in the bundle before."""

    @property
    def is_numbered(self) -> bool:
        return self.sequence != UNNUMBERED


def encode(bundle: Bundle) -> bytes:
    """The message of a bundle."""
    kind, sequence, session, tick_ns, entries, tick, goes_on = bundle
    parts = [_HEAD.pack(MAGIC, sequence, session, tick_ns, tick, len(entries), kind, goes_on)]
    for message, name, data, log_time_ns, publish_time_ns in entries:
        words = message.encode(), name.encode()
        parts.append(_ENTRY.pack(len(words[0]), len(words[1]), len(data), log_time_ns, publish_time_ns))
        parts += (*words, data)
    return b"".join(parts)


def decode(data: bytes) -> Bundle | None:
    """The inverse; None for anything that :func:`encode` does not make."""
    try:
        magic, sequence, session, tick_ns, tick, count, kind, goes_on = _HEAD.unpack_from(data)
        if magic != MAGIC:
            return None
        at = _HEAD.size
        entries = []
        for _ in range(count):
            message, name, size, log_time_ns, publish_time_ns = _ENTRY.unpack_from(data, at)
            texts = at + _ENTRY.size
            body = texts + message + name
            at = body + size
            words = data[texts : texts + message].decode(), data[texts + message : body].decode()
            entries.append(Entry(*words, data[body:at], log_time_ns, publish_time_ns))
        bundle = Bundle(Kind(kind), sequence, session, tick_ns, tuple(entries), tick, goes_on)
    except (struct.error, ValueError):
        return None
    return bundle if at == len(data) else None


def unnumbered(data: bytes) -> bytes:
    """An encoded bundle as it is repeated."""
    return data[:4] + UNNUMBERED.to_bytes(8, "big") + data[12:]


def shares(entries: Iterable[Entry], largest: int = LARGEST) -> Iterator[tuple[Entry, ...]]:
    """Entries of one tick, as many at a time as one bundle takes; at least one time, even with none.

    One that is larger than a bundle becomes a byte that does not decode, which a reader of the log counts as a loss.
    """
    share: list[Entry] = []
    room = largest - _HEAD.size
    left = room
    for entry in entries:
        size = size_of(entry)
        if size > room:
            entry = entry._replace(data=b"\xff")
            size = size_of(entry)
        if size > left or len(share) == 0xFFFF:
            yield tuple(share)
            share, left = [], room
        share.append(entry)
        left -= size
    yield tuple(share)


def size_of(entry: Entry) -> int:
    """Bytes of an entry in a bundle."""
    return _ENTRY.size + len(entry.message.encode()) + len(entry.name.encode()) + len(entry.data)


def pieces(session: int, values: dict[str, Any], files: dict[str, bytes], largest: int = LARGEST) -> list[bytes]:
    """Encoded head bundles of a session: ``values`` as JSON and ``files`` whole, cut into pieces for :func:`joined`."""
    blobs = {"values": json.dumps(values).encode(), **files}
    step = largest // 2
    cut = [(name, blob[at : at + step]) for name, blob in blobs.items() for at in range(0, max(len(blob), 1), step)]
    count = len(cut)
    return [
        encode(Bundle(Kind.HEAD, UNNUMBERED, session, 0, (Entry("head", name, data, number, count),)))
        for number, (name, data) in enumerate(cut)
    ]


def joined(bundles: Sequence[Bundle]) -> tuple[dict[str, Any], dict[str, bytes]] | None:
    """The inverse of :func:`pieces`; None until all are there, each once and in order, or where they make no sense."""
    entries = [entry for bundle in bundles for entry in bundle.entries]
    count = len(entries)
    if not count or any((e.log_time_ns, e.publish_time_ns) != (at, count) for at, e in enumerate(entries)):
        return None
    blobs: dict[str, list[bytes]] = {}
    for entry in entries:
        blobs.setdefault(entry.name, []).append(entry.data)
    files = {name: b"".join(parts) for name, parts in blobs.items()}
    try:
        values = json.loads(files.pop("values", b""))
    except ValueError:
        return None
    return (values, files) if isinstance(values, dict) else None
