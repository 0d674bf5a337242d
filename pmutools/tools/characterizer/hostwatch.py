"""What a live source can tell of the measuring host: how it stood still, and what its TCP had to repair."""

from __future__ import annotations

from typing import Any

from pmutools.net.endpoint import Scheme
from pmutools.timebase import NS
from pmutools.tools.characterizer.engine import Engine

TCP_NS = NS
"""How often TCP's counts are read."""


class HostWatch:
    """Hands an engine what the source has counted since the last look; a source that counts nothing is none the worse.

    Looked for are ``host.stalled`` (how often so far) with ``host.stalls`` (the last of them, with ``length_ns`` and
    ``utc_ns``), and ``tcp_counts(place)`` with ``retransmits`` and ``out_of_order`` so far.
    """

    def __init__(self, source: Any, engine: Engine) -> None:
        self._host, self._counts_of = getattr(source, "host", None), getattr(source, "tcp_counts", None)
        self._engine = engine
        self._stalled = 0
        self._tcp_ns = 0
        self._tcp: dict[int, tuple[int, int]] = {
            place: (0, 0)
            for place, wanted in enumerate(engine.wanted)
            if wanted.endpoint.scheme in (Scheme.TCP, Scheme.TCP_UDP)
        }

    def look(self, monotonic_ns: int) -> None:
        """Hand over what is new."""
        if self._host is not None and (fresh := self._host.stalled - self._stalled) > 0:
            self._stalled += fresh
            for stall in list(self._host.stalls)[-fresh:]:
                self._engine.stalled(stall.length_ns, stall.utc_ns)
        if self._counts_of is not None and monotonic_ns >= self._tcp_ns:
            self._tcp_ns = monotonic_ns + TCP_NS
            for place, (retransmits, out_of_order) in self._tcp.items():
                counts = self._counts_of(place)
                self._tcp[place] = counts.retransmits, counts.out_of_order
                self._engine.resent(
                    (place,), max(0, counts.retransmits - retransmits), max(0, counts.out_of_order - out_of_order)
                )
