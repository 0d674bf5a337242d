"""Simulated sessions with their logs read back."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from dcon.engine import Engine
from dcon.session.reader import LoggedTick, SessionReader
from dcon.settings import parse
from dcon.sim.plan import START_NS, Plan
from dcon.sim.simulate import Outcome, simulate
from pmutools.c37118 import Frame, decode_config
from pmutools.timebase import NS

START_SLOT = START_NS * 60 // NS
NAMES = ("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")


class Session:
    """A simulated session, with its log read back."""

    def __init__(self, path: Path, plan: Plan) -> None:
        self.outcome: Outcome = simulate(plan, str(path))
        self.reader = SessionReader(path)
        self.ticks: list[LoggedTick] = list(self.reader.ticks())
        self.records = [tick.record for tick in self.ticks]

    def stamps_s(self, name: str) -> list[float]:
        return [(f.time_ns - START_NS) / 1e9 for tick in self.ticks for f in tick.frames if f.name == name]

    def delays_ms(self, name: str) -> list[float]:
        return [((f.arrival_ns or 0) - f.time_ns) / 1e6 for tick in self.ticks for f in tick.frames if f.name == name]

    def counts(self, name: str) -> list[int]:
        """Frames in each tick."""
        return [sum(frame.name == name for frame in tick.frames) for tick in self.ticks]

    def when(self, event: str, subject: str) -> list[float]:
        return [at for at, found in self.outcome.events if (found.name, found.subject) == (event, subject)]

    def tick_at(self, time_s: float) -> int:
        return next(k for k, at in enumerate(self.outcome.tick_s) if at >= time_s - 1e-6)

    def largest_step(self) -> float:
        return max(abs(b - a) for a, b in pairwise(self.outcome.command_mw))

    def per_stamp(self) -> dict[str, dict[int, float]]:
        """f (Hz, deviation) of every PMU by reporting instant (0 is the start), from the controller's own rings."""
        settings = parse(self.reader.ini_text, "log")
        engine = Engine(settings.params, settings.sites, verified=True)
        found: dict[str, dict[int, float]] = {name: {} for name in NAMES}
        for tick in self.ticks:
            for name, config in tick.configs:
                assert engine.reconfigure(name, decode_config(config)[1]) is None
            frames: dict[str, list[Frame]] = {}
            for frame in tick.frames:
                frames.setdefault(frame.name, []).append(Frame(frame.wire, frame.arrival_ns, frame.stamp_source, 0))
            engine.tick(frames, tick.orders, tick.record.tick_ns)
            for name, pmu in zip(NAMES, engine.state.pmus, strict=True):
                for back, f_hz in enumerate(pmu.ring[:4]):
                    assert pmu.slot is not None
                    assert found[name].setdefault(pmu.slot - START_SLOT - back, f_hz) == f_hz
        return found


Simulated = Callable[[Plan], Session]


def simulations(folder: Path) -> Simulated:
    """Each plan is run once."""
    known: dict[Plan, Session] = {}

    def of(plan: Plan) -> Session:
        if plan not in known:
            known[plan] = Session(folder / f"{len(known)}.mcap", plan)
        return known[plan]

    return of
