"""``[pmu NAME]`` of the initialisation file: which PMUs there are, and where their streams come from.

The reader, the characterizer and the controller take the same file; each leaves the other's sections alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.errors import SettingsError, SourceError
from pmutools.net.endpoint import Endpoint, Scheme, parse_endpoint
from pmutools.parsers import choice, integer, number, parsed_by, words
from pmutools.settings import Ini, Section, fill, parse_ini

SIDES = ("north", "south", "none")
SECTIONS = ("controller", "supervisor", "probing", "platform", "watchdog", "server", "output", "pdci", "log")
"""Sections that belong to the controller."""
RATES = (1, 240)
"""Reporting rates that a site may have, frames per second."""


def endpoint(text: str) -> Endpoint:
    """A parser of URLs; it leaves the place of an error to its caller."""
    try:
        return parse_endpoint(text)
    except SettingsError as error:
        raise ValueError(error) from None


def _voltage(text: str) -> tuple[str, ...]:
    channels = words(text)
    if len(set(channels)) != len(channels) or len(channels) not in (1, 3):
        raise ValueError(f"{text!r} is neither one positive-sequence channel nor three phases VA,VB,VC")
    return channels


@dataclass(frozen=True, slots=True)
class Site:
    """``[pmu NAME]``: one PMU."""

    name: str
    url: Endpoint = field(metadata=parsed_by(endpoint))
    """Where its stream comes from."""
    idcode: int | None = field(default=None, metadata=parsed_by(integer(1, 65534)))
    """IDCODE of the stream; the only one there is unless given."""
    station: str | None = field(default=None, metadata=parsed_by(str))
    """Station of a stream with several."""
    side: str = field(default="none", metadata=parsed_by(choice(*SIDES)))
    """Controller: ``north``, ``south``, or ``none`` for a PMU that is recorded only."""
    voltage: tuple[str, ...] = field(default=("VA", "VB", "VC"), metadata=parsed_by(_voltage))
    """Controller: positive-sequence channel, or those of the three phases."""
    nominal_kv: float | None = field(default=None, metadata=parsed_by(number(0.1, 2000)))
    """Controller: line-to-line; without it the voltage's magnitude is not judged."""
    rate: int | None = field(default=None, metadata=parsed_by(integer(*RATES)))
    """Frames per second that are expected; what the stream's configuration says unless given."""
    config: str | None = field(default=None, metadata=parsed_by(str))
    """A recording that holds the stream's configuration, for one that never sends it; relative to this file."""

    @property
    def stream(self) -> int | None:
        """IDCODE of the stream, from either key."""
        return self.url.idcode if self.idcode is None else self.idcode

    @property
    def endpoint(self) -> Endpoint:
        """The URL with the stream's IDCODE in it."""
        return replace(self.url, idcode=self.stream)

    def stations(self, config: StreamConfig) -> tuple[int, ...]:
        """The numbers of the stations that are this PMU: one, or all where it names none; () where it is not there."""
        names = [station.name for station in config.stations]
        if self.station is None:
            return tuple(range(len(names)))
        return (names.index(self.station),) if self.station in names else ()


@dataclass(frozen=True, slots=True)
class StreamSites:
    """One stream, which is received once, and the sites that are in it: several of a concentrator's."""

    endpoint: Endpoint
    sites: tuple[Site, ...]

    @property
    def name(self) -> str:
        """The site's name; of several, all of them with a ``+`` between."""
        return "+".join(site.name for site in self.sites)

    @property
    def rate(self) -> int | None:
        """Frames per second that are expected; None where no site says it."""
        return next((site.rate for site in self.sites if site.rate is not None), None)


def streams_of(sites: Iterable[Site]) -> tuple[StreamSites, ...]:
    """Each endpoint once, in the order of the file, with its sites.

    What receives from ``[stream.endpoint for stream in streams]`` tells of streams by their places in this tuple
    (:meth:`pmutools.net.receiver.Receivers.owners`).
    """
    found: dict[Endpoint, list[Site]] = {}
    for site in sites:
        found.setdefault(site.endpoint, []).append(site)
    return tuple(StreamSites(endpoint, tuple(members)) for endpoint, members in found.items())


