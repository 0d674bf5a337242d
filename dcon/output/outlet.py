"""What an output process drives, given the datagrams that have come and the time. No clock, no socket.

- The newest command (``DCN1``) that is whole and newer than the last counts. What is malformed or old is counted, and
  is no sign of life.
- A command without the flag CLOSED, which only the watchdog sets, is 0 V.
- When no command has come for ``hold``, the output goes to 0 V, and is told so again each ``hold``. Whoever commands
  next may begin its sequence anew.
- What had queued while this process did not run is of unknown age: it is counted and not driven.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from dcon.drivers.driver import bounded_v
from dcon.link.command import CLOSED, decode
from dcon.link.sealed import follows


class Drive(NamedTuple):
    """What to drive, and whose wish it is."""

    output_v: float
    sequence: int | None = None
    """Of the command; None where nobody commands."""
    time_ns: int = 0


class Outlet:
    """The output's memory: which command came last, and when."""

    def __init__(self, hold_ns: int, now_ns: int) -> None:
        """``now_ns`` and every later time are of one clock without steps."""
        self.hold_ns = hold_ns
        self.commands = 0
        """Those that were taken."""
        self.refused: Counter[str] = Counter()
        """Datagrams that were not, by reason: ``malformed``, ``old``, ``slept``; ``not a number`` was driven as 0 V."""
        self.holds = 0
        """How often the output went to 0 V by itself."""
        self.held = True
        self._sequence: int | None = None
        self._heard_ns = self._told_ns = self._turn_ns = now_ns

    @property
    def due_ns(self) -> int:
        """When :meth:`turn` must be called next, with or without datagrams."""
        return (self._told_ns if self.held else self._heard_ns) + self.hold_ns

    def turn(self, datagrams: Iterable[bytes], now_ns: int) -> Drive | None:
        """What to drive now; None is "no change". ``datagrams`` in the order of their arrival."""
        slept = now_ns - self._turn_ns > self.hold_ns
        self._turn_ns = now_ns
        newest: Drive | None = None
        for datagram in datagrams:
            command = decode(datagram)
            if command is None:
                self.refused["malformed"] += 1
            elif slept:
                self.refused["slept"] += 1
            elif self._sequence is not None and not follows(command.sequence, self._sequence):
                self.refused["old"] += 1
            else:
                self.commands += 1
                self._sequence = command.sequence
                self.refused["not a number"] += not math.isfinite(command.output_v)
                output_v = bounded_v(command.output_v) if command.flags & CLOSED else 0.0
                newest = Drive(output_v, command.sequence, command.time_ns)
        if newest is not None:
            self.held, self._heard_ns = False, now_ns
            return newest
        if now_ns < self.due_ns:
            return None
        self.holds += not self.held
        self.held, self._sequence, self._told_ns = True, None, now_ns
        return Drive(0.0)
