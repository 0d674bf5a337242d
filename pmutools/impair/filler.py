"""What a concentrator sends for a station it has no data of: STAT 0x8000, fillers by FORMAT, digital words 0."""

from __future__ import annotations

from collections.abc import Collection

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import CHK_SIZE, STAT_ABSENT
from pmutools.c37118.layout import Field, layout_of
from pmutools.impair.wire_faults import refitted


def filler(item: Field) -> bytes:
    """The bytes that stand for "absent": NaN in floats, 0x8000 in integers; 0 in digital words, which have none."""
    if item.name == "stat":
        return STAT_ABSENT.to_bytes(2, "big")
    if item.name == "digitals":
        return bytes(item.size)
    one = b"\x7f\xc0\x00\x00" if "f" in item.code else b"\x80\x00"
    return one * (item.size // len(one))


def filled(frame: bytes, config: StreamConfig, stations: Collection[str]) -> bytes:
    """A data frame of ``config`` with fillers for the named stations; a frame of another size is left alone."""
    if len(frame) != config.frame_size:
        return frame
    body = bytearray(frame[:-CHK_SIZE])
    for station, fields in zip(config.stations, layout_of(config).stations, strict=True):
        if station.name in stations:
            for item in fields:
                body[item.offset : item.offset + item.size] = filler(item)
    return refitted(frame, bytes(body))
