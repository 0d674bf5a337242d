"""``pmu characterize``: a source through the engine into a folder, and all that is made of it in the end."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pmutools import linux
from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.demux import Loss, Message
from pmutools.clock import Clock, UtcOffset, utc_offset
from pmutools.errors import SettingsError, SourceError
from pmutools.formats.source import Block, Source
from pmutools.measure.budget import Departures
from pmutools.measure.clockquality import ClockQuality
from pmutools.measure.compare import compare
from pmutools.measure.profile import profile_text
from pmutools.measure.require import Requirement, verdicts
from pmutools.measure.run import Run
from pmutools.measure.stream import WAIT_NS, StreamResult
from pmutools.measure.timeline import Course
from pmutools.timebase import NS
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.folder import Folder
from pmutools.tools.characterizer.hostwatch import HostWatch
from pmutools.tools.characterizer.names import SUMMARY
from pmutools.tools.characterizer.recorder import Recorder
from pmutools.tools.characterizer.summaries import final_summary, results_of, run_part
from pmutools.tools.characterizer.truth import Truth, hold_to
from pmutools.tools.live import ROUND_NS, LiveSource

LEAST_STEP_NS = 100_000
"""A clock that was set by less is not told from reading it twice."""
CLOCK_NS = 10 * NS
"""How often the receiver's clock is looked after."""
TRIM_NS = 10 * NS
"""How often what a backlog left free is given back: without it a run of days is as large as its worst second."""
FIT_NS = 4 * NS
"""Fits are made until so long after the end; streams beyond that are told without."""
LEDGER_NS = 5 * NS
"""How long a ledger is waited for whose player is about to end."""
_GROUP = 4096
Observe = Callable[[Engine, Sequence[Block | Message | Loss]], None]
"""Given the engine and what it has just taken."""


def unobserved(engine: Engine, items: Sequence[Block | Message | Loss]) -> None:
    """Nobody looks on."""


@dataclass(frozen=True)
class Settings:
    """What is to be made of a run."""

    wait_ns: int = WAIT_NS
    """A concentrator's wait: what comes later is late."""
    phase_ns: int = 0
    """When the controller's steps are, after whole periods of UTC."""
    samples: bool = True
    interval_ns: int | None = None
    ledger: Path | None = None
    before: Mapping[str, Any] | None = None
    """The summary of an earlier run to compare with."""
    requirements: Sequence[Requirement] = ()
    profile: Path | None = None
    exact_profile: bool = False
    clock_bound_ns: int | None = None
    """How wrong the clock of a recording was at most, if the user vouches for it."""
    round_ns: int = ROUND_NS


@dataclass
class Outcome:
    """A finished run, and what went wrong with it."""

    run: Run
    paths: list[Path] = field(default_factory=list)
    """What was written."""
    failures: list[str] = field(default_factory=list)
    """Outputs that could not be made, and why."""
    incomplete: list[str] = field(default_factory=list)
    """Input that was lost or undecodable, in words."""

    @property
    def received(self) -> int:
        """Frames that were measured."""
        return sum(result.counts.slots.frames for result in self.run.results)

    @property
    def holds(self) -> bool:
        """Whether all requirements do."""
        return all(verdict.holds for verdict in self.run.verdicts)


def load_summary(folder: Path) -> Mapping[str, Any]:
    """``summary.json`` of an earlier run. Raises SettingsError where there is none."""
    path = folder / SUMMARY if folder.is_dir() else folder
    try:
        found: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        found["streams"], found["all"]  # KeyError for another program's
    except OSError as error:
        raise SettingsError(f"--compare {folder}: {path.name}: {error.strerror}; name the folder of a run") from None
    except (ValueError, KeyError, TypeError):
        raise SettingsError(f"--compare {folder}: {path.name} is no summary of pmu characterize") from None
    return found


