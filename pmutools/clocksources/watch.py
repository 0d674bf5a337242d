"""All sources together: asked once, or again and again in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

from pmutools.clock import Clock, SystemClock, utc_offset
from pmutools.clocksources.asking import NoAnswer, Patience, find
from pmutools.clocksources.chrony import CHRONYD, Chronyd, ask_chrony
from pmutools.clocksources.gpsd import GPSD, Gpsd, ask_gpsd
from pmutools.clocksources.kernel import ask_kernel
from pmutools.clocksources.ptp import ask_ptp
from pmutools.measure.clockquality import ClockLog, ClockQuality

PERIOD_S = 10.0
ROUND_S = 8.0
"""All sources together take no longer; each has its own limit, of 2 or 3 s."""
LEAVE_S = 1.0
"""How long closing waits for a question that is on its way; a thread that is stuck in the kernel is left behind."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where to ask, where that is not where it always is."""

    chronyd: Chronyd = CHRONYD
    gpsd: Gpsd = GPSD
    ptp4l: str | None = None
    """Path of its socket."""


HERE = Places()
Question = Callable[[Patience], Any]


class ClockSources:
    """Asks every source there is. Programs are looked for once, when this is made."""

    def __init__(self, places: Places = HERE) -> None:
        self.questions: dict[str, Question] = {
            "kernel": lambda patience: ask_kernel(),
            "chrony": _by("chronyc", lambda path, patience: ask_chrony(path, places.chronyd, patience)),
            "ptp": _by("pmc", lambda path, patience: ask_ptp(path, places.ptp4l, patience)),
            "gps": lambda patience: ask_gpsd(places.gpsd, patience),
        }
        """By field of :class:`~pmutools.measure.clockquality.ClockQuality`; the quickest to answer first."""
        self.silent: dict[str, str] = {}
        """Why a source says nothing, as of its last answer."""

    def ask(
        self,
        before: ClockQuality | None = None,
        stopped: threading.Event | None = None,
        tell: Callable[[ClockQuality], None] = lambda quality: None,
    ) -> ClockQuality:
        """All answers; ``tell`` hears of each as it comes, beside those of ``before``."""
        quality, patience = before or ClockQuality(), Patience(ROUND_S, stopped)
        for name in self.questions:
            quality = self.ask_one(name, quality, patience)
            tell(quality)
        return quality

    def ask_one(self, name: str, quality: ClockQuality, patience: Patience) -> ClockQuality:
        """``quality`` with the answer of one source put in; without it where that gives none."""
        try:
            answer = self.questions[name](patience)
            self.silent.pop(name, None)
        except NoAnswer as error:
            answer = None
            self.silent[name] = str(error)
        return replace(quality, **{name: answer})


def _by(program: str, question: Callable[[str, Patience], Any]) -> Question:
    path = find(program)

    def ask(patience: Patience) -> Any:
        if path is None:
            raise NoAnswer(f"{program} is not installed")
        return question(path, patience)

    return ask


class ClockWatch:
    """Asks all sources at once and then every ``period_s``, in a thread; nobody waits for it.

    :attr:`quality` is the last word at any time, from the kernel's on. ``with`` or :meth:`close` ends the thread,
    within :data:`LEAVE_S`. Memory is constant. A round takes some 2 ms of processor time, of which other
    threads may have to wait for a part. Who runs under SCHED_FIFO makes it before asking for that: threads made later
    inherit it, and so does what they start.
    """

    def __init__(self, places: Places = HERE, *, period_s: float = PERIOD_S, clock: Clock | None = None) -> None:
        self._sources = ClockSources(places)
        self._clock, self._period_s = clock or SystemClock(), period_s
        self._stopped, self._lock = threading.Event(), threading.Lock()
        self._quality = self._sources.ask_one("kernel", ClockQuality(), Patience(0))
        self._log = ClockLog(self._quality)
        self._thread = threading.Thread(target=self._run, name="clock-watch", daemon=True)
        self._thread.start()

    def __enter__(self) -> ClockWatch:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def quality(self) -> ClockQuality:
        """What was said last."""
        return self._quality

    @property
    def silent(self) -> dict[str, str]:
        """Why a source says nothing."""
        return dict(self._sources.silent)

    def log(self) -> ClockLog:
        """The course of it so far: one sample a round, and the times that the clock was set.

        Before the first round is over, the sample is what is known.
        """
        with self._lock:
            log = replace(self._log)
        if not log.samples:
            log.add(self._quality)
        return log

    def close(self) -> None:
        self._stopped.set()
        self._thread.join(LEAVE_S)

    def _run(self) -> None:
        before = utc_offset(self._clock)
        while not self._stopped.is_set():
            quality = self._sources.ask(self._quality, self._stopped, self._tell)
            if self._stopped.is_set():  # not all were asked
                return
            now = utc_offset(self._clock)
            with self._lock:
                self._log.add(quality)
                if step_ns := before.step_ns(now):
                    self._log.stepped(step_ns)
            before = now
            self._stopped.wait(self._period_s)

    def _tell(self, quality: ClockQuality) -> None:
        if not self._stopped.is_set():
            self._quality = quality
