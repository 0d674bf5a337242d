"""A finished run: all that its outputs are made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pmutools.measure.compare import Difference
from pmutools.measure.completeness import Alignment
from pmutools.measure.require import Verdict
from pmutools.measure.stream import StreamResult
from pmutools.measure.timeline import Course


@dataclass(frozen=True)
class Run:
    """What was measured. ``results`` and ``courses`` are in the order of ``summary["streams"]``."""

    summary: Mapping[str, Any]
    """``summary.json``."""
    results: Sequence[StreamResult]
    courses: Sequence[Course | None]
    alignments: Sequence[Alignment] = ()
    source: str = ""
    """What was measured, as the user named it: URLs, an initialisation file, a recording."""
    begin_ns: int = 0
    """UTC, by the receiver."""
    end_ns: int = 0
    news: Sequence[tuple[int, str]] = field(default=())
    """(UTC ns, line) of what happened to connections, clock and host."""
    verdicts: Sequence[Verdict] = ()
    """Of ``--require``."""
    differences: Sequence[Difference] = ()
    """Of ``--compare``."""
    intervals: Sequence[tuple[int, Mapping[str, Any]]] = ()
    """(UTC ns of its end, :func:`~pmutools.measure.summary.interval_summary` of all streams together)."""
    compared_with: str = ""
    """What the differences are against, as the user named it."""
    command: str = ""
    """The command line that measured it."""
