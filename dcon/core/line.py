"""The DC line: whether its status is known, and whether its schedule has room for the command."""

from __future__ import annotations

import math

from dcon.core.params import Params
from dcon.core.values import Pdci, Surroundings


def line_status(params: Params, surroundings: Surroundings, now_ns: int) -> Pdci | None:
    """The line's status, where one is told that is not too old."""
    status = surroundings.pdci
    if status is None or now_ns - status.time_ns > params.line.status_age_s * 1e9:
        return None
    return status


def margin_mw(params: Params, status: Pdci, driven_mw: float) -> float:
    """How far inside its rating and above its minimum the line stays with ±``limit_mw`` on its schedule.

    Where the line tells no schedule, it is its power without what is driven.
    """
    line, scheduled = params.line, status.scheduled_mw
    if math.isnan(scheduled):
        scheduled = status.power_mw - driven_mw
    rating = line.rating_ns_mw if scheduled >= 0 else line.rating_sn_mw
    return min(rating - abs(scheduled), abs(scheduled) - line.minimum_mw) - params.limit_mw
