"""Diagnoses of how frames come: late, unevenly, in lumps, or not at all, and by whose doing."""

from __future__ import annotations

from pmutools.flow import StampSource
from pmutools.measure.clock_signs import is_off
from pmutools.measure.delay import BURST_SHARE
from pmutools.measure.device_signs import is_frozen
from pmutools.measure.scene import ENOUGH, Row, Scene, ms_text, span_text
from pmutools.measure.stream import SILENCE_NS
from pmutools.timebase import NS

PAUSE_NS = NS
PERIODIC_SHARE = 0.35
"""A period that makes this much of the variance of delays is no chance."""


def _own_drops(scene: Scene) -> str | None:
    counts = scene.result.counts
    if not counts.events.own_drops:
        return None
    return (
        f"this host dropped {counts.events.own_drops} datagrams at its own socket: up to {counts.own_lost} of the "
        f"{counts.slots.lost} missing frames are no loss of the network's; raise net.core.rmem_max, or give the "
        "measurement a core of its own"
    )


def _stalls(scene: Scene) -> str | None:
    events = scene.result.counts.events
    if not events.stalls:
        return None
    return (
        f"the measuring host stood still {events.stalls} time(s), for up to {events.longest_stall_ms:.0f} ms: arrivals "
        "stamped in user space are late by that; kernel stamps are not"
    )


def _reconnects(scene: Scene) -> str | None:
    events = scene.result.counts.events
    if not events.disconnects:
        return None
    lost = scene.result.counts.slots.lost
    return (
        f"the connection was lost, or the sender began anew, {events.disconnects} time(s), and {events.connects} were "
        f"made in all; {lost} frames are missing, those of the pauses among them"
    )


def _retransmits(scene: Scene) -> str | None:
    events, received = scene.result.counts.events, scene.result.counts.slots.received
    if events.retransmits + events.out_of_order < max(3, received / 1000):
        return None
    return (
        f"{events.out_of_order} segments of TCP came while an earlier one was missing, and {events.retransmits} had to "
        "be sent again from here: the path loses packets, and TCP turns each loss into a delay of this frame and of "
        "all behind it"
    )


def _pauses(scene: Scene) -> str | None:
    result, losses = scene.result, scene.result.counts.losses
    runs = [(length, count) for length, count in losses.periods.items() if length * result.period_ns >= PAUSE_NS]
    if is_frozen(scene):
        return None  # told as such
    if runs:
        times, longest = sum(count for _, count in runs), losses.longest
        own = result.counts.own_lost
        if own >= sum(length * count for length, count in runs):
            return None  # this host's own doing, told elsewhere
        besides = f" (up to {own} of the missing frames are this host's own drops)" if own else ""
        return (
            f"{longest} frames in a row are missing ({span_text(longest * result.period_ns)}), and a second or more "
            f"{times} time(s): the sender was stopped, or the path was down{besides}"
        )
    if not result.silences:
        return None
    longest_ns = max(silence.length_ns for silence in result.silences)
    return (
        f"nothing came for up to {span_text(longest_ns)}, and hardly a frame is missing: a link that stores frames and "
        "forwards them later, or a sender that was stopped without its clock"
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


def _batching(scene: Scene) -> str | None:
    counts = scene.result.counts
    share = counts.quality.source_share(StampSource.KERNEL_BATCHED)
    gaps = counts.delays.interarrival.count
    bursts = counts.delays.bursts / gaps if gaps >= ENOUGH else 0.0
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


def _uneven(scene: Scene) -> str | None:
    result, windows = scene.result, scene.result.counts.windows
    slots = result.counts.slots
    if windows.windows < ENOUGH or not slots.expected:
        return None
    empty, lost = windows.empty / windows.windows, slots.lost / slots.expected
    if empty < 0.05 or windows.more < 0.03 * windows.windows or lost > empty / 2:
        return None
    return (
        f"{empty:.0%} of the control windows of {ms_text(result.period_ns)} have no frame and "
        f"{windows.more / windows.windows:.0%} "
        f"have two or more, while {lost:.2%} is lost: arrival is uneven; a controller at this rate must hold "
        "its last input"
    )


def _periodic(scene: Scene) -> str | None:
    delays, period_ns = scene.result.counts.delays, scene.result.period_ns
    peak = delays.evenness.peak(period_ns)
    spread = delays.pdv.quantile_ns(0.99)
    if peak is None or peak[1] < PERIODIC_SHARE or spread is None or spread < 0.02 * period_ns:
        return None
    hertz, share = peak
    return (
        f"the delay swings with a period of {1 / hertz:.2g} s, which makes {share:.0%} of its variation: a poll cycle, "
        "a scheduler or a rate that does not fit this one is on the path"
    )


def _late(scene: Scene) -> str | None:
    delays = scene.result.counts.delays
    if delays.delay.count < ENOUGH or delays.late < 0.001 * delays.delay.count:
        return None
    most = delays.delay.quantile_ns(0.999) or 0.0
    if most > 10 * NS or scene.result.clock_steps or scene.leaps or is_off(scene):
        return None  # a clock's error, told elsewhere
    return (
        f"{delays.late / delays.delay.count:.2%} of the frames came after the concentrator's wait of "
        f"{ms_text(scene.result.wait_ns)}; one of {ms_text(most)} would have got 99.9 % of them"
    )


ROWS: tuple[Row, ...] = (
    Row("own-drops", "the receiver's socket buffer overflowed", _own_drops),
    Row("host-stalls", "the measuring process stood still", _stalls),
    Row("reconnects", "a connection that was lost, a sender that began anew", _reconnects),
    Row("tcp-losses", "segments out of order or sent again: 3, and 1 of 1000 frames, or more", _retransmits),
    Row("pauses", "a second of frames in a row missing, or no arrival for 10 s", _pauses),
    Row("multicast-ageing", "a multicast stream falls silent 180 to 330 s after its start", _ageing),
    Row("tcp-batching", "frames share a TCP read, or come in bursts over TCP", _batching),
    Row("uneven-arrival", "control windows with none and with two frames, without loss", _uneven),
    Row("periodic-delay", "one period makes 35 % or more of the delay's variance within 256 frames", _periodic),
    Row("late-frames", "0.1 % or more come after the wait", _late),
)
