"""What is read off a ringdown, and why nothing is: a loop that was open while it rang damps nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dcon.core.orders import SYSTEM
from dcon.core.values import Event, Mode, Record, SystemState
from dcon.sim.plan import Plan
from pmutools.modal.matrix_pencil import ringdown

SHORTEST_S = 4.0
"""Of a ringdown that is judged."""
_LEFT = frozenset(("rampdown", "fault", "estop"))
"""Events of the system that leave ACTIVE."""


class Estimate(NamedTuple):
    """A mode read off a ringdown; ``r2`` is the fit's share of the variance."""

    frequency_hz: float
    damping_percent: float
    r2: float


def is_closed(record: Record) -> bool:
    """Whether the feedback drives the line in a tick, all of it."""
    return record.state is SystemState.ACTIVE and record.mode is Mode.CLOSED_LOOP


def window_s(plan: Plan) -> tuple[float, float] | None:
    """(begin, end) of the plan's ringdown, as far as it is seen; None where that is too little, or there is none."""
    if plan.course.ringdown_s is None:
        return None
    start_s, stop_s = plan.course.ringdown_s
    stop_s = min(stop_s, plan.length_s)
    return (start_s, stop_s) if stop_s - start_s >= SHORTEST_S else None


def judge(swing_mhz: Sequence[float], plan: Plan) -> Estimate | None:
    """The strongest inter-area mode (0.1 to 1 Hz) of the plan's ringdown; None where there is none to see."""
    window = window_s(plan)
    if window is None:
        return None
    fit = ringdown(np.array(swing_mhz), plan.rate_hz, window[0], min(window[1], len(swing_mhz) / plan.rate_hz))
    mode = fit.dominant()
    return None if mode is None else Estimate(mode.frequency_hz, 100 * mode.damping, fit.r2)


def why_unjudged(
    plan: Plan, tick_s: Sequence[float], closed: Sequence[bool], events: Sequence[tuple[float, Event]]
) -> str:
    """Why a run has no closed loop to judge, in words; "" where the loop was closed for as long as it is judged.

    ``tick_s`` and ``closed`` have one entry a tick.
    """
    if plan.course.ringdown_s is None:
        return "the scenario has no ringdown"
    window = window_s(plan)
    if window is None:
        return f"too short: of the ringdown, from {plan.course.ringdown_s[0]:g} s on, {SHORTEST_S:g} s are needed"
    if not plan.control:
        return "the loop was open: control was not asked for"
    if not any(closed):
        return "the loop was open: it was never armed and activated"
    open_s = [at for at, is_one in zip(tick_s, closed, strict=True) if not is_one and window[0] <= at < window[1]]
    if not open_s:
        return ""
    began_s = next(at for at, is_one in zip(tick_s, closed, strict=True) if is_one)
    if began_s > open_s[0]:
        return f"the loop was open: it was closed from {began_s:.3f} s on only, the ringdown begins at {window[0]:g} s"
    ends = [(at, event) for at, event in events if event.subject == SYSTEM and event.name in _LEFT and at <= open_s[0]]
    left = [f"{event.name} at {at:.3f} s{event.detail and f', {event.detail}'}" for at, event in ends[-1:]]
    return "the loop was open: " + "".join(left or [f"from {open_s[0]:.3f} s on"])
