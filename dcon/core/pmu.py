"""What happens to one PMU in a tick: its frames through checks and differentiator, in order of their stamps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

from dcon.core.checks import Supervisor
from dcon.core.differentiator import EMPTY, Filter, advance, midpoint
from dcon.core.params import RING_SIZE, Params, PmuParams
from dcon.core.stamps import is_apart
from dcon.core.state import Pmu
from dcon.core.values import Sample
from pmutools.timebase import slot as slot_of

_stamp = attrgetter("time_ns")


def end_run(pmu: Pmu) -> Pmu:
    """``pmu`` with its run ended: the next good frame starts filter and ring afresh."""
    return pmu._replace(slot=None, filter=EMPTY, ring=())


def turn(params: Params, pmu: Pmu, theta_rad: float) -> tuple[Filter, tuple[float, ...]]:
    """Filter and ring of a run after one more angle."""
    filtered = advance(params.coefficients, pmu.filter, theta_rad)
    if filtered.frames < 3:
        return filtered, ()
    return filtered, (filtered.f_hz, *pmu.ring[: RING_SIZE - 1])


def extend(params: Params, last: Pmu, sample: Sample, slot: int, now_ns: int) -> Pmu:
    """The run with ``sample``, whose reporting instant is ``slot``."""
    v1 = sample.v1
    filtered, ring = turn(params, last, math.atan2(v1.imag, v1.real))
    return Pmu(
        slot=slot,
        time_ns=sample.time_ns,
        arrival_ns=min(sample.arrival_ns, now_ns),
        time_base=sample.time_base,
        v1=v1,
        magnitude_v=math.hypot(v1.real, v1.imag),
        filter=filtered,
        ring=ring,
        idle_ticks=0,
        raised=last.raised,
    )


def bridge(params: Params, last: Pmu, sample: Sample) -> Pmu | None:
    """The run with an estimate for the one frame missing before ``sample``; None if it is not exactly one."""
    if last.filter.frames < 3 or not is_apart(last.time_ns, sample.time_ns, 2, params.rate_hz, sample.time_base):
        return None
    theta = midpoint(last.filter.theta_rad, math.atan2(sample.v1.imag, sample.v1.real))
    filtered, ring = turn(params, last, theta)
    return last._replace(filter=filtered, ring=ring)  # slot and stamp come with ``sample``


def follows(params: Params, last: Pmu, sample: Sample, slot: int) -> bool:
    """Whether ``sample`` is the frame right after the run's newest, or the first of a run (section V.B)."""
    if last.slot is None:
        return True
    if slot != last.slot + 1:
        return False
    return is_apart(last.time_ns, sample.time_ns, 1, params.rate_hz, sample.time_base)


def update(
    params: Params, supervisor: Supervisor, site: PmuParams, last: Pmu, samples: Sequence[Sample], now_ns: int
) -> Pmu:
    """One PMU after one tick.

    Flags of frames stay up over ticks without frames; no frame is no evidence that a fault has gone.
    """
    bits = supervisor.bits
    pmu = last
    raised = 0
    taken = False
    for sample in sorted(samples, key=_stamp) if len(samples) > 1 else samples:
        if pmu.slot is not None and sample.time_ns <= pmu.time_ns:
            raised |= bits["stale_frame"]
            continue
        taken = True
        slot = slot_of(sample.time_ns, params.rate)
        if not follows(params, pmu, sample, slot):
            bridged = bridge(params, pmu, sample) if params.interpolate_single_loss else None
            raised |= bits["stamp_step" if bridged is None else "interpolated"]
            pmu = end_run(pmu) if bridged is None else bridged
        new = extend(params, pmu, sample, slot, now_ns)
        found = 0
        for bit, test in supervisor.frame_tests:
            if test(params, site, pmu, new, sample):
                found |= bit
        raised |= found
        pmu = end_run(new) if found & supervisor.disabling else new
    if not taken:
        pmu = pmu._replace(idle_ticks=pmu.idle_ticks + 1)
        raised |= last.raised & supervisor.of_frames
    for bit, test_pmu in supervisor.pmu_tests:
        if test_pmu(params, pmu, now_ns):
            raised |= bit
            if bit & supervisor.disabling:
                pmu = end_run(pmu)
    return pmu if raised == pmu.raised else pmu._replace(raised=raised)
