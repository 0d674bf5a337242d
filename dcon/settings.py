"""The initialisation file of the controller: PMUs, control law, checks, output, log. One file, one reader."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from dcon.core.clash import Clash
from dcon.core.params import RATES, Line, Pair, Params, PmuParams, Required
from dcon.core.probe import Probing
from dcon.core.thresholds import Thresholds
from dcon.limiter import LIMIT_MW
from dcon.places import Destination, LineSource, destination, line_source
from dcon.watchdog.codec import LOOPS
from dcon.watchdog.limits import BOUNDS, Limits, Rules
from pmutools.errors import SettingsError
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.parsers import Parser, boolean, choice, integer, number, parsed_by, suggestion, words
from pmutools.settings import Entry, Ini, Section, fill, parse_ini
from pmutools.sites import Site, endpoint, read_ini, sites_of

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
TIME_SOURCES = ("auto", "kernel", "chrony", "gpsd", "ptp", "none")
_SEPARATORS = " ,()"
"""In lists of instances."""
T = TypeVar("T")


def _listening(text: str) -> Endpoint:
    where = endpoint(text if "://" in text else f"tcp://{text}")
    if where.scheme is not Scheme.TCP or not where.port:
        raise ValueError(f"{text}: operators connect to HOST:PORT, over TCP")
    return where


@dataclass(frozen=True, slots=True)
class Output:
    """``[output]``: where the command goes."""

    url: Destination | None = field(default=None, metadata=parsed_by(destination))
    """``udp://HOST:PORT`` of a plant or gateway, ``iio://FOLDER?...`` or ``modbus://HOST:PORT?...`` (see the page on
    outputs); nothing is driven without it."""
    hold_ms: float = field(default=100.0, metadata=parsed_by(number(20, 1000)))
    """``iio://`` and ``modbus://``: the output goes to 0 V by itself when no command has come for so long."""

    @property
    def needs_process(self) -> bool:
        """Whether ``dcon output`` drives it; the watchdog sends datagrams itself."""
        return self.url is not None and not isinstance(self.url, Endpoint)


@dataclass(frozen=True, slots=True)
class LineInput:
    """``[pdci]``: where the line's status comes from. What it is judged by is :class:`~dcon.core.params.Line`."""

    url: LineSource | None = field(default=None, metadata=parsed_by(line_source))
    """``udp://ADDRESS:PORT?source=...``, where its datagrams are awaited, or ``modbus://HOST:PORT?...``, a device to be
    asked (see the page on outputs); without it the status is not known."""


@dataclass(frozen=True, slots=True)
class Platform:
    """``[platform]``: the 60 Hz loop."""

    run_dir: Path | None = field(default=None, metadata=parsed_by(Path))
    """Folder of the sockets by which control process, watchdog, server and output meet; mode 0700, so that nobody else
    may enter. ``--run-dir`` goes over it; without one ``dcon platform`` is alone and ``dcon run`` takes a temporary
    one."""

    phase_ms: float = field(default=4.0, metadata=parsed_by(number(0, 1000)))
    """Ticks are this long after each 1/60 s of UTC."""
    fifo: bool = field(default=True, metadata=parsed_by(boolean))
    """Ask for the FIFO scheduling policy; without the privilege the loop runs on, with a warning."""
    judge_overruns: bool = field(default=False, metadata=parsed_by(boolean))
    """Tell the checks of ticks that were not done in time: one warns, three in a second trip. An ordinary machine
    pauses now and then, and the loop makes up for it; a real-time system must not pause."""
    gps_required: bool = field(default=False, metadata=parsed_by(boolean))
    """The GPS lock of the controller's clock must be known: without it no arming, and a loss disarms."""
    time_source: str = field(default="auto", metadata=parsed_by(choice(*TIME_SOURCES)))
    """Whose word on this machine's clock counts as its GPS lock: ``kernel`` (adjtimex), ``chrony``, ``gpsd``, ``ptp``,
    the best promise among them (``auto``: the lock is not known until somebody promises something), or nobody's
    (``none``: it is not known)."""
    time_bound_ms: float = field(default=5.0, metadata=parsed_by(number(1e-3, 1000)))
    """The clock has its lock while that word is that it is no further than this from UTC."""


def _loops(text: str) -> tuple[str, ...]:
    return tuple(map(choice(*LOOPS), words(text)))


def _limit(name: str) -> float:
    """A field for a limit of the watchdog, which has its own defaults and bounds."""
    default: float = field(default=getattr(Limits(), name), metadata=parsed_by(number(*BOUNDS[name])))
    return default


