"""What every output is to its caller."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from dcon.places import FULL_SCALE_V


class Readback(NamedTuple):
    """The output as measured, or as the device says it."""

    number: int
    """Of the call of :meth:`Driver.drive` that it answers, counted from 1. On a slow bus that is not the newest one."""
    output_v: float


class Driver(Protocol):
    """An output. What goes wrong in it is counted and told, never raised; only making one raises.

    No method waits for more than one write to a local file. ``trouble`` says what is wrong now, "" is nothing.
    """

    driven: int
    """Calls of :meth:`drive`."""
    failed: int
    """What could not be written or read back, so often."""
    reads_back: bool
    """Whether :meth:`readback` ever has something to say."""
    settle_ns: int
    """How long after :meth:`drive` it is worth asking."""

    @property
    def trouble(self) -> str: ...

    def drive(self, time_ns: int, output_v: float, flags: int = 0, /) -> None:
        """Put out ``output_v`` volts from now on, the command of the tick at ``time_ns`` (POSIX UTC)."""

    def readback(self) -> Readback | None:
        """The newest there is; None where there is none, or reading failed."""

    def close(self) -> None:
        """Leave 0 V, and let go of the device."""


def bounded_v(output_v: float) -> float:
    """Within ±10 V; 0 for what is not finite."""
    return max(-FULL_SCALE_V, min(FULL_SCALE_V, output_v)) if math.isfinite(output_v) else 0.0
