"""Frames and configurations between their arrival and the tick that takes them."""

from __future__ import annotations

from collections import deque

from pmutools.c37118 import Frame
from pmutools.timebase import NS

LATEST_NS = NS
"""An arrival further from the tick than this is a clock's mistake: the frame is taken, the latency check is for it."""
FRAMES_A_TICK = 16
"""Of one PMU: a flood in its name costs the tick no more than this. A PMU sends one, after a pause some more."""
BYTES_A_TICK = 8 << 10
"""Of one PMU, and one frame more: long frames take longer to read and to log."""
WAITING = 512
"""Frames of one PMU that may wait; more are counted and gone. A second of 60 frames/s is made up for."""

CONFIGS = 4
CONFIGS_NS = 10 * NS
"""So many configurations of one PMU are taken in so long; the newest of those beyond waits, however it may flood."""
CONFIG_BYTES_A_TICK = 16 << 10
"""Of all PMUs: more wait for the next tick."""


class Waiting:
    """The queues of all PMUs, and the newest configuration of each that is not in force yet."""

    def __init__(self) -> None:
        self._queues: dict[str, deque[Frame]] = {}
        self._configs: dict[str, Frame] = {}
        self._taken: dict[str, deque[int]] = {}
        """When the last configurations were."""
        self.crowded = 0
        """Frames for which there was no room, and those of a PMU whose configuration had to wait."""
        self.overtaken = 0
        """Configurations that a newer one replaced before they were taken."""

    def add_config(self, name: str, frame: Frame) -> None:
        self.overtaken += name in self._configs
        self._configs[name] = frame

    def configs(self, now_ns: int) -> list[tuple[str, Frame]]:
        """Those to be put in force now, by PMU; ``now_ns`` is of a clock without steps."""
        ready: list[tuple[str, Frame]] = []
        left = CONFIG_BYTES_A_TICK
        for name, frame in list(self._configs.items()):
            taken = self._taken.setdefault(name, deque(maxlen=CONFIGS))
            fits = not ready or len(frame.data) <= left
            if fits and (len(taken) < CONFIGS or now_ns - taken[0] >= CONFIGS_NS):
                taken.append(now_ns)
                left -= len(frame.data)
                ready.append((name, self._configs.pop(name)))
        return ready

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
            left = BYTES_A_TICK
            while queue and len(now) < FRAMES_A_TICK and left > 0:
                frame = queue.popleft()
                if tick_ns < (frame.arrival_ns or 0) <= tick_ns + LATEST_NS:
                    later.append(frame)
                else:
                    now.append(frame)
                    left -= len(frame.data)
            queue.extendleft(reversed(later))
            if name in self._configs:  # not in force yet: by another they would be misread
                self.crowded += len(now)
            elif now:
                taken[name] = now
        return taken

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))
