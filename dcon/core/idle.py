"""Checks that are set beyond what the command can reach at the present limit: they are there, and can never fire."""

from __future__ import annotations

import math
from typing import Final

from dcon.core.params import Params

SQUARE: Final = 4 / math.pi
"""Largest swing of a command that goes from limit to limit, once what is not of the band is filtered out."""


def idle_checks(params: Params) -> list[str]:
    """One line for each check that cannot fire at ``limit_mw``, with the setting that keeps it from it."""
    limits, limit_mw = params.thresholds, params.limit_mw
    grown_mw = limits.growth_min_mw * limits.growth_max
    found = (
        (
            "growing",
            f"growth_min_mw = {limits.growth_min_mw:g}, so a swing must come to {grown_mw:g} MW",
            grown_mw >= SQUARE * limit_mw,
        ),
        ("bias", f"bias_max_mw = {limits.bias_max_mw:g}", limits.bias_max_mw >= limit_mw),
        ("saturation", "a command that is always 0 is never at its limit", limit_mw == 0),
        (
            "the limit of arming",
            f"arm_limit_mw = {params.arm_limit_mw:g}",
            params.arm_limit_mw >= limit_mw,
        ),
    )
    return [f"{name} can never fire at limit_mw = {limit_mw:g}: {why}" for name, why, idle in found if idle]
