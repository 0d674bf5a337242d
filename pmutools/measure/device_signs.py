"""Diagnoses of the sender: nothing from it, stamps that do not fit its configuration, oddities of what it says."""

from __future__ import annotations

from pmutools.c37118.constants import Format, Stat, stat_trigger_reason
from pmutools.measure.scene import ENOUGH, Row, Scene, span_text
from pmutools.timebase import NS, format_utc

_ENOUGH_STEPS = 20
FROZEN_FRAMES = 10
"""So many frames in a row with one stamp are no copies any more ..."""
FROZEN_PERIODS = 5
"""... where they come over so many periods."""
CORRUPT_SHARE = 0.001
STOPPED_NS, STOPPED_PERIODS = 3 * NS, 30
NO_TIME_BASE = 0xFFFFFF
"""All bits of TIME_BASE: a default, more likely than a clock of 16.8 MHz."""


def _silent(scene: Scene) -> str | None:
    counts, identity = scene.result.counts, scene.result.identity
    if counts.slots.frames:
        return None
    came, where = counts.events, f" at {identity.where}" if identity.where else ""
    if came.before_config:
        return (
            f"{came.before_config} data frames came{where}, and no configuration that fits them: a spontaneous sender "
            "repeats its own about once a minute; wait for it, or name a recording that holds it"
        )
    if came.corrupt:
        return f"nothing but {came.corrupt} frames with a wrong CHK came{where}: look at the link"
    return (
        f"not a single frame came{where}: is the sender on, and sending to this address and port? "
        "A device answers to its own IDCODE only"
    )


def _corrupt(scene: Scene) -> str | None:
    counts = scene.result.counts
    corrupt, frames = counts.events.corrupt, counts.slots.frames
    if not frames or corrupt < CORRUPT_SHARE * (frames + corrupt):
        return None
    return (
        f"{corrupt} frames ({corrupt / (frames + corrupt):.2%}) have a wrong CHK and are taken for lost: the sender "
        "computes it wrongly, or something between (a serial link, a converter, a gateway) spoils bytes; UDP and TCP "
        "find what the network itself does"
    )


def is_frozen(scene: Scene) -> bool:
    """Whether stamps stood still while frames went on coming."""
    still, known = scene.result.standstill, scene.result.first_arrival_ns is not None
    over = FROZEN_PERIODS * scene.result.period_ns if known else 0
    return still.frames >= FROZEN_FRAMES and still.length_ns >= over


def _frozen(scene: Scene) -> str | None:
    if not is_frozen(scene):
        return None
    still = scene.result.standstill
    lasting = f" over {span_text(still.length_ns)}" if still.length_ns else ""
    return (
        f"{still.frames} frames in a row{lasting} have the same stamp, {format_utc(still.stamp_ns)}"
        f"{'' if still.ended else ', to the end'}: the sender's clock or its processing hangs and it sends on; its "
        "values are not of now, and the instants without a frame are nobody's loss on the way"
    )


def _stopped(scene: Scene) -> str | None:
    result = scene.result
    if not result.counts.slots.frames or result.silent_ns <= max(STOPPED_NS, STOPPED_PERIODS * result.period_ns):
        return None
    if is_frozen(scene) and not result.standstill.ended:
        return None
    came = result.last_arrival_ns != result.last_new_ns
    what = "what came after that was copies or old stamps" if came else "nothing came after that"
    return (
        f"it stopped {span_text(result.silent_ns)} before the end, and {what}: the sender, its "
        "link or its connection is down; it is not counted as loss"
    )


def _unwanted_rate(scene: Scene) -> str | None:
    wanted, rate = scene.result.identity.wanted_hz, scene.result.rate
    if not wanted or not rate or wanted == rate:
        return None
    return (
        f"{wanted} frames/s are expected (the initialisation file's rate), the stream's configuration says "
        f"{float(rate):g}/s: losses are counted by the latter"
    )


