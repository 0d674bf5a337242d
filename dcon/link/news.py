"""What the control process is told besides frames: a JSON object a datagram, to ``control.in``, by its ``kind``.

(The watchdog's status and the output's readback have layouts of their own, in :mod:`dcon.link.beats`.) Everybody in the
run folder may write there, so what is read is held to what a log can hold: finite numbers, times, text that is UTF-8.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dcon.core.values import Order, Pdci
from dcon.link.beats import LoopName
from dcon.link.counts import COUNTS
from dcon.link.failure import Failure


class GpsLock(NamedTuple):
    """Of this machine's clock."""

    age_s: float
    """Since it last had its lock; 0 while it has."""
    source: str = ""
    """By whose word."""
    detail: str = ""


class ServerWord(NamedTuple):
    """What the server found out; None is what is not known."""

    disk_free_percent: float | None = None
    response_gain: float | None = None
    response_lag_ms: float | None = None


class LoopCounts(NamedTuple):
    """What one loop of the aides has counted."""

    loop: LoopName
    counts: Mapping[str, int]


News = GpsLock | Pdci | Order | ServerWord | LoopCounts | Failure


def encode(news: News) -> bytes:
    """The datagram. Raises ValueError for a number that is not finite, but for a schedule that is not known."""
    values = news._asdict()
    if isinstance(news, Pdci) and math.isnan(news.scheduled_mw):
        values["scheduled_mw"] = None
    return json.dumps({"kind": _NAMES[type(news)], **values}, allow_nan=False).encode()


def decode(datagram: bytes) -> News | None:
    """None for what makes no sense."""
    try:
        said = json.loads(datagram)
        return _KINDS[said["kind"]](said)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None


def _gps(said: Mapping[str, Any]) -> GpsLock:
    age_s = _number(said["age_s"])
    if age_s < 0:
        raise ValueError("a lock from the future")
    return GpsLock(age_s, _words(said.get("source", "")), _words(said.get("detail", "")))


def _pdci(said: Mapping[str, Any]) -> Pdci:
    scheduled_mw = said.get("scheduled_mw")
    return Pdci(
        _whole(said["time_ns"]),
        _number(said["power_mw"]),
        said["in_service"] is True,
        said["dcon_enabled"] is True,
        math.nan if scheduled_mw is None else _number(scheduled_mw),
    )


def _order(said: Mapping[str, Any]) -> Order:
    name, text, who, why = (_words(said.get(key, "")) for key in ("name", "text", "who", "why"))
    return Order(name, _number(said.get("value") or 0.0), text, who, why)


def _server(said: Mapping[str, Any]) -> ServerWord:
    found = (said.get(key) for key in ServerWord._fields)
    return ServerWord(*(None if value is None else _number(value) for value in found))


def _counts(said: Mapping[str, Any]) -> LoopCounts:
    counts = {name: _whole(value) for name, value in said["counts"].items() if name in COUNTS}
    return LoopCounts(LoopName(said["loop"]), counts)


def _failed(said: Mapping[str, Any]) -> Failure:
    return Failure(_words(said["reason"]), said["is_mistake"] is True)


_KINDS: Mapping[str, Callable[[Mapping[str, Any]], News]] = {
    "gps": _gps,
    "pdci": _pdci,
    "order": _order,
    "server": _server,
    "counts": _counts,
    "failed": _failed,
}
_NAMES: Mapping[type[News], str] = {
    GpsLock: "gps",
    Pdci: "pdci",
    Order: "order",
    ServerWord: "server",
    LoopCounts: "counts",
    Failure: "failed",
}


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is no number")
    return float(value)


def _words(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    value.encode()
    return value


def _whole(value: object) -> int:
    """A count, or POSIX UTC in nanoseconds."""
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise ValueError(f"{value!r} is no count, and no time")
    return value
