"""The control loop's sockets and log where it has no other process to leave them to."""

from __future__ import annotations

from collections.abc import Sequence

from dcon.control.ports import Ends, Nowhere
from dcon.drivers.udp_command import UdpCommandDriver
from dcon.front.receiving import Reception
from dcon.link.crossing import Item
from dcon.session.head import Head
from dcon.session.parts import free_path
from dcon.session.rolling import RollingWriter
from dcon.settings import Settings
from pmutools.clock import Clock

COARSE_NS = 1_200_000
"""Selectors wait in whole milliseconds: the last stretch before a deadline is slept exactly."""


class OwnFrames:
    """Receives and parses until shortly before the deadline, waits for it exactly, and takes what has come."""

    def __init__(self, reception: Reception, clock: Clock) -> None:
        self._reception, self._clock = reception, clock
        self.counts = reception.counts
        self._items: list[Item] = []

    def wait(self, deadline_ns: int) -> None:
        clock, reception = self._clock, self._reception
        while (left_ns := deadline_ns - clock.monotonic_ns()) > 2 * COARSE_NS:
            reception.parse(reception.receive(left_ns - COARSE_NS), self._items.append)
        clock.sleep_until(deadline_ns)

    def take(self) -> Sequence[Item]:
        self._reception.parse(self._reception.receive(0), self._items.append)
        items, self._items = self._items, []
        return items

    def close(self) -> None:
        self._reception.close()


def own_ends(settings: Settings, clock: Clock, log_path: str) -> Ends:
    """All in this process. A log that is there already stays: the session's is NAME-2, NAME-3, ... beside it.

    Raises SourceError where a port cannot be bound or a host is unknown.
    """
    command = Nowhere() if settings.output.url is None else UdpCommandDriver(settings.output.url)
    try:
        reception = Reception.of([site.endpoint for site in settings.sites], clock)
    except BaseException:
        command.close()
        raise
    limits = settings.log

    def open_log(head: Head) -> RollingWriter:
        return RollingWriter(free_path(log_path), head, max_mb=limits.max_mb, max_minutes=limits.max_minutes)

    return Ends(OwnFrames(reception, clock), open_log, command)
