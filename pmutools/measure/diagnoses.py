"""What is most likely wrong, in words: a table of symptoms, each with its numbers and a remedy.

A row looks at one stream's result beside the receiver's clock and the other streams, and says a sentence or nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from pmutools.c37118.constants import Stat, TimeQuality
from pmutools.flow import StampSource
from pmutools.measure.clockquality import TAI_LESS_UTC_S, ClockLog
from pmutools.measure.delay import BURST_SHARE
from pmutools.measure.floor import Skew, Step
from pmutools.measure.histogram import NS_PER_MS
from pmutools.measure.stream import SILENCE_NS, StreamResult
from pmutools.timebase import NS, format_utc

GPS_LESS_UTC_S = 18
_ENOUGH = 50
"""Fewer frames with an arrival tell nothing of delays."""


@dataclass(frozen=True)
class Scene:
    """What a diagnosis may look at."""

    result: StreamResult
    clock: ClockLog = field(default_factory=ClockLog)
    others: Sequence[StreamResult] = ()
    """All streams of the run, this one among them."""

    @property
    def middle_ns(self) -> float | None:
        """Median delay, of enough frames."""
        return _middle(self.result)

    @property
    def locked_share(self) -> float:
        delays = self.result.counts.delays
        return delays.locked.count / delays.delay.count if delays.delay.count else 0.0


Test = Callable[[Scene], str | None]


class Diagnosis(NamedTuple):
    """A finding: the row's id and its sentence."""

    id: str
    text: str


class Row(NamedTuple):
    """A symptom: what it is called, what it looks at, and the test that says it in words or returns None."""

    id: str
    sign: str
    test: Test


def _middle(result: StreamResult) -> float | None:
    delays = result.counts.delays.delay
    return delays.quantile_ns(0.5) if delays.count >= _ENOUGH else None


def _period(scene: Scene) -> str | None:
    middle, period = scene.middle_ns, scene.result.period_ns
    if middle is None or not period or middle <= 0:
        return None
    why = "the source stamps and then waits (or fills its window) before it sends; the network is not to blame"
    periods = middle / period
    floor = scene.result.counts.delays.delay.min_ns or 0
    steady = middle - floor < 0.2 * period
    if abs(periods - 1) <= 0.05 and steady:
        return f"the delay, {_ms(middle)}, is one reporting period of {_ms(period)}: {why}"
    seen = {}
    for other in scene.others:
        other_middle = _middle(other)
        if other.rate and other_middle is not None and other_middle > 0:
            seen[float(other.rate)] = other_middle / other.period_ns
    if len(seen) < 2 or not 0.4 <= periods <= 10 or max(seen) < 1.5 * min(seen):
        return None
    if max(seen.values()) > 1.1 * min(seen.values()):
        return None
    told = ", ".join(f"{count:.2f} periods at {rate:g}/s" for rate, count in sorted(seen.items()))
    return f"the delay grows with 1/Fs ({told}): {why}"


def _scale(scene: Scene) -> str | None:
    if (middle := scene.middle_ns) is None:
        return None
    for name, offset_s in (("TAI", TAI_LESS_UTC_S), ("GPS time", GPS_LESS_UTC_S)):
        if abs(abs(middle) - offset_s * NS) < NS:
            who = "the sender's stamps run on" if middle < 0 else "the receiver's clock (or phc2sys -O) runs on"
            return (
                f"the delay is {middle / NS:.2f} s, and {name} is {offset_s} s ahead of UTC: {who} {name} "
                "instead of UTC"
            )
    return None


def _leap(scene: Scene) -> str | None:
    counts = scene.result.counts
    steps, flagged = counts.delays.second_steps, counts.quality.leap_flagged
    if not steps and flagged and counts.slots.conflicting:
        return (
            f"{counts.slots.conflicting} stamps came twice, with other values, and {flagged} frames carry leap flags: "
            "an inserted leap second repeats a second of POSIX time; its frames are not lost, they count as copies"
        )
    if not steps or (steps > 10 and not flagged):
        return None
    flags = f"{flagged} frames carry leap flags" if flagged else "no frame carries a leap flag"
    return (
        f"the delay jumped by a whole second {steps} time(s) and {flags}: a leap second treated differently "
        "at both ends"
    )


