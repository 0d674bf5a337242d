"""``summary.json``: everything that was measured, under the names that scripts hold on to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from pmutools import timebase
from pmutools.measure.budget import Departures, budget
from pmutools.measure.clockquality import ClockLog, ClockQuality
from pmutools.measure.completeness import Alignment, curve
from pmutools.measure.diagnoses import diagnose
from pmutools.measure.fits import best_fit, typical
from pmutools.measure.histogram import ms
from pmutools.measure.quality import Events
from pmutools.measure.scene import Peer, Scene, peers_of
from pmutools.measure.stream import StreamCounts, StreamResult
from pmutools.measure.uncertainty import uncertainty


def summary(
    results: Sequence[StreamResult],
    clock: ClockLog,
    alignments: Sequence[Alignment] = (),
    *,
    host: Events | None = None,
    may_fit: Callable[[], bool] = lambda: True,
    departures: Sequence[Departures] | None = None,
) -> dict[str, Any]:
    """The whole, JSON-safe: ``clock``, ``streams``, ``all``. Alignments must be closed.

    Delays are fitted as long as ``may_fit`` says so: a fit takes some 25 ms. ``departures`` are what the sender's
    ledger tells, a stream each. ``host`` is what happened that belongs to no stream alone, with all drops of this
    machine's sockets: streams that share one were each told of the same drops.
    """
    peers, whole = peers_of(results), Whole()
    streams = []
    for number, result in enumerate(results):
        known = None if departures is None else departures[number]
        streams.append(stream_summary(result, clock, peers, fit=may_fit(), departures=known))
        whole.add(result)
    return {"clock": safe(clock.to_json()), "streams": streams, "all": whole.to_json(alignments, host)}


class Whole:
    """All streams together, added one by one: sums, one distribution of all delays, and the alignment of stamps."""

    def __init__(self) -> None:
        self._counts, self._streams, self._silent_ns = StreamCounts(), 0, 0

    def add(self, result: StreamResult) -> None:
        """One more stream."""
        jitter_ns = max(self._counts.delays.jitter_ns, result.counts.delays.jitter_ns)
        self._counts.merge(result.counts)
        self._counts.delays.jitter_ns = jitter_ns
        self._streams += 1
        self._silent_ns = max(self._silent_ns, result.silent_ns)

    def to_json(self, alignments: Sequence[Alignment] = (), host: Events | None = None) -> dict[str, Any]:
        """``all`` of the summary, JSON-safe."""
        counts = self._counts
        if host is not None:
            events = counts.events.plus(host)
            events.own_drops = host.own_drops
            counts = replace(counts, events=events)
        together = [alignment.to_json() for alignment in alignments]
        expected = counts.slots.expected
        return safe(
            {
                "streams": self._streams,
                **_counted(counts),
                "silent_s": self._silent_ns / timebase.NS,
                "own_drops": counts.events.own_drops,
                **_delays(counts, None),
                "per_window": counts.windows.to_json(),
                "completeness_vs_wait": together[0]["completeness_vs_wait"]
                if len(together) == 1
                else curve(counts.delays.delay, expected),
                "quality": counts.quality.to_json(expected, counts.slots.received),
                "alignment": together,
                **_more(counts),
            }
        )


def stream_summary(
    result: StreamResult,
    clock: ClockLog,
    others: Sequence[Peer] = (),
    *,
    fit: bool = True,
    departures: Departures | None = None,
) -> dict[str, Any]:
    """One stream's part; ``departures`` are what the sender's ledger tells of it."""
    counts, identity = result.counts, result.identity
    sure = uncertainty(clock.bound_ns, clock.why, counts.quality, result.period_ns)
    locked = uncertainty(clock.bound_ns, clock.why, counts.quality, result.period_ns, locked=True)
    fitted_to, of = typical(counts.delays)
    fitted = best_fit(fitted_to) if fit else None
    skew = None if result.clock_steps else result.floor.drift()
    peak = counts.delays.evenness.peak(result.period_ns)
    names = [station.name for station in result.config.stations]
    diagnoses = diagnose(Scene(result, clock, others))
    rows = budget(counts.delays.delay, counts.delays.pdv, counts.windows.to_tick, departures=departures)
    return safe(
        {
            "name": identity.name,
            "idcode": identity.idcode,
            "transport": identity.transport,
            "rate_hz": float(result.rate),
            **_counted(counts),
            "silent_s": result.silent_ns / timebase.NS,
            "own_drops": counts.events.own_drops,
            **_delays(counts, sure.bound_ns),
            "loss_runs": counts.losses.to_json(result.period_ns),
            "reordering": counts.order.to_json(),
            "per_window": counts.windows.to_json(),
            "completeness_vs_wait": curve(counts.delays.delay, counts.slots.expected),
            "quality": counts.quality.to_json(counts.slots.expected, counts.slots.received, names),
            "fit": {**fitted.to_json(), "of": of} if fitted else None,
            "diagnoses": [diagnosis._asdict() for diagnosis in diagnoses],
            # what follows may grow
            **_more(counts),
            "where": identity.where,
            "other_names": list(identity.others),
            "wait_ms": ms(result.wait_ns),
            "tmax_s": result.horizon_ns / timebase.NS,
            "uncertainty": sure.to_json(),
            "uncertainty_reason": sure.reason,
            "uncertainty_locked_ms": ms(locked.bound_ns),
            "skew_ppm": skew.ppm if skew else None,
            "delay_correlation": counts.delays.correlation,
            "periodic": {"hz": peak[0], "share": peak[1]} if peak else None,
            "allan_deviation": counts.delays.evenness.allan(result.period_ns),
            "hours": counts.hours.to_json(result.rate),
            "floor": [
                [start_ns, ms(least)]
                for start_ns, least in zip(result.floor.start_ns.tolist(), result.floor.least_ns.tolist(), strict=True)
            ],
            "silences": [
                {"after_s": silence.after_ns / timebase.NS, "length_s": silence.length_ns / timebase.NS}
                for silence in result.silences
            ],
            "clock_steps": [
                {"at": _utc(step.at_ns), "change_s": step.change_ns / timebase.NS} for step in result.clock_steps
            ],
            "first": _utc(result.first_ns),
            "last": _utc(result.last_ns),
            "one_way_ms": departures.one_way.summary_ms() if departures else None,
            "budget": [row.to_json() for row in rows],
        }
    )


def interval_summary(counts: StreamCounts, clock: ClockQuality | None = None, period_ns: float = 0.0) -> dict[str, Any]:
    """What was counted in an interval; the delays' percentiles, without fits and diagnoses.

    ``clock`` is the receiver's at its end; without it delays have no uncertainty.
    """
    bound_ns = None
    if clock is not None:
        bound_ns = uncertainty(clock.bound_ns, clock.text, counts.quality, period_ns).bound_ns
    return safe(
        {
            **_counted(counts),
            "own_drops": counts.events.own_drops,
            "per_window": counts.windows.to_json(),
            **_delays(counts, bound_ns),
            "stale": counts.slots.stale,
            "conflicting": counts.slots.conflicting,
            "negative": counts.delays.negative,
            "events": counts.events.to_json(),
        }
    )


def _counted(counts: StreamCounts) -> dict[str, Any]:
    slots = counts.slots
    return {
        "expected": slots.expected,
        "received": slots.received,
        "lost": slots.lost,
        "duplicated": slots.duplicated,
        "reordered": counts.order.reordered,
        "corrupt": counts.events.corrupt,
        "late": counts.delays.late,
        "off_grid": slots.off_grid,
    }


def _delays(counts: StreamCounts, bound_ns: int | None) -> dict[str, Any]:
    delays = counts.delays
    return {
        "delay_ms": delays.delay.summary_ms(counts.slots.lost),
        "delay_locked_ms": delays.locked.summary_ms(),
        "uncertainty_ms": ms(bound_ns),
        "interarrival_ms": delays.interarrival.summary_ms(),
        "ipdv_ms": delays.ipdv.summary_ms(),
        "pdv_ms": delays.pdv.summary_ms(),
        "jitter_rfc3550_ms": ms(delays.jitter_ns) if delays.interarrival.count else None,
    }


def _more(counts: StreamCounts) -> dict[str, Any]:
    slots, delays, windows = counts.slots, counts.delays, counts.windows
    received = slots.received or None
    return {
        "frames": slots.frames,
        "lost_own_at_most": counts.own_lost,
        "stale": slots.stale,
        "conflicting": slots.conflicting,
        "replicated_share": slots.replicated / received if received else None,
        "epochs": slots.epochs,
        "outages": slots.outages,
        "negative": delays.negative,
        "bursts": delays.bursts,
        "delay_unlocked_ms": delays.unlocked.summary_ms(),
        "owamp_jitter_ms": ms(delays.owamp_jitter_ns),
        "windows": {
            "most": windows.most,
            "empty_runs": windows.empty_runs.to_json(),
            "to_tick_ms": windows.to_tick.summary_ms(),
        },
        "rates_per_s": counts.rates.to_json(),
        "events": counts.events.to_json(),
    }


def _utc(time_ns: int | None) -> str | None:
    """ISO-8601; None for no time, and for one that no calendar has."""
    try:
        return None if time_ns is None else timebase.format_utc(time_ns)
    except OverflowError:
        return None


def safe(told: dict[str, Any]) -> dict[str, Any]:
    """JSON has neither infinity nor NaN, and keys are text."""
    return {str(key): _safe(value) for key, value in told.items()}


def _safe(value: Any) -> Any:
    if isinstance(value, dict):
        return safe(value)
    if isinstance(value, list | tuple):
        return [_safe(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