def read_ini(path: str | Path) -> tuple[Ini, str]:
    """An initialisation file's sections, and its text. Raises SourceError where it cannot be read."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is no UTF-8 text"
        raise SourceError(f"{path}: {reason}") from None
    return parse_ini(text, str(path), defaults_for="pmu"), text


def sites_of(ini: Ini) -> tuple[Site, ...]:
    """The PMUs of an initialisation file, in its order.

    Raises SettingsError, with the line, for an unknown section or key, a value that does not parse, no PMU at all, and
    two PMUs that would be given the same frames.
    """
    ini.only("pmu *", *SECTIONS)
    sections = ini.family("pmu")
    if not sections:
        raise SettingsError(f"{ini.source}: no [pmu NAME] section; add one for each PMU")
    sites = tuple(fill(Site, section, name=section.argument) for section in sections)
    _check_apart(sections, sites)
    return sites


def load_sites(path: str | Path) -> tuple[Site, ...]:
    """:func:`sites_of` the file at ``path``, saved configurations' paths made absolute."""
    sites = sites_of(read_ini(path)[0])
    folder = Path(path).resolve().parent
    return tuple(replace(site, config=str(folder / site.config)) if site.config else site for site in sites)


def _check_apart(sections: tuple[Section, ...], sites: tuple[Site, ...]) -> None:
    """Raise SettingsError for a PMU that has two IDCODEs, or that clashes with one above it."""
    for index, (section, site) in enumerate(zip(sections, sites, strict=True)):
        if site.idcode is not None and site.url.idcode not in (None, site.idcode):
            raise section.entries["idcode"].where.error(f"{site.idcode}, but the url says {site.url.idcode}; keep one")
        for other in sites[:index]:
            if _overlap(site, other):
                problem = f"{site.url} gives it the frames of {other.name} too"
                raise section.where.error(f"{problem}; tell the two apart by idcode, station or ?source=")
            if _same_port(site.url, other.url):
                problem = f"{site.url} and {other.url} of {other.name} are one port of this machine"
                raise section.entries["url"].where.error(f"{problem}; write the same host in both")
            if site.endpoint == other.endpoint:
                _check_alike(section, sections[sites.index(other)])


def _check_alike(section: Section, other: Section) -> None:
    """Raise SettingsError for sites of one stream that say different things of it."""
    for key in ("rate", "config"):
        one, two = section.entries.get(key), other.entries.get(key)
        if one is None or two is None or one.text == two.text:
            continue
        if one.where.section != section.name:  # of [DEFAULT]: the other one is what stands out
            one, two, other = two, one, section
        raise one.where.error(f"{one.text}, but {other.argument} in the same stream has {two.text}; keep one")


def _overlap(site: Site, other: Site) -> bool:
    """Whether frames of one PMU would be taken for the other's."""
    one, two = site.url, other.url
    if (one.scheme, one.host, one.port) != (two.scheme, two.host, two.port):
        return False
    pairs = ((site.stream, other.stream), (site.station, other.station), (one.source, two.source))
    return all(None in pair or pair[0] == pair[1] for pair in pairs)


_EVERY_HOST = ("0.0.0.0", "::")


def _same_port(one: Endpoint, two: Endpoint) -> bool:
    """Whether one is bound to every local address and the other to one of them, at the same port: only one can be."""
    (host, port), (other, other_port) = bound_at(one), bound_at(two)
    if not port or port != other_port or host == other or (":" in host) != (":" in other):
        return False
    return host in _EVERY_HOST or other in _EVERY_HOST


def bound_at(url: Endpoint) -> tuple[str, int]:
    """Where datagrams of an endpoint are received; port 0 where the system chooses, or there are none."""
    if url.scheme is Scheme.UDP:
        return url.host, url.port
    every = _EVERY_HOST[":" in url.host]
    return url.data_host or every, url.data_port or 0
