"""Diagnoses of clocks: the receiver's, the sender's, and what delays tell of both."""

from __future__ import annotations

import math

from pmutools.c37118.constants import Stat, TimeQuality
from pmutools.measure.clockquality import TAI_LESS_UTC_S
from pmutools.measure.delay import SECOND_WITHIN_NS
from pmutools.measure.floor import Skew, Step
from pmutools.measure.histogram import NS_PER_MS
from pmutools.measure.scene import Row, Scene, ms_text, span_text
from pmutools.timebase import NS, format_utc

GPS_LESS_UTC_S = 18
USUAL_NS = 200 * NS_PER_MS
"""What a delay may be beside a clock's whole seconds."""
SMEAR_PPM = 11.6
"""Of a leap second that is smeared over a day."""


def _receiver(scene: Scene) -> str | None:
    clock = scene.clock
    if not clock.samples or not scene.result.counts.slots.frames or (clock.bound_ns is not None and not clock.steps):
        return None
    if clock.steps:
        return (
            f"the receiver's clock was set {clock.steps} time(s), by up to {ms_text(clock.largest_step_ns, '+')}, "
            "during the run"
        )
    return clock.last.text if not clock.last.disciplined else "receiver clock not disciplined for part of the run"


def _negative(scene: Scene) -> str | None:
    delays = scene.result.counts.delays
    if not delays.negative or delays.delay.min_ns is None:
        return None
    share = delays.negative / delays.delay.count
    whose = "the sender's clock is ahead"
    if scene.clock.bound_ns is None:
        whose += ", or the receiver's, which is not disciplined, is behind"
    return (
        f"{share:.1%} of the delays are below zero, down to {ms_text(delays.delay.min_ns)}: {whose}; they are "
        "kept, and only "
        "differences of delays (PDV, IPDV) are to be trusted"
    )


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


def _locked_but_off(scene: Scene) -> str | None:
    middle = scene.middle_ns
    if middle is None or abs(middle) < 5 * NS or scene.locked_share < 0.5 or _scale(scene):
        return None
    return (
        f"time quality says locked, but the stamps are {span_text(abs(middle))} "
        f"{'behind' if middle > 0 else 'ahead of'} the "
        "receiver's clock: the sender's time quality means nothing, or the receiver's date is wrong"
    )


def _clock_off(scene: Scene) -> str | None:
    """As of :func:`_locked_but_off`, of a sender that owns up to it."""
    middle = scene.middle_ns
    if middle is None or abs(middle) < 5 * NS or scene.locked_share >= 0.5 or _scale(scene):
        return None
    off = f"{abs(middle) / NS / 3600:.2f} h" if abs(middle) >= 3600 * NS else span_text(abs(middle))
    return (
        f"the sender's clock is {off} {'behind' if middle > 0 else 'ahead'}; it says itself that it is not "
        "synchronised: its delays are its clock's error, and no wait of a concentrator helps"
    )


def _whole_second(scene: Scene) -> str | None:
    """A steady delay of whole seconds and a usual rest; below zero it can be nothing but a clock."""
    delays, middle = scene.result.counts.delays.delay, scene.middle_ns
    if middle is None or delays.min_ns is None or scene.leaps or scene.result.clock_steps or _scale(scene):
        return None
    seconds = math.floor(middle / NS + SECOND_WITHIN_NS / NS)
    rest, least = middle - seconds * NS, delays.min_ns - seconds * NS
    if not 1 <= abs(seconds) < 5 or rest > USUAL_NS or least < -SECOND_WITHIN_NS:
        return None
    way = "ahead of" if seconds < 0 else "behind"
    besides = "" if seconds < 0 else ", unless a concentrator waits so long"
    return (
        f"the delay is {middle / NS:.3f} s, a whole number of seconds ({seconds:+d}) and {ms_text(rest)}: the sender's "
        f"clock is {abs(seconds)} s {way} the receiver's, as where one of them missed a leap second{besides}"
    )


def is_off(scene: Scene) -> bool:
    """Whether delays are a clock's error, so that a longer wait is no remedy."""
    return any(test(scene) for test in (_scale, _locked_but_off, _clock_off, _whole_second))


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


def _leap(scene: Scene) -> str | None:
    counts = scene.result.counts
    steps, flagged = scene.leaps, counts.quality.leap_flagged
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


def _set(scene: Scene) -> str | None:
    """But for leap seconds, which are told as such."""
    steps = [step for step in scene.result.clock_steps if abs(abs(step.change_ns) - NS) >= SECOND_WITHIN_NS]
    if not steps:
        return None
    first = steps[0]
    return (
        f"the sender's clock was set {len(steps)} time(s), first {'ahead' if first.change_ns > 0 else 'back'} by "
        f"{span_text(abs(first.change_ns))} at {format_utc(first.at_ns)}: its stamps jumped while frames kept coming. "
        "Nothing of that is loss or a copy: slots are counted anew from there; delays before and after do not compare"
    )


def _smear(scene: Scene) -> str | None:
    skew, flagged = scene.result.floor.skew(), scene.result.counts.quality.leap_flagged
    if skew is None or not flagged or not 0.7 * SMEAR_PPM < abs(skew.ppm) < 1.4 * SMEAR_PPM:
        return None
    return (
        f"{flagged} frames carry leap flags, and the delay drifts by {skew.ppm:+.1f} ppm: the receiver's time server "
        "smears the leap second over a day, the sender does not; delays are wrong by up to 0.5 s meanwhile"
    )


def _trend(scene: Scene) -> tuple[Skew, Step] | None:
    skew, step = scene.result.floor.skew(), scene.result.floor.step()
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
        f"the least delay {way} steadily, by {ms_text(abs(moved_ns))} in {skew.span_s:.0f} s ({skew.ppm:+.1f} "
        "ppm): sender's and "
        "receiver's clocks run at different speeds; one of them is not disciplined"
    )


def _step(scene: Scene) -> str | None:
    if (trend := _trend(scene)) is None:
        return None
    skew, step = trend
    if scene.result.clock_steps or scene.leaps:
        return None  # told as such
    if abs(step.change_ns) < max(NS_PER_MS, 6 * step.noise_ns) or 2 * step.noise_ns > skew.residual_ns:
        return None
    return (
        f"the least delay changed by {ms_text(step.change_ns, '+')} near {format_utc(step.at_ns)} and stayed "
        "there: another "
        "route, another filter setting of the PMU, or a clock that was set"
    )


ROWS: tuple[Row, ...] = (
    Row("receiver-clock", "nobody bounds the receiver's clock, or it was set", _receiver),
    Row("negative-delays", "delays below zero", _negative),
    Row("tai-utc", "median delay of ±37 s or ±18 s", _scale),
    Row("locked-but-off", "MSG_TQ 0 on stamps 5 s or more from the receiver's clock", _locked_but_off),
    Row("clock-off", "stamps 5 s or more from the receiver's clock, not synchronised by their own word", _clock_off),
    Row("whole-second", "a median delay of 1 to 4 whole seconds, and up to 200 ms", _whole_second),
    Row("unsynchronised", "STAT or MSG_TQ says not synchronised, data called valid", _unsynchronised),
    Row("leap-second", "delays that jump by 1 s, or stamps that come twice under leap flags", _leap),
    Row("sender-clock-step", "stamps jump by 0.9 s and 10 periods or more while frames keep coming", _set),
    Row("leap-smear", "leap flags, and a delay that drifts by some 11.6 ppm", _smear),
    Row("clock-skew", "a slope of the delay's floor of 1 ppm or more", _skew),
    Row("latency-step", "a lasting change of the delay's floor", _step),
)