def _stale(scene: Scene) -> str | None:
    slots = scene.result.counts.slots
    if not slots.stale:
        return None
    horizon = scene.result.horizon_ns / NS
    return (
        f"{slots.stale} frame(s) were stale: stamps more than {horizon:g} s from those around them; devices "
        "send an old "
        "buffer when they are started, or a store-and-forward link caught up; they are in no delay figure"
    )


def _trend(scene: Scene) -> tuple[Skew, Step] | None:
    skew, step = scene.result.course.skew(), scene.result.course.step()
    return None if skew is None or step is None else (skew, step)


def _skew(scene: Scene) -> str | None:
    if (trend := _trend(scene)) is None:
        return None
    skew, step = trend
    moved_ns = skew.ppm * 1000 * skew.span_s
    if abs(skew.ppm) < 1 or abs(moved_ns) < max(NS_PER_MS, 5 * skew.residual_ns) or skew.residual_ns > step.noise_ns:
        return None
    way = "grows" if skew.ppm > 0 else "shrinks"
    return (
        f"the least delay {way} steadily, by {_ms(abs(moved_ns))} in {skew.span_s:.0f} s ({skew.ppm:+.1f} "
        "ppm): sender's and "
        "receiver's clocks run at different speeds; one of them is not disciplined"
    )


def _step(scene: Scene) -> str | None:
    if (trend := _trend(scene)) is None:
        return None
    skew, step = trend
    if abs(step.change_ns) < max(NS_PER_MS, 6 * step.noise_ns) or 2 * step.noise_ns > skew.residual_ns:
        return None
    return (
        f"the least delay changed by {_ms(step.change_ns, '+')} near {format_utc(step.at_ns)} and stayed "
        "there: another "
        "route, another filter setting of the PMU, or a clock that was set"
    )


def _batching(scene: Scene) -> str | None:
    counts = scene.result.counts
    share = counts.quality.source_share(StampSource.KERNEL_BATCHED)
    gaps = counts.delays.interarrival.count
    bursts = counts.delays.bursts / gaps if gaps >= _ENOUGH else 0.0
    if share >= 0.05:
        return (
            f"{share:.0%} of the frames shared a TCP read with a later one: their arrival is an upper bound, up to a "
            "reporting period late; prefer UDP, TCP_NODELAY at the sender, or a capture on the wire"
        )
    if scene.result.identity.transport == "tcp" and bursts >= 0.1:
        return (
            f"{bursts:.0%} of the frames came within {BURST_SHARE:g} periods of the one before: the sender's "
            "TCP gathers "
            "frames (Nagle), or retransmissions held them up"
        )
    return None


def _own_drops(scene: Scene) -> str | None:
    counts = scene.result.counts
    if not counts.events.own_drops:
        return None
    return (
        f"this host dropped {counts.events.own_drops} datagrams at its own socket ({counts.slots.lost} frames "
        "are missing in "
        "all): no loss of the network's; raise net.core.rmem_max, or give the measurement a core of its own"
    )


def _stalls(scene: Scene) -> str | None:
    events = scene.result.counts.events
    if not events.stalls:
        return None
    return (
        f"the measuring host stood still {events.stalls} time(s), for up to {events.longest_stall_ms:.0f} ms: arrivals "
        "stamped in user space are late by that; kernel stamps are not"
    )


def _ageing(scene: Scene) -> str | None:
    result = scene.result
    if not result.identity.multicast or result.first_arrival_ns is None or result.last_arrival_ns is None:
        return None
    silences = [silence.after_ns for silence in result.silences]
    if result.silent_ns >= SILENCE_NS:
        silences.append(result.last_arrival_ns - result.first_arrival_ns)
    if not silences or not 180 * NS <= min(silences) <= 330 * NS:
        return None
    return (
        f"the multicast group fell silent {min(silences) / NS:.0f} s after the first frame; a switch that snoops IGMP "
        "forgets a group after about 260 s where no querier asks for it: enable an IGMP querier on the VLAN"
    )


