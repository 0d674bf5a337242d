"""What happens in the demo, and when: seconds from its start. One table for the grid, the operator and the judge."""

from __future__ import annotations

from dataclasses import dataclass

from dcon.control.orders import TimedOrder
from dcon.core.values import Order
from pmutools.grid.scenarios import BRAKE_MW, Pulse, Scenario

BRAKE_S = 0.5
SETTLE_S = 1.0
"""From the end of a brake to where its ringdown is judged."""
JUDGED_S = 12.0


@dataclass(frozen=True, slots=True)
class Course:
    """Two brake insertions of the same grid: the first with the controller watching, the second with it driving."""

    open_loop_s: float = 23.0
    """First brake; the instances have been verified by then."""
    swing_s: float = 14.0
    """From a brake until the next thing happens."""
    init_s: float = 20.0
    """Verified data before an instance may be used."""

    @property
    def arm_s(self) -> float:
        """Disarmed, and armed again with the loop closed."""
        return self.open_loop_s + self.swing_s

    @property
    def closed_loop_s(self) -> float:
        """Second brake: after the ramp down, both steps of arming and the 1 s transfer."""
        return self.arm_s + 3.5

    @property
    def disarm_s(self) -> float:
        return self.closed_loop_s + self.swing_s

    @property
    def end_s(self) -> float:
        return self.disarm_s + 1.5

    @property
    def scenario(self) -> Scenario:
        brakes = (self.open_loop_s, self.closed_loop_s)
        pulses = tuple(Pulse("brake", start, start + BRAKE_S, BRAKE_MW) for start in brakes)
        return Scenario("demo", "Chief Joseph brake twice: open loop, then closed loop", pulses, duration_s=self.end_s)

    @property
    def orders(self) -> tuple[TimedOrder, ...]:
        table = (
            (self.open_loop_s - 1.8, "arm"),
            (self.open_loop_s - 1.5, "activate"),
            (self.arm_s, "disarm"),
            (self.arm_s + 1.3, "closed_loop"),
            (self.arm_s + 1.5, "arm"),
            (self.arm_s + 1.8, "activate"),
            (self.disarm_s, "disarm"),
        )
        return tuple(TimedOrder(round(at_s * 1e9), Order(name)) for at_s, name in table)

    def judged(self, brake_s: float) -> tuple[float, float]:
        """Where the ringdown after a brake is judged."""
        start = brake_s + BRAKE_S + SETTLE_S
        return start, start + min(JUDGED_S, self.swing_s - BRAKE_S - SETTLE_S - 0.3)
