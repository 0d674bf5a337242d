"""What was measured, as rows of a table for people and for the documentation."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple

from bench.stopwatch import Rate

Group = Literal["codec", "capture", "start-up", "control", "measure", "live", "read", "player"]
BINDING: tuple[Group, ...] = ("codec", "capture", "start-up")
"""A missed budget of these groups is a failure."""
HEAD = ("what", "ours", "against", "result", "budget", "")


class Budget(NamedTuple):
    """What the result must be: at least or at most ``value``."""

    bound: Literal["at least", "at most"]
    value: float

    def met(self, result: float) -> bool:
        return result >= self.value if self.bound == "at least" else result <= self.value


@dataclass(frozen=True)
class Row:
    """One comparison; ``result`` is in ``unit`` and is held to ``budget``."""

    group: Group
    what: str
    ours: str
    against: str
    result: float
    unit: str
    budget: Budget | None = None

    @property
    def missed(self) -> bool:
        return self.budget is not None and not self.budget.met(self.result)

    @property
    def cells(self) -> tuple[str, ...]:
        budget, verdict = "", ""
        if self.budget is not None:
            budget = f"{self.budget.bound} {_number(self.budget.value)}{self.unit}"
            verdict = "missed" if self.missed else "met"
        return self.what, self.ours, self.against, f"{_number(self.result)}{self.unit}", budget, verdict


def faster(group: Group, what: str, ours: Rate, name: str, theirs: Rate, at_least: float | None = None) -> Row:
    """How many times as fast as another program."""
    budget = None if at_least is None else Budget("at least", at_least)
    return Row(group, what, per_s(ours), f"{name}: {per_s(theirs)}", ours.over(theirs), "x", budget)


def within(group: Group, what: str, ours: Rate, name: str, limit: Rate, at_most: float | None = None) -> Row:
    """How many times as long as what cannot be beaten."""
    budget = None if at_most is None else Budget("at most", at_most)
    return Row(group, what, per_s(ours), f"{name}: {per_s(limit)}", limit.over(ours), "x", budget)


def per_s(rate: Rate) -> str:
    """``2.41 M/s ±3 %``."""
    value, unit = rate.median, ""
    for unit in ("", " k", " M", " G"):  # noqa: B007
        if value < 1000:
            break
        value /= 1000
    return f"{_number(value)}{unit}/s ±{100 * rate.spread:.0f} %"


def _number(value: float) -> str:
    """Three digits that count, no exponent."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def text(rows: Sequence[Row]) -> str:
    """Aligned columns, a blank line between the groups."""
    lines = [HEAD, *(row.cells for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEAD))]
    aligned = [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    ]
    out = [aligned[0]]
    for before, row, line in zip([None, *rows], rows, aligned[1:], strict=False):
        if before is None or before.group != row.group:
            out += ["", f"[{row.group}]"]
        out.append(line)
    return "\n".join(out)


def markdown(rows: Sequence[Row], method: Sequence[str]) -> str:
    """The page's part: method, then one table."""
    lines = [*method, "", _line(HEAD), _line(["---"] * len(HEAD))]
    lines += [_line(cell.replace("|", "\\|") for cell in row.cells) for row in rows]
    return "\n".join(lines) + "\n"


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def machine() -> str:
    """The kind of machine, in general words."""
    virtual = " virtual" if " hypervisor" in _read("/proc/cpuinfo") else ""
    kind = f"{os.cpu_count()}-core {platform.machine().replace('_', '-')}{virtual} machine"
    return f"{kind}, {platform.system()}, Python {platform.python_version()}"


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def versions(packages: Sequence[str]) -> str:
    return ", ".join(f"{package} {version(package)}" for package in packages)


def today() -> str:
    return f"{datetime.now(UTC):%Y-%m-%d}"
