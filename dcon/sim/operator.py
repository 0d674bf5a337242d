"""The operator of a simulated session: arms and activates as soon as the controller allows it."""

from __future__ import annotations

from dcon.core.values import Mode, Order, SystemState

_NEXT = {SystemState.STANDBY: Order("arm"), SystemState.ARMED: Order("activate")}


class EagerOperator:
    """Orders the mode, then both steps of arming, once; what disarms the controller later stands.

    ``probe_s``: when to start the probing signal, if the controller is ACTIVE by then; None for none.
    """

    def __init__(self, mode: Mode = Mode.CLOSED_LOOP, probe_s: float | None = None) -> None:
        self._mode = mode
        self._mode_ordered = False
        self._activated = False
        self._probe_s = probe_s

    def orders(self, state: SystemState, time_s: float = 0.0) -> tuple[Order, ...]:
        """What to order in the next tick, at ``time_s`` of the run, given the state after the last."""
        if not self._mode_ordered:
            self._mode_ordered = True
            return (Order(str(self._mode)),)
        if self._probe_s is not None and time_s >= self._probe_s:
            self._probe_s = None
            return (Order("probe_start"),) if state is SystemState.ACTIVE else ()
        order = _NEXT.get(state)
        if self._activated or order is None:
            return ()
        self._activated = order.name == "activate"
        return (order,)