class Job:
    """One run: measured by :meth:`live` or :meth:`recorded`, ended by :meth:`finish`."""

    def __init__(self, engine: Engine, folder: Folder, settings: Settings, clock: Clock, *, source: str) -> None:
        """``source`` is what is measured, as the user named it."""
        self.engine, self._folder, self._settings, self._clock = engine, folder, settings, clock
        self._source = source
        self._extra: Callable[[], Mapping[str, Any]] = dict
        self._recorder: Recorder | None = None
        self._end_ns = self._fit_ns = 0

    def live(
        self, source: LiveSource, sample_clock: Callable[[], ClockQuality] | None, observe: Observe = unobserved
    ) -> None:
        """Measure live streams until the source ends."""
        engine, clock = self.engine, self._clock
        self._extra = lambda: _bytes_of(source) | {"unwanted_frames": source.receivers.unwanted}
        recorder = self._record(live=True)
        offset, sample_ns, trim_ns = utc_offset(clock, 3), 0, clock.monotonic_ns() + TRIM_NS
        watch = HostWatch(source, engine)
        for items in source.rounds(self._settings.round_ns):
            now_ns = clock.realtime_ns()
            engine.take(items)
            offset = self._look_at_clock(offset, now_ns)
            watch.look(clock.monotonic_ns())
            if sample_clock is not None and clock.monotonic_ns() >= sample_ns:
                sample_ns = clock.monotonic_ns() + CLOCK_NS
                engine.sample_clock(sample_clock())
            if clock.monotonic_ns() >= trim_ns:
                trim_ns = clock.monotonic_ns() + TRIM_NS
                linux.trim_heap()
            recorder.look(now_ns)
            observe(engine, items)
        if sample_clock is not None:
            engine.sample_clock(sample_clock())
        self._close(clock.realtime_ns())

    def recorded(self, source: Source, observe: Observe = unobserved, stop: Callable[[], bool] = lambda: False) -> None:
        """Measure a recording to its end, or until ``stop``; the time is that of its arrivals, or stamps."""
        self._extra = lambda: _bytes_of(source) | {"defects": source.defects()}
        if (bound_ns := self._settings.clock_bound_ns) is not None:
            self.engine.sample_clock(ClockQuality(vouched_ns=bound_ns))
        recorder = self._record(live=False)
        for items in groups(source.blocks()):
            self.engine.take(items)
            recorder.look(max(self.engine.last_ns, 0))
            observe(self.engine, items)
            if stop():
                break
        self._close(self.engine.last_ns if self.engine.last_ns != NO_TIME else 0)

    def finish(self) -> Outcome:
        """The summary and all else that is made of it. What cannot be made is among the outcome's failures."""
        engine, settings, recorder = self.engine, self._settings, self._recorder
        assert recorder is not None
        results, courses = self._in_order()
        failures = recorder.failures
        truth = self._truth(results, failures)
        run = self._run(self._end_ns, complete=True)
        departures = None if truth is None else [Departures(a.at_sender, a.one_way) for a in truth.agreements]
        summary = final_summary(
            engine, results, run, lambda: self._clock.monotonic_ns() < self._fit_ns, departures=departures
        )
        if truth is not None and settings.ledger is not None:
            summary["ledger"] = truth.to_json(settings.ledger, results)
        judged = verdicts(settings.requirements, summary)
        if judged:
            summary["require"] = [
                {"text": v.requirement.text, "stream": v.stream, "value": v.value, "holds": v.holds, "note": v.note}
                for v in judged
            ]
        differences = [] if settings.before is None else compare(settings.before, summary)
        if differences:
            summary["compare"] = [row._asdict() | {"change": row.change} for row in differences]
        outcome = Outcome(
            Run(
                summary,
                results,
                courses,
                list(engine.alignments.values()),
                self._source,
                self._end_ns if engine.begin_ns is None else engine.begin_ns,
                self._end_ns,
                engine.chronicle.lines(),
                judged,
                differences,
            ),
            failures=failures,
            incomplete=list(_incomplete(summary["run"]["input"])),
        )
        self._write(outcome)
        return outcome

    # --- within

    def _record(self, *, live: bool) -> Recorder:
        settings = self._settings
        self._recorder = Recorder(
            self.engine,
            self._folder,
            lambda utc_ns: self._run(utc_ns, complete=False),
            self._clock.monotonic_ns,
            samples=settings.samples or settings.ledger is not None,
            interval_ns=settings.interval_ns,
            live=live,
        )
        return self._recorder

    def _close(self, end_ns: int) -> None:
        assert self._recorder is not None
        self._end_ns, self._fit_ns = end_ns, self._clock.monotonic_ns() + FIT_NS
        self._recorder.close(end_ns)
        self.engine.close()
        self._recorder.finish()

    def _in_order(self) -> tuple[list[StreamResult], list[Course | None]]:
        """Results and courses: as the initialisation file or the command line has them, then by name."""
        gauges = self.engine.gauges
        results = list(results_of(self.engine, self._end_ns))
        places = [gauge.owners[0] if gauge.owners else 0 for gauge in gauges] + self.engine.silent()
        order = sorted(range(len(results)), key=lambda n: (places[n], _natural(results[n].identity.name)))
        courses = [gauges[n].timeline.course() if n < len(gauges) else None for n in order]
        return [results[n] for n in order], courses

    def _look_at_clock(self, before: UtcOffset, now_ns: int) -> UtcOffset:
        now = utc_offset(self._clock, 3)
        step_ns = before.step_ns(now)
        if abs(step_ns) < LEAST_STEP_NS:
            return before
        self.engine.clock_stepped(step_ns, now_ns)
        return now

    def _run(self, end_ns: int, *, complete: bool) -> dict[str, Any]:
        return run_part(self.engine, self._source, self.engine.begin_ns, end_ns, self._extra, complete=complete)

    def _truth(self, results: Sequence[StreamResult], failures: list[str]) -> Truth | None:
        ledger, recorder = self._settings.ledger, self._recorder
        assert recorder is not None
        if ledger is None:
            return None
        if recorder.samples is None:
            failures.append(f"{ledger}: without samples nothing can be held to it")
            return None
        end_ns = self._clock.monotonic_ns() + LEDGER_NS
        begin_ns = self._end_ns if self.engine.begin_ns is None else self.engine.begin_ns
        span = begin_ns, self._end_ns - self._settings.wait_ns
        while True:
            try:
                return hold_to(ledger, recorder.samples.path, results, *span)
            except SourceError as error:
                if self._clock.monotonic_ns() >= end_ns:
                    failures.append(str(error))
                    return None
            self._clock.sleep_until(self._clock.monotonic_ns() + NS // 5)

    def _write(self, outcome: Outcome) -> None:
        settings, recorder = self._settings, self._recorder
        assert recorder is not None
        try:
            recorder.put_summary(json.dumps(outcome.run.summary, allow_nan=False) + "\n")
            outcome.paths.append(self._folder.path / SUMMARY)
        except SourceError as error:
            outcome.failures.append(str(error))
        outcome.paths += recorder.paths
        if settings.profile is not None:
            try:
                text = profile_text(outcome.run.results, exact=settings.exact_profile)
                settings.profile.write_text(text + "\n", encoding="utf-8")
                outcome.paths.append(settings.profile)
            except OSError as error:
                outcome.failures.append(f"cannot write {settings.profile}: {error.strerror}")


def groups(items: Iterable[Block | Message | Loss]) -> Iterator[list[Block | Message | Loss]]:
    """Blocks that were gathered over the same time together: up to one of each stream."""
    group: list[Block | Message | Loss] = []
    streams: set[Any] = set()
    for item in items:
        if isinstance(item, Block):
            key = item.flow, item.batch.config.idcode
            if key in streams:
                yield group
                group, streams = [], set()
            streams.add(key)
        group.append(item)
        if len(group) >= _GROUP:
            yield group
            group, streams = [], set()
    yield group


def _natural(name: str) -> list[tuple[int, str]]:
    """N2 before N10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _bytes_of(source: Source | LiveSource) -> dict[str, Any]:
    tally = source.tally
    return {
        "fed_bytes": tally.fed,
        "framed_bytes": tally.framed,
        "ignored_bytes": tally.ignored,
        "ignored_flows": tally.ignored_flows,
        "skipped": {str(reason): nbytes for reason, nbytes in tally.skipped.items()},
    }


def _incomplete(told: Mapping[str, Any]) -> Iterator[str]:
    """What of the input was lost or undecodable."""
    for reason, nbytes in told["skipped"].items():
        yield f"{nbytes} bytes skipped: {reason}"
    if told["ignored_flows"] and "defects" not in told:  # in a capture there may be all kinds of traffic
        yield f"{told['ignored_bytes']} bytes of {told['ignored_flows']} senders without a single frame"
    if told["own_drops"]:
        yield f"{told['own_drops']} datagrams lost in this machine's receive buffer, not in the network"
    if told["unmeasured_frames"]:
        yield f"{told['unmeasured_frames']} frames of more streams than are measured"
    for name, count in told.get("defects", {}).items():
        yield f"{name}: {count}"
