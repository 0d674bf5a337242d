"""What the user asked for. Little has to be imported for it: sockets are bound before all else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.sites import Site, streams_of


class Wanted(NamedTuple):
    """What the user asked for: an endpoint, the sites that are in its stream, and their rate."""

    endpoint: Endpoint
    sites: tuple[str, ...] = ()
    rate: int | None = None

    @property
    def label(self) -> str:
        """What it is called where nothing of it has come."""
        return "+".join(self.sites) or str(self.endpoint)


def wanted_of(urls: Iterable[str], sites: Iterable[Site] = ()) -> tuple[Wanted, ...]:
    """What a command line and an initialisation file ask for, each once. Raises SettingsError for a wrong URL."""
    found = [Wanted(stream.endpoint, tuple(s.name for s in stream.sites), stream.rate) for stream in streams_of(sites)]
    return (*found, *(Wanted(endpoint) for endpoint in dict.fromkeys(map(parse_endpoint, urls))))
