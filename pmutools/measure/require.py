"""Limits on a summary: ``delay_p99<=90ms,loss<=0.1%,availability>=99.9%`` to verdicts.

A limit holds for every stream, or for all together where it is written ``all.loss<=1%``, or for those whose name a
pattern fits: ``N*.delay_p99<=90ms``. What was not measured does not hold.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from pmutools.errors import SettingsError
from pmutools.measure.histogram import PERCENTILES
from pmutools.parsers import suggestion

Read = Callable[[Mapping[str, Any]], float | None]


class Metric(NamedTuple):
    """Something that can be limited: how it is read from a stream's summary, and its unit: ms, s, share or count."""

    read: Read
    unit: str
    what: str
    of_losses: bool = False
    """Own drops of this host spoil it: they cannot be told from losses of the network."""


def _share(part: str, of: str) -> Read:
    def read(stream: Mapping[str, Any]) -> float | None:
        return stream[part] / stream[of] if stream.get(of) else None

    return read


def _at(*path: str) -> Read:
    def read(stream: Mapping[str, Any]) -> float | None:
        found: Any = stream
        for key in path:
            found = found.get(key) if isinstance(found, Mapping) else None
        return found if isinstance(found, int | float) else None

    return read


def _window(key: str) -> Read:
    def read(stream: Mapping[str, Any]) -> float | None:
        windows = stream.get("per_window") or {}
        total = sum(windows.values())
        return windows[key] / total if total else None

    return read


def _distributions() -> dict[str, Metric]:
    found = {}
    for name, what in (
        ("delay", "stamp-to-arrival delay"),
        ("delay_locked", "... of synchronised frames"),
        ("pdv", "delay above its floor"),
        ("ipdv", "change of delay from slot to slot"),
        ("interarrival", "time between arrivals"),
    ):
        for key in ("mean", "sd", "min", *PERCENTILES, "max"):
            found[f"{name}_{key}"] = Metric(_at(f"{name}_ms", key), "ms", f"{what}: {key}")
    for key in PERCENTILES:
        read = _at("delay_ms", f"{key}_expected")
        what = f"stamp-to-arrival delay: {key}, lost frames as infinite"
        found[f"delay_{key}_expected"] = Metric(read, "ms", what, of_losses=True)
    return found


METRICS: dict[str, Metric] = {
    **_distributions(),
    "jitter": Metric(_at("jitter_rfc3550_ms"), "ms", "RFC 3550 jitter at the end"),
    "uncertainty": Metric(_at("uncertainty_ms"), "ms", "uncertainty of a delay"),
    "loss": Metric(_share("lost", "expected"), "share", "lost / expected", of_losses=True),
    "late": Metric(_share("late", "received"), "share", "after the wait / received"),
    "duplicates": Metric(_share("duplicated", "received"), "share", "extra copies / received"),
    "reordered": Metric(_share("reordered", "received"), "share", "reordered / received"),
    "off_grid": Metric(_share("off_grid", "received"), "share", "stamps off the reporting instants / received"),
    "availability": Metric(_at("quality", "availability"), "share", "received / expected", of_losses=True),
    "completeness": Metric(_at("quality", "completeness"), "share", "usable frames / expected", of_losses=True),
    "empty_windows": Metric(_window("0"), "share", "control windows without a frame", of_losses=True),
    "longest_loss": Metric(_at("loss_runs", "max"), "count", "longest run of lost frames", of_losses=True),
    "corrupt": Metric(_at("corrupt"), "count", "frames whose CHK is wrong"),
    "conflicting": Metric(_at("conflicting"), "count", "copies that differ"),
    "stale": Metric(_at("stale"), "count", "stale frames"),
    "own_drops": Metric(_at("own_drops"), "count", "datagrams this host dropped"),
    "expected": Metric(_at("expected"), "count", "frames expected"),
    "received": Metric(_at("received"), "count", "unique frames", of_losses=True),
    "silent": Metric(_at("silent_s"), "s", "silence after the last frame"),
}
_UNITS = {
    "ms": {"ms": 1.0, "us": 1e-3, "µs": 1e-3, "s": 1e3},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "share": {"%": 0.01, "": 1.0, "ppm": 1e-6},
    "count": {"": 1.0},
}
_COMPARE: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_FORM = re.compile(
    r"(?:(?P<scope>.+)\.)?(?P<name>[A-Za-z0-9_]+)\s*(?P<op><=|>=|<|>)\s*(?P<value>[-+0-9.eE]+)\s*(?P<unit>\S*)"
)


