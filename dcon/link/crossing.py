"""From the front to the control process: what has come for a tick, as a few messages of a socket pair.

A message is records end to end, at most :data:`MESSAGE_BYTES`, big-endian::

    B kind | B stamp source | H PMU (its place in the settings) | q arrival_ns | I size | the record's bytes

A configuration precedes the data frames that it rules, in the same message or in an earlier one.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields
from enum import IntEnum
from typing import Any, NamedTuple

from dcon.core.values import brief
from dcon.link.counts import FrontCounts
from dcon.link.failure import Failure
from pmutools.c37118 import Frame
from pmutools.flow import StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind

MESSAGE_BYTES = 96 << 10
"""A configuration frame of 64 KiB fits, and the default send buffer of a socket takes two such messages."""
_HEAD = struct.Struct(">BBHqI")
_SOURCES = tuple(StampSource)
_SOURCE_NUMBERS = {source: number for number, source in enumerate(_SOURCES)}


class Kind(IntEnum):
    """What a record is."""

    DATA = 0
    """A data frame that is to be read by the PMU's newest configuration."""
    CONFIG = 1
    """A configuration frame that says something new."""
    EVENT = 2
    """A :class:`~pmutools.net.dialogue.LinkEvent`, as JSON."""
    COUNTS = 3
    """:class:`~dcon.link.counts.FrontCounts` so far, as JSON."""
    FAILED = 4
    """:class:`~dcon.link.failure.Failure`, as JSON: the front cannot go on."""


class PmuFrameIn(NamedTuple):
    """A frame of the PMU at a place of the settings; ``is_config`` says which kind."""

    pmu: int
    frame: Frame
    is_config: bool = False


Item = PmuFrameIn | LinkEvent | FrontCounts | Failure
_EVENT_FIELDS = ("kind", "where", "detail", "datagrams", "label")
"""What of a LinkEvent crosses."""


def encode(items: Iterable[Item]) -> Iterator[tuple[bytes, list[Item]]]:
    """Messages that carry ``items``, in order, each with what is in it."""
    records: list[bytes] = []
    inside: list[Item] = []
    size = 0
    for item in items:
        record = _record(item)
        if inside and size + len(record) > MESSAGE_BYTES:
            yield b"".join(records), inside
            records, inside, size = [], [], 0
        records.append(record)
        inside.append(item)
        size += len(record)
    if inside:
        yield b"".join(records), inside


def _record(item: Item) -> bytes:
    match item:
        case PmuFrameIn(pmu, frame, is_config):
            kind = Kind.CONFIG if is_config else Kind.DATA
            source = _SOURCE_NUMBERS[frame.stamp_source]
            return _HEAD.pack(kind, source, pmu, frame.arrival_ns or 0, len(frame.data)) + frame.data
        case LinkEvent():
            said = {name: getattr(item, name) for name in _EVENT_FIELDS} | {"detail": brief(item.detail)}
            return _text(Kind.EVENT, json.dumps(said))
        case FrontCounts():
            return _text(Kind.COUNTS, json.dumps(asdict(item)))
        case Failure():
            return _text(Kind.FAILED, json.dumps(item))


def _text(kind: Kind, text: str) -> bytes:
    data = text.encode()
    return _HEAD.pack(kind, 0, 0, 0, len(data)) + data


def decode(message: bytes) -> Iterator[Item]:
    """The items of a message. Raises ValueError for one that the front cannot have sent."""
    at = 0
    while at < len(message):
        try:
            kind, source, pmu, arrival_ns, size = _HEAD.unpack_from(message, at)
        except struct.error:
            raise ValueError(f"a record's head is cut off at byte {at}") from None
        at += _HEAD.size
        data = message[at : at + size]
        at += size
        if len(data) < size:
            raise ValueError(f"a record of {size} bytes is cut off")
        if kind <= Kind.CONFIG:
            if source >= len(_SOURCES):
                raise ValueError(f"no stamp source {source}")
            yield PmuFrameIn(pmu, Frame(data, arrival_ns, _SOURCES[source], 0), kind == Kind.CONFIG)
        elif kind <= Kind.FAILED:
            try:
                yield _said(kind, json.loads(data))
            except (KeyError, TypeError, AttributeError, OverflowError) as error:
                raise ValueError(f"a record that says nothing: {error}") from None
        else:
            raise ValueError(f"no record of kind {kind}")


def _said(kind: Kind, said: Any) -> LinkEvent | FrontCounts | Failure:
    if kind == Kind.FAILED:
        reason, is_mistake = said
        return Failure(str(reason), is_mistake is True)
    if kind == Kind.EVENT:
        return LinkEvent(**said | {"kind": LinkKind(said["kind"]), "owners": ()})
    return FrontCounts(**{item.name: int(said[item.name]) for item in fields(FrontCounts)})
