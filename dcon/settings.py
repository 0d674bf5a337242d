"""The initialisation file of the controller: PMUs, control law, checks, output, log. One file, one reader."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from dcon.core.clash import Clash
from dcon.core.params import RATES, Line, Pair, Params, PmuParams, Required
from dcon.core.probe import Probing
from dcon.core.thresholds import Thresholds
from dcon.limiter import LIMIT_MW
from dcon.safeguards import check_safeguards, is_same_file
from dcon.sections import LineInput, Log, Output, Platform, Server, Watchdog
from pmutools.errors import SettingsError
from pmutools.parsers import Parser, boolean, choice, integer, number, suggestion, words
from pmutools.settings import Entry, Ini, Section, fill, parse_ini
from pmutools.sites import Site, read_ini, sites_of

PARAMS = {item.name: item for item in fields(Params)}
ELSEWHERE = frozenset(("pmus", "instances", "rate_hz", "thresholds", "line", "required", "probing"))
"""Fields of Params that other sections fill: no keys of ``[controller]``."""
GAIN_MAX = Params.gain_max_mw_per_mhz
"""MW/mHz that a line may be controlled with."""
RATE_HZ = 60
"""Of a PMU whose section names none."""
PROBE_BYTES = 16 << 20
"""Largest file of a probing signal."""
PROBE_FILE = "probing.file"
"""The setting that names it."""
_SEPARATORS = " ,()"
"""In lists of instances."""
T = TypeVar("T")


@dataclass(frozen=True)
class Settings:
    """Everything a session is run with. ``sites`` in the order of ``params.pmus``."""

    params: Params
    sites: tuple[Site, ...]
    output: Output = field(default_factory=Output)
    platform: Platform = field(default_factory=Platform)
    watchdog: Watchdog = field(default_factory=Watchdog)
    server: Server = field(default_factory=Server)
    log: Log = field(default_factory=Log)
    text: str = ""
    """The file itself, for the log."""
    probe_file: bytes = b""
    """What ``file`` of ``[probing]`` names, for the log."""
    line_input: LineInput = field(default_factory=LineInput)
    given: frozenset[tuple[str, str]] = frozenset()
    """(section, key) of what the file gives, be it what the default is."""


def load(path: str | Path) -> Settings:
    """Read an initialisation file that a line is to be controlled by: the gain is held to what is feasible.

    Raises SourceError where it cannot be read, SettingsError for what is in it.
    """
    ini, text = read_ini(path)
    settings = from_ini(ini, text)
    _spared(settings, ini, path)
    try:
        check_safeguards(settings)
    except Clash as clash:
        raise _placed(clash, ini, "watchdog") from None
    most = settings.params.gain_max_mw_per_mhz
    if most > GAIN_MAX:
        where = ini.section("controller").entries["gain_max_mw_per_mhz"].where
        raise where.error(f"{most:g} MW/mHz is above {GAIN_MAX:g}; only simulations and replays go beyond it")
    return settings


def _spared(settings: Settings, ini: Ini, path: str | Path) -> None:
    """Raise SettingsError where what is written is a file that is read, under whatever name."""
    read = {"the initialisation file": path, "the probing signal": settings.params.probing.file}
    read["the file of keys"] = settings.server.keys or ""
    files = [("watchdog", key, getattr(settings.watchdog, key)) for key in ("log", "relay_a", "relay_b")]
    for section, key, written in [("log", "path", settings.log.path), *files]:
        for what, name in read.items():
            if written and name and is_same_file(written, str(name)):
                entry = ini.section(section).entries.get(key)
                where = ini.section(section).where._replace(key=key) if entry is None else entry.where
                raise where.error(f"{written} is {what}, and would be overwritten; write to another file")


def parse(
    text: str,
    source: str,
    changes: tuple[str, ...] = (),
    *,
    probe_file: bytes | None = None,
    defaults: tuple[str, ...] = (),
) -> Settings:
    """Settings of an INI text, of a simulation or a replay; ``changes`` are ``SECTION.KEY=VALUE`` laid over it.

    ``probe_file`` is what the file of ``[probing]`` held; it is read where that is None. ``defaults``, written as
    ``changes`` are, count where the text does not say otherwise.
    """
    ini = parse_ini(text, source, defaults_for="pmu")
    for default in defaults:
        section, _, key = default.partition("=")[0].rpartition(".")
        if key not in ini.section(section).entries:
            ini = ini.changed(default, "a former default")
    for change in changes:
        ini = ini.changed(change)
        if change.partition("=")[0].strip().lower() == PROBE_FILE:
            probe_file = None  # what was recorded is not what is asked for
    return from_ini(ini, text, probe_file)


def from_ini(ini: Ini, text: str = "", probe_file: bytes | None = None) -> Settings:
    sites = sites_of(ini)
    platform = fill(Platform, ini.section("platform"))
    watchdog, server = fill(Watchdog, ini.section("watchdog")), fill(Server, ini.section("server"))
    line_input = fill(LineInput, _split(ini.section("pdci"), LineInput)[0])
    required = Required(platform.gps_required, watchdog.required, server.required, line_input.required)
    probing, probe_file = probing_of(ini.section("probing"), probe_file)
    try:
        params = _params(ini, sites, required, probing)
        if platform.phase_ms >= (period_ms := 1e3 / params.tick_hz):
            problem = f"{platform.phase_ms:g}: must be below the {period_ms:.1f} ms from tick to tick"
            raise Clash(problem, "platform.phase_ms", "controller.tick_hz")
    except Clash as clash:
        raise _placed(clash, ini, "controller") from None
    return Settings(
        params,
        sites,
        fill(Output, ini.section("output")),
        platform,
        watchdog,
        server,
        fill(Log, ini.section("log")),
        text,
        probe_file,
        line_input=line_input,
        given=frozenset((section.name, key) for section in ini.sections for key in section.entries),
    )


def probing_of(section: Section, data: bytes | None = None) -> tuple[Probing, bytes]:
    """``[probing]`` and what its file holds: ``data``, read unless given."""
    values = _numbers(Probing, section, skip=("samples",))
    if values.get("kind") == "file" and (entry := section.entries.get("file")) is not None:
        if data is None:
            data = _read(entry)
        values["samples"] = _column(entry, data, values.get("column", "probe_mw"))
    return _made(Probing, section, values), data or b""


def _read(entry: Entry) -> bytes:
    try:
        with Path(entry.text).open("rb") as file:
            data = file.read(PROBE_BYTES + 1)
    except OSError as error:
        raise entry.where.error(f"{entry.text}: {error.strerror}") from None
    if len(data) > PROBE_BYTES:
        raise entry.where.error(f"{entry.text}: more than {PROBE_BYTES:,} bytes; a signal is an hour at most")
    return data


def _column(entry: Entry, data: bytes, column: str) -> tuple[float, ...]:
    """The signal in MW, one value a tick."""
    rows = csv.DictReader(io.StringIO(data.decode(errors="replace")))
    if column not in (rows.fieldnames or ()):
        there = ", ".join(rows.fieldnames or ()) or "none"
        raise entry.where.error(f"{entry.text}: no column {column!r}; there are {there}: set column")
    samples = []
    for row in rows:
        try:
            samples.append(number(-LIMIT_MW, LIMIT_MW)(row[column] or ""))
        except ValueError as error:
            raise entry.where.error(f"{entry.text}:{rows.line_num}: {error}") from None
    return tuple(samples)


def frames_per_s(text: str) -> int:
    """A parser: the rates of the controller's differentiator."""
    if (rate := integer()(text)) not in RATES:
        raise ValueError(f"{text} is not one of {', '.join(map(str, RATES))} frames/s")
    return rate


