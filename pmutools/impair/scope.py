"""Which bytes of a frame a content fault may touch."""

from __future__ import annotations

import re
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import CHK_SIZE
from pmutools.c37118.layout import PREFIX_FIELDS, Field, layout_of
from pmutools.parsers import suggestion

VALUE_FIELDS = ("phasors", "freq", "dfreq", "analogs", "digitals")
STATION_FIELDS = ("stat", *VALUE_FIELDS, "values")
FIELDS = (*(item.name for item in PREFIX_FIELDS), *STATION_FIELDS, "chk")
"""Names that ``field=`` takes: the standard's, and ``values`` for all that was measured."""


class Span(NamedTuple):
    """Bytes ``start`` to ``end - 1`` of a frame; negative counts from the frame's end, ``end`` 0 is that end."""

    start: int
    end: int

    def of(self, size: int) -> range:
        """The positions in a frame of ``size`` bytes."""
        start = self.start + (size if self.start < 0 else 0)
        return range(start, min(size, self.end if self.end > 0 else size + self.end))


WHOLE = Span(0, 0)
_BYTES = re.compile(r"(\d+)(?:-(\d+))?", re.ASCII)


def byte_span(text: str) -> Span:
    """``10-20`` or ``10``: positions in the frame from 0, both included."""
    match = _BYTES.fullmatch(text.strip())
    if match is None or int(match[2] or match[1]) < int(match[1]):
        raise ValueError(f"{text!r} is not a range of byte positions like 10-20")
    return Span(int(match[1]), int(match[2] or match[1]) + 1)


class Scope(NamedTuple):
    """A stream's configuration, if known, and the part of it that a fault names."""

    config: StreamConfig | None = None
    field: str = ""
    station: str = ""
    positions: Span = WHOLE

    def station_fields(self, *names: str) -> list[Field]:
        """The fields of the named station, or of all, in data frames; raises ValueError where they cannot be found."""
        if self.config is None:
            raise ValueError(f"{'/'.join(names)} can only be found in a stream whose configuration is known")
        stations = self.config.stations
        chosen = [
            fields
            for station, fields in zip(stations, layout_of(self.config).stations, strict=True)
            if self.station in ("", station.name, str(station.idcode))
        ]
        if not chosen:
            known = [station.name for station in stations]
            raise ValueError(f"no station {self.station!r}; {suggestion(self.station, known)}")
        found = [item for fields in chosen for item in fields if item.name in names]
        if not found:
            raise ValueError(f"the stream has no {'/'.join(names)}")
        return found

    def spans(self) -> list[Span]:
        """The bytes that ``field=`` or ``bytes=`` name; all where neither is given."""
        if not self.field:
            return [self.positions]
        if self.field == "chk":
            return [Span(-CHK_SIZE, 0)]
        prefix = [item for item in PREFIX_FIELDS if item.name == self.field]
        names = VALUE_FIELDS if self.field == "values" else (self.field,)
        return [Span(item.offset, item.offset + item.size) for item in prefix or self.station_fields(*names)]
