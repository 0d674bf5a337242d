"""The three things a program asks of time, as an interface: UTC, a clock without steps, and a wake-up.

Nothing below the loops reads a clock of its own, so that tests and simulations run in :class:`VirtualClock` time.
Deadlines are absolute readings of the monotonic clock; sums of sleeps would drift.
"""

from __future__ import annotations

import sys
import time
from typing import NamedTuple, Protocol

from pmutools import linux

_monotonic_ns = time.perf_counter_ns if sys.platform == "win32" else time.monotonic_ns  # 15 ms steps on Windows


class Clock(Protocol):
    def realtime_ns(self) -> int:
        """POSIX UTC; may be slewed and stepped."""

    def monotonic_ns(self) -> int:
        """Nanoseconds of a clock that is never stepped, from an arbitrary origin."""

    def sleep_until(self, deadline_ns: int, /) -> None:
        """Return when the monotonic clock reads ``deadline_ns`` or later; at once if it does so already."""


class SystemClock:
    """The machine's clocks.

    ``spin_ns`` is how long before a deadline sleeping gives way to a busy wait: it takes the wake-up error from some
    50 µs to below 1 µs at the price of a core for that time. Keep it short (200 µs): under SCHED_FIFO nobody else has
    that core meanwhile, and the kernel's limit of 95 % ends a long one. ``native=False`` takes the portable sleep.
    """

    def __init__(self, *, spin_ns: int = 0, native: bool = linux.NATIVE) -> None:
        self.spin_ns = spin_ns
        self._sleep_until = linux.sleep_until if native else _portable_sleep_until

    def realtime_ns(self) -> int:
        return time.time_ns()

    def monotonic_ns(self) -> int:
        return _monotonic_ns()

    def sleep_until(self, deadline_ns: int, /) -> None:
        if deadline_ns - self.spin_ns > _monotonic_ns():
            self._sleep_until(deadline_ns - self.spin_ns)
        while _monotonic_ns() < deadline_ns:  # at most spin_ns, and what the sleep returned early
            pass


def _portable_sleep_until(deadline_ns: int) -> None:
    while (left_ns := deadline_ns - _monotonic_ns()) > 0:
        time.sleep(left_ns / 1e9)


class VirtualClock:
    """Time that passes only when someone sleeps (it jumps to the deadline) or a test moves it."""

    def __init__(self, realtime_ns: int = 1_700_000_000_000_000_000, monotonic_ns: int = 0) -> None:
        self._monotonic_ns = monotonic_ns
        self._offset_ns = realtime_ns - monotonic_ns

    def realtime_ns(self) -> int:
        return self._monotonic_ns + self._offset_ns

    def monotonic_ns(self) -> int:
        return self._monotonic_ns

    def sleep_until(self, deadline_ns: int, /) -> None:
        self._monotonic_ns = max(self._monotonic_ns, deadline_ns)

    def advance(self, by_ns: int) -> None:
        """Let ``by_ns`` (>= 0) pass."""
        if by_ns < 0:
            raise ValueError(f"time does not run backwards ({by_ns} ns)")
        self._monotonic_ns += by_ns

    def step(self, by_ns: int) -> None:
        """Set UTC forward or back, as an operator or a time server would; the monotonic clock stays."""
        self._offset_ns += by_ns


class UtcOffset(NamedTuple):
    """UTC minus monotonic time, known to ± ``bracket_ns / 2``, when the monotonic clock read ``at_ns``."""

    offset_ns: int
    bracket_ns: int
    at_ns: int

    def monotonic_ns(self, realtime_ns: int) -> int:
        """The monotonic reading at which UTC is ``realtime_ns``, as long as UTC is not stepped."""
        return realtime_ns - self.offset_ns

    def realtime_ns(self, monotonic_ns: int) -> int:
        return monotonic_ns + self.offset_ns

    def step_ns(self, later: UtcOffset) -> int:
        """By how much UTC was stepped between two readings; 0 within what the brackets cannot tell apart.

        Both clocks are slewed alike, so their offset changes by steps (and leap seconds) only.
        """
        moved_ns = later.offset_ns - self.offset_ns
        return moved_ns if abs(moved_ns) > (self.bracket_ns + later.bracket_ns) // 2 else 0


def utc_offset(clock: Clock, tries: int = 9) -> UtcOffset:
    """Read UTC between two monotonic readings, several times, and keep the tightest."""
    best: UtcOffset | None = None
    for _ in range(tries):
        before = clock.monotonic_ns()
        utc = clock.realtime_ns()
        after = clock.monotonic_ns()
        if best is None or after - before < best.bracket_ns:
            best = UtcOffset(utc - (before + after) // 2, after - before, after)
    assert best is not None
    return best
