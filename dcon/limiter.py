"""The last guard before the output: whatever is asked, what leaves is a finite number inside ±125 MW.

It shares no code with the controller, imports nothing of ours and can only say no: a value that is missing, not a
number or not finite gives 0 MW at once; a finite one is clipped, and moves no faster than the slew backstop.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

LIMIT_MW: Final = 125.0
"""Modulation limit of the line (Pierre et al., section I); a caller may ask for less, never for more."""
SLEW_MW_PER_S: Final = 1000.0
"""Backstop only: a 125 MW swing at 0.5 Hz needs 393 MW/s."""
MW_PER_V: Final = 12.5
"""±10 V are ±125 MW."""
LONGEST_STEP_S: Final = 0.1
"""A longer time between two calls earns no larger step."""


class Limited(NamedTuple):
    """What may leave, and why it differs from what was asked: "" | "invalid" | "limit" | "slew"."""

    mw: float
    reason: str


def _number(value: object) -> float | None:
    try:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        number = float(value)
    except Exception:  # too large, or an object whose methods fail
        return None
    return number if math.isfinite(number) else None


def limit(wanted_mw: object, previous_mw: object, dt_s: object, limit_mw: object = LIMIT_MW) -> Limited:
    """The command that may leave, ``dt_s`` seconds after ``previous_mw`` left; never raises, always finite.

    Anything but four finite numbers (``dt_s`` above and ``limit_mw`` not below zero) is 0 MW at once: a step to
    zero is the accepted price of not knowing. A ``previous_mw`` outside the limit counts as the limit.
    """
    wanted, previous, dt, bound = _number(wanted_mw), _number(previous_mw), _number(dt_s), _number(limit_mw)
    if wanted is None or previous is None or dt is None or bound is None or dt <= 0.0 or bound < 0.0:
        return Limited(0.0, "invalid")
    bound = min(bound, LIMIT_MW)
    clipped = max(-bound, min(bound, wanted))
    reason = "" if clipped == wanted else "limit"
    previous = max(-bound, min(bound, previous))
    step = SLEW_MW_PER_S * min(dt, LONGEST_STEP_S)
    if abs(clipped - previous) <= step:
        return Limited(clipped, reason)
    return Limited(previous + math.copysign(step, clipped - previous), "slew")


def volts(command_mw: object) -> float:
    """Volts of the analog output for a command: 12.5 MW/V, within ±10 V, 0 V for anything that is no number."""
    number = _number(command_mw)
    if number is None:
        return 0.0
    return max(-LIMIT_MW, min(LIMIT_MW, number)) / MW_PER_V
