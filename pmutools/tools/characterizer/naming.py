"""Who a stream is: frames of many flows to one stream with one name, through reconnections and restarts.

A stream that the user asked for is known by the endpoints it belongs to and its IDCODE: whatever connection or source
port it comes by, it is the same. In a recording it is known by what stays when a device is started anew: over UDP the
address it sends to, over TCP its own address and the receiver's host.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence

from pmutools.c37118.config import StreamConfig
from pmutools.flow import Flow, host_of
from pmutools.measure.stream import Identity
from pmutools.net.endpoint import Scheme, is_multicast
from pmutools.parsers import unique
from pmutools.tools.characterizer.wanted import Wanted

Owners = Callable[[Flow, int], tuple[int, ...]]
"""Places of the endpoints that a flow's IDCODE belongs to."""


def nobody(flow: Flow, idcode: int) -> tuple[int, ...]:
    """The owners of what comes from a recording."""
    return ()


def key_of(flow: Flow, idcode: int, owners: tuple[int, ...]) -> Hashable:
    """Equal for what is one stream."""
    if owners:
        return owners, idcode
    if flow.transport == "udp":
        return "udp", flow.destination, idcode
    if flow.transport == "tcp":
        return "tcp", flow.source, host_of(flow.destination), idcode
    return flow.ends, idcode


def identity_of(
    flow: Flow, config: StreamConfig, owners: tuple[int, ...], wanted: Sequence[Wanted], taken: Iterable[str]
) -> Identity:
    """What a new stream is called: as its sites, or by its configuration; not as those ``taken``."""
    mine = [wanted[place] for place in owners]
    sites = [site for each in mine for site in each.sites]
    stations = [station.name for station in config.stations]
    (name,) = unique(("+".join(sites) or config.name,), taken)
    others = tuple(dict.fromkeys(other for other in (*sites, *stations, str(config.idcode)) if other != name))
    where = str(mine[0].endpoint) if mine else " > ".join(filter(None, (flow.source, flow.destination)))
    rate = next((each.rate for each in mine if each.rate), None)
    return Identity(name, config.idcode, flow.transport, _to_group(flow), where, rate, others)


def silent_identity(wanted: Wanted, taken: Iterable[str]) -> Identity:
    """What an endpoint is called that nothing came from."""
    (name,) = unique((wanted.label,), taken)
    endpoint = wanted.endpoint
    transport = "tcp" if endpoint.scheme is Scheme.TCP else "udp"
    others = tuple(site for site in wanted.sites if site != name)
    multicast = is_multicast(endpoint.host)
    return Identity(name, endpoint.idcode or 0, transport, multicast, str(endpoint), wanted.rate, others)


def _to_group(flow: Flow) -> bool:
    host = host_of(flow.destination)
    return flow.transport == "udp" and bool(host) and is_multicast(host)
