"""``pmu ini``: what was seen of live streams, as an initialisation file with its remarks."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from pmutools.c37118.config import Station
from pmutools.cli.info_text import CHANNELS_SHOWN, format_text, remarks
from pmutools.cli.shell import visible
from pmutools.errors import SettingsError
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.settings import parse_ini
from pmutools.sites import RATES, Site, sites_of
from pmutools.timebase import NS, format_utc
from pmutools.tools.guess import nominal_kv
from pmutools.tools.survey import Survey, SurveyedEndpoint, SurveyedStream

WIDTH = 110
COLUMN = 40
"""Remarks on a line begin here."""
FAR_NS = 2 * NS
"""A delay beyond this is one of clocks, or of a recording that is played."""


@dataclass(frozen=True)
class Section:
    """One ``[pmu NAME]``: keys with their values, and remarks on them; above it, comments."""

    stream: SurveyedStream
    station: int
    name: str
    keys: Mapping[str, str]
    notes: Mapping[str, str] = field(default_factory=dict)
    comments: tuple[str, ...] = ()
    problem: str = ""
    """Why it cannot be in force."""


def sections_of(survey: Survey, configs: Mapping[SurveyedStream, str]) -> list[Section]:
    """A section a station of each stream; ``configs`` are the paths of saved configurations."""
    found = list[Section]()
    for endpoint in survey.endpoints:
        for stream in endpoint.streams:
            keys = {"url": str(_url(endpoint, stream)), "idcode": str(stream.inventory.idcode)}
            if path := configs.get(stream):
                keys["config"] = path
            found += [_section(stream, number, keys) for number in range(len(stream.stations))]
    names = _names(section.name for section in found)
    named = [replace(section, name=name) for section, name in zip(found, names, strict=True)]
    return list(_judged(named))


def _url(endpoint: SurveyedEndpoint, stream: SurveyedStream) -> Endpoint:
    """The user's URL, with the sender where several send to this port; the IDCODE has a key of its own."""
    url = replace(endpoint.endpoint, idcode=None)
    alike = [other for other in endpoint.streams if other.inventory.idcode == stream.inventory.idcode]
    rivals = alike if url.is_multicast else endpoint.streams
    if url.scheme is Scheme.UDP and url.source is None and len({other.host for other in rivals}) > 1:
        return replace(url, source=stream.host)
    return url


def _section(stream: SurveyedStream, number: int, keys: Mapping[str, str]) -> Section:
    station, several = stream.stations[number], len(stream.stations) > 1
    keys, notes = dict(keys), {"side": "north, south or none: what the controller makes of it"}
    if several:
        keys["station"] = station.name
    rate = stream.inventory.config.rate
    if rate.denominator == 1 and RATES[0] <= rate <= RATES[1]:
        keys["rate"] = str(rate.numerator)
    guess = stream.guess(number)
    if guess.channels:
        keys["voltage"] = ",".join(guess.channels)
        notes["voltage"] = guess.basis + (f"; {guess.doubt}" if guess.doubt else "")
    keys["side"] = "none"
    name = station.name or f"PMU{station.idcode}"
    return Section(stream, number, name, keys, notes, tuple(_station_comments(stream, number)))


def _names(names: Iterator[str]) -> list[str]:
    """Names of letters, digits and ``_``, each once (in any case)."""
    taken: set[str] = set()
    found = []
    for name in names:
        plain = fresh = re.sub(r"\W+", "_", name).strip("_") or "PMU"
        count = 1
        while fresh.lower() in taken:
            count += 1
            fresh = f"{plain}_{count}"
        taken.add(fresh.lower())
        found.append(fresh)
    return found


def _judged(sections: list[Section]) -> Iterator[Section]:
    """The sections, those that the file's reader would refuse or misread with the problem."""
    seen: dict[tuple[Endpoint, str | None], str] = {}
    for section in sections:
        keys, problem = dict(section.keys), ""
        for key in ("voltage", "config"):
            if key in keys and _read_back({"url": keys["url"], key: keys[key]}) is None:
                del keys[key]
        site = _read_back(keys)
        if site is None:
            problem = "what its frames say cannot be written here"
        elif (same := seen.setdefault((site.endpoint, site.station), section.name)) != section.name:
            problem = f"nothing tells it from [pmu {same}]"
        yield replace(section, keys=keys, problem=problem)


