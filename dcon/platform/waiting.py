"""Frames between their arrival and the tick that takes them."""

from __future__ import annotations

from collections import deque

from pmutools.c37118 import Frame
from pmutools.timebase import NS

LATEST_NS = NS
"""An arrival further from the tick than this is a clock's mistake: the frame is taken, the latency check is for it."""
FRAMES_A_TICK = 16
"""Of one PMU: a flood in its name costs the tick no more than this. A PMU sends one, after a pause some more."""
WAITING = 512
"""Frames of one PMU that may wait; more are counted and gone. A second of 60 frames/s is made up for."""


class Waiting:
    """The queues of all PMUs."""

    def __init__(self) -> None:
        self._queues: dict[str, deque[Frame]] = {}
        self.crowded = 0
        """Frames for which there was no room."""

    def add(self, name: str, frame: Frame) -> None:
        queue = self._queues.setdefault(name, deque())
        if len(queue) >= WAITING:
            self.crowded += 1
            return
        queue.append(frame)

    def take(self, tick_ns: int) -> dict[str, list[Frame]]:
        """Those for the tick at ``tick_ns``, by PMU, in order of arrival here; what came after it waits."""
        taken: dict[str, list[Frame]] = {}
        for name, queue in self._queues.items():
            later: list[Frame] = []
            now: list[Frame] = []
            while queue and len(now) < FRAMES_A_TICK:
                frame = queue.popleft()
                (later if tick_ns < (frame.arrival_ns or 0) <= tick_ns + LATEST_NS else now).append(frame)
            queue.extendleft(reversed(later))
            if now:
                taken[name] = now
        return taken

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))
