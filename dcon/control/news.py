"""What the control process is told besides frames, and what its ticks make of it: functions of news and time only.

News come as datagrams to ``control.in``. The newest of each kind counts, and for how long is decided here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from dcon.core.values import Order, Pdci, Surroundings
from dcon.link.beats import LoopName, Readback, WatchdogState, WatchdogStatus, decode_readback, decode_status
from dcon.link.counts import COUNTS, total
from dcon.link.crossing import Failure
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


class Server(NamedTuple):
    """What the server says, heard at ``heard_ns``."""

    heard_ns: int
    disk_free_percent: float | None = None
    response_gain: float | None = None
    response_lag_ms: float | None = None


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
    server: Server | None = None
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
    try:
        said = json.loads(datagram)
        return _KINDS[said["kind"]](heard, said, now_ns)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return Said(heard._replace(ignored=heard.ignored + 1))


def _gps(heard: Heard, said: Mapping[str, Any], now_ns: int) -> Said:
    age_s = _number(said["age_s"])
    if age_s < 0:
        raise ValueError("a lock from the future")
    return Said(heard._replace(gps_age_s=age_s, gps_ns=now_ns))


def _pdci(heard: Heard, said: Mapping[str, Any], _now_ns: int) -> Said:
    scheduled_mw = said.get("scheduled_mw")
    pdci = Pdci(
        _time_ns(said["time_ns"]),
        _number(said["power_mw"]),
        said["in_service"] is True,
        said["dcon_enabled"] is True,
        math.nan if scheduled_mw is None else _number(scheduled_mw),
    )
    return Said(heard._replace(pdci=pdci))


def _order(heard: Heard, said: Mapping[str, Any], _now_ns: int) -> Said:
    name, text, who, why = (said.get(key, "") for key in ("name", "text", "who", "why"))
    name, text, who, why = map(_words, (name, text, who, why))
    return Said(heard, Order(name, _number(said.get("value") or 0.0), text, who, why))


def _server(heard: Heard, said: Mapping[str, Any], now_ns: int) -> Said:
    found = [said.get(key) for key in Server._fields[1:]]
    return Said(heard._replace(server=Server(now_ns, *(None if value is None else _number(value) for value in found))))


def _counts(heard: Heard, said: Mapping[str, Any], _now_ns: int) -> Said:
    loop = LoopName(said["loop"])
    counts = {name: _count(value) for name, value in said["counts"].items() if name in COUNTS}
    return Said(heard._replace(counts={**heard.counts, loop: counts}))


def _failed(heard: Heard, said: Mapping[str, Any], _now_ns: int) -> Said:
    return Said(heard._replace(failed=Failure(_words(said["reason"]), said["is_mistake"] is True)))


_KINDS = {"gps": _gps, "pdci": _pdci, "order": _order, "server": _server, "counts": _counts, "failed": _failed}


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is no number")
    return float(value)


def _words(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    value.encode()  # JSON has halves of surrogates, which no log takes
    return value


def _count(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise ValueError(f"{value!r} is no count")
    return value


def counted(heard: Heard) -> dict[str, int]:
    """All that was counted of the news, and by who tells them."""
    return total({"news_ignored": heard.ignored}, *heard.counts.values())


def _time_ns(value: object) -> int:
    """POSIX UTC, as the log can hold it."""
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise ValueError(f"{value!r} is no time")
    return value


def surroundings(heard: Heard, now_ns: int, sent_ns: int) -> Surroundings:
    """What a tick that begins at ``now_ns`` is told, the last command having left at ``sent_ns`` (monotonic).

    A readback counts only where it was taken after that: an older one answers an older command.
    """
    readback, status = heard.readback, heard.status
    server = heard.server or Server(heard.started_ns)
    silent_ns = max(now_ns - server.heard_ns, 0)
    if silent_ns > SERVER_NS:
        server = Server(server.heard_ns)
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
