"""The sixteen control instances: alignment of their two PMUs, their states, and which of them is active."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from dcon.core.checks import Supervisor
from dcon.core.params import Pair, Params
from dcon.core.state import Instance, Pmu
from dcon.core.values import InstanceState

_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time: there are many instances
_S = InstanceState
_INITIALISING: Final = InstanceState.INITIALISING  # looking a member up costs as much as comparing it
TRANSITIONS: Final[dict[tuple[InstanceState, str], InstanceState]] = {
    (_S.DISABLED, "pair"): _S.INITIALISING,
    (_S.INITIALISING, "verified"): _S.READY,
    (_S.READY, "hold"): _S.HELD,
    (_S.HELD, "new"): _S.READY,
    (_S.INITIALISING, "fault"): _S.DISABLED,
    (_S.READY, "fault"): _S.DISABLED,
    (_S.HELD, "fault"): _S.DISABLED,
}
"""(state, trigger) -> state; what is not listed changes nothing.

``pair``: both PMUs have a frequency at one stamp. ``verified``: and have had for ``init_s``. ``hold``: no new common
stamp in this tick; ``new``: one. ``fault``: a check that disables, of the instance or of either PMU.
"""


def difference(north: Pmu, south: Pmu, align: bool) -> tuple[int, float] | None:
    """(slot, f_north - f_south in mHz) at the newest stamp that both have; None if there is none (section V.C).

    Without alignment: of the newest frame of each, whatever their stamps.
    """
    if north.slot is None or south.slot is None or not north.ring or not south.ring:
        return None
    slot = min(north.slot, south.slot)
    if not align:
        return slot, (north.ring[0] - south.ring[0]) * 1e3
    back_north, back_south = north.slot - slot, south.slot - slot
    if back_north >= len(north.ring) or back_south >= len(south.ring):
        return None
    return slot, (north.ring[back_north] - south.ring[back_south]) * 1e3


def disable(last: Instance, reason: str, raised: int = 0) -> Instance:
    """``last`` after a fault: whatever was verified is lost. A disabled instance keeps its first reason."""
    if last.state is InstanceState.DISABLED and last.reason and not last.verified:
        return last._replace(raised=raised)
    return Instance(reason=reason, raised=raised)


def update(
    params: Params, supervisor: Supervisor, pair: Pair, last: Instance, pmus: Sequence[Pmu], now_ns: int
) -> Instance:
    """One instance after its PMUs' tick."""
    north, south = pmus[pair.north], pmus[pair.south]
    if (north.raised | south.raised) & supervisor.disabling:
        reasons = [
            f"{params.pmus[index].name}: {' '.join(names)}"
            for index in pair
            if (names := supervisor.named(pmus[index].raised & supervisor.disabling))
        ]
        return disable(last, ", ".join(reasons))
    found = difference(north, south, params.align)
    if found is None:
        return last if last.state is InstanceState.DISABLED else disable(last, "no common stamp")
    slot, delta_f_mhz = found
    raised = 0
    for bit, test in supervisor.instance_tests:
        if test(params, north, south, now_ns):
            raised |= bit
    if raised & supervisor.disabling:
        return disable(last, " ".join(supervisor.named(raised & supervisor.disabling)), raised)
    new_frames = 1 if last.slot is None else slot - last.slot
    verified = last.verified + max(new_frames, 0)
    state = TRANSITIONS.get((last.state, "pair"), last.state)
    if state is _INITIALISING and verified >= params.init_frames:
        state = TRANSITIONS[state, "verified"]
    else:
        state = TRANSITIONS.get((state, "new" if new_frames > 0 else "hold"), state)
    return _new(Instance, (state, verified, slot, delta_f_mhz, last.reason, raised))


def choose(params: Params, instances: Sequence[Instance], active: int | None, keep: bool) -> int | None:
    """Index of the instance to follow: the first that is READY; None if none is.

    With ``keep``, the active one stays while it is READY, until a better one has been READY for ``return_s``.
    """
    current = active if active is not None and instances[active].is_ready else None
    for index, instance in enumerate(instances):
        if index == current:
            return index
        if instance.is_ready and (current is None or not keep or instance.verified >= params.return_frames):
            return index
    return None
