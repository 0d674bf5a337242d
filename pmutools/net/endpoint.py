"""Where a stream comes from or goes to, as a URL.

===================================  ==================================================================
``udp://HOST:PORT``                  spontaneous datagrams; a multicast group is just a HOST
``udp+cmd://HOST:PORT``              commands and data over UDP
``tcp://HOST:PORT``                  commands and data on one connection
``tcp+udp://HOST:PORT?data=PORT``    commands over TCP, data over UDP (``data=GROUP:PORT``: multicast)
===================================  ==================================================================

Keys of the query: ``idcode`` picks the stream; ``iface`` (an address or a name) is the local interface for multicast
and the local address of a connection; ``source`` is the only sender a reader accepts (source-specific multicast), and
the address a player sends from; ``ttl`` is that of multicast; ``stamps=hardware`` has a reader take the network card's
arrival stamps, in the card's own timescale, where the card makes them. IPv6 addresses stand in brackets. Port 0 means
any free one, for an end that binds.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from urllib.parse import parse_qsl, urlencode, urlsplit

from pmutools.c37118.constants import FIRST_IDCODE, LAST_IDCODE
from pmutools.errors import SettingsError


class Scheme(StrEnum):
    """How commands and data travel."""

    UDP = "udp"
    UDP_COMMANDED = "udp+cmd"
    TCP = "tcp"
    TCP_UDP = "tcp+udp"

    @property
    def commanded(self) -> bool:
        """Whether there is a channel for commands."""
        return self is not Scheme.UDP


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A parsed URL; ``str()`` gives it back. ``data_host`` and ``data_port`` are those of ``?data=``."""

    scheme: Scheme
    host: str
    port: int
    idcode: int | None = None
    iface: str | None = None
    source: str | None = None
    data_host: str | None = None
    data_port: int | None = None
    ttl: int | None = None
    hardware_stamps: bool = False
    """``stamps=hardware``; ``stamps=kernel`` is what holds without the key."""

    def __str__(self) -> str:
        data = None
        if self.data_port is not None:
            data = join_host(self.data_host, self.data_port) if self.data_host else str(self.data_port)
        query = {"idcode": self.idcode, "data": data, "iface": self.iface, "source": self.source, "ttl": self.ttl}
        query["stamps"] = "hardware" if self.hardware_stamps else None
        text = urlencode({key: value for key, value in query.items() if value is not None}, safe=":[]")
        return f"{self.scheme}://{join_host(self.host, self.port)}{'?' if text else ''}{text}"

    @property
    def is_multicast(self) -> bool:
        """Whether data go to a group, which others may be listening to."""
        return is_multicast(self.data_host or self.host)


def is_multicast(host: str) -> bool:
    """Whether ``host`` is the address of a group."""
    try:
        return ipaddress.ip_address(host).is_multicast
    except ValueError:
        return False


def scoped(host: str, iface: str | None) -> str:
    """An IPv6 group with its interface: those of link scope exist once on each."""
    return f"{host}%{iface}" if iface and ":" in host and "%" not in host and is_multicast(host) else host


def join_host(host: str, port: int) -> str:
    """``host:port``, or ``[host]:port`` for IPv6."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def parse_endpoint(url: str) -> Endpoint:
    """Parse a URL as in the module's text.

    Raises
    ------
    SettingsError
        One line that names the URL, what is wrong in it, and what to write.
    """
    text = url.strip()
    if "://" not in text:
        known = text.partition(":")[0]
        guess = f"{known}://{text[len(known) + 1 :].lstrip('/')}" if known in _SCHEMES else f"tcp://{text}"
        raise SettingsError(f"{url}: no endpoint URL; write {guess} (or {', '.join(_prefixes())})")
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError as error:
        raise SettingsError(
            f"{url}: {str(error).lower()}; ports are 0..65535, IPv6 addresses stand in brackets"
        ) from None
    if parts.scheme not in _SCHEMES:
        raise SettingsError(f"{url}: unknown scheme {parts.scheme!r}; use one of {', '.join(_prefixes())}")
    scheme = Scheme(parts.scheme)
    host = parts.hostname
    if parts.username is not None or parts.path not in ("", "/") or parts.fragment:
        raise SettingsError(f"{url}: only {scheme}://HOST:PORT?key=value is understood")
    if not host:
        raise SettingsError(f"{url}: no host; write {scheme}://0.0.0.0:{port or 4713} for every local address")
    if port is None:
        usual = 4713 if scheme in (Scheme.UDP, Scheme.UDP_COMMANDED) else 4712
        raise SettingsError(f"{url}: no port; C37.118 customarily has {scheme}://{host}:{usual}")
    query = _query(url, parts.query)
    data_host, data_port = _data(url, query.get("data"), scheme)
    return Endpoint(
        scheme,
        host,
        port,
        idcode=_number(url, query, "idcode", FIRST_IDCODE, LAST_IDCODE),
        iface=query.get("iface"),
        source=_address(url, query, "source"),
        data_host=data_host,
        data_port=data_port,
        ttl=_number(url, query, "ttl", 0, 255),
        hardware_stamps=_stamps(url, query.get("stamps", "kernel")),
    )


_SCHEMES = frozenset(map(str, Scheme))
_KEYS = ("idcode", "data", "iface", "source", "ttl", "stamps")


def _prefixes() -> list[str]:
    return [f"{scheme}://" for scheme in Scheme]


def _query(url: str, text: str) -> dict[str, str]:
    query: dict[str, str] = {}
    for key, value in parse_qsl(text, keep_blank_values=True):
        if key not in _KEYS:
            close = get_close_matches(key, _KEYS, 1)
            hint = f"is {close[0]!r} meant?" if close else f"known: {', '.join(_KEYS)}"
            raise SettingsError(f"{url}: unknown key {key!r}; {hint}")
        if key in query:
            raise SettingsError(f"{url}: {key!r} is given twice")
        if not value:
            raise SettingsError(f"{url}: {key!r} has no value")
        query[key] = value
    return query


def _number(url: str, query: dict[str, str], key: str, low: int, high: int) -> int | None:
    text = query.get(key)
    if text is None:
        return None
    if not re.fullmatch(r"[0-9]{1,6}", text) or not low <= int(text) <= high:
        raise SettingsError(f"{url}: {key}={text} is not a whole number {low}..{high}")
    return int(text)


def _address(url: str, query: dict[str, str], key: str) -> str | None:
    text = query.get(key)
    if text is None:
        return None
    try:
        return str(ipaddress.ip_address(text.strip("[]")))
    except ValueError:
        raise SettingsError(f"{url}: {key}={text} is not an IP address") from None


def _stamps(url: str, text: str) -> bool:
    if text not in ("kernel", "hardware"):
        raise SettingsError(f"{url}: stamps={text} is neither kernel nor hardware")
    return text == "hardware"


def _data(url: str, text: str | None, scheme: Scheme) -> tuple[str | None, int | None]:
    if text is None:
        if scheme is Scheme.TCP_UDP:
            raise SettingsError(f"{url}: no data port; add ?data=PORT, the UDP port that the server sends to")
        return None, None
    if scheme is not Scheme.TCP_UDP:
        raise SettingsError(f"{url}: 'data' belongs to {Scheme.TCP_UDP}:// only")
    host, _, port = text.rpartition(":")
    if not re.fullmatch(r"[0-9]{1,5}", port) or not int(port) <= 65535:
        raise SettingsError(f"{url}: data={text} is not a port 0..65535 (or GROUP:PORT)")
    return host.strip("[]") or None, int(port)
