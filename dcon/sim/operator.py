"""The operator of a simulated session: arms and activates as soon as the controller allows it."""

from __future__ import annotations

from dcon.core.values import Mode, Order, SystemState

_NEXT = {SystemState.STANDBY: Order("arm"), SystemState.ARMED: Order("activate")}


class EagerOperator:
    """Orders closed loop, then both steps of arming, once; what disarms the controller later stands."""

    def __init__(self) -> None:
        self._mode_ordered = False
        self._activated = False

    def orders(self, state: SystemState) -> tuple[Order, ...]:
        """What to order in the next tick, given the state after the last."""
        if not self._mode_ordered:
            self._mode_ordered = True
            return (Order(str(Mode.CLOSED_LOOP)),)
        order = _NEXT.get(state)
        if self._activated or order is None:
            return ()
        self._activated = order.name == "activate"
        return (order,)
