"""What happens to one PMU in a tick: its frames through checks and differentiator, in order of their stamps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

from dcon.core.checks import Supervisor, Tables, judge
from dcon.core.differentiator import EMPTY, Coefficients, Filter, advance, midpoint
from dcon.core.params import Params, PmuParams
from dcon.core.quick import next_frame
from dcon.core.stamps import is_apart
from dcon.core.state import UNKNOWN, Evidence, Freq, Pmu
from dcon.core.thresholds import RING_SIZE
from dcon.core.values import Sample
from pmutools.timebase import slot as slot_of

_stamp = attrgetter("time_ns")


def end_run(pmu: Pmu) -> Pmu:
    """``pmu`` with its run ended: the next good frame starts filter and ring afresh."""
    return pmu._replace(slot=None, filter=EMPTY, ring=(), freq=UNKNOWN)


def turn(params: Params, pmu: Pmu, theta_rad: float) -> tuple[Filter, tuple[float, ...]]:
    """Filter and ring of a run after one more angle."""
    filtered = advance(params.coefficients, pmu.filter, theta_rad)
    if filtered.frames < 3:
        return filtered, ()
    return filtered, (filtered.f_hz, *pmu.ring[: RING_SIZE - 1])


def smoothed(c: Coefficients, last: Freq, deviation_hz: float) -> Freq:
    """FREQ (from nominal) of one more frame through the low-pass in H(z), so that both lag alike.

    H(z) without its derivative K (1 - z⁻¹) / (1 + z⁻¹) / 2π is (b 2π / K) (1 + z⁻¹)² / (1 - a1 z⁻¹ + a2 z⁻²), K = 2 Fs.
    The first frame of a run is taken for what came before it.
    """
    if math.isnan(deviation_hz) or math.isnan(last.y1):
        return Freq(deviation_hz, deviation_hz, deviation_hz, deviation_hz)
    x1, x2, y1, y2 = last
    return Freq(deviation_hz, x1, c.low_pass * (deviation_hz + 2 * x1 + x2) + c.a1 * y1 - c.a2 * y2, y1)


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
        freq=smoothed(params.coefficients, last.freq, sample.frequency_hz - params.nominal_hz),
    )


def bridge(params: Params, last: Pmu, sample: Sample) -> Pmu | None:
    """The run with an estimate for the one frame missing before ``sample``; None if it is not exactly one."""
    if last.filter.frames < 3 or not is_apart(last.time_ns, sample.time_ns, 2, params.rate_hz, sample.time_base):
        return None
    theta = midpoint(last.filter.theta_rad, math.atan2(sample.v1.imag, sample.v1.real))
    filtered, ring = turn(params, last, theta)
    halfway_hz = (last.freq.x1 + sample.frequency_hz - params.nominal_hz) / 2
    freq = smoothed(params.coefficients, last.freq, halfway_hz)
    return last._replace(filter=filtered, ring=ring, freq=freq)  # slot and stamp come with ``sample``


def follows(params: Params, last: Pmu, sample: Sample, slot: int) -> bool:
    """Whether ``sample`` is the frame right after the run's newest, or the first of a run (section V.B)."""
    if last.slot is None:
        return True
    if slot != last.slot + 1:
        return False
    return is_apart(last.time_ns, sample.time_ns, 1, params.rate_hz, sample.time_base)


def update(
    params: Params,
    supervisor: Supervisor,
    tables: Tables,
    site: PmuParams,
    last: Pmu,
    samples: Sequence[Sample],
    now_ns: int,
    unread: int = 0,
) -> Pmu:
    """One PMU after one tick; ``unread`` frames of it could not be read.

    Flags of frames stay up over ticks without frames; no frame is no evidence that a fault has gone.
    """
    if len(samples) == 1 and tables.quick is not None and not unread:
        uneventful = next_frame(tables.quick, site.base_v, last, samples[0], now_ns)
        if uneventful is not None:
            return uneventful
    return _update(params, supervisor, tables, site, last, samples, now_ns, unread)


def _update(
    params: Params,
    supervisor: Supervisor,
    tables: Tables,
    site: PmuParams,
    last: Pmu,
    samples: Sequence[Sample],
    now_ns: int,
    unread: int,
) -> Pmu:
    bits = supervisor.bits
    pmu = last
    raised = 0
    evidence: Evidence = ()
    taken = False
    if unread:
        raised |= bits["unread_frame"]
        evidence = ((bits["unread_frame"], float(unread)),)
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
        found, held, seen = judge(tables.frame, pmu.held, (params, site, pmu, new, sample))
        raised |= found
        evidence += seen
        if held:
            new = new._replace(held=held)
        pmu = end_run(new) if found & supervisor.disabling else new
    if not taken:
        pmu = pmu._replace(idle_ticks=pmu.idle_ticks + 1)
        kept = last.raised & supervisor.of_frames
        evidence += tuple(item for item in last.evidence if item[0] & kept & ~raised)
        raised |= kept
    found, _, seen = judge(tables.pmu, (), (params, pmu, now_ns))
    if found & supervisor.disabling:
        pmu = end_run(pmu)
    return pmu._replace(raised=raised | found, evidence=evidence + seen)
