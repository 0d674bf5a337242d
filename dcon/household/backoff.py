"""When to start a process again that has ended: soon at first, later and later while it does not stay."""

from __future__ import annotations

from typing import NamedTuple

FIRST_S, LONGEST_S = 0.25, 8.0
STAYED_S = 10.0
"""One that ran for so long has proved that it can."""


class Backoff(NamedTuple):
    """How often it ended in a row without having stayed."""

    failures: int = 0

    def ended(self, ran_s: float) -> tuple[Backoff, float]:
        """(what is known now, seconds to wait), after it ran for ``ran_s``."""
        failures = 0 if ran_s >= STAYED_S else self.failures
        wait_s = min(FIRST_S * 2.0 ** min(failures, 16), LONGEST_S)
        return Backoff(failures + 1), wait_s
