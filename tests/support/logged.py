"""A session log read back, in seconds from a start: what the tests of simulated and of live sessions ask of one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import pytest

from dcon.core.differentiator import EMPTY, PAPER_60, advance
from dcon.core.values import Event, Record, SystemState
from dcon.engine import Engine
from dcon.session.reader import LoggedTick, SessionReader
from dcon.settings import parse
from pmutools.c37118 import Frame, decode_config
from pmutools.timebase import NS

RATE = 60
NAMES = ("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")
"""The fleet's."""


def ramps_down(records: Sequence[Record], k: int) -> float:
    """Assert that the command comes from where it was down to 0 in a second, from record ``k`` on; where it was, MW."""
    start = records[max(k - 1, 0)].command_mw
    ramp = [record.command_mw for record in records[k : k + 61]]
    assert ramp == pytest.approx([start * (60 - j) / 60 for j in range(61)], abs=1e-9)
    assert records[k + 60].state is SystemState.STANDBY
    return start


class Logged:
    """One session. ``start_ns`` is the stamp of slot 0."""

    def __init__(self, path: Path, start_ns: int) -> None:
        self.path, self.start_ns = path, start_ns
        self.reader = SessionReader(path)
        self.ticks: list[LoggedTick] = list(self.reader.ticks())
        self.records: list[Record] = [tick.record for tick in self.ticks]

    def seconds(self, time_ns: int) -> float:
        return (time_ns - self.start_ns) / 1e9

    def slot(self, time_ns: int) -> int:
        """Reporting instant of a stamp."""
        return round((time_ns - self.start_ns) * RATE / NS)

    def stamps_s(self, name: str) -> list[float]:
        return [self.seconds(f.time_ns) for tick in self.ticks for f in tick.frames if f.name == name]

    def delays_ms(self, name: str) -> list[float]:
        return [((f.arrival_ns or 0) - f.time_ns) / 1e6 for tick in self.ticks for f in tick.frames if f.name == name]

    def counts(self, name: str) -> list[int]:
        """Frames in each tick."""
        return [sum(frame.name == name for frame in tick.frames) for tick in self.ticks]

    def events(self) -> Iterator[tuple[float, Event]]:
        """With the time of their tick."""
        for record in self.records:
            yield from ((self.seconds(record.tick_ns), event) for event in record.events)

    def when(self, event: str, subject: str) -> list[float]:
        return [at for at, found in self.events() if (found.name, found.subject) == (event, subject)]

    def tick_at(self, time_s: float) -> int:
        """Index of the first tick at that time or later."""
        return next(k for k, record in enumerate(self.records) if self.seconds(record.tick_ns) >= time_s - 1e-6)

    @cached_property
    def command_mw(self) -> list[float]:
        return [record.command_mw for record in self.records]

    def own_mw(self, instance: int = 0) -> list[float]:
        """What one instance alone would have commanded, tick by tick."""
        return [record.instances[instance].command_mw for record in self.records]

    def unhandled(self, name: str) -> dict[int, float]:
        """f (Hz, deviation) of a PMU by reporting instant, as the filter alone has it that does not notice a loss."""
        memory, found = EMPTY, dict[int, float]()
        for tick in self.ticks:
            for frame in tick.frames:
                if frame.name == name:
                    memory = advance(PAPER_60, memory, math.atan2(frame.v1.imag, frame.v1.real))
                    found[self.slot(frame.time_ns)] = memory.f_hz
        return found

    def largest_step(self) -> float:
        return max(abs(b - a) for a, b in pairwise(self.command_mw))

    def per_stamp(self) -> dict[str, dict[int, float]]:
        """f (Hz, deviation) of every PMU by reporting instant (0 is the start), from the controller's own rings."""
        settings = parse(self.reader.ini_text, "log")
        engine = Engine(settings.params, settings.sites, verified=self.reader.metadata.get("verified") == "true")
        names = self.reader.pmus
        found: dict[str, dict[int, float]] = {name: {} for name in names}
        first_slot = self.start_ns * RATE // NS
        for tick in self.ticks:
            for name, config in tick.configs:
                assert engine.reconfigure(name, decode_config(config)[1]) is None
            frames: dict[str, list[Frame]] = {}
            for frame in tick.frames:
                frames.setdefault(frame.name, []).append(Frame(frame.wire, frame.arrival_ns, frame.stamp_source, 0))
            engine.tick(frames, tick.orders, tick.record.tick_ns)
            for name, pmu in zip(names, engine.state.pmus, strict=True):
                for back, f_hz in enumerate(pmu.ring[:4]):
                    assert pmu.slot is not None
                    assert found[name].setdefault(pmu.slot - first_slot - back, f_hz) == f_hz
        return found