def _read_back(keys: Mapping[str, str]) -> Site | None:
    """The site that these keys make, None where one of them is not read as it is meant, or does not print."""
    if not all(value.isprintable() for value in keys.values()):
        return None
    text = "\n".join(("[pmu X]", *(f"{key} = {value}" for key, value in keys.items())))
    try:
        ini = parse_ini(text, "", defaults_for="pmu")
        (site,) = sites_of(ini)
    except SettingsError:
        return None
    read = {key: entry.text for key, entry in ini.sections[0].entries.items()}
    return site if read == keys and (site.station or None) == (keys.get("station") or None) else None


# --- text -------------------------------------------------------------------------------------------------------


def ini_text(survey: Survey, sections: list[Section]) -> str:
    """The file: ready to be read back, with what it was made from as comments."""
    lines = [*_head(survey)]
    rate = _common_rate(sections)
    if rate is not None:
        lines += ["", "[DEFAULT]", f"rate = {rate}"]
    for endpoint in survey.endpoints:
        lines += ["", *_endpoint_lines(endpoint)]
        for stream in endpoint.streams:
            lines += ["", *_comments(_stream_comments(stream))]
            for number, section in enumerate(section for section in sections if section.stream is stream):
                lines += [*([""] if number else []), *_section_lines(section, rate)]
    return "\n".join(lines) + "\n"


def _head(survey: Survey) -> Iterator[str]:
    began = f"{format_utc(survey.began_ns)[:19]}Z"
    yield f"; Written by pmu ini from {survey.listened_ns / NS:.1f} s of live streams, {began}."
    yield "; What is guessed says so: look at it, and at side and nominal_kv, before a controller is run with it."
    if survey.unlisted:
        yield f"; {survey.unlisted} more streams came; they are not listed."
    if survey.own_drops:
        yield f"; {survey.own_drops} datagrams were lost in this machine's receive buffer."


def _comments(texts: Iterable[str]) -> Iterator[str]:
    for text in texts:
        shown = visible(text)
        indent = " " * (len(shown) - len(shown.lstrip()))
        yield from textwrap.wrap(shown, WIDTH, initial_indent="; ", subsequent_indent=f"; {indent}")


def _common_rate(sections: list[Section]) -> str | None:
    """The rate that most have; None where some cannot say theirs: [DEFAULT] would give them this one."""
    rates = [section.keys.get("rate") for section in sections if not section.problem]
    if not rates or None in rates:
        return None
    return max(rates, key=rates.count)


def _endpoint_lines(endpoint: SurveyedEndpoint) -> Iterator[str]:
    yield f"; --- {endpoint.endpoint} ".ljust(100, "-")
    if not endpoint.streams:
        yield f"; {visible(endpoint.reason)}"
        yield ";[pmu NAME]"
        yield f";url = {endpoint.endpoint}"
    for host, idcode in endpoint.unconfigured:
        yield (
            f"; Data of IDCODE {idcode} come from {host}, but no configuration: a spontaneous sender repeats its own "
            "about once a minute (--duration 70)"
        )
    for idcode, host in endpoint.foreign.items():
        yield f"; IDCODE {idcode} comes from {host}, too, and was not asked for: name it with ?idcode={idcode}"


def _stream_comments(stream: SurveyedStream) -> Iterator[str]:
    inventory = stream.inventory
    config = inventory.config
    rate = f"{float(config.rate):g} frames/s" if config.rate else "rate undefined"
    if (measured := inventory.measured_hz) is not None:
        rate += f" (measured {measured:.3f})"
    where = ", ".join(list(stream.senders)[:4]) or stream.host
    frames = f"{inventory.frames} data frames of {config.frame_size} bytes"
    yield f"IDCODE {inventory.idcode} from {where}: {config.kind.name}, {rate}, {frames}"
    middle, most = stream.delay.quantiles_ns((0.5, 0.99))
    if middle is not None and most is not None:
        yield f"delay (arrival less stamp): median {_span(middle)}, 99 % within {_span(most)}"
    if inventory.frames and not any(inventory.time_quality):
        yield "time quality: locked in every frame"
    yield from (f"* {text}" for text in _oddities(stream))