@dataclass(frozen=True, slots=True)
class Watchdog:
    """``[watchdog]``. Files are such as GPIO value files, on a local disk."""

    required: bool = field(default=False, metadata=parsed_by(boolean))
    """Watchdog and emergency stop must be known to be healthy and released: without them no arming, a loss trips."""
    beats: tuple[str, ...] = field(default=Rules().beats, metadata=parsed_by(_loops))
    """Loops whose beats must come; others are judged from their first beat on."""
    readback: str = field(default="auto", metadata=parsed_by(choice("auto", "required")))
    """``required``: without a readback of the output the relays open; ``auto``: from the first readback on."""
    status: tuple[str, ...] = field(default=("control.in", "status.in"), metadata=parsed_by(words))
    """Sockets of the run folder that are told each 20 ms; one that nobody holds does no harm."""
    estop_a: str = field(default="", metadata=parsed_by(str))
    """File of line a of the emergency stop: ``1`` is released, anything else is pressed; "" is no such line."""
    estop_b: str = field(default="", metadata=parsed_by(str))
    """The same of line b."""
    relay_a: str = field(default="", metadata=parsed_by(str))
    """File that drives relay a: ``1`` closes it. It must be there; one that cannot be written trips."""
    relay_b: str = field(default="", metadata=parsed_by(str))
    """The same of relay b, in series with a."""
    contact_a: str = field(default="", metadata=parsed_by(str))
    """File that shows the contact of relay a: ``1`` closed, ``0`` open, anything else is wrong either way."""
    contact_b: str = field(default="", metadata=parsed_by(str))
    """The same of relay b."""
    drive: str = field(default="level", metadata=parsed_by(choice("level", "pulse")))
    """``pulse``: what drives a closed relay turns each 10 ms, so that a monostable lets it go when the process dies."""
    fifo: bool = field(default=True, metadata=parsed_by(boolean))
    """Ask for the FIFO scheduling policy, above the controller's; without the privilege it runs on, with a warning."""
    log: str = field(default="", metadata=parsed_by(str))
    """File for its lines (JSON); without one they go to stderr."""
    log_mb: float = field(default=10.0, metadata=parsed_by(number(0.01, 1e4)))
    """A log file of so many megabytes becomes ``FILE.1``, over the one before."""
    status_timeout_ms: float = field(default=100.0, metadata=parsed_by(number(40, 5000)))
    """The controller takes a watchdog that has said nothing for so long as dead, and trips."""
    fast_timeout_ms: float = _limit("fast_timeout_ms")
    """Longest time without a beat of control, udp and parse, or with beats whose counter stands."""
    slow_timeout_ms: float = _limit("slow_timeout_ms")
    """The same of gps, gui, pdci and output."""
    server_timeout_ms: float = _limit("server_timeout_ms")
    """The same of the server, which is only told."""
    control_rate_max_hz: float = _limit("control_rate_max_hz")
    """Largest advance of the counter of control in a second; it makes 60 rounds, and may catch up."""
    front_rate_max_hz: float = _limit("front_rate_max_hz")
    """The same of udp and parse."""
    slow_rate_max_hz: float = _limit("slow_rate_max_hz")
    """The same of all others."""
    command_timeout_ms: float = _limit("command_timeout_ms")
    """Longest time without a command."""
    malformed_max: float = _limit("malformed_max")
    """So many datagrams with a wrong size, magic, CRC or value are forgiven, until none came for a second."""
    range_max_v: float = _limit("range_max_v")
    """Largest volts of a command, either way."""
    mismatch_max_mw: float = _limit("mismatch_max_mw")
    """Largest difference of a command's MW from 12.5 MW/V times its volts."""
    stamp_max_ms: float = _limit("stamp_max_ms")
    """Largest difference of a command's time from the watchdog's UTC, either way."""
    unasked_max_v: float = _limit("unasked_max_v")
    """Largest volts, either way, of a command that does not ask for closed relays."""
    readback_max_percent: float = _limit("readback_max_percent")
    """Largest difference of a readback from what was forwarded, in percent of 10 V."""
    readback_count: float = _limit("readback_count")
    """So many in a row beyond it trip."""
    readback_timeout_ms: float = _limit("readback_timeout_ms")
    """Longest time without a readback, where they came or are required."""
    estop_discrepancy_ms: float = _limit("estop_discrepancy_ms")
    """Longest time for which one line of the emergency stop may be pressed and the other not."""
    contact_timeout_ms: float = _limit("contact_timeout_ms")
    """Longest time that a contact may take to be as ordered."""
    late_max_ms: float = _limit("late_max_ms")
    """How late a round of the watchdog itself may come; they are 10 ms apart."""
    close_max_v: float = _limit("close_max_v")
    """Largest volts, either way, at which the relays close."""

    @property
    def rules(self) -> Rules:
        """What the watchdog judges by."""
        limits = Limits(*(getattr(self, name) for name in Limits._fields))
        return Rules(limits, self.beats, self.readback == "required")


@dataclass(frozen=True, slots=True)
class Server:
    """``[server]``."""

    required: bool = field(default=False, metadata=parsed_by(boolean))
    """The server must be heard: without it no arming; a loss warns."""
    listen: Endpoint = field(default=Endpoint(Scheme.TCP, "127.0.0.1", 4790), metadata=parsed_by(_listening))
    """``HOST:PORT`` for operators. Orders are signed, what is told is not secret to who can connect."""
    keys: str | None = field(default=None, metadata=parsed_by(str))
    """File of operators and their keys (``dcon keys``); without it nobody orders anything."""
    window_s: float = field(default=5.0, metadata=parsed_by(number(0.1, 60)))
    """An order's time may differ so much from the platform's clock."""