def _changed(scene: Scene) -> str | None:
    quality = scene.result.counts.quality
    if not quality.config_changes:
        return None
    counted = "each counted by CFGCNT" if quality.cfgcnt_changes == quality.config_changes else "CFGCNT did not tell"
    return (
        f"the configuration changed {quality.config_changes} time(s) while it ran, {counted}: channels, scales or rate "
        "are not what they were; who keeps the old one misreads the frames"
    )


def _rate(scene: Scene) -> str | None:
    result, slots, delays = scene.result, scene.result.counts.slots, scene.result.counts.delays
    if not result.rate:
        if not slots.frames:
            return None
        return "the configuration names no rate (DATA_RATE 0): losses cannot be counted"
    rate = float(result.rate)
    steps = delays.slot_steps
    if steps.count >= _ENOUGH_STEPS and (step := steps.quantile(0.5) or 1) > 1 and steps.quantile(0.1) == step:
        return (
            f"frames come for every {step}th reporting instant: the device sends {rate / step:g}/s, its "
            f"configuration says {rate:g}/s"
        )
    low, high = steps.quantile(0.1) or 1, steps.quantile(0.9) or 1
    if steps.count >= _ENOUGH_STEPS and low > 1 and high <= 2.5 * low:
        told = rate * slots.received / slots.expected
        return (
            f"hardly two reporting instants in a row are ever filled: the device sends about {told:.3g}/s, its "
            f"configuration says {rate:g}/s"
        )
    if slots.conflicting > 0.2 * slots.frames and slots.off_grid > 0.2 * slots.frames and slots.expected:
        measured = rate * (slots.frames - slots.stale) / slots.expected
        return f"the device sends about {measured:.3g} frames/s, its configuration says {rate:g}/s"
    return None


