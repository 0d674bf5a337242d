"""The sixteen control instances: alignment of their two PMUs, their states, and which of them is active."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from dcon.core.checks import PairView, Supervisor, Tables, judge
from dcon.core.params import Pair, Params
from dcon.core.quick import next_instances
from dcon.core.state import Instance, Pmu
from dcon.core.values import InstanceState

_S = InstanceState
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


def disable(last: Instance, reason: str) -> Instance:
    """``last`` after a fault: whatever was verified is lost. A disabled instance keeps its first reason."""
    if last.state is InstanceState.DISABLED and last.reason and not last.verified:
        return last._replace(raised=0, held=(), evidence=())
    return Instance(reason=reason)


def median_mhz(last: Sequence[Instance], found: Sequence[tuple[int, float] | None]) -> float | None:
    """Of Δf over the instances that were READY and still have one; None where they are fewer than three."""
    known = sorted(new[1] for old, new in zip(last, found, strict=True) if new is not None and old.is_ready)
    middle, odd = divmod(len(known), 2)
    if len(known) < 3 or math.isnan(sum(known)):
        return None
    return known[middle] if odd else (known[middle - 1] + known[middle]) / 2


def update(
    params: Params, supervisor: Supervisor, tables: Tables, last: Sequence[Instance], pmus: Sequence[Pmu], now_ns: int
) -> tuple[tuple[Instance, ...], bool]:
    """All instances after their PMUs' tick, and whether nothing about them is new but their numbers."""
    if tables.quick is not None:
        uneventful = next_instances(tables.quick, params.instances, last, pmus, supervisor.disabling, now_ns)
        if uneventful is not None:
            return uneventful, True
    faulty = [bool(pmu.raised & supervisor.disabling) for pmu in pmus]
    found = [
        None if faulty[north] or faulty[south] else difference(pmus[north], pmus[south], params.align)
        for north, south in params.instances
    ]
    middle = median_mhz(last, found)
    after = []
    for pair, old, new in zip(params.instances, last, found, strict=True):
        if faulty[pair.north] or faulty[pair.south]:
            after.append(disable(old, _faults(params, supervisor, pair, pmus)))
        elif new is None:
            after.append(old if old.state is InstanceState.DISABLED else disable(old, "no common stamp"))
        else:
            view = PairView(pmus[pair.north], pmus[pair.south], new[1], middle, now_ns)
            after.append(_updated(params, supervisor, tables, old, new[0], view))
    return tuple(after), False


def _faults(params: Params, supervisor: Supervisor, pair: Pair, pmus: Sequence[Pmu]) -> str:
    """Which checks of which PMU disable an instance."""
    return ", ".join(
        f"{params.pmus[index].name}: {' '.join(names)}"
        for index in pair
        if (names := supervisor.named(pmus[index].raised & supervisor.disabling))
    )


def _updated(
    params: Params, supervisor: Supervisor, tables: Tables, last: Instance, slot: int, view: PairView
) -> Instance:
    """One instance that has a difference at ``slot``."""
    raised, held, evidence = judge(tables.instance, last.held, (params, view))
    if raised & supervisor.disabling:
        reason = " ".join(supervisor.named(raised & supervisor.disabling))
        return disable(last, reason)._replace(raised=raised, held=held, evidence=evidence)
    new_frames = 1 if last.slot is None else slot - last.slot
    verified = last.verified + max(new_frames, 0)
    state = TRANSITIONS.get((last.state, "pair"), last.state)
    if state is InstanceState.INITIALISING and verified >= params.init_frames:
        state = TRANSITIONS[state, "verified"]
    else:
        state = TRANSITIONS.get((state, "new" if new_frames > 0 else "hold"), state)
    return Instance(state, verified, slot, view.delta_f_mhz, last.reason, raised, held, evidence)


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