@dataclass(frozen=True, slots=True)
class Requirement:
    """One limit; ``limit`` in the metric's own unit, ``scope`` a pattern of stream names, ``all``, or empty."""

    text: str
    scope: str
    name: str
    op: str
    limit: float

    def holds(self, value: float | None) -> bool:
        """What was not measured does not hold."""
        return value is not None and _COMPARE[self.op](value, self.limit)


class Verdict(NamedTuple):
    """Whether a limit holds for a stream."""

    requirement: Requirement
    stream: str
    value: float | None
    holds: bool
    note: str = ""

    def __str__(self) -> str:
        unit = METRICS[self.requirement.name].unit
        if self.value is None:
            told = self.note or "not measured"
        elif unit == "share":
            told = f"{self.value:.4%}"
        else:
            told = f"{self.value:.6g}{'' if unit == 'count' else f' {unit}'}"
        return f"{'ok  ' if self.holds else 'FAIL'} {self.stream}: {self.requirement.text} ({told})"


def parse_requirements(text: str) -> tuple[Requirement, ...]:
    """Limits from a comma list. Raises SettingsError that says what to write instead."""
    items = [item.strip() for item in text.split(",")]
    if not all(items):
        raise SettingsError("--require: an empty limit; write METRIC<=VALUE, as in delay_p99<=90ms,loss<=0.1%")
    return tuple(_requirement(item) for item in items)


def _requirement(item: str) -> Requirement:
    match = _FORM.fullmatch(item)
    if match is None:
        remedy = "write METRIC, one of <= >= < >, and a value with its unit, as in delay_p99<=90ms"
        raise SettingsError(f"--require: {item!r} is no limit; {remedy}")
    name, unit = match["name"].lower(), match["unit"]
    if (metric := METRICS.get(name)) is None:
        raise SettingsError(f"--require: {item!r}: {name!r} is nothing that is measured; {_nearest(name)}")
    try:
        value = float(match["value"])
    except ValueError:
        raise SettingsError(f"--require: {item!r}: {match['value']!r} is not a number") from None
    units = _UNITS[metric.unit]
    if unit not in units:
        known = " or ".join(known or "no unit" for known in units)
        raise SettingsError(f"--require: {item!r}: {name} is told in {known}, not {unit or 'without a unit'!r}")
    limit = value * units[unit]
    if not math.isfinite(limit) or (metric.unit == "share" and not 0 <= limit <= 1):
        remedy = (
            f"; did you mean {match['value']}%?" if metric.unit == "share" and not unit and 1 < value <= 100 else ""
        )
        raise SettingsError(f"--require: {item!r}: {match['value']}{unit} is no {metric.unit}{remedy}")
    return Requirement(item, (match["scope"] or "").strip(), name, match["op"], limit)


def _nearest(name: str) -> str:
    told = suggestion(name, METRICS)
    if told.startswith("did you"):
        return told
    return "known: delay_p99, pdv_p99, loss, availability, completeness, ... (docs/metrics.md has all)"


def verdicts(requirements: Sequence[Requirement], summary: Mapping[str, Any]) -> list[Verdict]:
    """Every limit on every stream it concerns; one that concerns no stream does not hold."""
    found = []
    for requirement in requirements:
        metric = METRICS[requirement.name]
        concerned = [
            (stream["name"], stream)
            for stream in summary["streams"]
            if not requirement.scope or fnmatchcase(stream["name"].casefold(), requirement.scope.casefold())
        ]
        if not concerned and requirement.scope == "all":
            concerned = [("all", summary["all"])]
        if not concerned:
            names = [stream["name"] for stream in summary["streams"]]
            note = f"no such stream; {suggestion(requirement.scope, [*names, 'all'])}" if names else "no stream came"
            found.append(Verdict(requirement, requirement.scope or "all", None, False, note))
        for name, stream in concerned:
            found.append(_verdict(requirement, metric, name, stream))
    return found


def _verdict(requirement: Requirement, metric: Metric, name: str, stream: Mapping[str, Any]) -> Verdict:
    """A limit that fails where this host dropped frames was not measured: the network alone may well keep it."""
    value = metric.read(stream)
    holds, own = requirement.holds(value), stream.get("lost_own_at_most")
    if holds or not own or not metric.of_losses:
        return Verdict(requirement, name, value, holds)
    told = f"up to {own} of {stream['lost']} lost frames may be this host's own doing"
    return Verdict(requirement, name, None, False, f"own drops: cannot be judged; {told}")
