"""All that is written while a run is on: samples, intervals, and the summary so far.

What the system refuses to write costs that output, never the measurement: it is taken down, and the rest goes on.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pmutools.errors import SourceError
from pmutools.formats import JOURNAL
from pmutools.formats.output import OutputFile
from pmutools.timebase import NS
from pmutools.tools.characterizer.chores import Chores
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.folder import Folder
from pmutools.tools.characterizer.intervals import Intervals
from pmutools.tools.characterizer.names import INTERVALS, SAMPLES, SUMMARY
from pmutools.tools.characterizer.samples import Samples
from pmutools.tools.characterizer.summaries import checkpoint

FLUSH_NS = NS
"""What a run that is killed can lose of its files; of more than 16 streams also what is gathered of each."""
CHECKPOINT_NS = 10 * NS
"""How often the summary is written meanwhile; with shorter intervals, at each of them."""
CHECKPOINT_SHARE = 20
"""Checkpoints take at most one part in so many of the time."""


class Recorder:
    """Writes into ``folder`` what ``engine`` measures.

    ``interval_ns`` None: no intervals. ``live`` says whether they end by the clock or in the recording. ``run`` gives
    ``run`` of the summary at a UTC time. ``monotonic_ns`` is asked for the time.
    """

    def __init__(
        self,
        engine: Engine,
        folder: Folder,
        run: Callable[[int], Mapping[str, Any]],
        monotonic_ns: Callable[[], int],
        *,
        samples: bool = True,
        interval_ns: int | None = None,
        live: bool = True,
    ) -> None:
        self.failures: list[str] = []
        """Outputs that could not be written, and why."""
        self.samples: Samples | None = None
        self._engine, self._folder, self._run, self._now_ns = engine, folder, run, monotonic_ns
        self._chores = Chores(monotonic_ns)
        self._live = live
        self._lines: OutputFile | None = None
        self._intervals: Intervals | None = None
        now_ns = monotonic_ns()
        self._period_ns = min(CHECKPOINT_NS, interval_ns or CHECKPOINT_NS)
        self._flush_ns, self._checkpoint_ns = now_ns + FLUSH_NS, now_ns + self._period_ns
        if samples:
            self.samples = Samples(folder.path)
            engine.sinks.append(self._sample)
        if interval_ns is not None:
            self._lines = OutputFile(folder.path / INTERVALS)
            self._intervals = Intervals(engine, interval_ns, self._put_line)
            self._interval_ns = now_ns + interval_ns
            if not live:
                engine.cut = self._intervals.pieces
        self._interval_from_ns: int | None = engine.begin_ns

    @property
    def paths(self) -> list[Path]:
        """The files that are finished."""
        outputs = (self.samples, self._lines)
        return [output.path for output in outputs if output is not None and output.path.exists()]

    def look(self, utc_ns: int) -> None:
        """After each round: do what is due, and go on with what takes longer."""
        now_ns = self._now_ns()
        if now_ns >= self._flush_ns:
            self._flush_ns = now_ns + FLUSH_NS
            self._engine.drain()
            self._flush()
        if self._intervals is not None and not self._live:
            self._intervals.write_ready()
        elif self._intervals is not None and now_ns >= self._interval_ns:
            period_ns = self._intervals.period_ns
            self._interval_ns += ((now_ns - self._interval_ns) // period_ns + 1) * period_ns
            if not self._chores.busy(INTERVALS):  # else this one goes on, and is longer
                self._start_interval(utc_ns)
        if now_ns >= self._checkpoint_ns and not self._chores.busy(SUMMARY):
            took_ns = self._chores.took_ns.get(SUMMARY, 0)
            self._checkpoint_ns = now_ns + max(self._period_ns, CHECKPOINT_SHARE * took_ns)
            self._chores.start(SUMMARY, checkpoint(self._engine, lambda: self._run(utc_ns), utc_ns, self._put_summary))
        self._chores.work()

    def close(self, utc_ns: int) -> None:
        """The end, before the engine is closed: the last interval; a checkpoint that is on its way is given up."""
        self._chores.drop(SUMMARY)
        self._chores.finish()
        if self._intervals is not None and self._live:
            self._start_interval(utc_ns)
            self._chores.finish()
        elif self._intervals is not None:
            self._intervals.finish()

    def finish(self) -> None:
        """After the engine was closed: finish the files."""
        for output in (self.samples, self._lines):
            if output is not None:
                try:
                    output.close()
                except SourceError as error:
                    self._fail(str(error))
                    if output is self.samples:
                        self._give_up_samples()

    def make_room(self) -> bool:
        """Delete what is left of samples that were given up; whether there was any."""
        journal = self._folder.path / (SAMPLES + JOURNAL)
        there = self.samples is None and journal.exists()
        if there:
            journal.unlink(missing_ok=True)
        return there

    def _start_interval(self, utc_ns: int) -> None:
        assert self._intervals is not None
        begin_ns = utc_ns if self._interval_from_ns is None else self._interval_from_ns
        self._interval_from_ns = utc_ns
        self._chores.start(INTERVALS, self._intervals.look(begin_ns, utc_ns))

    def _sample(self, gauge: Any, seen: Any) -> None:
        if self.samples is not None:
            try:
                self.samples.add(gauge, seen)
            except SourceError as error:
                self._fail(str(error))
                self._give_up_samples()

    def _flush(self) -> None:
        try:
            if self.samples is not None:
                self.samples.flush()
        except SourceError as error:
            self._fail(str(error))
            self._give_up_samples()
        self._put_line("")

    def _give_up_samples(self) -> None:
        """Without its end the table is of no use; what was flushed of the journal is."""
        samples, self.samples = self.samples, None
        if samples is not None:
            with contextlib.suppress(SourceError):
                samples.close()
            samples.path.unlink(missing_ok=True)  # with what it held: room for the summary

    def _put_line(self, line: str) -> None:
        if self._lines is None:
            return
        try:
            self._lines.write(line.encode())
            self._lines.flush()
        except SourceError as error:
            self._lines = None
            self._fail(str(error))

    def _put_summary(self, text: str) -> None:
        try:
            self.put_summary(text)
        except SourceError as error:
            self._fail(str(error))

    def put_summary(self, text: str) -> None:
        """Write the summary, if need be in place of samples that were given up. Raises SourceError."""
        try:
            self._folder.put(SUMMARY, text)
        except SourceError:
            if not self.make_room():
                raise
            self._folder.put(SUMMARY, text)

    def _fail(self, reason: str) -> None:
        if reason not in self.failures:
            self.failures.append(reason)
            self._engine.chronicle.add(max(self._engine.last_ns, 0), reason)
