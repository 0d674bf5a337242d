"""The ``gps`` loop: has whoever disciplines this machine's clock its lock?"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from dcon.aides.aide import ROUND_S, Aide
from dcon.aides.gps_lock import Lock, Verdict, judge
from dcon.link.beats import LoopName
from dcon.link.news import GpsLock
from dcon.sections import Platform
from pmutools.clocksources.asking import Patience
from pmutools.clocksources.watch import ClockSources, Places
from pmutools.measure.clockquality import ClockQuality
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
TELL_NS = NS
"""The lock is told so often, and when it changes."""
ASK_S = 1.0
"""From one question to the next."""
PATIENCE_S = 3.0


class GpsAide(Aide):
    """The lock of this machine's clock."""

    def __init__(self, platform: Platform, run_dir: Path, places: Places | None = None) -> None:
        super().__init__(LoopName.GPS, run_dir)
        self._source, self._limit_ns = platform.time_source, round(platform.time_bound_ms * 1e6)
        self._lock = Lock()
        self._sources = ClockSources(places or Places(gpsd=platform.gpsd))
        self._told: tuple[Verdict | None, bool] = None, False
        self._told_ns = 0
        self._broken: Exception | None = None
        if self._source != "none":
            threading.Thread(target=self._ask, name="gps-questions", daemon=True).start()

    def _ask(self) -> None:
        """Ask again and again; every answer is judged as it comes."""
        quality = ClockQuality()
        field = "gps" if self._source == "gpsd" else self._source
        try:
            while not self._stopped.is_set():
                if field == "auto":
                    quality = self._sources.ask(quality, self._stopped, self._judge)
                else:
                    quality = self._sources.ask_one(field, ClockQuality(), Patience(PATIENCE_S, self._stopped))
                    self._judge(quality)
                self._stopped.wait(ASK_S)
        except Exception as error:  # the edge of this thread: the loop fails of it
            self._broken = error

    def _judge(self, quality: ClockQuality) -> None:
        if not self._stopped.is_set():
            self._lock.hear(judge(self._source, quality, self._sources.silent, self._limit_ns), time.monotonic_ns())

    def round(self) -> None:
        self._stopped.wait(ROUND_S)
        if self._broken is not None:
            raise self._broken
        now_ns = time.monotonic_ns()
        verdict, age_s = self._lock.said(now_ns), self._lock.age_s(now_ns)
        if verdict is None or age_s is None:
            return
        state = verdict._replace(detail=""), age_s == 0
        if state == self._told and now_ns - self._told_ns < TELL_NS:
            return
        if state != self._told:
            level = logging.INFO if verdict.locked else logging.WARNING
            LOG.log(level, "GPS lock of the clock: %s, by %s: %s", "yes" if verdict.locked else "no", *verdict[1:])
        self._told, self._told_ns = state, now_ns
        self.tell(GpsLock(age_s, verdict.source, verdict.detail))
