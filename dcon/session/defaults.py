"""Defaults that have changed: a log is replayed with those that it was recorded under."""

from __future__ import annotations

from collections.abc import Mapping

KEY = "defaults"
"""Of a log's metadata: the number of the defaults in force; 1 where a log has none."""
NUMBER = 3
"""Of those in force now."""
CHANGED = ((2, "pdci.status_age_s=10"), (3, "pdci.required=no"))
"""(number of the defaults that brought another, what held before)."""


def former(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """What held, as ``SECTION.KEY=VALUE``, where a session was recorded and its file does not say otherwise."""
    said = metadata.get(KEY, "1")
    number = int(said) if said.isdecimal() else 1
    return tuple(default for changed, default in CHANGED if number < changed)
