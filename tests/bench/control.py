"""One control tick, and how many times faster than real time a session can be simulated and replayed."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.table import Budget, Row

from dcon.engine import Engine
from dcon.replay.replay import replay
from dcon.session.reader import LoggedTick, SessionReader
from dcon.settings import parse
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.c37118 import Frame, decode_config


@dataclass(frozen=True)
class Sizes:
    duration_s: float
    rounds: int


FULL = Sizes(duration_s=30.0, rounds=5)
QUICK = Sizes(duration_s=2.0, rounds=1)


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "session.mcap")
        plan = Plan(duration_s=sizes.duration_s)
        logged, bare, again, ticks_ms = [], [], [], list[float]()
        for _ in range(sizes.rounds):
            logged.append(_real_times(sizes, lambda: simulate(plan, path)))
            bare.append(_real_times(sizes, lambda: simulate(plan)))
            again.append(_real_times(sizes, lambda: _replayed(path)))
            ticks_ms += tick_times_ms(path)
    yield _tick_row(ticks_ms)
    yield _multiple("`dcon simulate`, session log written", logged, 30)
    yield _multiple("`dcon simulate`, no log", bare, 60)
    yield _multiple("`dcon replay`", again, 30)


def tick_times_ms(path: str) -> list[float]:
    """Processor time of every tick of a session: 8 frames decoded, 16 instances, all checks."""
    reader = SessionReader(path)
    settings = parse(reader.ini_text, "bench")
    engine = Engine(settings.params, settings.sites, verified=True)
    times_ms = []
    for tick in reader.ticks():
        for name, frame in tick.configs:
            engine.configure(name, decode_config(frame)[1])
        frames = _frames(tick)
        began_ns = time.thread_time_ns()
        record = engine.tick(frames, tick.orders, tick.record.tick_ns).record
        times_ms.append((time.thread_time_ns() - began_ns) / 1e6)
        assert record.command_mw == tick.record.command_mw
    return times_ms


def _frames(tick: LoggedTick) -> dict[str, list[Frame]]:
    frames: dict[str, list[Frame]] = {}
    for frame in tick.frames:
        frames.setdefault(frame.name, []).append(Frame(frame.wire, frame.arrival_ns, frame.stamp_source, 0))
    return frames


def _replayed(path: str) -> None:
    assert replay(path).different == 0


def _real_times(sizes: Sizes, run: Callable[[], object]) -> float:
    began_s = time.process_time()
    run()
    return sizes.duration_s / (time.process_time() - began_s)


def _tick_row(times_ms: list[float]) -> Row:
    quantiles = statistics.quantiles(times_ms, n=100)
    ours = f"p50 {quantiles[49]:.3f} ms, p99 {quantiles[98]:.3f} ms"
    what = "one control tick: 8 frames, 16 instances, all checks"
    return Row("control", what, ours, "the paper: 1 to 2 ms", quantiles[98], " ms", Budget("at most", 1))


def _multiple(what: str, rounds: list[float], at_least: float) -> Row:
    median = statistics.median(rounds)
    ours = f"{min(rounds):.1f} to {max(rounds):.1f} s a second"
    return Row("control", what, ours, "real time", median, "x", Budget("at least", at_least))