def _negative(scene: Scene) -> str | None:
    delays = scene.result.counts.delays
    if not delays.negative or delays.delay.min_ns is None:
        return None
    share = delays.negative / delays.delay.count
    whose = "the sender's clock is ahead"
    if not scene.clock.last.disciplined:
        whose += ", or the receiver's, which is not disciplined, is behind"
    return (
        f"{share:.1%} of the delays are below zero, down to {_ms(delays.delay.min_ns)}: {whose}; they are "
        "kept, and only "
        "differences of delays (PDV, IPDV) are to be trusted"
    )


def _unsynchronised(scene: Scene) -> str | None:
    quality = scene.result.counts.quality
    share = quality.flag_share(Stat.NOT_SYNCHRONISED) or 0.0
    failed = quality.tq_codes.get(TimeQuality.FAILED, 0) / quality.frames if quality.frames else 0.0
    valid = 1 - quality.invalid / quality.frames if quality.frames else 0.0
    if max(share, failed) < 0.01 or valid < 0.5:
        return None
    return (
        f"the sender says it is not synchronised (STAT bit 13 in {share:.0%}, MSG_TQ F in {failed:.0%} of the "
        "frames) and yet "
        "calls its values good: they may be used, its stamps and phase angles may not; look to its GPS antenna"
    )


def _locked_but_off(scene: Scene) -> str | None:
    middle = scene.middle_ns
    if middle is None or abs(middle) < 5 * NS or scene.locked_share < 0.5 or _scale(scene):
        return None
    return (
        f"time quality says locked, but the stamps are {_span(abs(middle))} "
        f"{'behind' if middle > 0 else 'ahead of'} the "
        "receiver's clock: the sender's time quality means nothing, or the receiver's date is wrong"
    )


def _off_grid(scene: Scene) -> str | None:
    slots = scene.result.counts.slots
    if slots.frames < _ENOUGH or slots.off_grid < 0.01 * slots.frames:
        return None
    return (
        f"{slots.off_grid / slots.frames:.0%} of the stamps are not at reporting instants of "
        f"{float(scene.result.rate):g}/s: the "
        "device stamps when it sends, or its rate is not the configured one"
    )


def _rate(scene: Scene) -> str | None:
    result, slots, delays = scene.result, scene.result.counts.slots, scene.result.counts.delays
    if not result.rate:
        return "the configuration names no rate (DATA_RATE 0): losses cannot be counted"
    rate = float(result.rate)
    steps = delays.slot_steps
    if steps.count >= _ENOUGH and (step := steps.quantile(0.5) or 1) > 1 and steps.quantile(0.1) == step:
        return (
            f"frames come for every {step}th reporting instant: the device sends {rate / step:g}/s, its "
            f"configuration says {rate:g}/s"
        )
    if slots.conflicting > 0.2 * slots.frames and slots.off_grid > 0.2 * slots.frames and slots.expected:
        measured = rate * (slots.frames - slots.stale) / slots.expected
        return f"the device sends about {measured:.3g} frames/s, its configuration says {rate:g}/s"
    return None


def _two_senders(scene: Scene) -> str | None:
    slots = scene.result.counts.slots
    if slots.received < _ENOUGH or slots.replicated < 0.2 * slots.received or _rate(scene):
        return None
    kind = "with other values" if slots.conflicting > slots.duplicated / 2 else "byte for byte the same"
    return (
        f"{slots.replicated / slots.received:.0%} of the frames came more than once, {kind}: two senders (or "
        "two paths, or a "
        "mirror port) feed this stream"
    )


def _coarse(scene: Scene) -> str | None:
    result, delays = scene.result, scene.result.counts.delays
    if result.config.time_base < 10_000:
        return (
            f"TIME_BASE is {result.config.time_base}: stamps are told to {1000 / result.config.time_base:.3g} "
            "ms, and so are "
            "delays"
        )
    count = delays.delay.count
    if count >= _ENOUGH and delays.multiples.get(1_000_000, 0) >= 0.999 * count:
        unit = 10 if delays.multiples.get(10_000_000, 0) >= 0.999 * count else 1
        return (
            f"all arrivals are whole multiples of {unit} ms: who took them rounds, and delays are no better than that"
        )
    return None


