"""The course of a run from its ``intervals.jsonl``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pmutools.timebase import parse_utc

MOST_BYTES = 32 << 20
"""A longer file, of a long run of many streams, would take too long to read."""


def read_intervals(path: Path) -> list[tuple[int, Mapping[str, Any]]]:
    """(UTC ns of its end, ``all``) of each line; nothing where there is no such file, or it is too long."""
    if not path.exists() or path.stat().st_size > MOST_BYTES:
        return []
    with path.open(encoding="utf-8") as lines:
        told = [json.loads(line) for line in lines]
    return [(parse_utc(each["end"]), each["all"]) for each in told]
