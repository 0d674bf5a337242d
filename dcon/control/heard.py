"""What the control process is told besides frames, and what its ticks make of it: functions of news and time only.

News come as datagrams to ``control.in``. The newest of each kind counts, and for how long is decided here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from dcon.core.values import Order, Pdci, Surroundings
from dcon.link.beats import LoopName, Readback, WatchdogState, WatchdogStatus, decode_readback, decode_status
from dcon.link.counts import total
from dcon.link.failure import Failure
from dcon.link.news import GpsLock, LoopCounts, ServerWord, decode
from dcon.session.codec import Watchdog

GPS_NS = 3_000_000_000
"""A lock that nobody has spoken of for so long is getting old."""
HELPERS = {
    LoopName.UDP: "front",
    LoopName.PARSE: "front",
    LoopName.GPS: "aides",
    LoopName.GUI: "aides",
    LoopName.PDCI: "aides",
}
"""Loops of the control process's children, and whose each is."""
BEATING_MS = 250.0
"""Those of an earlier life are older: a process is started again after so long, and takes its time."""
SERVER_NS = 3_000_000_000
"""What the server has found out is not told any longer once it has been silent for so long."""
NOTHING_FOUND: Final = ServerWord()


class Heard(NamedTuple):
    """The newest of every kind, each with the monotonic time at which it was heard."""

    started_ns: int
    """When this began to listen."""
    patience_ns: int = 100_000_000
    """A watchdog that has said nothing for so long is not healthy."""
    gps_age_s: float | None = None
    gps_ns: int = 0
    status: WatchdogStatus | None = None
    """Stamped by its sender's CLOCK_MONOTONIC, which is this process's too; so is ``readback``."""
    readback: Readback | None = None
    pdci: Pdci | None = None
    server: ServerWord = NOTHING_FOUND
    server_ns: int | None = None
    """None before the server has said anything."""
    ignored: int = 0
    """Datagrams that say nothing which is known here."""
    failed: Failure | None = None
    """The aides have ended, by their own word."""
    counts: Mapping[str, Mapping[str, int]] = MappingProxyType({})
    """What each loop of the aides has counted."""


class Said(NamedTuple):
    """What one datagram changes."""

    heard: Heard
    order: Order | None = None


def hear(heard: Heard, datagram: bytes, now_ns: int) -> Said:
    """What is known after a datagram that was taken at ``now_ns`` (monotonic). Never raises: what makes no sense is
    counted."""
    if (status := decode_status(datagram)) is not None:
        return Said(heard._replace(status=status))
    if (readback := decode_readback(datagram)) is not None and math.isfinite(readback.volts):
        return Said(heard._replace(readback=readback))
    match decode(datagram):
        case Order() as order:
            return Said(heard, order)
        case GpsLock() as lock:
            return Said(heard._replace(gps_age_s=lock.age_s, gps_ns=now_ns))
        case Pdci() as line:
            return Said(heard._replace(pdci=line))
        case ServerWord() as word:
            return Said(heard._replace(server=word, server_ns=now_ns))
        case LoopCounts(loop, counts):
            return Said(heard._replace(counts={**heard.counts, loop: counts}))
        case Failure() as failure:
            return Said(heard._replace(failed=failure))
    return Said(heard._replace(ignored=heard.ignored + 1))


def counted(heard: Heard) -> dict[str, int]:
    """All that was counted of the news, and by who tells them."""
    return total({"news_ignored": heard.ignored}, *heard.counts.values())


def surroundings(heard: Heard, now_ns: int, sent_ns: int) -> Surroundings:
    """What a tick that begins at ``now_ns`` is told, the last command having left at ``sent_ns`` (monotonic).

    A readback counts only where it was taken after that: an older one answers an older command.
    """
    readback, status = heard.readback, heard.status
    silent_ns = max(now_ns - (heard.started_ns if heard.server_ns is None else heard.server_ns), 0)
    server = heard.server if silent_ns <= SERVER_NS else NOTHING_FOUND
    return Surroundings(
        gps_age_s=_gps_age_s(heard, now_ns),
        watchdog_healthy=is_healthy(heard, now_ns),
        estop_released=None if status is None else status.estop_released,
        pdci=heard.pdci,
        readback_v=None if readback is None or readback.monotonic_ns < sent_ns else readback.volts,
        response_gain=server.response_gain,
        response_lag_ms=server.response_lag_ms,
        server_age_s=silent_ns / 1e9,
        disk_free_percent=server.disk_free_percent,
        relays_closed=None if status is None or is_silent(heard, now_ns) else status.closed,
    )


def watchdog_of(heard: Heard, time_ns: int, now_ns: int) -> Watchdog | None:
    """The watchdog's state for the log, as known at ``time_ns`` (POSIX UTC), which is ``now_ns`` (monotonic); None
    before it has said anything."""
    status = heard.status
    if status is None:
        return None
    latched = status.state is WatchdogState.TRIPPED
    silent = is_silent(heard, now_ns)
    return Watchdog(
        time_ns, status.closed, not status.estop_released, latched, " ".join(status.causes), status.beats_ms, silent
    )


def is_silent(heard: Heard, now_ns: int) -> bool:
    """Whether the watchdog has said nothing for longer than it may."""
    return heard.status is None or now_ns - heard.status.monotonic_ns > heard.patience_ns


def is_healthy(heard: Heard, now_ns: int) -> bool:
    """Whether the watchdog lives, has not tripped, and would close its relays."""
    status = heard.status
    if status is None or is_silent(heard, now_ns):
        return False
    return status.healthy and status.state is not WatchdogState.TRIPPED


def is_there(heard: Heard, now_ns: int) -> bool:
    """Whether there is nothing to wait for: the watchdog is healthy, or has tripped, which only an operator ends, and
    front and aides have beaten: they could start."""
    status = heard.status
    if status is None or status.state is not WatchdogState.TRIPPED:
        return is_healthy(heard, now_ns)
    beats_ms = dict(status.beats_ms)
    return all(beats_ms.get(loop, math.inf) < BEATING_MS for loop in HELPERS)


def _gps_age_s(heard: Heard, now_ns: int) -> float | None:
    if heard.gps_age_s is None:
        return None
    silent_ns = now_ns - heard.gps_ns
    return heard.gps_age_s + (silent_ns / 1e9 if silent_ns > GPS_NS else 0.0)
