"""The config stage: the stream's configuration changes while it runs, with or without notice.

``config = add(analogs=2) cfgcnt=keep announce=60 notice=no when=10..20``

After content faults, which go by the stream's own configuration; damage that they did is kept: a wrong CHK or
FRAMESIZE stays wrong, a frame cut short is left alone. Where ``when`` ends, the stream returns to its own
configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple, Protocol

from pmutools.c37118.config import AnalogChannel, Station, StreamConfig, encode_config
from pmutools.c37118.config_kinds import as_kind
from pmutools.c37118.constants import CHK_SIZE, MAX_FRAME_SIZE, Format, FrameType, Stat
from pmutools.c37118.layout import layout_of
from pmutools.c37118.prefix import decode_prefix
from pmutools.draws import Draws
from pmutools.errors import WireError
from pmutools.impair.grammar import named_parts
from pmutools.impair.moment import Moment, Test
from pmutools.impair.selectors import DATA, Selector, selector
from pmutools.impair.wire_faults import refitted
from pmutools.parsers import boolean, choice, integer, one_of, parsed_by, seconds_ns, suggestion

_MOST_ANALOGS = 1000
KEPT = 64
"""Combinations of parts whose configuration is kept, a stream: parts with chances meet in any of 2^parts."""


class Kind(Protocol):
    """A change of one station. ``words``: how many analogs more its data frames have."""

    @property
    def words(self) -> int: ...

    @property
    def mark(self) -> str: ...

    def changed(self, station: Station) -> Station: ...


@dataclass(frozen=True, slots=True)
class AddAnalogs:
    """So many more analogs, of value 0: data frames grow, and with them FRAMESIZE."""

    analogs: int = field(metadata=parsed_by(integer(1, _MOST_ANALOGS)))

    @property
    def words(self) -> int:
        return self.analogs

    @property
    def mark(self) -> str:
        return f"add{self.analogs}"

    def changed(self, station: Station) -> Station:
        first = len(station.analogs) + 1
        added = (AnalogChannel(f"ADDED{first + k}") for k in range(self.analogs))
        return replace(station, analogs=(*station.analogs, *added))


@dataclass(frozen=True, slots=True)
class Rename:
    """Another station name; data frames stay as they are."""

    station: str = field(metadata=parsed_by(str))

    @property
    def words(self) -> int:
        return 0

    @property
    def mark(self) -> str:
        return f"rename({self.station})"

    def changed(self, station: Station) -> Station:
        return replace(station, name=self.station, wire_name=None)


@dataclass(frozen=True, slots=True)
class Count:
    """Nothing but CFGCNT moves."""

    @property
    def words(self) -> int:
        return 0

    @property
    def mark(self) -> str:
        return "count"

    def changed(self, station: Station) -> Station:
        return station


KINDS: dict[str, type[Kind]] = {"add": AddAnalogs, "rename": Rename, "count": Count}


@dataclass(frozen=True, slots=True)
class ConfigChange:
    """``station`` changes (its name or IDCODE; by default the first), CFGCNT moves unless ``cfgcnt=keep``.

    ``announce``: STAT bit 10 is set for so many ns before each range of ``when``. ``notice``: the new configuration
    is sent unasked.
    """

    kind: Kind = field(metadata=parsed_by(one_of(KINDS, "change of configuration")))
    station: str = field(default="", metadata=parsed_by(str))
    cfgcnt: str = field(default="bump", metadata=parsed_by(choice("bump", "keep")))
    announce: int = field(default=0, metadata=parsed_by(seconds_ns))
    notice: bool = field(default=True, metadata=parsed_by(boolean))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))

    def __post_init__(self) -> None:
        if isinstance(self.kind, Count) and self.cfgcnt == "keep":
            raise ValueError("count() with cfgcnt=keep changes nothing; leave one out")
        if self.announce:
            try:
                self.when.before(self.announce)
            except ValueError as error:
                raise ValueError(f"announce: {error}") from None

    def place(self, config: StreamConfig) -> int:
        """The number of the station that changes; raises ValueError."""
        for number, station in enumerate(config.stations):
            if self.station in ("", station.name, str(station.idcode)):
                return number
        raise ValueError(
            f"no station {self.station!r}; {suggestion(self.station, [station.name for station in config.stations])}"
        )

    def changed(self, config: StreamConfig, number: int) -> StreamConfig:
        """``config`` after the change of its station ``number``."""
        station = self.kind.changed(config.stations[number])
        if self.cfgcnt == "bump":
            station = replace(station, cfgcnt=station.cfgcnt + 1 & 0xFFFF)
        return replace(config, stations=(*config.stations[:number], station, *config.stations[number + 1 :]))


class _At(NamedTuple):
    """A part at work: which station it changes, when, and when that is announced."""

    part: ConfigChange
    number: int
    selected: Test
    announced: Test | None


class _Changed(NamedTuple):
    """What parts in force make of a stream. ``inserts``: (position in its own frames, bytes), the last one first."""

    config: StreamConfig
    notice: bool
    inserts: tuple[tuple[int, bytes], ...]
    marks: tuple[str, ...]


class Reconfiguration:
    """The config stage of one stream. Raises ValueError for a change that ``config`` cannot have."""

    def __init__(
        self, parts: Sequence[ConfigChange], draws: Callable[[str], Draws], config: StreamConfig | None
    ) -> None:
        self._config = config
        self._parts = [self._at(part, name, draws) for name, part in named_parts("config", parts)]
        self._changed = lru_cache(KEPT)(self._change)
        if parts:
            for one in range(len(parts)):
                self._changed(tuple(number == one for number in range(len(parts))))
            self._changed((True,) * len(parts))
        self.none = (False,) * len(parts)

    def _at(self, part: ConfigChange, name: str, draws: Callable[[str], Draws]) -> _At:
        if self._config is None:
            raise ValueError("only a stream whose configuration is known can change it")
        selected = part.when.test(draws(f"{name}.when"))
        announced = part.when.before(part.announce).test(draws(f"{name}.when")) if part.announce else None
        return _At(part, part.place(self._config), selected, announced)

    def active(self, at: Moment) -> tuple[bool, ...]:
        """Which parts are in force for a data frame."""
        return tuple(part.selected(at) for part in self._parts)

    def config(self, active: tuple[bool, ...]) -> StreamConfig | None:
        """The configuration under which frames leave; None: the stream's own."""
        return self._changed(active).config if any(active) else None

    def notice(self, active: tuple[bool, ...]) -> bool:
        return self._changed(active).notice

    def data(self, frame: bytes, at: Moment, active: tuple[bool, ...]) -> tuple[bytes, tuple[str, ...]]:
        """A data frame under the parts in force, and what was done to it."""
        config = self._config
        if config is None or not self._parts or len(frame) != config.frame_size:
            return frame, ()
        marks: tuple[str, ...] = ()
        body = bytearray(frame[:-CHK_SIZE])
        for part, on in zip(self._parts, active, strict=True):
            if not on and part.announced is not None and part.announced(at):
                stat = layout_of(config).stations[part.number][0].offset
                body[stat : stat + 2] = (int.from_bytes(body[stat : stat + 2], "big") | Stat.CONFIG_CHANGE).to_bytes(2)
                marks = (*marks, "config:announced")
        if any(active):
            changed = self._changed(active)
            marks = (*marks, *changed.marks)
            for position, word in changed.inserts:
                body[position:position] = word
            if body[2:4] == config.frame_size.to_bytes(2, "big"):
                body[2:4] = changed.config.frame_size.to_bytes(2, "big")
        return (refitted(frame, bytes(body)) if marks else frame), marks

    def announcement(self, frame: bytes, active: tuple[bool, ...]) -> bytes:
        """A configuration frame of the stream as it is while ``active`` parts are in force; any other as it is."""
        config = self.config(active)
        try:
            prefix = decode_prefix(frame)
        except WireError:
            return frame
        if config is None or not prefix.type.rules_data:
            return frame
        stamp = {"soc": prefix.soc, "fracsec": prefix.fracsec, "time_quality": prefix.time_quality}
        return encode_config(as_kind(config, FrameType(prefix.type)), **stamp)

    def _change(self, active: tuple[bool, ...]) -> _Changed:
        own = config = self._config
        assert own is not None and config is not None
        inserts, marks, notice = list[tuple[int, bytes]](), list[str](), True
        for (part, number, _, _), on in zip(self._parts, active, strict=True):
            if on:
                config = part.changed(config, number)
                marks.append(f"config:{part.kind.mark}")
                notice = notice and part.notice
                if part.kind.words:
                    inserts.append((_end_of_analogs(own, number), bytes(part.kind.words * _word_size(own, number))))
        if config.frame_size > MAX_FRAME_SIZE:
            raise ValueError(f"data frames of {config.frame_size} bytes; FRAMESIZE ends at {MAX_FRAME_SIZE}")
        encode_config(config)
        return _Changed(config, notice, tuple(sorted(inserts, reverse=True)), tuple(marks))


def _word_size(config: StreamConfig, number: int) -> int:
    return 4 if config.stations[number].format & Format.ANALOG_FLOAT else 2


def _end_of_analogs(config: StreamConfig, number: int) -> int:
    fields = {item.name: item for item in layout_of(config).stations[number]}
    last = fields.get("analogs") or fields["dfreq"]
    return last.offset + last.size
