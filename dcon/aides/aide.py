"""One loop of the aides: rounds, beats, and words to the control process."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from dcon.link import paths
from dcon.link.beats import LoopName, LoopState
from dcon.link.news import LoopCounts, News, encode
from dcon.link.paths import Sender
from dcon.link.pulse import Pulse
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
ROUND_S = 0.1
"""Longest wait of a loop."""
COUNTS_NS = NS
"""Counts are told so often, where they have changed."""


class Aide(threading.Thread):
    """One loop: its rounds, its beats, and its words to the control process."""

    def __init__(self, loop: LoopName, run_dir: Path) -> None:
        super().__init__(name=loop, daemon=True)
        self.loop = loop
        self._watchdog, self._control = Sender(run_dir / paths.WATCHDOG), Sender(run_dir / paths.CONTROL)
        self._pulse = Pulse(loop, self._watchdog)
        self._stopped = threading.Event()
        self.failure = ""
        """Why the loop has ended by itself."""
        self._untold = 0
        self._counted: dict[str, int] = {}
        """The counts that the control process knows."""
        self._counted_ns = 0

    def run(self) -> None:
        try:
            while not self._stopped.is_set():
                self.round()
                self._pulse.beat(time.monotonic_ns())
                self._tell_counts(time.monotonic_ns())
        except Exception as error:  # the edge of the loop: its beats stop, and the process ends
            LOG.exception("the %s loop failed", self.name)
            self.failure = f"{type(error).__name__}: {error}"
        finally:
            self._pulse.beat(time.monotonic_ns(), LoopState.FAILED if self.failure else LoopState.ENDING)
            self.release()

    def stop(self) -> None:
        """Ask for the end of the loop."""
        self._stopped.set()

    def round(self) -> None:
        """Do what there is to do, and wait for :data:`ROUND_S` at most."""
        raise NotImplementedError

    def release(self) -> None:
        """Let go of what the loop holds."""
        self._watchdog.close()
        self._control.close()

    def tell(self, news: News) -> bool:
        """To the control process; whether it was taken."""
        taken = self._control.send(encode(news))
        self._untold += not taken
        return taken

    def counts(self) -> dict[str, int]:
        """What this loop counts (:data:`dcon.link.counts.COUNTS`)."""
        return {"untold": self._untold}

    def _tell_counts(self, now_ns: int) -> None:
        if now_ns - self._counted_ns < COUNTS_NS:
            return
        self._counted_ns = now_ns
        counts = {name: value for name, value in self.counts().items() if value}
        if counts != self._counted and self.tell(LoopCounts(self.loop, counts)):
            self._counted = counts
