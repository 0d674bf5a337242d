"""Numbers, times and names as a report tells them."""

from __future__ import annotations

import math
from collections.abc import Iterable

from pmutools.measure.histogram import NS_PER_MS
from pmutools.parsers import unique
from pmutools.timebase import NS, format_utc

NONE = "–"
INFINITE = "∞"
NAME_WIDTH = 24
"""Longer names are cut in figures; tables have them whole."""
_SPANS = ((86_400, "d"), (3600, "h"), (60, "min"), (1, "s"))


def clean(text: str) -> str:
    """``text`` without what does not print: names come from the wire and may hold anything."""
    return text if text.isprintable() else "".join(letter if letter.isprintable() else "\ufffd" for letter in text)


def labels(names: Iterable[str]) -> list[str]:
    """Names short enough for an axis, no two alike."""
    return unique(shortened(name, NAME_WIDTH) for name in names)


def shortened(name: str, width: int) -> str:
    """A name without what does not print, cut to ``width`` letters."""
    cleaned = clean(name).strip() or "unnamed"
    return cleaned if len(cleaned) <= width else f"{cleaned[: width - 1]}…"


def count(value: float | None) -> str:
    """A whole number, by thousands."""
    return NONE if value is None else f"{value:,.0f}".replace("-", "−")


def milliseconds(value: float | None) -> str:
    """A figure in ms, to four digits or so: 0.42, 41.23, 213.4, 86,400,000."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return INFINITE
    digits = 2 if abs(value) < 99.995 else 1 if abs(value) < 9_999.95 else 0
    text = f"{value:,.{digits}f}"
    return (text.lstrip("-") if not float(text.replace(",", "")) else text).replace("-", "−")


def percent(share: float | None) -> str:
    """A share of 1; what is not all never reads 100 %, what is not nothing never 0 %."""
    if share is None:
        return NONE
    if share in (0, 1):
        return f"{100 * share:.0f} %"
    if share < 0.5:
        return f"{100 * share:.2g} %" if share >= 1e-6 else "<0.0001 %"
    for digits in (1, 2, 3, 4):
        if share < 1 - 0.5 * 10 ** (-digits - 2):
            return f"{100 * share:.{digits}f} %"
    return ">99.9999 %"


def span(length_ns: float) -> str:
    """A length of time by its two largest units: ``2 h 3 min``."""
    seconds = length_ns / NS
    if seconds < 60:
        return f"{seconds:.3g} s"
    left = round(seconds)
    parts: list[str] = []
    for size, unit in _SPANS:
        whole, left = divmod(left, size)
        if whole or parts:
            parts.append(f"{whole} {unit}" if whole else "")
    return " ".join(part for part in parts[:2] if part)


def lasting(length_ms: float | None) -> str:
    """A length of time with its unit: in ms, where it is no more than some seconds."""
    if length_ms is None or abs(length_ms) < 10_000:
        return NONE if length_ms is None else f"{milliseconds(length_ms)} ms"
    return ("−" if length_ms < 0 else "") + span(abs(length_ms) * NS_PER_MS)


def utc(time_ns: int | None, digits: int = 0) -> str:
    """A moment: ``2016-09-08 17:05:11 UTC``, cut to ``digits`` of a second."""
    if time_ns is None:
        return NONE
    try:
        text = format_utc(time_ns)
    except OverflowError:
        return f"{time_ns / NS:.0f} s of POSIX time"
    return f"{text[:10]} {text[11 : 20 + digits if digits else 19]} UTC"


def day_of(time_ms: float) -> str:
    """The date of a time in ms since 1970, for the title of an axis of time."""
    return utc(round(time_ms * NS_PER_MS))[:10]


def plural(number: int, one: str, many: str = "") -> str:
    """``1 stream``, ``8 streams``."""
    return f"{count(number)} {one if number == 1 else many or one + 's'}"


def listed(names: Iterable[str], most: int = 5) -> str:
    """``N1, N2 and 7 others``."""
    given = list(names)
    if len(given) <= most + 1:
        return " and ".join(part for part in (", ".join(given[:-1]), given[-1] if given else "") if part)
    return f"{', '.join(given[:most])} and {len(given) - most} others"