def rate_of(site: Site) -> int:
    """Frames per second."""
    return RATE_HZ if site.rate is None else site.rate


def _params(ini: Ini, sites: tuple[Site, ...], required: Required, probing: Probing) -> Params:
    for section, site in zip(ini.family("pmu"), sites, strict=True):
        if entry := section.entries.get("rate"):
            entry.read(frames_per_s)
        if rate_of(site) != rate_of(sites[0]):
            entry = entry or section.entries["url"]
            raise entry.where.error(
                f"{rate_of(site)} frames/s, but {sites[0].name} has {rate_of(sites[0])}; the controller needs one rate"
            )
        if site.side != "none" and set(site.name) & set(_SEPARATORS):
            raise section.where.error("the name of a PMU with a side has no space, comma or bracket; rename it")
    section = ini.section("controller")
    entries = dict(section.entries)
    priority = entries.pop("priority", None)
    given = _numbers(Params, Section(section.name, section.where, entries), skip=ELSEWHERE)
    thresholds = _filled(Thresholds, ini.section("supervisor"))
    line = _filled(Line, _split(ini.section("pdci"), LineInput)[1], known=[item.name for item in fields(LineInput)])
    instances = every_pair(ini.source, sites) if priority is None else _priority(sites, priority)
    gain, most = (given.get(key, PARAMS[key].default) for key in ("gain_mw_per_mhz", "gain_max_mw_per_mhz"))
    if gain > most:
        entry = entries.get("gain_mw_per_mhz") or entries["gain_max_mw_per_mhz"]
        raise entry.where.error(
            f"{gain:g} MW/mHz is above gain_max_mw_per_mhz = {most:g}; 9 to 15 are usable, "
            "a simulation or replay may set controller.gain_max_mw_per_mhz too"
        )
    try:
        return Params(
            pmus=tuple(PmuParams(site.name, site.nominal_kv) for site in sites),
            instances=instances,
            thresholds=thresholds,
            line=line,
            required=required,
            probing=probing,
            rate_hz=rate_of(sites[0]),
            **given,
        )
    except Clash:
        raise
    except SettingsError as error:
        raise section.where.error(error) from None


