"""The front as a process: PMU streams in, frames out to the control process that has started it.

``python -m dcon.front --ini FILE --fd N --run-dir DIR``, with one end of a SEQPACKET socket pair inherited as
descriptor N. Its loops ``udp`` and ``parse`` take turns in one thread, and each beats to the watchdog. It never waits
for the control process: data frames that the pair has no room for are counted; the newest configurations, and news, are
kept. It ends when the pair does.
"""

from __future__ import annotations

import socket

from dcon.front.receiving import Reception
from dcon.front.turns import Turns
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item, PmuFrameIn, encode
from dcon.link.pulse import Pulse
from pmutools.clock import Clock

ROUND_NS = 10_000_000
"""The longest that a round waits for something to come."""
BEAT_NS = 10_000_000
PARSE_NS = 5_000_000
"""A turn parses for so long, and one chunk more; what is left waits for the next (:mod:`dcon.front.turns`)."""
KEPT = 1000
"""News that may wait for room in the pair; the oldest go first. Of configurations the newest of each PMU waits too."""
COUNTS_NS = 500_000_000
PRIORITY = 9
"""One below the control process."""


class Outlet:
    """One end of the pair. What it had no room for is counted in ``counts``."""

    def __init__(self, sock: socket.socket, counts: FrontCounts) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._counts = counts
        self._configs: dict[int, PmuFrameIn] = {}
        """By PMU, the newest that waits for room."""
        self._news: list[Item] = []
        """What else does."""
        self._items: list[Item] = []
        self.is_open = True
        """Somebody is there to take what comes."""

    def add(self, item: Item) -> None:
        """For the next :meth:`flush`."""
        self._items.append(item)

    def flush(self) -> None:
        """Send what waits, then what is new, in order, up to the first message that finds no room: a smaller one after
        it may find some, and must not overtake a configuration."""
        items = [*self._configs.values(), *self._news, *self._items]
        self._configs, self._news, self._items = {}, [], []
        sent = 0
        for message, inside in encode(items):
            try:
                self._sock.send(message)
            except BlockingIOError:
                self._keep(items[sent:])
                return
            except OSError:
                self.is_open = False
                return
            sent += len(inside)

    def _keep(self, items: list[Item]) -> None:
        for item in items:
            match item:
                case PmuFrameIn(pmu, _, True):
                    self._counts.overtaken_configs += pmu in self._configs
                    self._configs[pmu] = item
                case PmuFrameIn():
                    self._counts.crowded += 1
                case FrontCounts():  # newer ones follow
                    pass
                case _:
                    self._news.append(item)
        self._counts.untold += len(self._news[:-KEPT])
        del self._news[:-KEPT]


class Front:
    """Both loops, in turn, until nobody takes what they find."""

    def __init__(self, reception: Reception, outlet: Outlet, udp: Pulse, parse: Pulse, clock: Clock) -> None:
        """``udp`` and ``parse`` are the loops' pulses."""
        self.reception, self.outlet, self._clock = reception, outlet, clock
        self._udp, self._parse = udp, parse
        self._counted_ns = 0
        self._received = Turns(reception.counts, reception.receivers.routes.hears)
        """What is not parsed yet."""

    def run(self) -> None:
        while self.outlet.is_open:
            self.turn()

    def turn(self) -> None:
        reception, outlet, clock, received = self.reception, self.outlet, self._clock, self._received
        if received.has_room:
            received.add(reception.receive(0 if received else ROUND_NS))
        now_ns = clock.monotonic_ns()
        self._udp.beat(now_ns)
        end_ns = now_ns + PARSE_NS
        while received and now_ns < end_ns:
            reception.parse((received.next(),), outlet.add)
            now_ns = clock.monotonic_ns()
        if now_ns - self._counted_ns >= COUNTS_NS:
            self._counted_ns = now_ns
            outlet.add(FrontCounts(**vars(reception.counts)))  # it also finds out whether anybody is there
        outlet.flush()
        self._parse.beat(now_ns)