def _uneven(scene: Scene) -> str | None:
    result, windows = scene.result, scene.result.counts.windows
    slots = result.counts.slots
    if windows.windows < _ENOUGH or not slots.expected:
        return None
    empty, lost = windows.empty / windows.windows, slots.lost / slots.expected
    if empty < 0.05 or windows.more < 0.03 * windows.windows or lost > empty / 2:
        return None
    return (
        f"{empty:.0%} of the control windows of {_ms(result.period_ns)} have no frame and "
        f"{windows.more / windows.windows:.0%} "
        f"have two or more, while {lost:.2%} is lost: arrival is uneven; a controller at this rate must hold "
        "its last input"
    )


def _late(scene: Scene) -> str | None:
    delays = scene.result.counts.delays
    if delays.delay.count < _ENOUGH or delays.late < 0.001 * delays.delay.count:
        return None
    most = delays.delay.quantile_ns(0.999) or 0.0
    if most > 10 * NS:
        return None  # a clock's error, told elsewhere
    return (
        f"{delays.late / delays.delay.count:.2%} of the frames came after the concentrator's wait of "
        f"{_ms(scene.result.wait_ns)}; one of {_ms(most)} would have got 99.9 % of them"
    )


def _receiver(scene: Scene) -> str | None:
    clock = scene.clock
    if not clock.samples or (clock.bound_ns is not None and not clock.steps):
        return None
    if clock.steps:
        return (
            f"the receiver's clock was set {clock.steps} time(s), by up to {_ms(clock.largest_step_ns, '+')}, "
            "during the run"
        )
    return clock.last.text if not clock.last.disciplined else "receiver clock not disciplined for part of the run"


ROWS: tuple[Row, ...] = (
    Row("receiver-clock", "nobody bounds the receiver's clock, or it was set", _receiver),
    Row("negative-delays", "delays below zero", _negative),
    Row("tai-utc", "median delay of ±37 s or ±18 s", _scale),
    Row("locked-but-off", "MSG_TQ 0 on stamps 5 s or more from the receiver's clock", _locked_but_off),
    Row("unsynchronised", "STAT or MSG_TQ says not synchronised, data called valid", _unsynchronised),
    Row("leap-second", "delays that jump by 1 s, or stamps that come twice under leap flags", _leap),
    Row("clock-skew", "a slope of the delay's floor of 1 ppm or more", _skew),
    Row("latency-step", "a lasting change of the delay's floor", _step),
    Row("delay-of-a-period", "delay of one period, or proportional to 1/Fs over the streams", _period),
    Row("stale-frames", "stamps far from those around them", _stale),
    Row("rate-mismatch", "steps of the stamps differ from 1/DATA_RATE", _rate),
    Row("off-grid", "1 % or more of the stamps off the reporting instants", _off_grid),
    Row("two-senders", "20 % or more of the frames come more than once", _two_senders),
    Row("own-drops", "the receiver's socket buffer overflowed", _own_drops),
    Row("host-stalls", "the measuring process stood still", _stalls),
    Row("multicast-ageing", "a multicast stream falls silent 180 to 330 s after its start", _ageing),
    Row("tcp-batching", "frames share a TCP read, or come in bursts over TCP", _batching),
    Row("coarse-stamps", "stamps or arrivals in whole milliseconds", _coarse),
    Row("uneven-arrival", "control windows with none and with two frames, without loss", _uneven),
    Row("late-frames", "0.1 % or more come after the wait", _late),
)


def diagnose(scene: Scene) -> list[Diagnosis]:
    """All rows that have something to say, in the table's order: clocks first, since they colour all else."""
    return [Diagnosis(row.id, text) for row in ROWS if (text := row.test(scene))]


def _ms(value_ns: float, sign: str = "") -> str:
    return f"{value_ns / NS_PER_MS:{sign}.4g} ms"


def _span(value_ns: float) -> str:
    seconds = value_ns / NS
    for unit, size in (("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"
