"""What a tick changed about checks and instances: entries of the flag register, and events."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dcon.core.checks import Supervisor, Tables
from dcon.core.params import Params
from dcon.core.register import Register, fallen, risen, with_changes
from dcon.core.state import Evidence, Instance, Pmu, State
from dcon.core.values import Event, Flag, InstanceState

_INSTANCE_EVENTS = {
    InstanceState.DISABLED: "instance_disabled",
    InstanceState.INITIALISING: "instance_initialising",
    InstanceState.READY: "instance_ready",
}


def changed_pmus(
    params: Params,
    supervisor: Supervisor,
    tables: Tables,
    last: State,
    pmus: Sequence[Pmu],
    now_ns: int,
    events: list[Event],
) -> Register:
    """The register after what PMUs show; checks that rose become events."""
    flags = last.flags
    for site, before, pmu in zip(params.pmus, last.pmus, pmus, strict=True):
        if pmu.raised != before.raised:
            events.extend(Event(name, site.name) for name in supervisor.named(pmu.raised & ~before.raised))
            flags = compared(supervisor, tables, flags, site.name, before.raised, pmu.raised, pmu.evidence, now_ns)
    return flags


def changed_instances(
    params: Params,
    supervisor: Supervisor,
    tables: Tables,
    last: State,
    instances: Sequence[Instance],
    flags: Register,
    now_ns: int,
    events: list[Event],
) -> Register:
    """The register after what instances show; checks that rose and changes of state become events."""
    for name, old, new in zip(params.instance_names, last.instances, instances, strict=True):
        if new.raised != old.raised:
            events.extend(Event(check, name) for check in supervisor.named(new.raised & ~old.raised))
            flags = compared(supervisor, tables, flags, name, old.raised, new.raised, new.evidence, now_ns)
        if new.state is not old.state and not (new.is_ready and old.is_ready):
            events.append(Event(_INSTANCE_EVENTS[new.state], name, new.reason))
    return flags


def compared(
    supervisor: Supervisor,
    tables: Tables,
    flags: Register,
    subject: str,
    before: int,
    now: int,
    evidence: Evidence,
    now_ns: int,
) -> Register:
    """The register after a subject's checks went from ``before`` to ``now``."""
    if before == now:
        return flags
    new = []
    found = dict(evidence)
    for name in supervisor.named(now & ~before):
        bit = supervisor.bits[name]
        value = found.get(bit, math.nan)
        low, high = tables.limits.get(bit, (math.nan, math.nan))
        limit = high if value > high or low == -math.inf else low
        new.append(risen(flags, name, subject, now_ns, value, limit))
    gone = [flags.get((name, subject)) for name in supervisor.named(before & ~now)]
    new.extend(fallen(flag, now_ns) for flag in gone if flag is not None)
    return with_changes(flags, new)


def changes(before: Register, after: Register) -> tuple[Flag, ...]:
    """Entries of the register that are not what they were."""
    if after is before:
        return ()
    return tuple(flag for key, flag in after.items() if before.get(key) is not flag)