def _span(ns: float) -> str:
    """A duration in the unit that suits it."""
    unit, name = next(((unit, name) for unit, name in _UNITS if abs(ns) >= unit), _UNITS[-1])
    return f"{ns / unit:.1f} {name}"


_UNITS = ((86_400 * NS, "days"), (3600 * NS, "h"), (10 * NS, "s"), (NS // 1000, "ms"))


def _oddities(stream: SurveyedStream) -> Iterator[str]:
    inventory = stream.inventory
    yield from remarks(inventory)
    (middle,) = stream.delay.quantiles_ns((0.5,))
    if middle is not None and not 0 <= middle <= FAR_NS:
        yield "that is no delay: the stamps are not of now (a clock that is wrong, or a recording that is played)"
    measured, rate = inventory.measured_hz, float(inventory.config.rate)
    if measured is not None and rate and inventory.frames > 10 and abs(measured / rate - 1) > 0.02:
        yield f"the frames come at {measured:.2f}/s, the configuration says {rate:g}"
    if len(stream.senders) > 1:
        yield f"it comes from {len(stream.senders)} ports: restarted, or several devices with one IDCODE"
    if not stream.stations:
        yield "no stations: nothing to make a section of"


def _station_comments(stream: SurveyedStream, number: int) -> Iterator[str]:
    station = stream.stations[number]
    facts = f"IDCODE {station.idcode}, {station.fnom_hz:g} Hz, {format_text(station.format)}"
    yield f"{station.name or '(no name)'}: {facts}"
    yield f"  {_channels(station)}"
    if stream.inventory.frames and not stream.good[number]:
        yield "* its STAT never said that its data are good"


def _channels(station: Station) -> str:
    parts = [f"{channel.name or '(no name)'} ({channel.kind})" for channel in station.phasors]
    parts += [f"{channel.name or '(no name)'} (analog)" for channel in station.analogs]
    words = len(station.digitals)
    parts += [f"{words} digital word{'s' * (words > 1)}"] if words else []
    return ", ".join(parts) or "no channels but frequency and ROCOF"


def _section_lines(section: Section, rate: str | None) -> Iterator[str]:
    yield from _comments(section.comments)
    off = ";" if section.problem else ""
    if section.problem:
        yield f"; * {section.problem}"
    yield f"{off}[pmu {section.name}]"
    for key, value in section.keys.items():
        if key == "rate" and value == rate and not off:
            continue
        note = section.notes.get(key)
        line = f"{off}{key} = {visible(value)}"
        yield f"{line:<{COLUMN}}; {visible(note)}" if note else line
    if "voltage" not in section.keys:
        names = [channel.name for channel in section.stream.stations[section.station].phasors if channel.kind == "V"]
        some = ", ".join(names[:CHANNELS_SHOWN]) + (", ..." if len(names) > CHANNELS_SHOWN else "")
        yield from _comments((f"one positive-sequence channel, or three phases, of: {some or 'none'}",))
        yield ";voltage ="
    if text := _level(section):
        yield text


def _level(section: Section) -> str:
    """A line with the nominal voltage that the values point to, commented out."""
    channels = section.keys.get("voltage", "").split(",")
    phasors = section.stream.stations[section.station].phasors
    values = section.stream.values(section.station)
    volts = [abs(value) for channel, value in zip(phasors, values, strict=True) if channel.name == channels[0]]
    if not volts or not math.isfinite(volts[0]):
        return ""
    kv = volts[0] * math.sqrt(3) / 1000
    seen = f"{channels[0]} is {volts[0] / 1000:.4g} kV, {kv:.4g} kV line to line"
    level = nominal_kv(volts[0])
    line = f";nominal_kv = {'' if level is None else f'{level:g}'}"
    return f"{line:<{COLUMN}}; {visible(seen)}" + ("" if level else ": no usual level")
