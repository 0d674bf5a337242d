"""``dcon simulate --sweep``: one plan for every combination of values, run in as many processes as there are cores."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import Any, Final, NamedTuple

from dcon.sim.plan import Plan
from dcon.sim.simulate import Outcome, Tell, simulate
from pmutools.errors import SettingsError, SourceError
from pmutools.parsers import number

LIMIT: Final = 10_000
"""Runs of one sweep."""


class Swept(NamedTuple):
    """What may be swept: the field of a plan, and what a unit of the command line is in the field's."""

    field: str
    unit: str
    scale: float = 1.0


SWEPT: Final = {
    "gain": Swept("gain_mw_per_mhz", "MW/mHz"),
    "delay": Swept("delay_ms", "ms"),
    "deadband": Swept("deadband_mhz", "mHz"),
    "noise": Swept("noise_rad", "mrad", 1e-3),
    "seed": Swept("seed", ""),
}


class Axis(NamedTuple):
    """One ``--sweep``: values in the units of the command line."""

    name: str
    values: tuple[float, ...]


class Run(NamedTuple):
    """One plan of a sweep: where on the axes, and where its session is logged."""

    plan: Plan
    swept: dict[str, float]
    path: str | None = None


def parse_axis(text: str) -> Axis:
    """``NAME=FROM:TO:STEP``, both ends included. Raises SettingsError."""
    name, equals, span = text.partition("=")
    try:
        first, last, step = map(number(), span.split(":"))
        count = math.floor((last - first) / step + 1e-9) + 1
    except (ValueError, ZeroDivisionError, OverflowError):
        equals = ""
    if not equals or name not in SWEPT or min(first, last) < 0 or not 0 < count <= LIMIT:
        raise SettingsError(f"--sweep {text}: write {'|'.join(SWEPT)}=FROM:TO:STEP, not below 0, as in gain=0:15:3")
    values = [round(first + step * number, 12) for number in range(count)]
    if name == "seed" and any(value % 1 for value in values):
        raise SettingsError(f"--sweep {text}: seeds are whole numbers")
    return Axis(name, tuple(map(int, values) if name == "seed" else values))


def runs(plan: Plan, axes: Sequence[Axis], folder: str | os.PathLike[str] | None = None) -> list[Run]:
    """Every combination, the last axis turning fastest; sessions go to ``folder``. Raises SettingsError."""
    twice = [axis.name for axis in axes if sum(axis.name == other.name for other in axes) > 1]
    if twice:
        raise SettingsError(f"--sweep {twice[0]}: given twice")
    count = 1
    for axis in axes:
        count *= len(axis.values)
    if count > LIMIT:
        raise SettingsError(f"--sweep: more than {LIMIT} runs")
    found = []
    for place, values in enumerate(itertools.product(*(axis.values for axis in axes)), 1):
        swept = {axis.name: value for axis, value in zip(axes, values, strict=True)}
        fields: dict[str, Any] = {SWEPT[name].field: value * SWEPT[name].scale for name, value in swept.items()}
        if "seed" in swept:
            fields["seed"] = int(swept["seed"])
        name = "session.mcap" if count == 1 else f"session-{place}.mcap"
        path = None if folder is None else os.path.join(folder, name)
        found.append(Run(replace(plan, **fields), swept, path))
    return found


def outcomes(sweep: Sequence[Run], tell: Tell | None = None) -> Iterator[Outcome]:
    """The outcome of each run, in order; without columns if there are several, which go through other processes.

    ``tell`` is given the simulated seconds of a single run. Raises what :func:`~dcon.sim.simulate.simulate` raises.
    """
    if len(sweep) == 1:
        yield simulate(sweep[0].plan, sweep[0].path, tell)
        return
    before = set(multiprocessing.active_children())
    workers = ProcessPoolExecutor(min(os.cpu_count() or 1, len(sweep)), initializer=_led)
    try:
        under_way: list[Future[Outcome]] = [workers.submit(_judged, run) for run in sweep]
        for future in under_way:
            yield future.result()
        workers.shutdown()
    except BrokenProcessPool:
        raise SourceError("--sweep: the process of a run was killed; out of memory?") from None
    finally:
        workers.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()


def _led() -> None:
    """A worker leaves Ctrl-C to the process that it works for, which ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _judged(run: Run) -> Outcome:
    return simulate(run.plan, run.path).summary()