def _off_grid(scene: Scene) -> str | None:
    slots = scene.result.counts.slots
    if slots.frames < ENOUGH or slots.off_grid < 0.01 * slots.frames:
        return None
    return (
        f"{slots.off_grid / slots.frames:.0%} of the stamps are not at reporting instants of "
        f"{float(scene.result.rate):g}/s: the "
        "device stamps when it sends, or its rate is not the configured one"
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


def _two_senders(scene: Scene) -> str | None:
    slots, senders = scene.result.counts.slots, scene.result.counts.events.senders
    if senders > 1:
        return (
            f"{senders} senders feed this stream at once ({slots.conflicting} copies with other values, "
            f"{slots.duplicated - slots.conflicting} the same): tell them apart by ?source=, or give one another IDCODE"
        )
    if slots.received < ENOUGH or slots.replicated < 0.2 * slots.received or _rate(scene):
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
    if count >= ENOUGH and delays.multiples.get(1_000_000, 0) >= 0.999 * count:
        unit = 10 if delays.multiples.get(10_000_000, 0) >= 0.999 * count else 1
        return (
            f"all arrivals are whole multiples of {unit} ms: who took them rounds, and delays are no better than that"
        )
    return None


def _odd_base(scene: Scene) -> str | None:
    if scene.result.config.time_base != NO_TIME_BASE:
        return None
    return (
        "TIME_BASE is 16777215, all its bits set: reporting instants cannot be told exactly in it; stamps are taken to "
        "the nearest instant"
    )


def _trigger(scene: Scene) -> str | None:
    quality = scene.result.counts.quality
    share = quality.flag_share(Stat.TRIGGER) or 0.0
    if quality.frames < ENOUGH or share < 0.99:
        return None
    reasons = {stat_trigger_reason(word) for _, word in quality.stat if word & Stat.TRIGGER}
    why = f" (reason {', '.join(f'{int(reason):X}' for reason in sorted(reasons))})"
    return f"STAT has the trigger bit set in {share:.0%} of the frames{why}: it tells of no event, do not act on it"


def _concentrated(scene: Scene) -> str | None:
    config = scene.result.config
    blocks = [station.idcode for station in config.stations]
    if len(blocks) != 1 or blocks[0] == config.idcode:
        return None
    return (
        f"the stream is {config.idcode}, the PMU in it {blocks[0]}: a concentrator sends it, whose wait is part of the "
        "delay"
    )


def _unmasked(scene: Scene) -> str | None:
    stations = scene.result.config.stations
    words = sum(not word.valid for station in stations for word in station.digitals)
    if not words:
        return None
    return (
        f"{words} digital word(s) are sent, and DIGUNIT calls none of their bits valid: mask and labels are not kept up"
    )


def _unscaled(scene: Scene) -> str | None:
    stations = scene.result.config.stations
    integer = [station for station in stations if not station.format & Format.PHASOR_FLOAT]
    phasors = sum(not channel.phunit & 0xFFFFFF for s in integer for channel in s.phasors if channel.phscale is None)
    analogs = sum(
        bool(channel.anunit >> 24) and not channel.anunit & 0xFFFFFF
        for station in stations
        for channel in station.analogs
    )
    if not phasors and not analogs:
        return None
    told = [f"PHUNIT of {phasors} phasor(s)"] * bool(phasors) + [f"ANUNIT of {analogs} analog(s)"] * bool(analogs)
    return f"{' and '.join(told)} has the factor 0: their scale is not kept up, and their values are to be asked after"


def _idle_scale(scene: Scene) -> str | None:
    """PHUNIT's factor is to be ignored beside floats; ANUNIT's is the user's own, and 1 in the standard's example."""
    stations = scene.result.config.stations
    of_phasors = [
        channel.phunit & 0xFFFFFF
        for station in stations
        if station.format & Format.PHASOR_FLOAT
        for channel in station.phasors
        if channel.phscale is None
    ]
    of_analogs = [
        channel.anunit & 0xFFFFFF if channel.anunit & 0xFFFFFF != 1 else 0
        for station in stations
        if station.format & Format.ANALOG_FLOAT
        for channel in station.analogs
    ]
    told = [
        f"{name} of {sum(map(bool, factors))} {what}(s) ({', '.join(map(str, sorted({*factors} - {0})[:3]))})"
        for name, factors, what in (("PHUNIT", of_phasors, "phasor"), ("ANUNIT", of_analogs, "analog"))
        if any(factors)
    ]
    if not told:
        return None
    return (
        f"values are sent as floating point, and {' and '.join(told)} has a factor as for integers: it is "
        "ignored here, and who multiplies by it is wrong by that much"
    )


ROWS: tuple[Row, ...] = (
    Row("silent", "no frame at all", _silent),
    Row("stopped", "nothing new for 3 s and 30 periods at the end", _stopped),
    Row("frozen-stamp", "10 or more frames in a row with the same stamp, over 5 periods or more", _frozen),
    Row("corrupt", "0.1 % or more of the frames have a wrong CHK", _corrupt),
    Row("unexpected-rate", "another rate than the initialisation file's", _unwanted_rate),
    Row("config-changed", "another configuration while it ran", _changed),
    Row("stale-frames", "stamps far from those around them", _stale),
    Row("rate-mismatch", "steps of the stamps differ from 1/DATA_RATE", _rate),
    Row("off-grid", "1 % or more of the stamps off the reporting instants", _off_grid),
    Row("two-senders", "two at once, or 20 % or more of the frames come more than once", _two_senders),
    Row("coarse-stamps", "stamps or arrivals in whole milliseconds", _coarse),
    Row("odd-time-base", "all bits of TIME_BASE set", _odd_base),
    Row("trigger-stuck", "STAT's trigger bit in 99 % of the frames or more", _trigger),
    Row("concentrator", "the only PMU of a stream has another IDCODE", _concentrated),
    Row("unmasked-digitals", "digital words of which DIGUNIT calls no bit valid", _unmasked),
    Row("zero-scale", "PHUNIT of integer phasors, or ANUNIT of typed analogs, with factor 0", _unscaled),
)
NOTES: tuple[Row, ...] = (
    Row("idle-scale", "PHUNIT or ANUNIT of floating-point values with a factor for integers", _idle_scale, "note"),
)
