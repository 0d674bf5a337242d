"""What the measuring machine itself does to a measurement: it stands still, and its clock is set.

Both are judged from readings of a :class:`~pmutools.clock.Clock`; :class:`Heartbeat` is the thread that takes them.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from pmutools.clock import Clock, UtcOffset, utc_offset

BEAT_NS = 10_000_000
STALL_NS = 50_000_000
"""A gap between two beats that is longer is a stall."""
CLOCK_LOOK_NS = 1_000_000_000
STEP_NS = 1_000_000
"""The least change of UTC that is told."""
KEPT = 1024
"""So many stalls, and steps, are kept; their counts go on."""


class Stall(NamedTuple):
    """This process was not run for ``length_ns``, from ``monotonic_ns`` or ``utc_ns`` on."""

    monotonic_ns: int
    utc_ns: int
    length_ns: int


class ClockStep(NamedTuple):
    """UTC was set by ``step_ns``, seen at ``monotonic_ns``, when it was ``utc_ns`` by the new setting."""

    monotonic_ns: int
    utc_ns: int
    step_ns: int


class HostLog:
    """Stalls and steps of the clock, from beats that should come every :data:`BEAT_NS`. Its clock is read in beats."""

    def __init__(self, clock: Clock) -> None:
        self.stalled = 0
        """Stalls so far, and how long they were together."""
        self.stalled_ns = 0
        self.stepped = 0
        """Steps so far."""
        self._clock = clock
        self._stalls: deque[Stall] = deque(maxlen=KEPT)
        self._steps: deque[ClockStep] = deque(maxlen=KEPT)
        self._news: deque[Stall | ClockStep] = deque(maxlen=KEPT)
        self.start()

    def start(self) -> None:
        """Beats begin, or begin again."""
        self._last_ns = self._clock.monotonic_ns()
        self._offset: UtcOffset = utc_offset(self._clock, 3)

    @property
    def stalls(self) -> tuple[Stall, ...]:
        """The last :data:`KEPT` of them."""
        return tuple(self._stalls)

    @property
    def steps(self) -> tuple[ClockStep, ...]:
        """The last :data:`KEPT` of them."""
        return tuple(self._steps)

    def news(self) -> Iterator[Stall | ClockStep]:
        """What has happened since this was last asked."""
        while self._news:
            yield self._news.popleft()

    def beat(self) -> None:
        """To be called every :data:`BEAT_NS`; that it is not is what is told."""
        now_ns = self._clock.monotonic_ns()
        gap_ns, self._last_ns = now_ns - self._last_ns, now_ns
        if gap_ns > STALL_NS:
            self.stalled += 1
            self.stalled_ns += gap_ns
            stall = Stall(now_ns - gap_ns, self._offset.realtime_ns(now_ns - gap_ns), gap_ns)
            self._stalls.append(stall)
            self._news.append(stall)
        if now_ns - self._offset.at_ns >= CLOCK_LOOK_NS:
            self._look_at_clock()

    def _look_at_clock(self) -> None:
        later = utc_offset(self._clock, 3)
        step_ns = self._offset.step_ns(later)
        self._offset = later
        if abs(step_ns) > STEP_NS:
            self.stepped += 1
            step = ClockStep(later.at_ns, later.realtime_ns(later.at_ns), step_ns)
            self._steps.append(step)
            self._news.append(step)


class Heartbeat:
    """A thread that beats: it stands still when the process does, and not when the process has much to do.

    What it finds is in ``log``, which may be read at any time.
    """

    def __init__(self, log: HostLog) -> None:
        self._log = log
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        log.start()
        self._thread.start()

    def stop(self) -> None:
        """Beat no more."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(BEAT_NS / 1e9):
            self._log.beat()
