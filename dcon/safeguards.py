"""What keeps one failure, or anybody at all, from doing harm, and whether the settings leave it so.

Only of a file that a line is to be controlled by: simulations and replays take what was recorded.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING

from dcon.core.clash import Clash
from dcon.link import paths
from dcon.places import IioPlace, ModbusLine
from dcon.watchdog.limits import Rules
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.sites import bound_at

if TYPE_CHECKING:
    from dcon.settings import Settings

LINES = ("estop_a", "estop_b", "relay_a", "relay_b", "contact_a", "contact_b")
"""Keys of ``[watchdog]`` that name a file each."""


def check_safeguards(settings: Settings) -> None:
    """Raise Clash for settings that make two safeguards one, or one that cannot work."""
    watchdog, line = settings.watchdog, settings.params.line
    files = {f"watchdog.{name}": getattr(watchdog, name) for name in (*LINES, "log")}
    files["log.path"] = settings.log.path
    for (one, path), (other, second) in combinations(files.items(), 2):
        if path and second and is_same_file(path, second):
            raise Clash(f"{second}: is the file of {_key(one)} too; each needs one of its own", other, one)
    for name in watchdog.status:
        if name in (".", "..") or "/" in name or "\0" in name:
            raise Clash(f"{name}: is no plain name of a socket in the run folder", "watchdog.status")
        if name in paths.NAMES and name not in (paths.CONTROL, paths.STATUS):
            raise Clash(f"{name}: something else is awaited there, and would be crowded out", "watchdog.status")
    where = settings.output.url
    if watchdog.readback == "required" and where is not None and not _reads_back(where):
        problem = f"required: [output] url = {where} reads nothing back, so no relay could stay closed; set it to auto"
        raise Clash(problem, "watchdog.readback", "output.url")
    if isinstance(where, Endpoint):
        for name, host, port in _awaited(settings):
            if port == where.port and (where.host == host or _is_here(where.host)):
                raise Clash(f"{where}: there {name} is awaited; commands need a port of their own", "output.url")
    source = settings.line_input.url
    if isinstance(source, Endpoint):
        for name, host, port in _of_pmus(settings):
            if port == source.port and _overlap(host, source.host):
                problem = f"{source}: there {name} is awaited; the line's status needs a port of its own"
                raise Clash(problem, "pdci.url", f"pmu {name}.url")
    if isinstance(source, ModbusLine) and source.keys.period_ms >= 1e3 * line.status_age_s:
        problem = f"{line.status_age_s:g}: must be above period_ms = {source.keys.period_ms:g} of url"
        raise Clash(problem, "pdci.status_age_s", "pdci.url")
    if line.rating_ns_mw == 0:
        raise Clash(f"0: must be above minimum_mw = {line.minimum_mw:g}", "pdci.rating_ns_mw", "pdci.minimum_mw")


def weak_safeguards(settings: Settings) -> list[str]:
    """One line for each safeguard that one failure defeats or that is left out, each door that stands open, and what
    keeps everything from being armed."""
    return [*_single(settings), *_unwatched(settings), *_open(settings), *_never(settings)]


def is_same_file(one: str, other: str) -> bool:
    """Under whatever names; of files that are not there, by what the names come to."""
    if os.path.exists(one) and os.path.exists(other):
        return os.path.samefile(one, other)
    return os.path.realpath(one) == os.path.realpath(other)


def _single(settings: Settings) -> Iterator[str]:
    watchdog = settings.watchdog
    for what, kind in (("line of the emergency stop", "estop"), ("relay", "relay")):
        one, other = getattr(watchdog, f"{kind}_a"), getattr(watchdog, f"{kind}_b")
        if bool(one) != bool(other):
            lacks = f"{kind}_b" if one else f"{kind}_a"
            yield f"[watchdog] {lacks} is not set: there is only one {what}, and its failure is not seen or survived"
    if watchdog.drive == "level" and (watchdog.relay_a or watchdog.relay_b):
        yield (
            "[watchdog] drive = level: closed relays stay closed if the watchdog dies; "
            "pulse, with a monostable in front of each relay, fails safe"
        )


def _unwatched(settings: Settings) -> Iterator[str]:
    """What nobody looks at."""
    watchdog = settings.watchdog
    for each in "ab":
        if getattr(watchdog, f"contact_{each}") and not getattr(watchdog, f"relay_{each}"):
            yield f"[watchdog] contact_{each}: relay_{each} is not set, so nothing drives what that contact shows"
    if unheeded := [name for name in Rules().beats if name not in watchdog.beats]:
        yield f"[watchdog] beats: without {', '.join(unheeded)}, which may then never beat and close the relays"
    if not settings.line_input.required:
        yield "[pdci] required = no: arms without knowing whether the line is in service and takes the command"


def _open(settings: Settings) -> Iterator[str]:
    """Where anybody is listened to."""
    line = settings.line_input.url
    for site in settings.sites:
        url = site.url
        if url.scheme is Scheme.UDP and url.source is None and not _is_loopback(url.host):
            yield f"[pmu {site.name}] url = {url}: whoever reaches that port may send its frames; add ?source=ADDRESS"
    if isinstance(line, Endpoint) and line.source is None and not _is_loopback(line.host):
        yield f"[pdci] url = {line}: whoever reaches that port may tell the line's status; add ?source=ADDRESS"


def _never(settings: Settings) -> Iterator[str]:
    """Why nothing can be armed."""
    if settings.line_input.required and settings.line_input.url is None:
        yield "[pdci] url is not set: nobody tells the line's status, so nothing can be armed; set it, or required = no"
    if settings.platform.gps_required and settings.platform.time_source == "none":
        yield "[platform] gps_required = yes with time_source = none: the lock is never known, so nothing can be armed"
    if paths.CONTROL not in settings.watchdog.status:
        yield f"[watchdog] status lacks {paths.CONTROL}: the controller does not hear it, so nothing can be armed"


def _reads_back(where: object) -> bool:
    if isinstance(where, IioPlace):
        return where.keys.readback is not None
    return not isinstance(where, Endpoint)


def _awaited(settings: Settings) -> Iterator[tuple[str, str, int]]:
    """Who is awaited at a UDP port of this machine: name, host and port."""
    yield from _of_pmus(settings)
    line = settings.line_input.url
    if isinstance(line, Endpoint):
        yield "the line's status", line.host, line.port


def _of_pmus(settings: Settings) -> Iterator[tuple[str, str, int]]:
    for site in settings.sites:
        host, port = bound_at(site.url)
        if port:
            yield site.name, host, port


def _overlap(one: str, other: str) -> bool:
    """Whether only one socket can be bound to these at the same port. A name is not asked for."""
    try:
        first, second = (ipaddress.ip_address("127.0.0.1" if host == "localhost" else host) for host in (one, other))
    except ValueError:
        return one == other
    return first == second or (first.version == second.version and (first.is_unspecified or second.is_unspecified))


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _is_here(host: str) -> bool:
    """Whether it is an address of this machine; a name is not asked for."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost"
    if address.is_loopback or address.is_unspecified:
        return True
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((host, 0))
    except OSError:
        return False
    return not address.is_multicast


def _key(name: str) -> str:
    section, _, key = name.partition(".")
    return f"[{section}] {key}"
