"""The control law, and the transfers that keep its output free of steps."""

from __future__ import annotations

import math
from typing import NamedTuple


def saturate(mw: float, limit_mw: float) -> float:
    """``mw`` within ±``limit_mw``; NaN stays NaN (the order of the arguments decides that)."""
    return max(min(mw, limit_mw), -limit_mw)


def command_mw(delta_f_mhz: float, gain_mw_per_mhz: float, deadband_mhz: float, limit_mw: float) -> float:
    """P = K(Δf) of eq. (2) and Fig. 6: deadband, gain, saturation.

    The deadband is taken off |Δf| (offset form), so that P leaves zero without a jump.
    P > 0 carries more power from north to south; Δf = f_north - f_south.
    """
    if delta_f_mhz > deadband_mhz:
        return min(gain_mw_per_mhz * (delta_f_mhz - deadband_mhz), limit_mw)
    if delta_f_mhz < -deadband_mhz:
        return max(gain_mw_per_mhz * (delta_f_mhz + deadband_mhz), -limit_mw)
    return delta_f_mhz if math.isnan(delta_f_mhz) else 0.0  # NaN is for the limiter to refuse


class Transfer(NamedTuple):
    """A bumpless transfer: at the change, the difference to the last output; then less of it, linearly, to nothing.

    Counted in ticks, so that a clock that is set back cannot hold an output up.
    """

    offset_mw: float = 0.0
    left_ticks: int = 0
    total_ticks: int = 1

    @property
    def residual_mw(self) -> float:
        return self.offset_mw * self.left_ticks / self.total_ticks

    def tick(self) -> Transfer:
        return self._replace(left_ticks=self.left_ticks - 1) if self.left_ticks else self


def approach(value: float, target: float, step: float) -> float:
    """``value`` moved towards ``target`` by at most ``step`` (> 0)."""
    return max(value - step, min(value + step, target))