@dataclass(frozen=True, slots=True)
class Log:
    """``[log]``."""

    path: str = field(default="session.mcap", metadata=parsed_by(str))
    """Of the first part; the others are ``session.part2.mcap``, ``session.part3.mcap``, ... beside it."""
    max_mb: float = field(default=1000.0, metadata=parsed_by(number(1, 1e6)))
    """A part of so many megabytes is ended, and the next begun."""
    max_minutes: float = field(default=60.0, metadata=parsed_by(number(1, 1e6)))
    """So is one that spans so much time."""
    backfill_s: float = field(default=120.0, metadata=parsed_by(number(1, 3600)))
    """The controller keeps so much of its log for a server that is away ..."""
    backfill_mb: float = field(default=64.0, metadata=parsed_by(number(1, 4096)))
    """... and at most so many megabytes: memory that is locked."""


@dataclass(frozen=True)
class Settings:
    """Everything a session is run with. ``sites`` in the order of ``params.pmus``."""

    params: Params
    sites: tuple[Site, ...]
    output: Output = Output()
    platform: Platform = Platform()
    watchdog: Watchdog = Watchdog()
    server: Server = Server()
    log: Log = Log()
    text: str = ""
    """The file itself, for the log."""
    probe_file: bytes = b""
    """What ``file`` of ``[probing]`` names, for the log."""
    line_input: LineInput = LineInput()
    given: frozenset[tuple[str, str]] = frozenset()
    """(section, key) of what the file gives, be it what the default is."""


def load(path: str | Path) -> Settings:
    """Read an initialisation file that a line is to be controlled by: the gain is held to what is feasible.

    Raises SourceError where it cannot be read, SettingsError for what is in it.
    """
    ini, text = read_ini(path)
    settings = from_ini(ini, text)
    _spared(settings, ini, path)
    most = settings.params.gain_max_mw_per_mhz
    if most > GAIN_MAX:
        where = ini.section("controller").entries["gain_max_mw_per_mhz"].where
        raise where.error(f"{most:g} MW/mHz is above {GAIN_MAX:g}; only simulations and replays go beyond it")
    return settings


def _spared(settings: Settings, ini: Ini, path: str | Path) -> None:
    """Raise SettingsError where what is written is a file that is read, under whatever name."""
    read = {"the initialisation file": path, "the probing signal": settings.params.probing.file}
    read["the file of keys"] = settings.server.keys or ""
    for section, key, written in (("log", "path", settings.log.path), ("watchdog", "log", settings.watchdog.log)):
        for what, name in read.items():
            if all(place and os.path.exists(place) for place in (written, name)) and os.path.samefile(written, name):
                entry = ini.section(section).entries.get(key)
                where = ini.section(section).where._replace(key=key) if entry is None else entry.where
                raise where.error(f"{written} is {what}, and would be overwritten; write to another file")


def parse(text: str, source: str, changes: tuple[str, ...] = (), *, probe_file: bytes | None = None) -> Settings:
    """Settings of an INI text, of a simulation or a replay; ``changes`` are ``SECTION.KEY=VALUE`` laid over it.

    ``probe_file`` is what the file of ``[probing]`` held; it is read where that is None.
    """
    ini = parse_ini(text, source, defaults_for="pmu")
    for change in changes:
        ini = ini.changed(change)
        if change.partition("=")[0].strip().lower() == PROBE_FILE:
            probe_file = None  # what was recorded is not what is asked for
    return from_ini(ini, text, probe_file)


def from_ini(ini: Ini, text: str = "", probe_file: bytes | None = None) -> Settings:
    sites = sites_of(ini)
    platform = fill(Platform, ini.section("platform"))
    watchdog, server = fill(Watchdog, ini.section("watchdog")), fill(Server, ini.section("server"))
    required = Required(platform.gps_required, watchdog.required, server.required)
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
        line_input=fill(LineInput, _split(ini.section("pdci"), LineInput)[0]),
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
    line = _filled(Line, _split(ini.section("pdci"), LineInput)[1])
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


def _filled(cls: type[T], section: Section) -> T:
    """A dataclass of a section."""
    return _made(cls, section, _numbers(cls, section))


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


def _numbers(cls: type, section: Section, skip: Collection[str] = ()) -> dict[str, Any]:
    """Values of a section for a dataclass whose fields carry bounds or choices as metadata, by the defaults' types."""
    known = {item.name: item for item in fields(cls) if item.name not in skip}
    values: dict[str, Any] = {}
    for key, entry in section.entries.items():
        if key not in known:
            raise entry.where.error(f"unknown key; {suggestion(key, known)}")
        item = known[key]
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
