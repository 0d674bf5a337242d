"""The initialisation file of the controller: PMUs, control law, checks, output, log. One file, one reader."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from dcon.core.params import Pair, Params, PmuParams, Thresholds
from pmutools.errors import SettingsError
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.parsers import Parser, boolean, integer, number, parsed_by, suggestion, words
from pmutools.settings import Entry, Ini, Section, fill, parse_ini
from pmutools.sites import Site, endpoint, read_ini, sites_of

PARAMS = {item.name: item for item in fields(Params)}
FROM_SITES = frozenset(("pmus", "instances", "thresholds", "rate_hz"))
"""Fields of Params that follow from the PMUs' sections: no keys of ``[controller]``."""
_RATE = PARAMS["rate_hz"].metadata
RATE_HZ = 60
"""Of a PMU whose section names none."""


def _destination(text: str) -> Endpoint:
    where = endpoint(text)
    if where.scheme is not Scheme.UDP or not where.port:
        raise ValueError(f"{text}: commands leave as udp://HOST:PORT")
    return where


@dataclass(frozen=True, slots=True)
class Output:
    """``[output]``: where the command goes."""

    url: Endpoint | None = field(default=None, metadata=parsed_by(_destination))
    """``udp://HOST:PORT`` of the plant or gateway; nothing is sent without it."""


@dataclass(frozen=True, slots=True)
class Platform:
    """``[platform]``: the 60 Hz loop."""

    phase_ms: float = field(default=4.0, metadata=parsed_by(number(0, 1000)))
    """Ticks are this long after each 1/60 s of UTC."""
    fifo: bool = field(default=True, metadata=parsed_by(boolean))
    """Ask for the FIFO scheduling policy; without the privilege the loop runs on, with a warning."""


@dataclass(frozen=True, slots=True)
class Log:
    """``[log]``."""

    path: str = field(default="session.mcap", metadata=parsed_by(str))


@dataclass(frozen=True, slots=True)
class Reserved:
    """``[watchdog] [server] [pdci]``: known sections that have no key yet."""


@dataclass(frozen=True)
class Settings:
    """Everything a session is run with. ``sites`` in the order of ``params.pmus``."""

    params: Params
    sites: tuple[Site, ...]
    output: Output = Output()
    platform: Platform = Platform()
    log: Log = Log()
    text: str = ""
    """The file itself, for the log."""


def load(path: str | Path) -> Settings:
    """Read an initialisation file. Raises SourceError where it cannot be read, SettingsError for what is in it."""
    return from_ini(*read_ini(path))


def parse(text: str, source: str, changes: tuple[str, ...] = ()) -> Settings:
    """Settings of an INI text; ``changes`` are ``SECTION.KEY=VALUE`` laid over it."""
    ini = parse_ini(text, source, defaults_for="pmu")
    for change in changes:
        ini = ini.changed(change)
    return from_ini(ini, text)


def from_ini(ini: Ini, text: str = "") -> Settings:
    sites = sites_of(ini)
    for name in ("watchdog", "server", "pdci"):
        fill(Reserved, ini.section(name))
    return Settings(
        _params(ini, sites),
        sites,
        fill(Output, ini.section("output")),
        fill(Platform, ini.section("platform")),
        fill(Log, ini.section("log")),
        text,
    )


def rate_of(site: Site) -> int:
    """Frames per second."""
    return RATE_HZ if site.rate is None else site.rate


def _params(ini: Ini, sites: tuple[Site, ...]) -> Params:
    for section, site in zip(ini.family("pmu"), sites, strict=True):
        if entry := section.entries.get("rate"):
            entry.read(integer(_RATE["low"], _RATE["high"]))
        if rate_of(site) != rate_of(sites[0]):
            entry = entry or section.entries["url"]
            raise entry.where.error(
                f"{rate_of(site)} frames/s, but {sites[0].name} has {rate_of(sites[0])}; the controller needs one rate"
            )
    section = ini.section("controller")
    entries = dict(section.entries)
    priority = entries.pop("priority", None)
    given = _numbers(Params, Section(section.name, section.where, entries), skip=FROM_SITES)
    thresholds = Thresholds(**_numbers(Thresholds, ini.section("supervisor")))
    instances = _every_pair(ini.source, sites) if priority is None else _priority(sites, priority)
    gain, most = (given.get(key, PARAMS[key].default) for key in ("gain_mw_per_mhz", "gain_max_mw_per_mhz"))
    if gain > most:
        entry = entries.get("gain_mw_per_mhz") or entries["gain_max_mw_per_mhz"]
        raise entry.where.error(f"{gain:g} MW/mHz is above gain_max_mw_per_mhz = {most:g}; 9 to 15 are usable")
    try:
        return Params(
            pmus=tuple(PmuParams(site.name, site.nominal_kv) for site in sites),
            instances=instances,
            thresholds=thresholds,
            rate_hz=rate_of(sites[0]),
            **given,
        )
    except SettingsError as error:
        raise section.where.error(error) from None


def _numbers(cls: type, section: Section, skip: Collection[str] = ()) -> dict[str, Any]:
    """Values of a section for a dataclass whose fields carry bounds as metadata; booleans and whole numbers too."""
    known = {item.name: item for item in fields(cls) if item.name not in skip}
    values: dict[str, Any] = {}
    for key, entry in section.entries.items():
        if key not in known:
            raise entry.where.error(f"unknown key; {suggestion(key, known)}")
        item = known[key]
        parse: Parser[Any]
        if isinstance(item.default, bool):
            parse = boolean
        elif isinstance(item.default, int):
            parse = integer(item.metadata["low"], item.metadata["high"])
        else:
            parse = number(item.metadata["low"], item.metadata["high"])
        values[key] = entry.read(parse)
    return values


def _every_pair(source: str, sites: tuple[Site, ...]) -> tuple[Pair, ...]:
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


def effective(settings: Settings) -> list[tuple[str, str, str, str]]:
    """Every setting in force but those of single PMUs, for ``dcon check``: section, key, value with unit, source."""
    rows = []
    params = settings.params
    sections: tuple[tuple[str, Any], ...] = (
        ("controller", params),
        ("supervisor", params.thresholds),
        ("platform", settings.platform),
        ("output", settings.output),
        ("log", settings.log),
    )
    for section, values in sections:
        for item in fields(values):
            if item.name not in FROM_SITES:
                value = _shown(getattr(values, item.name), item.metadata.get("unit", ""))
                rows.append((section, item.name, value, item.metadata.get("source", "")))
        if section == "controller":
            rows.append((section, "priority", ",".join(params.instance_names), ""))
    return rows


def _shown(value: object, unit: str) -> str:
    text = f"{value:g}" if isinstance(value, float) else "" if value is None else str(value)
    return f"{text.lower() if isinstance(value, bool) else text} {unit}".strip()
