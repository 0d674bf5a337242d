"""The course of a run from its ``intervals.jsonl``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pmutools.timebase import parse_utc

MOST_BYTES = 32 << 20
"""A longer file, of a long run of many streams, would take too long to read."""


def too_long(path: Path) -> str:
    """Why a file is left out of the report, as a line of its news; empty where it is not."""
    if not path.exists() or (nbytes := path.stat().st_size) <= MOST_BYTES:
        return ""
    return f"{path.name} is not shown here: it has {nbytes >> 20} MiB, more than the {MOST_BYTES >> 20} of a report"


def read_intervals(path: Path) -> list[tuple[int, Mapping[str, Any]]]:
    """(UTC ns of its end, ``all``) of each line; nothing where there is no such file, or it is :func:`too_long`."""
    if not path.exists() or too_long(path):
        return []
    with path.open(encoding="utf-8") as lines:
        told = [json.loads(line) for line in lines]
    return [(parse_utc(each["end"]), each["all"]) for each in told]
