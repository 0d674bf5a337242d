"""How the total delay of the loop is made up, and when the control ticks fall."""

from __future__ import annotations

from typing import NamedTuple

MS = 1_000_000
PMU_MS, NETWORK_MS, CONTROL_MS, COMMAND_MS = 44, 16, 11, 11
"""Table I's means; together 82 ms."""


class Delays(NamedTuple):
    """Parts of the delay from a stamp to the effect of the command that uses it, in ns."""

    arrival_ns: int
    """Stamp to arrival: PMU and network."""
    control_ns: int
    """Arrival to the tick that uses the frame."""
    command_ns: int

    @property
    def total_ns(self) -> int:
        return self.arrival_ns + self.control_ns + self.command_ns

    @property
    def phase_ns(self) -> int:
        """Of the ticks against the stamps: a tick comes this long after the stamp that it uses."""
        return self.arrival_ns + self.control_ns


def split(total_ms: float) -> Delays:
    """Share ``total_ms`` out as Table I does.

    What is missing from 82 ms is taken from arrival first; what is more goes to the command, since frames that arrive
    too late would disable the controller instead of delaying it.
    """
    total_ns = round(total_ms * MS)
    command_ns = min(COMMAND_MS * MS, total_ns)
    control_ns = min(CONTROL_MS * MS, total_ns - command_ns)
    arrival_ns = min((PMU_MS + NETWORK_MS) * MS, total_ns - command_ns - control_ns)
    return Delays(arrival_ns, control_ns, total_ns - arrival_ns - control_ns)
