"""Simulated sessions with their logs read back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from support.logged import NAMES as NAMES
from support.logged import Logged

from dcon.sim.plan import START_NS, Plan
from dcon.sim.simulate import Outcome, simulate


class Session(Logged):
    """A simulated session, with its log read back."""

    def __init__(self, path: Path, plan: Plan) -> None:
        self.outcome: Outcome = simulate(plan, str(path))
        super().__init__(path, START_NS)


Simulated = Callable[[Plan], Session]


def simulations(folder: Path) -> Simulated:
    """Each plan is run once."""
    known: dict[Plan, Session] = {}

    def of(plan: Plan) -> Session:
        if plan not in known:
            known[plan] = Session(folder / f"{len(known)}.mcap", plan)
        return known[plan]

    return of