def _split(section: Section, cls: type) -> tuple[Section, Section]:
    """A section that two classes share: the entries of ``cls``, and the others."""
    names = {item.name for item in fields(cls)}
    mine = {key: entry for key, entry in section.entries.items() if key in names}
    others = {key: entry for key, entry in section.entries.items() if key not in names}
    return Section(section.name, section.where, mine), Section(section.name, section.where, others)


def _filled(cls: type[T], section: Section, known: Collection[str] = ()) -> T:
    """A dataclass of a section."""
    return _made(cls, section, _numbers(cls, section, known=known))


def _made(cls: type[T], section: Section, values: dict[str, Any]) -> T:
    """What its values are not together is said of one of them, else of the section."""
    try:
        return cls(**values)
    except Clash as clash:
        raise _placed(clash, Ini(section.where.source, (section,)), section.name) from None
    except SettingsError as error:
        raise section.where.error(error) from None


def _placed(clash: Clash, ini: Ini, section: str) -> SettingsError:
    """A clash with the line of the first key that it is about and the file gives; ``section`` is that of bare keys."""
    for place, name in enumerate(clash.keys):
        kind, _, key = name.rpartition(".")
        if (entry := ini.section(kind or section).entries.get(key)) is not None:
            return entry.where.error(clash if place else clash.problem)
    return ini.section(section).where.error(clash)


def _numbers(cls: type, section: Section, skip: Collection[str] = (), known: Collection[str] = ()) -> dict[str, Any]:
    """Values of a section for a dataclass whose fields carry bounds or choices as metadata, by the defaults' types.

    ``known`` are keys of the section that are not the dataclass's, for the words about one that is unknown.
    """
    mine = {item.name: item for item in fields(cls) if item.name not in skip}
    values: dict[str, Any] = {}
    for key, entry in section.entries.items():
        if key not in mine:
            raise entry.where.error(f"unknown key; {suggestion(key, (*known, *mine))}")
        item = mine[key]
        parse: Parser[Any]
        if isinstance(item.default, bool):
            parse = boolean
        elif isinstance(item.default, str):
            parse = choice(*item.metadata["choices"]) if "choices" in item.metadata else str
        elif isinstance(item.default, int):
            parse = integer(item.metadata["low"], item.metadata["high"])
        else:
            parse = number(item.metadata["low"], item.metadata["high"])
        values[key] = entry.read(parse)
    return values


def every_pair(source: str, sites: tuple[Site, ...]) -> tuple[Pair, ...]:
    """Every north PMU with every south one, in the order of the file."""
    sides = {side: [index for index, site in enumerate(sites) if site.side == side] for side in ("north", "south")}
    for side, members in sides.items():
        if not members:
            raise SettingsError(f"{source}: no PMU has side = {side}; add that line to at least one [pmu NAME]")
    return tuple(Pair(north, south) for north in sides["north"] for south in sides["south"])


def _priority(sites: tuple[Site, ...], priority: Entry) -> tuple[Pair, ...]:
    """Control instances as ``priority`` lists them, best first."""
    index = {site.name: number for number, site in enumerate(sites)}
    pairs: list[Pair] = []
    for name in priority.read(words):
        split = [(n, name[len(n) + 1 :]) for n in index if name.startswith(f"{n}-") and name[len(n) + 1 :] in index]
        if len(split) != 1:
            raise priority.where.error(f"{name!r} is no pair NORTH-SOUTH of PMUs; there are {', '.join(index)}")
        ((north, south),) = split
        if sites[index[north]].side != "north" or sites[index[south]].side != "south":
            raise priority.where.error(f"{name!r}: {north} must have side = north and {south} side = south")
        pair = Pair(index[north], index[south])
        if pair in pairs:
            raise priority.where.error(f"{name!r} is listed twice; keep the first")
        pairs.append(pair)
    if not pairs:
        raise priority.where.error("lists no pair; write NORTH-SOUTH,NORTH-SOUTH,... or leave the key out")
    return tuple(pairs)
