"""The initialisation file of the controller: PMUs, control law, checks, output, log. One file, one reader."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from dcon.core.params import Pair, Params, PmuParams, Thresholds
from pmutools.errors import SettingsError, SourceError
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.parsers import Parser, boolean, choice, integer, number, parsed_by, suggestion, words
from pmutools.settings import Entry, Ini, Section, fill, parse_ini

SIDES = ("north", "south", "none")


def _endpoint(text: str) -> Endpoint:
    return parse_endpoint(text)


@dataclass(frozen=True, slots=True)
class Site:
    """``[pmu NAME]``: one PMU of the controller."""

    name: str
    url: Endpoint = field(metadata=parsed_by(_endpoint))
    """Where its stream comes from."""
    idcode: int | None = field(default=None, metadata=parsed_by(integer(1, 65534)))
    """IDCODE of the stream; the only one there is unless given."""
    station: str | None = field(default=None, metadata=parsed_by(str))
    """Station of a stream with several."""
    side: str = field(default="none", metadata=parsed_by(choice(*SIDES)))
    """``north``, ``south``, or ``none`` for a PMU that is recorded only."""
    voltage: tuple[str, ...] = field(default=("VA", "VB", "VC"), metadata=parsed_by(words))
    """Positive-sequence channel, or those of the three phases."""
    nominal_kv: float | None = field(default=None, metadata=parsed_by(number(0.1, 2000)))
    """Line-to-line; without it the voltage's magnitude is not judged."""
    rate: int = field(default=60, metadata=parsed_by(integer(1, 240)))
    """Frames per second."""


@dataclass(frozen=True, slots=True)
class Output:
    """``[output]``: where the command goes."""

    url: Endpoint | None = field(default=None, metadata=parsed_by(_endpoint))
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
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is no UTF-8 text"
        raise SourceError(f"{path}: {reason}") from None
    return parse(text, str(path))


def parse(text: str, source: str, changes: tuple[str, ...] = ()) -> Settings:
    """Settings of an INI text; ``changes`` are ``SECTION.KEY=VALUE`` laid over it."""
    ini = parse_ini(text, source, defaults_for="pmu")
    for change in changes:
        ini = ini.changed(change)
    return from_ini(ini, text)


def from_ini(ini: Ini, text: str = "") -> Settings:
    ini.only("pmu *", "controller", "supervisor", "platform", "watchdog", "server", "output", "pdci", "log")
    sites = tuple(fill(Site, section, name=section.argument) for section in ini.family("pmu"))
    if not sites:
        raise SettingsError(f"{ini.source}: no [pmu NAME] section; add one for each PMU")
    return Settings(
        _params(ini, sites),
        sites,
        fill(Output, ini.section("output")),
        fill(Platform, ini.section("platform")),
        fill(Log, ini.section("log")),
        text,
    )


def _params(ini: Ini, sites: tuple[Site, ...]) -> Params:
    section = ini.section("controller")
    entries = dict(section.entries)
    priority = entries.pop("priority", None)
    numbers = _numbers(Params, Section(section.name, section.where, entries), skip={"pmus", "instances", "thresholds"})
    thresholds = Thresholds(**_numbers(Thresholds, ini.section("supervisor")))
    rates = {site.rate for site in sites}
    if len(rates) > 1 and "rate_hz" not in numbers:
        listed = ", ".join(f"{site.name} {site.rate}" for site in sites)
        raise SettingsError(f"{ini.source}: PMUs at different rates ({listed}); the controller needs one rate")
    numbers.setdefault("rate_hz", rates.pop())
    try:
        return Params(
            pmus=tuple(PmuParams(site.name, site.nominal_kv) for site in sites),
            instances=_instances(sites, priority),
            thresholds=thresholds,
            **numbers,
        )
    except SettingsError as error:
        raise SettingsError(f"{section.where}: {error}") from None


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


def _instances(sites: tuple[Site, ...], priority: Entry | None) -> tuple[Pair, ...]:
    """Control instances, best first: as ``priority`` says, else every north PMU with every south one."""
    index = {site.name: number for number, site in enumerate(sites)}
    if priority is None:
        north = [index[site.name] for site in sites if site.side == "north"]
        south = [index[site.name] for site in sites if site.side == "south"]
        return tuple(Pair(n, s) for n in north for s in south)
    pairs = []
    for name in words(priority.text):
        split = [(n, name[len(n) + 1 :]) for n in index if name.startswith(f"{n}-") and name[len(n) + 1 :] in index]
        if not split:
            raise priority.where.error(f"{name!r} is no pair NORTH-SOUTH of PMUs; there are {', '.join(index)}")
        north_name, south_name = split[0]
        if sites[index[north_name]].side != "north" or sites[index[south_name]].side != "south":
            raise priority.where.error(f"{name!r}: {north_name} must have side = north and {south_name} side = south")
        pairs.append(Pair(index[north_name], index[south_name]))
    return tuple(pairs)


def effective(settings: Settings) -> list[tuple[str, str, str, str]]:
    """Every number in force, for ``dcon check``: section, key, value with unit, source."""
    rows = []
    for section, values in (("controller", settings.params), ("supervisor", settings.params.thresholds)):
        for item in fields(values):
            if item.name in ("pmus", "instances", "thresholds"):
                continue
            value, unit = getattr(values, item.name), item.metadata.get("unit", "")
            shown = f"{value:g}" if isinstance(value, float) else str(value).lower()
            rows.append((section, item.name, f"{shown} {unit}".strip(), item.metadata.get("source", "")))
    rows.append(("controller", "priority", ",".join(settings.params.instance_names), ""))
    return rows
