"""Settings that are possible each, but not together."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pmutools.errors import SettingsError


class Clash(SettingsError):
    """``keys`` are what it is about, each ``SECTION.KEY``, or only ``KEY`` within one section; said of the first."""

    def __init__(self, problem: str, *keys: str) -> None:
        super().__init__(f"{keys[0].rpartition('.')[2]} = {problem}")
        self.problem = problem
        self.keys = keys


def check_order(values: Any, pairs: Iterable[tuple[str, str]]) -> None:
    """Raise Clash for the first of ``pairs`` of fields whose first is not below its second."""
    for low, high in pairs:
        one, other = getattr(values, low), getattr(values, high)
        if not one < other:
            raise Clash(f"{one:g}: must be below {high} = {other:g}", low, high)
